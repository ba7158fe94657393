"""The usage meter measures what is known to have been used, in this process and in others."""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from reconstruction.core.profiling import UsageMeter
from reconstruction.costs import cost_rows, costs_json, describe_costs

pytestmark = pytest.mark.stage

ROOT = Path(__file__).resolve().parents[2]
_MB = 2**20
# A child that touches a known amount of memory, burns a known amount of CPU time, and ends.
_CHILD = """
import sys, time
held = bytearray(b'x') * (int(sys.argv[1]) * 2**20)
time.sleep(float(sys.argv[2]))
while time.process_time() < float(sys.argv[3]):
    pass
"""


def _child(megabytes: int, seconds: float, cpu_s: float = 0.0) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-c", _CHILD, str(megabytes), str(seconds), str(cpu_s)])


def _resident_mb() -> float:
    """Return the memory of this process and of its children, such as a fork server that an earlier test started."""
    import psutil

    process = psutil.Process()
    children = [child.memory_full_info().uss for child in process.children(recursive=True)]
    return (process.memory_info().rss + sum(children)) / _MB


@pytest.mark.skipif(sys.platform != "linux", reason="the high-water mark is Linux's")
def test_memory_of_this_process_is_seen_even_between_two_samples():
    # In a new process, whose high-water mark no earlier test has raised; the memory is freed within milliseconds.
    code = """
import mmap, psutil
from reconstruction.core.profiling import UsageMeter
before = psutil.Process().memory_info().rss
with UsageMeter() as meter:
    held = mmap.mmap(-1, 300 * 2**20, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | mmap.MAP_POPULATE)
    held.close()
print(meter.usage.peak_memory_mb - before / 2**20)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert 295 < float(done.stdout) < 330


def test_memory_of_a_child_counts_while_it_lives():
    before = _resident_mb()
    with UsageMeter() as meter:
        _child(200, 0.4).wait()
    assert before + 195 < meter.usage.peak_memory_mb < before + 260


def test_children_at_the_same_time_add_up_and_one_after_the_other_do_not():
    before = _resident_mb()
    with UsageMeter() as together:
        for child in [_child(100, 0.8), _child(100, 0.8)]:
            child.wait()
    with UsageMeter() as apart:
        for _ in range(2):
            _child(100, 0.3).wait()
    assert together.usage.peak_memory_mb > before + 195
    assert apart.usage.peak_memory_mb < before + 170


def test_memory_of_a_grandchild_counts():
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {_CHILD!r}, '150', '0.4', '0'])"
    before = _resident_mb()
    with UsageMeter() as meter:
        subprocess.run([sys.executable, "-c", code], check=True)
    assert meter.usage.peak_memory_mb > before + 145


@pytest.mark.skipif(sys.platform != "linux", reason="fork shares pages")
def test_pages_shared_by_a_fork_count_once():
    held = np.ones(200 * _MB, np.uint8)
    code = "import os, time; pid = os.fork(); time.sleep(0.4); pid and os.waitpid(pid, 0)"
    before = _resident_mb()
    with UsageMeter() as meter:
        # The child holds 200 MB and forks: two processes, one set of pages.
        subprocess.run([sys.executable, "-c", f"held = bytearray(b'x') * (200 * 2**20); {code}"], check=True)
    assert held[0] == 1
    assert meter.usage.peak_memory_mb < before + 300


def test_cpu_time_of_children_that_ended_and_that_still_run():
    with UsageMeter() as ended:
        _child(1, 0.0, 0.5).wait()
    assert 0.45 < ended.usage.cpu_s < 1.2
    child = _child(1, 0.0, 60.0)
    try:
        time.sleep(0.5)  # What it used before the body runs is not the body's.
        with UsageMeter() as running:
            until = time.perf_counter() + 1.0
            while time.perf_counter() < until:
                time.sleep(0.05)
    finally:
        child.kill()
        child.wait()
    assert 0.2 < running.usage.cpu_s < 1.3
    assert 0.95 < running.usage.wall_s < 2.0


def _report() -> dict:
    return {
        "timings_s": {"publish": 1.0, "depth": 20.0, "frames": 2.0, "other": 0.5},
        "peak_memory_mb": 2048.0,
        "volatile": {
            "cpu_s": {"frames": 2.0, "depth": 30.0, "publish": 1.0},
            "stage_peak_memory_mb": {"frames": 512.0, "depth": 2048.0, "publish": 700.0},
            "cached": ["frames"],
        },
    }


def test_costs_are_told_in_the_order_of_the_run_with_their_total():
    report = _report()
    assert [row.name for row in cost_rows(report)] == ["frames", "depth", "publish", "other"]
    lines = describe_costs(report).splitlines()
    assert lines[1].split() == ["frames", "2.0", "2.0", "1.0", "0.50", "from", "the", "cache"]
    assert lines[2].split() == ["depth", "20.0", "30.0", "1.5", "2.00"]
    assert lines[4].split() == ["other", "0.5", "-", "-", "-"]
    assert lines[-1].split() == ["total", "23.5", "33.0", "1.4", "2.00"]
    assert costs_json(report)["depth"] == {
        "wall_s": 20.0,
        "cpu_s": 30.0,
        "peak_memory_mb": 2048.0,
        "cached": False,
    }


def test_costs_of_a_bundle_of_an_earlier_version_are_shown_as_far_as_known():
    report = {"timings_s": {"frames": 2.0, "mystery": 1.0}, "peak_memory_mb": None}
    lines = describe_costs(report).splitlines()
    assert lines[1].split() == ["frames", "2.0", "-", "-", "-"]
    assert lines[2].split()[0] == "mystery"
    assert lines[-1].split() == ["total", "3.0", "-", "-", "-"]
