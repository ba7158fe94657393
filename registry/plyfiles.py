"""Read the vertices of `.ply` files into one column a property."""

from pathlib import Path

import numpy as np

from registry.errors import BundleError


def read_vertices(path: Path) -> dict[str, np.ndarray]:
    """Return the properties of a PLY's vertices, binary or ASCII, by name, each (n,).

    Raises:
        BundleError: it is not a PLY of vertices, or it is truncated.
    """
    from plyfile import PlyData, PlyParseError

    try:
        columns = PlyData.read(path)["vertex"].data
    except (PlyParseError, KeyError, ValueError) as error:
        raise BundleError(f"{path}: not a PLY of vertices, or damaged ({error})") from error
    return {name: columns[name] for name in columns.dtype.names or ()}
