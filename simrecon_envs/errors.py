"""Errors of the environments; see `registry.errors` for the class tree."""

from gymnasium.error import NameNotFound

from registry.errors import BundleError, EnvironmentMissing, SceneNotFound


class SceneAssetsMissing(EnvironmentMissing, BundleError):
    """The files of a registered scene are missing or damaged. Exit code 4."""

    exit_code = 4


class EnvNotFound(SceneNotFound, NameNotFound):
    """No scene or task has this id. Also Gymnasium's `NameNotFound`. Exit code 2."""
