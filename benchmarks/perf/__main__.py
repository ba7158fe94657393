"""Time the kernels: `python -m benchmarks.perf [--rounds N] [--against COMMIT] [-k NAMES]`."""

import argparse
import os
import sys
from pathlib import Path

import pytest

from benchmarks.perf.against import compare_with


def main() -> int:
    """Run the folder's tests with the given options; return pytest's exit code, or that of the comparison."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.perf", description=__doc__)
    parser.add_argument("--rounds", type=int, default=21, help="rounds per kernel (default 21)")
    parser.add_argument(
        "--against",
        metavar="COMMIT",
        help='time that commit and this tree in turns; fail where a kernel is a fifth slower ("base": that of CI)',
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the least ratios there")
    parser.add_argument("-k", metavar="NAMES", help="only kernels that match, as pytest -k")
    arguments = parser.parse_args()
    # Set before NumPy is imported: one thread for linear algebra, too.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    if arguments.against:
        return compare_with(arguments.against, arguments.rounds, arguments.k)
    line = [str(Path(__file__).parent), "--perf-rounds", str(arguments.rounds), "--durations=0"]
    line += ["-p", "no:cacheprovider", "--benchmark-columns=median", "--benchmark-quiet"]
    line += ["--perf-json", str(arguments.json.resolve())] if arguments.json else []
    line += ["-k", arguments.k] if arguments.k else []
    return int(pytest.main(line))


if __name__ == "__main__":
    sys.exit(main())
