# pyright: strict
"""Check every mesh and picture of an untrusted bundle before any reader sees it.

Loaders (SAPIEN, trimesh, PIL, viewers) follow references to other files, trust counts and read duplicate keys each in
their own way. These checks accept only files that have one meaning, lie in themselves and are of bounded size.
"""

from collections.abc import Iterable
from pathlib import Path

from registry.errors import BundleError
from registry.glb_check import MeshSize, check_glb
from registry.obj_check import check_obj
from registry.pictures import check_png_data, picture_size
from registry.plyfiles import check_ply
from registry.regular_files import read_regular

# Limits over all files of a bundle.
MAX_BUNDLE_VERTICES, MAX_BUNDLE_INDICES, MAX_BUNDLE_PIXELS = 20_000_000, 80_000_000, 512 << 20
_MAX_PICTURE_BYTES = 64 << 20
_PICTURES = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}


def check_mesh_file(path: Path, name: str, decompress: bool = False) -> MeshSize:
    """Check a .glb, .obj, .ply, .png or .jpg file and return its size; other files are accepted unread.

    With `decompress`, PNG data is decompressed once, and must be as much as the header claims.

    Raises:
        BundleError: It does not have the format of its suffix, references something outside of itself, has a number
            that is not finite or an index without a target, or exceeds a limit.
        OSError: It cannot be read.
    """
    suffix = name[name.rfind(".") :] if "." in name else ""
    if suffix == ".glb":
        return check_glb(path, name, decompress)
    if suffix == ".obj":
        return MeshSize(vertices=check_obj(path, name))
    if suffix == ".ply":
        check_ply(path, name)
    elif suffix in _PICTURES:
        data = read_regular(path, name, _MAX_PICTURE_BYTES)
        width, height = picture_size(data, name, _PICTURES[suffix])
        if decompress and suffix == ".png":
            check_png_data(data, name)
        return MeshSize(pixels=width * height)
    return MeshSize()


def check_mesh_files(folder: Path, names: Iterable[str], decompress: bool = False) -> None:
    """Check files of a bundle, each and together; `decompress` as in `check_mesh_file`.

    Raises:
        BundleError: As `check_mesh_file`, or they are too much together.
        OSError: One cannot be read.
    """
    vertices = indices = pixels = 0
    for name in names:
        size = check_mesh_file(folder / name, name, decompress)
        vertices, indices, pixels = vertices + size.vertices, indices + size.indices, pixels + size.pixels
        if vertices > MAX_BUNDLE_VERTICES or indices > MAX_BUNDLE_INDICES or pixels > MAX_BUNDLE_PIXELS:
            raise BundleError(
                f"{name}: with it the bundle has {vertices} vertices, {indices} indices and {pixels} pixels, more than "
                f"{MAX_BUNDLE_VERTICES}, {MAX_BUNDLE_INDICES} and {MAX_BUNDLE_PIXELS}"
            )
