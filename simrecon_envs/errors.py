"""Errors of the environments; the tree is in `registry.errors`."""

from registry.errors import BundleError, EnvironmentMissing


class SceneAssetsMissing(EnvironmentMissing, BundleError):
    """The files of a registered scene are gone or damaged. Exit code 4."""

    exit_code = 4
