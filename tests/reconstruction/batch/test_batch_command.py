"""`simrecon batch` as a user meets it: plan, run, run again, interrupt, kill -9 of the driver."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import fsspec
import pytest

from benchmarks.batch import CHEAP
from reconstruction.batch.journal import Journal
from registry import SceneRegistry
from synthetic.videos import standard_film, write_black, write_empty, write_not_a_video, write_video

ROOT = Path(__file__).resolve().parents[3]
pytestmark = pytest.mark.stage


def command(films: Path | str, home: Path, *flags: object) -> list[str]:
    line = [sys.executable, "-m", "reconstruction.cli", "batch", films, "--registry", home / "registry"]
    return [*map(str, line), "--out", str(home / "out"), "--memory", "0.5", "--cores", "1", *map(str, flags)]


def batch(films: Path | str, home: Path, *flags: object) -> subprocess.CompletedProcess:
    line = command(films, home, *flags)
    return subprocess.run(line, capture_output=True, text=True, cwd=ROOT, timeout=900)


@pytest.fixture
def broken(tmp_path) -> Path:
    folder = tmp_path / "films"
    folder.mkdir()
    write_empty(folder / "empty.mp4")
    write_not_a_video(folder / "list.mp4")
    return folder


def test_a_dry_run_changes_nothing(broken, tmp_path):
    done = batch(broken, tmp_path, "--dry-run")
    assert done.returncode == 0, done.stderr
    assert "2 videos: 2 would run" in done.stdout
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "registry").exists()


def test_a_bad_list_runs_nothing(broken, tmp_path):
    (broken / "list.csv").write_text("path,id\nempty.mp4,A B\nno.mp4,\n")
    done = batch(broken / "list.csv", tmp_path)
    assert done.returncode == 2
    assert "2 problems, nothing was run" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (("--at-once", "-1"), "--at-once -1"),
        (("--memory", "nan"), "--memory"),
        (("--drop-work",), "needs --work-dir"),
        (("--address", "auto"), "needs --engine ray"),
        (("--engine", "nope"), "there are local, ray"),
        (("--set", "depth.zzz=1"), "no option 'zzz'"),
    ],
)
def test_wrong_use_is_said_in_lines(broken, tmp_path, flags, says):
    done = batch(broken, tmp_path, *flags)
    assert done.returncode == 2
    assert says in done.stderr
    assert "Traceback" not in done.stderr


def test_failures_are_in_table_and_page_and_a_second_run_does_nothing(broken, tmp_path):
    done = batch(broken, tmp_path)
    assert done.returncode == 3, done.stderr
    assert "2 videos: 0 published, 2 failed, 0 not ended" in done.stdout
    events = Journal(tmp_path / "out").events()
    assert [e["event"] for e in events].count("ended") == 2
    page = (tmp_path / "out" / "index.html").read_text()
    assert "is empty (0 bytes)" in page
    assert "is empty (0 bytes)" in (tmp_path / "out" / "results.csv").read_text()
    again = batch(broken, tmp_path)
    assert again.returncode == 3
    assert "nothing to do" in again.stdout
    assert Journal(tmp_path / "out").events() == events
    write_black(broken / "empty.mp4")  # another film under the old name
    third = batch(broken, tmp_path)
    assert third.stderr.startswith("[0/1] empty: started")
    assert len(Journal(tmp_path / "out").events()) == len(events) + 3


def test_an_interrupt_and_a_kill_of_the_driver_lose_nothing(broken, tmp_path):
    for number in range(2):
        write_not_a_video(broken / f"more{number}.mp4")
    for kill in (signal.SIGINT, signal.SIGKILL):
        driver = subprocess.Popen(command(broken, tmp_path), stderr=subprocess.PIPE, text=True, cwd=ROOT)
        for line in driver.stderr:
            if "started" in line:
                break
        time.sleep(0.5)
        driver.send_signal(kill)
        driver.communicate(timeout=120)
        assert driver.returncode == (130 if kill == signal.SIGINT else -signal.SIGKILL)
    done = batch(broken, tmp_path)
    assert "4 videos: 0 published, 4 failed, 0 not ended" in done.stdout
    ends = [
        e["scene"]
        for e in Journal(tmp_path / "out").events()
        if e["event"] == "ended" and e["result"] == "failed"
    ]
    assert sorted(ends) == sorted({*ends})
    assert len(ends) == 4


def test_films_and_lists_at_an_address(s3, broken, tmp_path):
    write_black(broken / "black.mp4")
    (broken / "list.csv").write_text("path,id\nempty.mp4,nothing\n../films/list.mp4,text\nno.mp4,gone\n")
    bucket = fsspec.filesystem("s3", use_listings_cache=False)
    bucket.put(str(broken), "lab/films", recursive=True)
    done = batch("s3://lab/films", tmp_path, "--dry-run")
    assert "3 videos: 3 would run" in done.stdout, done.stderr
    assert "left out, no video: list.csv" in done.stdout
    done = batch("s3://lab/films/list.csv", tmp_path)
    assert done.returncode == 2
    assert "line 4, path" in done.stderr
    assert "1 problem, nothing was run" in done.stderr
    bucket.pipe_file("lab/films/list.csv", b"path\nempty.mp4\nlist.mp4\nblack.mp4\n")
    done = batch("s3://lab/films/list.csv", tmp_path, "--work-dir", "s3://lab/work")
    assert done.returncode == 3, done.stderr
    states = Journal(tmp_path / "out").states()
    assert {name: state.kind for name, state in states.items()} == dict.fromkeys(
        ("empty", "list", "black"), "video"
    )
    assert states["black"].video == "s3://lab/films/black.mp4"
    assert "nothing to do" in batch("s3://lab/films/list.csv", tmp_path, "--work-dir", "s3://lab/work").stdout
    bucket.pipe_file("lab/films/empty.mp4", b"no longer empty")
    done = batch("s3://lab/films/list.csv", tmp_path, "--work-dir", "s3://lab/work", "--dry-run")
    assert "1 would run" in done.stdout


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("s3://lab/nothing", "no such file or folder"),
        ("s3://nobody-made-this/films", "no such file or folder"),
        ("s3://key:secret@lab/films", "no user, password"),
        ("nope://lab/films", "Protocol not known"),
    ],
)
def test_an_address_without_films_is_one_line(s3, tmp_path, address, says):
    done = batch(address, tmp_path)
    assert done.returncode == 2, done.stderr
    assert says in done.stderr
    assert "secret" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr


@pytest.mark.end_to_end
def test_a_film_is_published_with_report_and_figures(s3, tmp_path):
    films = tmp_path / "films"
    films.mkdir()
    write_video(films / "room.mp4", standard_film()[::3])
    write_empty(films / "empty.mp4")
    flags = [flag for option in CHEAP for flag in ("--set", option)]
    done = batch(films, tmp_path, "--preset", "fast", "--work-dir", "s3://lab/work", *flags)
    assert done.returncode == 3, done.stderr
    registry = SceneRegistry(tmp_path / "registry")
    assert list(registry.revisions()) == ["room"]
    assert registry.verify("room").ok
    out = tmp_path / "out"
    assert (out / "reports" / "room.html").stat().st_size > 100_000
    assert (out / "previews" / "room.jpg").is_file()
    assert 'href="reports/room.html"' in (out / "index.html").read_text()
    before = registry.revisions()
    again = batch(films, tmp_path, "--preset", "fast", *flags)
    assert "nothing to do" in again.stdout
    registry.remove("room")
    third = batch(films, tmp_path, "--preset", "fast", *flags)
    assert "1 published" in third.stdout
    assert registry.revisions() == before
    (state,) = [s for s in Journal(out).states().values() if s.result == "published"]
    assert json.loads((registry.get("room").path / "scene.json").read_text())["id"] == state.scene_id
    assert os.environ.get("SIMRECON_HOME") != str(tmp_path)
    # Another machine, that has neither the film nor a stage result, computes nothing again.
    fsspec.filesystem("s3").put(str(films / "room.mp4"), "lab/films/room.mp4")
    line = [
        sys.executable,
        "-m",
        "reconstruction.cli",
        "reconstruct",
        "s3://lab/films/room.mp4",
        "--scene",
        "room",
    ]
    line += [
        "--registry",
        str(tmp_path / "other" / "registry"),
        "--work-dir",
        "s3://lab/work",
        "--preset",
        "fast",
        *flags,
    ]
    home = {**os.environ, "SIMRECON_HOME": str(tmp_path / "other")}
    done = subprocess.run(line, capture_output=True, text=True, cwd=ROOT, timeout=900, env=home)
    assert done.returncode == 0, done.stderr
    other = SceneRegistry(tmp_path / "other" / "registry")
    assert other.revisions() == before
    stages = other.load("room").scene["report"]["volatile"]["cached"]
    assert {"frames", "poses", "depth", "gaussians", "surface", "instances", "assets", "assembly"} <= set(
        stages
    )
