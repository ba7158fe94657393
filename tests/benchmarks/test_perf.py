"""The kernels' timing: when a kernel counts as slower, the tree of an earlier commit, and that every kernel runs."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.perf.against import compare_with, tree_at
from benchmarks.perf.ratios import compare, ratio

pytestmark = pytest.mark.stage

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(("now", "fails"), [(1.0, False), (2.38, False), (2.42, True)])
def test_a_kernel_fails_when_it_became_slower_by_more_than_a_fifth(now, fails):
    lines, slower = compare([{"sgm": 2.0, "settle": 1.0}], [{"sgm": now, "settle": 1.0}])
    assert slower == (["sgm"] if fails else [])
    assert f"{now / 2 - 1:+.0%}" in lines[0]


def test_the_median_of_the_turns_counts_and_kernels_of_one_side_are_named():
    lines, slower = compare(
        [{"sgm": 1.0, "old": 1.0}, {"sgm": 2.0, "old": 1.0}, {"sgm": 2.0}],  # 1.0: a slow reference
        [{"sgm": 9.0, "new": 1.0}, {"sgm": 2.1}, {"sgm": 2.0}],
    )
    assert [line.split()[-1] for line in lines] == ["+5%", "new", "gone"]
    assert not slower


def test_ratios_are_of_rounds():
    found = ratio(np.array([2.0, 4.0, 9.0]), np.array([1.0, 2.0, 3.0]))
    assert (found.low, found.median, found.high, found.least) == (2.0, 2.0, 2.5, 2.0)


def committed(repository: Path) -> str:
    """Commit all files of a folder; return the commit."""
    line = ["git", "-C", repository, "-c", "user.name=a", "-c", "user.email=a@b.c"]
    for words in (["init", "-q"], ["add", "."], ["commit", "-qm", "all"], ["rev-parse", "HEAD"]):
        done = subprocess.run([*line, *words], check=True, capture_output=True, text=True)
    return done.stdout.strip()


def test_the_tree_of_a_commit_has_its_files_and_no_others(tmp_path):
    (tmp_path / "kernel.py").write_text("first")
    first = committed(tmp_path)
    (tmp_path / "kernel.py").write_text("second")
    (tmp_path / "other.py").write_text("")
    committed(tmp_path)
    with tree_at(tmp_path, first) as tree:
        assert tree is not None
        assert [p.name for p in tree.iterdir()] == ["kernel.py"]
        assert (tree / "kernel.py").read_text() == "first"
    assert not tree.exists()
    with tree_at(tmp_path, "0" * 40) as tree:
        assert tree is None


@pytest.mark.parametrize(("now", "status"), [(1.1, 0), (1.3, 1)])
def test_the_comparison_runs_both_trees_and_fails_where_a_kernel_is_slower(tmp_path, capsys, now, status):
    """A repository whose kernels take as long as it says."""
    program = tmp_path / "benchmarks" / "perf" / "__main__.py"
    program.parent.mkdir(parents=True)
    text = "import sys\nopen(sys.argv[sys.argv.index('--json') + 1], 'w').write('{\"sgm\": RATIO}')\n"
    program.write_text(text.replace("RATIO", "1.0"))
    for package in program.parents[:2]:
        (package / "__init__.py").touch()
    first = committed(tmp_path)
    program.write_text(text.replace("RATIO", str(now)))
    assert compare_with(first, 3, None, tmp_path) == status
    assert ("sgm: slower than" in capsys.readouterr().out) == bool(status)
    assert compare_with("no-such-commit", 3, None, tmp_path) == 2


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
