"""Process of one video: runs a `simrecon` command line, and ends with its parent.

Standard input is a pipe that the parent holds open. If the parent dies, even by SIGKILL, the pipe closes, and this
process ends with all that it started: no run continues without a driver. It must be the leader of a process group.
"""

import os
import signal
import sys
import threading


def _end_with_parent(pipe: int) -> None:
    try:
        while os.read(pipe, 1):
            pass
    except OSError:
        pass
    os.killpg(os.getpgrp(), signal.SIGKILL)


def main() -> int:
    """Run the command line of `sys.argv`; return its exit code."""
    if os.getpgrp() == os.getpid():
        pipe = os.dup(0)
        nothing = os.open(os.devnull, os.O_RDONLY)
        os.dup2(nothing, 0)
        threading.Thread(target=_end_with_parent, args=(pipe,), daemon=True).start()
    from reconstruction.cli import main as simrecon

    return simrecon(sys.argv[1:])


if __name__ == "__main__":
    sys.exit(main())
