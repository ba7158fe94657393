"""The `simrecon` command: parse, dispatch, and turn every expected error into one clear message and an exit code."""

import argparse
import logging
import os
import sys
from collections.abc import Sequence

from registry.errors import SimReconError

_EPILOG = """exit codes:
  0  done
  2  wrong use (unknown flag, unknown scene, malformed file)
  3  the input cannot be reconstructed (too short, no parallax, blank, corrupt)
  4  something is missing on the machine (driver, disk space, permission); see `simrecon doctor`

a first run:
  simrecon doctor                                  what works here, what is missing, how to get it
  simrecon reconstruct room.mp4 --scene my_room    5-10 minutes on a laptop; can be interrupted and resumed
  simrecon show my_room
  python -c 'import gymnasium as gym, simrecon_envs; print(gym.make("SimRecon/my_room"))'
"""


def build_parser() -> argparse.ArgumentParser:
    """Build the parser of all verbs."""
    from reconstruction.commands import (
        benchmark,
        doctor,
        evaluate,
        export,
        marker,
        reconstruct,
        report,
        scenes,
        train,
    )

    parser = argparse.ArgumentParser(
        prog="simrecon",
        description="Turn an ordinary video of a room into a Gymnasium environment that robots learn in.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=_version())
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    reconstruct.add_parser(verbs)
    scenes.add_parsers(verbs)
    evaluate.add_parser(verbs)
    report.add_parser(verbs)
    export.add_parser(verbs)
    marker.add_parser(verbs)
    benchmark.add_parser(verbs)
    train.add_parser(verbs)
    doctor.add_parser(verbs)
    return parser


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return f"simrecon {version('simrecon')}"
    except PackageNotFoundError:
        return "simrecon (source tree, not installed)"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = build_parser().parse_args(argv)
    level = logging.INFO if getattr(arguments, "verbose", False) else logging.WARNING
    logging.basicConfig(level=level, format="%(name)s: %(message)s", stream=sys.stderr)
    try:
        return arguments.run(arguments)
    except SimReconError as error:
        if os.environ.get("SIMRECON_DEBUG"):
            raise
        print(f"simrecon {arguments.verb}: {error}", file=sys.stderr)
        return error.exit_code
    except OSError as error:
        if os.environ.get("SIMRECON_DEBUG") or error.errno is None:
            raise
        where = f" ({error.filename})" if error.filename else ""
        print(
            f"simrecon {arguments.verb}: {error.strerror}{where}. Check the disk's space and permissions, "
            f"then run the same command again; finished stages are kept.",
            file=sys.stderr,
        )
        return 4
    except MemoryError:
        print(
            f"simrecon {arguments.verb}: out of memory. Close other programs, or try --preset fast.",
            file=sys.stderr,
        )
        return 4
    except KeyboardInterrupt:
        print(
            "\ninterrupted; finished stages are kept, run the same command again to go on from there",
            file=sys.stderr,
        )
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 0


if __name__ == "__main__":
    sys.exit(main())
