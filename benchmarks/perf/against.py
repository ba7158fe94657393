"""Measure the kernels of an earlier commit and of this tree in turns, on this machine, and compare them."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.perf.ratios import TOLERANCE, compare

ROOT = Path(__file__).resolve().parents[2]
BASE = Path(__file__).with_name("base.txt")  # the commit that CI compares with
_TURNS = 2
_ATTEMPTS = 3  # the kernels that look slower are measured again: a median of six is surer than one of two


def compare_with(commit: str, rounds: int, names: str | None, root: Path = ROOT) -> int:
    """Print how long each kernel took before and now; return 1 if one became slower, 2 without that commit, else 0.

    Args:
        commit: what git calls it; "base" is that of `base.txt`, with which a clone that lacks it compares nothing.
        rounds: of each kernel in each turn.
        names: only kernels that match, as `pytest -k`.
        root: the working tree, in a repository.
    """
    asked, commit = commit, BASE.read_text().strip() if commit == "base" else commit
    before: list[dict[str, float]] = []
    now: list[dict[str, float]] = []
    with tree_at(root, commit) as tree:
        if tree is None:
            print(f"{commit} is not in the history of {root}: kernels are not compared")
            return 0 if asked == "base" else 2
        for _ in range(_ATTEMPTS):
            for turn in range(_TURNS):
                for found, place in ((before, tree), (now, root)):
                    print(f"turn {turn + 1} of {_TURNS}: {'before' if place is tree else 'now'}", flush=True)
                    found.append(_ratios(place, rounds, names))
            lines, slower = compare(before, now)
            if not slower:
                break
            names = " or ".join(slower)
    print(f"{'kernel':<18}{'before':>9}{'now':>9}{'change':>9}", *lines, sep="\n")
    if slower:
        print(
            f"{', '.join(slower)}: slower than at {commit} by more than {TOLERANCE - 1:.0%}. On purpose? "
            f"Then write a later commit into {BASE.relative_to(ROOT)}."
        )
    return int(bool(slower))


@contextmanager
def tree_at(repository: Path, commit: str) -> Iterator[Path | None]:
    """Give a folder with the files of a commit, None if the repository does not have it; removed at the end."""
    with tempfile.TemporaryDirectory(prefix="perf-") as folder:
        line = ["git", "-C", str(repository), "archive", "--format=tar", commit]
        packed = subprocess.run(line, capture_output=True, check=False) if shutil.which("git") else None
        if packed is None or packed.returncode:
            yield None
            return
        subprocess.run(["tar", "-x", "-C", folder], input=packed.stdout, check=True)
        yield Path(folder)


def _ratios(tree: Path, rounds: int, names: str | None) -> dict[str, float]:
    """Run `python -m benchmarks.perf` in a tree; return the ratio of each kernel."""
    with tempfile.TemporaryDirectory(prefix="perf-") as folder:
        place = Path(folder) / "ratios.json"
        line = [sys.executable, "-m", "benchmarks.perf", "--rounds", str(rounds), "--json", str(place)]
        done = subprocess.run(
            [*line, *(["-k", names] if names else [])],
            cwd=tree,
            env=os.environ | {"PYTHONPATH": str(tree)},
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise SystemExit(f"the kernels of {tree} do not run:\n{done.stdout}\n{done.stderr}")
        return json.loads(place.read_text())
