"""Several runs that share a work folder: each finishes, and none removes what another one reads."""

import fcntl
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from reconstruction.cache import StageStore
from reconstruction.core.types import Edge, SceneGraph
from reconstruction.leases import Leases, remove_at_once, remove_unless_leased
from synthetic.videos import short_film, write_video

pytestmark = pytest.mark.stage

ROOT = Path(__file__).resolve().parents[2]
GRAPH = SceneGraph(edges=(Edge(1, "supported_by", 0, 1.0, ""),))
# Waits until all processes are there, so that they meet.
START = """
import json, random, sys, time
from pathlib import Path
def meet(folder, name, count, timeout=120):
    (folder / f"at-{name}").touch()
    while len(list(folder.glob("at-*"))) < count and timeout > 0:
        time.sleep(0.005); timeout -= 0.005
work, here, number, count = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
"""
RUN = """
from reconstruction.cache import StageStore
from reconstruction.config import PipelineConfig
from reconstruction.runner import Run
film = Path(sys.argv[5])
config = PipelineConfig()
if number >= count // 2:
    config = config.with_option(f"frames.max_keyframes={40 + number}")
meet(here, number, count)
run = Run(film, config, StageStore(work, 1))
run.execute(until="frames")
meet(here, f"done-{number}", 2 * count)
again = run.store.load(type(run.results["frames"]), 1, "frames", run.keys["frames"])
print(json.dumps({"key": run.keys["frames"], "sum": int(again.images.sum())}))
"""
STORE = """
from reconstruction.cache import StageStore
from reconstruction.core.types import Edge, SceneGraph
store, dice = StageStore(work, 1), random.Random(number)
meet(here, number, count)
for _ in range(60):
    key = dice.randrange(4)
    graph = SceneGraph(edges=(Edge(key, "supported_by", 0, 1.0, "x" * 5000),))
    if not store.has(10, "scene_graph", f"k{key}"):
        store.save(graph, 10, "scene_graph", f"k{key}", {"key": key})
    store.check(10, "scene_graph", f"k{key}")
    assert store.load(SceneGraph, 10, "scene_graph", f"k{key}") == graph
    assert store.manifest(10, "scene_graph", f"k{key}") == {"key": key}
    time.sleep(0.002 * dice.random())
    StageStore(work, 1)  # sweeps
print("{}")
"""


def together(code: str, work: Path, here: Path, *arguments: object, count: int = 4) -> list[dict]:
    """Run a program in several processes at once; return the JSON that each prints."""
    here.mkdir()
    command = [sys.executable, "-c", START + code, work, here]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    started = [
        subprocess.Popen([*command, str(number), str(count), *arguments], cwd=ROOT, text=True, **pipes)
        for number in range(count)
    ]
    out = []
    for process in started:
        stdout, stderr = process.communicate(timeout=300)
        assert process.returncode == 0, stderr
        out.append(json.loads(stdout))
    return out


def test_four_runs_of_one_video_all_finish(tmp_path):
    film = tmp_path / "film.mp4"
    write_video(film, short_film(24))
    found = together(RUN, tmp_path / "work", tmp_path / "here", film)
    assert len({one["key"] for one in found}) == 3  # two runs share their options
    assert found[0] == found[1]
    assert all(one["sum"] > 0 for one in found)
    assert not list((tmp_path / "work").glob("tmp-*"))


def test_stores_that_save_prune_and_read_at_once_lose_nothing(tmp_path):
    together(STORE, tmp_path / "work", tmp_path / "here")
    assert not list((tmp_path / "work").glob("tmp-*"))


def test_a_finished_result_of_another_run_is_kept(tmp_path):
    first, second = StageStore(tmp_path), StageStore(tmp_path)
    first.save(GRAPH, 10, "scene_graph", "k", {"by": 1})
    inode = (tmp_path / "10_scene_graph-k").stat().st_ino
    second.save(GRAPH, 10, "scene_graph", "k", {"by": 2})
    assert (tmp_path / "10_scene_graph-k").stat().st_ino == inode
    assert second.manifest(10, "scene_graph", "k") == {"by": 1}


def test_a_result_that_another_run_puts_in_place_meanwhile_is_kept(tmp_path, monkeypatch):
    first, second = StageStore(tmp_path), StageStore(tmp_path)
    is_here, asked = second._is_here, []

    def too_early(*result):
        if not asked:
            asked.append(result)
            first.save(GRAPH, 10, "scene_graph", "k", {"by": 1})
            return False
        return is_here(*result)

    monkeypatch.setattr(second, "_is_here", too_early)
    second.save(GRAPH, 10, "scene_graph", "k", {"by": 2})
    assert second.manifest(10, "scene_graph", "k") == {"by": 1}
    first.check(10, "scene_graph", "k")


def test_a_result_is_put_in_place_of_one_that_another_run_is_about_to_remove(tmp_path):
    """The other run holds the lock of removal for a while before the folder is gone."""
    first, second = StageStore(tmp_path), StageStore(tmp_path)
    first.save(GRAPH, 10, "scene_graph", "k", {"by": 1})
    del first
    folder = tmp_path / "10_scene_graph-k"
    descriptor = os.open(folder, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def remove() -> None:
        time.sleep(0.3)
        remove_at_once(folder)
        os.close(descriptor)

    remover = threading.Thread(target=remove)
    remover.start()
    second.save(GRAPH, 10, "scene_graph", "k", {"by": 2})
    remover.join()
    assert second.manifest(10, "scene_graph", "k") == {"by": 2}
    second.check(10, "scene_graph", "k")


def test_a_result_in_use_is_not_pruned_and_goes_once_it_is_free(tmp_path):
    reader, writer = StageStore(tmp_path, 1), StageStore(tmp_path, 1)
    writer.save(GRAPH, 10, "scene_graph", "used", {})
    assert reader.has(10, "scene_graph", "used")
    writer.save(GRAPH, 10, "scene_graph", "new", {})
    assert reader.load(SceneGraph, 10, "scene_graph", "used") == GRAPH
    del reader
    writer.save(GRAPH, 10, "scene_graph", "newer", {})
    assert [p.name for p in tmp_path.iterdir()] == ["10_scene_graph-newer"]


def test_a_temporary_folder_in_use_is_not_swept_whatever_its_number(tmp_path):
    store = StageStore(tmp_path)
    scratch = store.scratch("poses")
    assert f"-{os.getpid()}-" in scratch.name
    StageStore(tmp_path)  # the same process number, as in two containers with one work folder
    assert scratch.is_dir()
    store.discard(scratch)
    assert not list(tmp_path.iterdir())


def test_a_folder_is_locked_by_what_it_is_and_not_by_its_name(tmp_path):
    leases, folder = Leases(), tmp_path / "a"
    folder.mkdir()
    assert leases.take("one", folder)
    folder = folder.rename(tmp_path / "b")
    assert not remove_unless_leased(folder)
    assert leases.take("one", folder), "taking it again is fine"
    leases.release_all()
    assert remove_unless_leased(folder)
    assert not leases.take("one", folder)
    assert remove_unless_leased(folder), "what is gone is gone"
