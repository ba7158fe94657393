"""List the compiled kernels of a run, with the types of their arguments, in reconstruction/core/kernels.json.

    python tools/kernels.py                                    # of the demo video
    python tools/kernels.py --add room.mp4 --set depth.prior=both

Run it after a kernel or the types that it is called with changed; tests name the kernels that are missing. The words
after the option are those of `simrecon reconstruct`.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

from reconstruction import cli
from reconstruction.core.precompiling import LISTED, compiled_kernels, listed_kernels

ROOT = Path(__file__).resolve().parents[1]
DEMO = str(ROOT / "examples" / "data" / "demo_room.mp4")


def main() -> int:
    """Reconstruct, then write the list."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--add", action="store_true", help="keep what is listed")
    options, words = parser.parse_known_args()
    with tempfile.TemporaryDirectory() as home:
        line = [
            "reconstruct",
            *(words or [DEMO]),
            "--registry",
            f"{home}/registry",
            "--work-dir",
            f"{home}/work",
        ]
        if status := cli.main(line):
            return status
    kernels = [*(listed_kernels() if options.add else []), *compiled_kernels()]
    rows = dict.fromkeys(json.dumps([k.module, k.name, k.types]) for k in kernels)
    LISTED.write_text("[\n" + ",\n".join(rows) + "\n]\n")
    print(f"{len(rows)} kernels in {LISTED}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
