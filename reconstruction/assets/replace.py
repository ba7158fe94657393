"""Replacement of a reconstructed mesh by a user's file (`--overrides`)."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from reconstruction.assets.collision import collision_parts
from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.loaded import colors_of, load_mesh, picture_of, upright
from reconstruction.assets.physics.mass import physical_attributes
from reconstruction.assets.physics.materials import MaterialChoice
from reconstruction.assets.solid import Solid, hull_solid, to_manifold
from reconstruction.core.types import ObjectAsset, TexturedMesh
from registry.errors import UsageError


def replace_mesh(item: ObjectAsset, path: Path, config: AssetsConfig | None = None) -> ObjectAsset:
    """Return the object with the mesh of a file, in metres, standing where the object stood.

    Args:
        item: the object.
        path: any file that trimesh reads; .glb and .gltf are +y up, all others +z up.
        config: for the collision shape.

    Raises:
        UsageError: the file is missing or holds no usable mesh.
    """
    config = config or AssetsConfig()
    if not path.is_file():
        raise UsageError(f"overrides: the mesh {path} of object {item.id} does not exist")
    try:
        loaded = load_mesh(str(path))
    except ValueError as error:
        raise UsageError(f"overrides: the mesh {path} of object {item.id}: {error}") from error
    vertices = upright(loaded.vertices, gltf=path.suffix.lower() in (".glb", ".gltf"))
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    vertices = vertices - np.array([*(low + high)[:2] / 2, low[2]])
    if (high - low).max() > 20 or (high - low).max() < 1e-3:
        size = (high - low).round(3)
        raise UsageError(
            f"overrides: the mesh {path} of object {item.id} is {size} m large; scale it to metres"
        )
    faces = np.asarray(loaded.faces, np.int32)
    uvs, texture = _texture(loaded, len(vertices))
    body = to_manifold(Solid(vertices, faces)) or hull_solid(vertices)
    choice = MaterialChoice(item.physics.material, False, None, "user's mesh")
    made, had = physical_attributes(body, choice), item.physics
    ranges = replace(had.ranges, mass_kg=made.ranges.mass_kg)
    physics = replace(made, friction=had.friction, restitution=had.restitution, ranges=ranges)
    source = f"user mesh {path.name}"
    return replace(
        item,
        visual=TexturedMesh(vertices.astype(np.float32), faces, uvs, texture),
        collision=collision_parts(body, config),
        physics=physics,
        provenance=replace(item.provenance, geometry=source, appearance=source),
    )


def _texture(loaded: Any, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return uvs (v, 2) and a square texture of a `trimesh.Trimesh`; a plain color where it has none."""
    import cv2

    drawn = picture_of(loaded)
    if drawn is not None:
        uv, picture = drawn
        side = int(min(1024, max(picture.shape[:2])))
        return uv.astype(np.float32), cv2.resize(picture, (side, side), interpolation=cv2.INTER_AREA)
    colors = colors_of(loaded)
    color = np.full(3, 170.0) if colors is None else colors.astype(np.float64).mean(axis=0)
    texture = np.broadcast_to(np.round(color).astype(np.uint8), (8, 8, 3)).copy()
    return np.full((count, 2), 0.5, np.float32), texture
