"""The error tree of the whole project.

SimReconError                 exit code 1   anything that we raise on purpose
├── UsageError                exit code 2   wrong use: bad flag, unknown scene, malformed overrides
│   ├── SceneNotFound         exit code 2   (also KeyError)
│   └── SceneBusy             exit code 2   another process holds the scene
├── InputError                exit code 3   the input cannot be reconstructed (too short, no parallax, blank …)
├── EnvironmentMissing        exit code 4   something is missing on the machine (driver, disk, permission, extra)
└── BundleError               exit code 1   a bundle on disk is malformed, unsafe or damaged (also ValueError)

A message says what failed, where (scene, stage, frame or file), what was expected, and what to do next.
"""

import difflib
from collections.abc import Iterable


class SimReconError(Exception):
    """Root of every error that the project raises on purpose."""

    exit_code = 1

    def __str__(self) -> str:
        """Return the message unquoted (`KeyError` would print its repr)."""
        return str(self.args[0]) if self.args else self.__class__.__name__


class UsageError(SimReconError, ValueError):
    """The command or function was called wrongly."""

    exit_code = 2


class SceneNotFound(SimReconError, KeyError):
    """The registry has no such scene."""

    exit_code = 2


class SceneBusy(SimReconError):
    """Another process is reconstructing the same scene into the same registry."""

    exit_code = 2


class InputError(SimReconError, ValueError):
    """The input video cannot be reconstructed."""

    exit_code = 3


class EnvironmentMissing(SimReconError, RuntimeError):
    """The machine lacks something: a driver, an extra, disk space, a permission."""

    exit_code = 4


class BundleError(SimReconError, ValueError):
    """A bundle on disk is malformed, unsafe or damaged."""


def did_you_mean(wrong: str, known: Iterable[str], *, cutoff: float = 0.6) -> str:
    """Return a sentence for a message with the nearest of the names that are known, or nothing if none is near.

    Args:
        wrong: the name that is not known.
        known: those that are.
        cutoff: how alike the two are at least, 0 to 1 (`difflib.SequenceMatcher.ratio`).

    Returns:
        " Did you mean 'name'?" with a space before it, or "".
    """
    near = difflib.get_close_matches(wrong, list(known), n=1, cutoff=cutoff)
    return f" Did you mean {near[0]!r}?" if near else ""
