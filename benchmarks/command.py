"""What the benchmarks' command lines share: errors as one line, exit codes, results kept when interrupted."""

import sys
from collections.abc import Callable

from registry.errors import SimReconError

KEPT_RESULTS = 64  # of each stage: no variant drops what another one shares


def guarded(program: str, run: Callable[[], int]) -> int:
    """Return what `run` does; an error is one line on stderr and its exit code, an interruption 130."""
    try:
        return run()
    except SimReconError as error:
        print(f"{program}: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("\ninterrupted; what is done is kept, the same command goes on from there", file=sys.stderr)
        return 130
