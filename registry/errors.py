# pyright: strict
"""Error classes of the whole project, with the exit codes of the command line.

SimReconError                 exit code 1   any error raised on purpose
├── UsageError                exit code 2   wrong use: bad flag, unknown scene, malformed overrides
│   ├── SceneNotFound         exit code 2   (also KeyError)
│   └── SceneBusy             exit code 2   another process holds the scene
├── InputError                exit code 3   the video cannot be reconstructed (too short, no parallax, blank …)
├── EnvironmentMissing        exit code 4   the machine lacks a driver, disk space, a permission or an extra
└── BundleError               exit code 1   a bundle on disk is malformed, unsafe or damaged (also ValueError)

A message says what failed, where (scene, stage, frame or file), what was expected, and what to do next.
"""

import difflib
from collections.abc import Iterable


class SimReconError(Exception):
    """Base class of all errors that the project raises on purpose."""

    exit_code = 1

    def __str__(self) -> str:
        """Return the message without quotes (`KeyError` prints its repr)."""
        return str(self.args[0]) if self.args else self.__class__.__name__


class UsageError(SimReconError, ValueError):
    """A command or function was called with invalid arguments."""

    exit_code = 2


class SceneNotFound(SimReconError, KeyError):
    """The registry has no such scene."""

    exit_code = 2


class SceneBusy(SimReconError):
    """Another process reconstructs the same scene into the same registry."""

    exit_code = 2


class InputError(SimReconError, ValueError):
    """The input video cannot be reconstructed."""

    exit_code = 3


class EnvironmentMissing(SimReconError, RuntimeError):
    """The machine lacks a driver, an extra, disk space or a permission."""

    exit_code = 4


class BundleError(SimReconError, ValueError):
    """A bundle on disk is malformed, unsafe or damaged."""


def did_you_mean(wrong: str, known: Iterable[str], *, cutoff: float = 0.6) -> str:
    """Suggest the known name closest to an unknown one.

    Args:
        wrong: Unknown name.
        known: Known names.
        cutoff: Minimum similarity, 0 to 1 (`difflib.SequenceMatcher.ratio`).

    Returns:
        " Did you mean 'name'?" with a leading space, or "" if no name is similar enough.
    """
    near = difflib.get_close_matches(wrong, list(known), n=1, cutoff=cutoff)
    return f" Did you mean {near[0]!r}?" if near else ""
