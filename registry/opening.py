# pyright: strict
"""Open a registry, wherever it is."""

from pathlib import Path

from registry.roots import address_of, registry_folder
from registry.store import SceneRegistry


def open_registry(address: Path | str | None = None, create: bool = False) -> SceneRegistry:
    """Open the registry in a folder, or at an address of fsspec (docs/sharing.md#a-registry-at-an-address).

    Args:
        address: A folder, an address such as `s3://lab/scenes`, the folder of its copy, or None for the default.
        create: Create an absent registry. One at an address begins to exist with its first scene.

    Raises:
        UsageError: There is no such protocol, or the address has a password.
        EnvironmentMissing: The registry cannot be created, or the extra of the protocol is not installed.
    """
    root = registry_folder(address)
    place = address_of(root)
    if place is None:
        return SceneRegistry(root, create)
    from registry.exchange.remote import RemoteRegistry  # clients of fsspec are heavy

    return RemoteRegistry(root, place)
