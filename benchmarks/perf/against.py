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


def compare_with(commit: str, rounds: int, names: str | None) -> int:
    """Print how long each kernel took before and now; return 1 if one became slower, else 0.

    Args:
        commit: what git calls it; "base" is that of `base.txt`.
        rounds: of each kernel in each turn.
        names: only kernels that match, as `pytest -k`.
    """
    commit = BASE.read_text().strip() if commit == "base" else commit
    before: list[dict[str, float]] = []
    now: list[dict[str, float]] = []
    with tree_at(ROOT, commit) as tree:
        if tree is None:
            print(f"{commit} is not in the history of {ROOT}: kernels are not compared")
            return 0
        for turn in range(_TURNS):
            for found, place in ((before, tree), (now, ROOT)):
                print(f"turn {turn + 1} of {_TURNS}: {'before' if place is tree else 'now'}", flush=True)
                found.append(_ratios(place, rounds, names))
    lines = compare(before, now)
    print(f"{'kernel':<18}{'before':>9}{'now':>9}{'change':>9}", *lines, sep="\n")
    slower = [line for line in lines if line.endswith("FAILS")]
    if slower:
        print(
            f"{len(slower)} became slower than at {commit} by more than {TOLERANCE - 1:.0%}. On purpose? "
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
    place = tree / ".perf.json"
    line = [sys.executable, "-m", "benchmarks.perf", "--rounds", str(rounds), "--json", str(place)]
    done = subprocess.run(
        [*line, *(["-k", names] if names else [])],
        cwd=tree,
        env=os.environ | {"PYTHONPATH": str(tree)},
        capture_output=True,
        text=True,
        check=False,
    )
    try:
        if done.returncode:
            raise SystemExit(f"the kernels of {tree} do not run:\n{done.stdout}\n{done.stderr}")
        return json.loads(place.read_text())
    finally:
        place.unlink(missing_ok=True)
