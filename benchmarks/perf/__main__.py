"""Time the kernels: `python -m benchmarks.perf [--rounds N] [--compare] [--save]`."""

import argparse
import os
import sys
from pathlib import Path

import pytest


def main() -> int:
    """Run the folder's tests with the given options; returns pytest's exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.perf", description=__doc__)
    parser.add_argument("--rounds", type=int, default=21, help="rounds per kernel (default 21)")
    parser.add_argument(
        "--compare", action="store_true", help="fail where a kernel became slower than stored"
    )
    parser.add_argument("--save", action="store_true", help="store the ratios as the new baseline")
    parser.add_argument("--baseline", type=Path, metavar="FILE", help="the stored ratios")
    parser.add_argument("-k", metavar="NAMES", help="only kernels that match, as pytest -k")
    arguments = parser.parse_args()
    # Set before NumPy is imported: one thread for linear algebra, too.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    line = [str(Path(__file__).parent), "--perf-rounds", str(arguments.rounds), "--durations=0"]
    line += ["-p", "no:cacheprovider", "--benchmark-columns=median", "--benchmark-quiet"]
    line += ["--perf-compare"] if arguments.compare else []
    line += ["--perf-save"] if arguments.save else []
    line += ["--perf-baseline", str(arguments.baseline.resolve())] if arguments.baseline else []
    line += ["-k", arguments.k] if arguments.k else []
    return int(pytest.main(line))


if __name__ == "__main__":
    sys.exit(main())
