"""Unpack an untrusted pack to a folder, with all checks of a bundle."""

import contextlib
from collections.abc import Generator
from pathlib import Path

from registry.bundle import SceneBundle
from registry.errors import BundleError, EnvironmentMissing
from registry.exchange.layout import extract_members, open_pack, read_members


def unpack(path: Path, folder: Path, name: str) -> SceneBundle:
    """Extract a pack to a new folder and open it with all checks of a bundle.

    Raises:
        BundleError: The pack is malformed, unsafe, damaged or too large.
        EnvironmentMissing: The folder cannot be written.
    """
    with open_pack(path) as stream:
        members = read_members(stream, name)
        with scratch_errors():
            folder.mkdir()
            extract_members(stream, members, folder, name)
    try:
        return SceneBundle.open(folder, check_hashes=True)
    except BundleError as error:
        raise BundleError(f"pack {name}: {str(error).removeprefix(f'bundle {folder}: ')}") from error


@contextlib.contextmanager
def scratch_errors() -> Generator[None, None, None]:
    """Convert OSError of a temporary folder into EnvironmentMissing."""
    try:
        yield
    except OSError as error:
        raise EnvironmentMissing(
            f"add: cannot write the temporary folder: {error.strerror} ({error.filename}). Free some space there, or "
            "set TMPDIR to another folder; nothing was added"
        ) from error
