# pyright: strict
"""Where a registry is: a folder, or an address of fsspec with a copy on this machine.

    $SIMRECON_HOME/registry                          the default
    $SIMRECON_HOME/registries/<name>/registry        copy of what lies at an address; `address` beside it says at which

Only folders that this module made below the user's own home are copies: a folder from someone else reaches no network.
"""

import hashlib
import os
import re
from pathlib import Path

from registry.errors import EnvironmentMissing, UsageError
from registry.files import write_whole

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")
_COPIES, _FOLDER, _ADDRESS = "registries", "registry", "address"


def default_registry_root() -> Path:
    """Return the folder of `$SIMRECON_REGISTRY`, a folder or an address; without it that of the default registry.

    The default is `$SIMRECON_HOME/registry`, or `~/.simrecon/registry` if that variable is unset, too.

    Raises:
        UsageError: The address has a password or a query.
        EnvironmentMissing: The folder of an address cannot be made.
    """
    named = os.environ.get("SIMRECON_REGISTRY")
    return registry_folder(named) if named else home_folder() / _FOLDER


def registry_folder(address: Path | str | None) -> Path:
    """Return the folder of a registry: of an address (`s3://lab/scenes`) that of its copy, which is made.

    Args:
        address: A folder, an address, or None for the default.

    Raises:
        UsageError: The address has a password or a query.
        EnvironmentMissing: The folder of an address cannot be made.
    """
    if address is None:
        return default_registry_root()
    if not is_address(address):
        return Path(address).expanduser()
    address = str(address)
    if "@" in address or "?" in address:
        raise UsageError(
            "the address of a registry holds no user, password or query: clients find credentials by themselves "
            "(docs/sharing.md#credentials)"
        )
    address = address.rstrip("/")
    words = re.sub(r"[^a-z0-9]+", "-", address.split("://")[1].lower()).strip("-")[:40]
    folder = home_folder() / _COPIES / f"{words}-{hashlib.sha256(address.encode()).hexdigest()[:8]}"
    if address_of(folder / _FOLDER) != address:
        try:
            write_whole(folder / _ADDRESS, address.encode())
        except OSError as error:
            raise EnvironmentMissing(
                f"registry: cannot make the copy of {address} on this machine: {error.strerror} ({folder}); "
                "choose another $SIMRECON_HOME"
            ) from error
    return folder / _FOLDER


def is_address(where: Path | str | None) -> bool:
    """Return whether this is an address of fsspec (`s3://lab/scenes`), not a path."""
    return isinstance(where, str) and bool(_URL.match(where))


def address_of(root: Path) -> str | None:
    """Return the address that a folder is the copy of; None for a registry of its own."""
    root = root.absolute()
    if root.name != _FOLDER or root.parent.parent != (home_folder() / _COPIES).absolute():
        return None
    try:
        return (root.parent / _ADDRESS).read_text(encoding="utf-8")
    except OSError:
        return None


def home_folder() -> Path:
    """Return the folder of registries and caches: `$SIMRECON_HOME`, or `~/.simrecon`."""
    home = os.environ.get("SIMRECON_HOME")
    return Path(home).expanduser() if home else Path.home() / ".simrecon"
