"""The engine on Ray: a local one whose worker is killed, and a cluster of two nodes, one of them with a full disk."""

import os
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from reconstruction.batch.attempt import Job
from reconstruction.batch.display import QuietDisplay
from reconstruction.batch.driver import Driver, Policy, Task
from reconstruction.batch.engines import Resources, load_engine
from reconstruction.batch.journal import Journal
from registry import SceneRegistry
from registry.errors import EnvironmentMissing
from synthetic.videos import write_not_a_video

pytestmark = pytest.mark.stage
ROOT = Path(__file__).resolve().parents[3]


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(EnvironmentMissing, match=r"simrecon\[ray\]"):
        load_engine("ray", Resources())


@pytest.fixture
def ray(monkeypatch):
    """Ray, whose workers import this tree."""
    module = pytest.importorskip("ray", reason="pip install 'simrecon[ray]'")
    monkeypatch.setenv(
        "PYTHONPATH", os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    )
    yield module
    module.shutdown()


def job(name: str, home: Path, **changes) -> Job:
    film = home / f"{name}.mp4"
    write_not_a_video(film)
    values = {"cores": 1, "memory_mb": 100, **changes}
    return Job(
        name, "f", (str(film), "--scene", name), home / "registry", home / "logs" / f"{name}.log", **values
    )


def processes(name: str) -> list[psutil.Process]:
    found = psutil.Process().children(recursive=True)
    return [p for p in found if name in " ".join(p.cmdline())]


def test_a_killed_worker_is_transient_and_takes_its_video_with_it(ray, tmp_path):
    engine = load_engine("ray", Resources(cores=1))
    try:
        first = job("a", tmp_path)
        assert engine.room(first)
        engine.start(first)
        assert not engine.room(job("b", tmp_path))
        end = time.monotonic() + 60
        while not (children := processes("reconstruction.batch.child")) and time.monotonic() < end:
            time.sleep(0.1)
        (worker,) = processes("ray::simrecon")
        worker.kill()
        ended = []
        while not ended and time.monotonic() < end + 60:
            ended = engine.finished(1.0)
        assert (ended[0][1].kind, ended[0][1].transient) == ("killed", True)
        psutil.wait_procs(children, timeout=20)
        assert not [p for p in children if p.is_running() and p.status() != psutil.STATUS_ZOMBIE]
        engine.start(first)
        ended = []
        while not ended and time.monotonic() < end + 180:
            ended = engine.finished(1.0)
        assert ended[0][1].kind == "video"
    finally:
        engine.close()


@pytest.mark.skipif(
    os.geteuid() != 0 or sys.platform != "linux", reason="mounting a small disk needs root on Linux"
)
def test_a_machine_with_a_full_disk_fails_over_to_another(ray, tmp_path):
    from ray.cluster_utils import Cluster

    full, roomy = tmp_path / "full", tmp_path / "roomy"
    full.mkdir()
    roomy.mkdir()
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", full], capture_output=True
    ).returncode:
        pytest.skip("no tmpfs can be mounted here")
    cluster = Cluster()
    try:
        for disk in (full, roomy):
            cluster.add_node(num_cpus=1, env_vars={"SCRATCH": str(disk)}, include_dashboard=False)
        engine = load_engine("ray", Resources(at_once=2, address=cluster.address))
        journal, names = Journal(tmp_path), "abcd"
        jobs = [job(name, tmp_path, work_dir="$SCRATCH/work", memory_mb=0) for name in names]
        with journal.held():
            driver = Driver(
                journal, engine, SceneRegistry(tmp_path / "registry"), QuietDisplay(), Policy(2, 0.1)
            )
            summary = driver.run([Task(one, one.scene_id) for one in jobs])
    finally:
        ray.shutdown()
        cluster.shutdown()
        subprocess.run(["umount", full], check=True)
    assert (summary.failed, summary.waiting, summary.trouble) == (4, 0, "")
    ends = [e for e in journal.events() if e["event"] == "ended"]
    assert {e["kind"] for e in ends if e["result"] == "failed"} == {"video"}, ends
    retried = [e for e in ends if e["result"] == "retry"]
    assert retried
    assert {e["kind"] for e in retried} == {"disk"}
    assert len(retried) <= 4, "a job may meet the full disk once"
