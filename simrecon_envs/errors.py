"""Errors of the environments; the tree is in `registry.errors`."""

from gymnasium.error import NameNotFound

from registry.errors import BundleError, EnvironmentMissing, SceneNotFound


class SceneAssetsMissing(EnvironmentMissing, BundleError):
    """The files of a registered scene are gone or damaged. Exit code 4."""

    exit_code = 4


class EnvNotFound(SceneNotFound, NameNotFound):
    """No scene or task has this id; Gymnasium's own error for it, too. Exit code 2."""
