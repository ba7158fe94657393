"""The kernels' timing: what counts as slower, and that every kernel runs."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.perf.ratios import BASELINE, complain

pytestmark = pytest.mark.stage

ROOT = Path(__file__).resolve().parents[2]
STORED = {"tolerance": 1.5, "ratios": {"sgm": 2.0}}


@pytest.mark.parametrize(("ratio", "fails"), [(1.0, False), (2.9, False), (3.1, True)])
def test_a_kernel_fails_when_it_became_half_as_slow_again(ratio, fails):
    assert bool(complain("sgm", ratio, STORED)) == fails


def test_the_complaint_says_how_much_and_what_to_do():
    text = complain("sgm", 4.0, STORED)
    assert "2.00 times the stored" in text
    assert "--save" in text
    assert "no stored ratio" in complain("new_kernel", 1.0, STORED)


def test_every_kernel_has_a_stored_ratio():
    source = (BASELINE.parent / "test_kernels.py").read_text()
    kernels = set(re.findall(r"^def test_(\w+)\(", source, re.MULTILINE))
    stored = json.loads(BASELINE.read_text())
    assert set(stored["ratios"]) == kernels
    assert stored["tolerance"] == 1.5


@pytest.mark.end_to_end
def test_every_kernel_runs_and_a_slower_one_fails(tmp_path):
    line = [sys.executable, "-m", "benchmarks.perf", "--rounds", "3"]
    # Within a worker of pytest-xdist, pytest-benchmark does not measure.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_XDIST")}
    done = subprocess.run(line, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout
    for name in json.loads(BASELINE.read_text())["ratios"]:
        assert re.search(rf"^{name} +\d", done.stdout, re.MULTILINE), done.stdout
    # Against a baseline in which it once was much faster, a kernel fails, and the others are not blamed.
    stored = json.loads(BASELINE.read_text())
    stored["ratios"] = {name: 100 * ratio for name, ratio in stored["ratios"].items()} | {"sgm": 0.01}
    (tmp_path / "baseline.json").write_text(json.dumps(stored))
    done = subprocess.run(
        [*line, "--compare", "-k", "sgm or rasterizer", "--baseline", str(tmp_path / "baseline.json")],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 1, done.stdout
    assert "times the stored 0.01" in done.stdout
    assert "1 passed" in done.stdout
    assert "1 failed" in done.stdout
