"""The `simrecon` command: runs a verb, and reports expected errors as one message and an exit code."""

import argparse
import errno
import logging
import os
import sys
from collections.abc import Sequence

from registry.errors import SimReconError
from registry.plain_text import plain

_EPILOG = """exit codes:
  0  done
  1  `check`: the film is unlikely to be reconstructed
  2  wrong use (unknown flag, unknown scene, malformed file)
  3  the input cannot be reconstructed (too short, no parallax, blank, corrupt)
  4  the machine lacks something (driver, disk space, permission); see `simrecon doctor`

a first run:
  simrecon doctor                                  what works on this machine, what is missing, how to get it
  simrecon check room.mp4                          whether the film is fine, in seconds
  simrecon reconstruct room.mp4 --scene my_room    5-10 minutes on a laptop; an interrupted run resumes
  simrecon show my_room
  python -c 'import gymnasium as gym, simrecon_envs; print(gym.make("SimRecon/my_room"))'
"""
_AGAIN = "run the same command again: it resumes after the last finished stage"


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all verbs."""
    from reconstruction.commands import (
        batch,
        benchmark,
        check,
        doctor,
        evaluate,
        exchange,
        export,
        marker,
        reconstruct,
        registry_verbs,
        report,
        scenes,
        studio,
        train,
    )

    parser = argparse.ArgumentParser(
        prog="simrecon",
        description="Turn a video of a room into a Gymnasium environment for robot learning.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=_version())
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    for module in (
        check,
        reconstruct,
        batch,
        scenes,
        registry_verbs,
        studio,
        evaluate,
        report,
        export,
        exchange,
        marker,
        benchmark,
        train,
        doctor,
    ):
        module.add_parser(verbs)
    return parser


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return f"simrecon {version('simrecon')}"
    except PackageNotFoundError:
        return "simrecon (source tree, not installed)"


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line (default: `sys.argv`); return the exit code."""
    from reconstruction.commands.streams import tolerant_streams

    with tolerant_streams() as out:
        code = _run(sys.argv[1:] if argv is None else list(argv))
        out.flush()
        if out.loss:
            return _fail(
                "", f"the output could not be written ({out.loss}); the work itself is not affected", 4
            )
    return code


def _run(argv: list[str]) -> int:
    for text in argv:
        if not _is_utf8(text):
            shown = text.encode("utf-8", "backslashreplace").decode()
            return _fail(
                "", f"the argument {shown!r} is not UTF-8. Rename the file or folder, and run again.", 2
            )
    arguments = build_parser().parse_args(argv)
    level = logging.INFO if getattr(arguments, "verbose", False) else logging.WARNING
    logging.basicConfig(level=level, format="%(name)s: %(message)s", stream=sys.stderr)
    debug = bool(os.environ.get("SIMRECON_DEBUG"))
    try:
        return arguments.run(arguments)
    except SimReconError as error:
        if debug:
            raise
        return _fail(arguments.verb, str(error), error.exit_code)
    except OSError as error:
        if debug or error.errno is None:
            raise
        return _fail(arguments.verb, describe_os_error(error), 4)
    except RuntimeError as error:
        if debug or "home directory" not in str(error):  # of `Path.home` and `Path.expanduser`
            raise
        advice = "Set HOME or SIMRECON_HOME to a folder, or give --registry DIR."
        return _fail(arguments.verb, f"this user has no home folder ({error}). {advice}", 4)
    except MemoryError:
        return _fail(arguments.verb, "out of memory. Close other programs, or use --preset fast.", 4)
    except KeyboardInterrupt:
        print(f"\ninterrupted; {_AGAIN}", file=sys.stderr)
        return 130


def describe_os_error(error: OSError) -> str:
    """Return the message for an error of the file system: cause, file, and what to do."""
    names = [str(name) for name in (error.filename, error.filename2) if name is not None]
    where = f" ({' and '.join(names)})" if names else ""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        advice = f"Free some space on that disk, then {_AGAIN}."
    elif error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        advice = "Fix the permissions, or choose another place."
    elif error.errno in (errno.EMFILE, errno.ENFILE):
        advice = "Raise the limit of open files (ulimit -n)."
    else:
        advice = f"Check the file and its disk, then {_AGAIN}."
    return f"{error.strerror}{where}. {advice}"


def _is_utf8(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _fail(verb: str, message: str, exit_code: int) -> int:
    print(f"simrecon{f' {verb}' if verb else ''}: {plain(message, lines=True)}", file=sys.stderr)
    return exit_code


if __name__ == "__main__":
    sys.exit(main())
