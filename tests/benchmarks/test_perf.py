"""The kernels' timing: when a kernel counts as slower, the tree of an earlier commit, and that every kernel runs."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.perf.against import tree_at
from benchmarks.perf.ratios import compare, ratio

pytestmark = pytest.mark.stage

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(("now", "fails"), [(1.0, False), (2.38, False), (2.42, True)])
def test_a_kernel_fails_when_it_became_slower_by_more_than_a_fifth(now, fails):
    lines = compare([{"sgm": 2.0, "settle": 1.0}], [{"sgm": now, "settle": 1.0}])
    assert lines[0].endswith("FAILS") == fails
    assert f"{now / 2 - 1:+.0%}" in lines[0]
    assert not lines[1].endswith("FAILS")


def test_the_least_of_the_turns_counts_and_kernels_of_one_side_are_named():
    lines = compare(
        [{"sgm": 2.0, "old": 1.0}, {"sgm": 3.0, "old": 1.0}],
        [{"sgm": 9.0, "new": 1.0}, {"sgm": 2.1, "new": 1.0}],
    )
    assert [line.split()[-1] for line in lines] == ["+5%", "new", "gone"]


def test_ratios_are_of_rounds():
    found = ratio(np.array([2.0, 4.0, 9.0]), np.array([1.0, 2.0, 3.0]))
    assert (found.low, found.median, found.high, found.least) == (2.0, 2.0, 2.5, 2.0)


def test_the_tree_of_a_commit_has_its_files_and_no_others(tmp_path):
    def git(*words: str) -> str:
        who = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
        return subprocess.run(
            ["git", "-C", tmp_path, *who, *words], check=True, capture_output=True, text=True
        ).stdout

    git("init", "-q")
    (tmp_path / "kernel.py").write_text("first")
    git("add", ".")
    git("commit", "-qm", "first")
    first = git("rev-parse", "HEAD").strip()
    (tmp_path / "kernel.py").write_text("second")
    (tmp_path / "other.py").write_text("")
    git("add", ".")
    git("commit", "-qm", "second")
    with tree_at(tmp_path, first) as tree:
        assert tree is not None
        assert [p.name for p in tree.iterdir()] == ["kernel.py"]
        assert (tree / "kernel.py").read_text() == "first"
    assert not tree.exists()
    with tree_at(tmp_path, "0" * 40) as tree:
        assert tree is None


@pytest.mark.end_to_end
def test_every_kernel_runs(tmp_path):
    kernels = re.findall(
        r"^def test_(\w+)\(", (ROOT / "benchmarks/perf/test_kernels.py").read_text(), re.MULTILINE
    )
    line = [sys.executable, "-m", "benchmarks.perf", "--rounds", "3", "--json", str(tmp_path / "ratios.json")]
    # Within a worker of pytest-xdist, pytest-benchmark does not measure.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_XDIST")}
    done = subprocess.run(line, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout
    ratios = json.loads((tmp_path / "ratios.json").read_text())
    assert set(ratios) == set(kernels)
    for name in kernels:
        assert ratios[name] > 0
        assert re.search(rf"^{name} +\d", done.stdout, re.MULTILINE), done.stdout
