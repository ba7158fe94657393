"""Attempts in processes of their own: real command lines that fail, are killed, are stopped, or lose their parent."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest

from reconstruction.batch.attempt import Job, run_attempt, stage_number, stage_of
from reconstruction.batch.engines import Resources, load_engine
from synthetic.videos import write_empty, write_not_a_video

pytestmark = pytest.mark.stage
ROOT = Path(__file__).resolve().parents[3]


def job(video: Path, home: Path, **changes) -> Job:
    arguments = (str(video), "--scene", video.stem, "--preset", "fast")
    values = {
        "registry": home / "registry",
        "log": home / "logs" / f"{video.stem}.log",
        "cores": 1,
        **changes,
    }
    return Job(video.stem, "f", arguments, **values)


def children(pid: int | None = None) -> list[psutil.Process]:
    found = psutil.Process(pid).children(recursive=True)
    return [p for p in found if "reconstruction.batch.child" in " ".join(p.cmdline())]


def wait_for(condition, seconds: float = 60.0):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if found := condition():
            return found
        time.sleep(0.05)
    raise AssertionError("it did not happen")


def test_a_film_that_cannot_be_reconstructed_says_why_and_leaves_nothing(tmp_path):
    write_empty(tmp_path / "film.mp4")
    outcome = run_attempt(job(tmp_path / "film.mp4", tmp_path))
    assert (outcome.kind, outcome.exit_code) == ("video", 3)
    assert "empty" in outcome.cause
    assert outcome.cure
    assert outcome.peak_memory_mb > 20
    assert outcome.wall_s > 0.1
    assert children() == []


def test_a_wrong_row_is_the_rows_fault(tmp_path):
    outcome = run_attempt(job(tmp_path / "gone.mp4", tmp_path))
    assert outcome.kind == "usage"


def test_a_killed_process_touches_one_video_and_is_transient(tmp_path):
    for name in ("a", "b"):
        write_not_a_video(tmp_path / f"{name}.mp4")
    engine = load_engine("local", Resources(at_once=2))
    jobs = [job(tmp_path / f"{name}.mp4", tmp_path) for name in ("a", "b")]
    assert engine.room(jobs[0])
    for one in jobs:
        engine.start(one)
    victim = wait_for(lambda: [p for p in children() if str(tmp_path / "a.mp4") in p.cmdline()])[0]
    victim.kill()
    outcomes = {}
    end = time.monotonic() + 120
    while len(outcomes) < 2 and time.monotonic() < end:
        outcomes |= {one.scene_id: outcome for one, outcome in engine.finished(1.0)}
    engine.close()
    assert (outcomes["a"].kind, outcomes["a"].transient) == ("killed", True)
    assert outcomes["b"].kind == "video"


def test_a_stopped_attempt_ends_soon_and_counts_as_interrupted(tmp_path):
    write_not_a_video(tmp_path / "film.mp4")
    stop = threading.Event()
    threading.Timer(0.5, stop.set).start()
    outcome = run_attempt(job(tmp_path / "film.mp4", tmp_path), stop)
    assert outcome.kind == "interrupted"
    assert children() == []


@pytest.mark.parametrize(
    ("limit", "kind"), [({"time_limit_s": 0.4}, "time"), ({"memory_limit_mb": 20}, "memory")]
)
def test_a_limit_ends_the_attempt(tmp_path, limit, kind):
    write_not_a_video(tmp_path / "film.mp4")
    outcome = run_attempt(job(tmp_path / "film.mp4", tmp_path, **limit))
    assert outcome.kind == kind
    assert children() == []


def test_a_log_that_cannot_be_written_is_the_machines_fault(tmp_path):
    (tmp_path / "file").write_text("")
    outcome = run_attempt(job(tmp_path / "x.mp4", tmp_path, log=tmp_path / "file" / "x.log"))
    assert outcome.kind == "machine"
    assert "file" in outcome.cause


def test_the_process_of_a_video_ends_when_its_parent_is_killed(tmp_path):
    write_not_a_video(tmp_path / "film.mp4")
    code = (
        "import sys\nfrom pathlib import Path\nfrom reconstruction.batch.attempt import Job, run_attempt\n"
        "home = Path(sys.argv[1])\n"
        "run_attempt(Job('film', 'f', (str(home / 'film.mp4'), '--scene', 'film'), home / 'registry', home / 'log'))"
    )
    parent = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], cwd=ROOT)
    child = wait_for(lambda: children(parent.pid))[0]
    wait_for(lambda: child.num_threads() > 1)  # it watches its parent
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    wait_for(lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE, 20.0)


def test_the_stage_of_a_running_video_is_read_from_its_log(tmp_path):
    log = tmp_path / "log"
    assert (stage_of(log), stage_number(log)) == ("", 0)
    log.write_text("[1/10] frames: 0.7 s\n[2/10] poses: ...\n[2/10] poses: note: x\n")
    assert (stage_of(log), stage_number(log)) == ("2/10 poses", 2)


@pytest.mark.skipif(
    os.geteuid() != 0 or sys.platform != "linux", reason="mounting a small disk needs root on Linux"
)
def test_a_full_disk_is_said_to_be_one(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    write_not_a_video(tmp_path / "film.mp4")
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", disk], capture_output=True)
    if mounted.returncode:
        pytest.skip("no tmpfs can be mounted here")
    try:
        outcome = run_attempt(job(tmp_path / "film.mp4", tmp_path, work_dir=str(disk / "work")))
    finally:
        subprocess.run(["umount", disk], check=True)
    assert (outcome.kind, outcome.transient) == ("disk", True)
    assert "GB free" in outcome.cause
    assert "--work-dir" in outcome.cause + outcome.cure
