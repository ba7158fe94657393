"""The room around the objects: floor, walls and ceiling, and the backdrop behind them."""

from collections.abc import Sequence

import numpy as np

from reconstruction.assets.backdrop import build_backdrop
from reconstruction.assets.base import bake_base, rectangle_mesh
from reconstruction.assets.base_rectangles import base_rectangles
from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.views import ScenePixels, rasterize_frames
from reconstruction.core.types import (
    Backdrop,
    BaseAsset,
    Camera,
    DepthMaps,
    InstanceSet,
    ObjectAsset,
    PosedFrames,
    SpaceGrid,
    StructureAsset,
)
from registry.geometry import transform_points


def build_room(
    posed: PosedFrames, depth: DepthMaps, found: InstanceSet, objects: Sequence[ObjectAsset], pixels: ScenePixels,
    space: SpaceGrid | None, config: AssetsConfig, structure: StructureAsset | None = None,
) -> tuple[tuple[BaseAsset, ...], Backdrop | None]:  # fmt: skip
    """Build every base entity, and the backdrop that closes the view where neither it nor an object is.

    Args:
        posed: keyframes in world space.
        depth: their depth maps, metres.
        found: base entities and instances.
        objects: the finished objects.
        pixels: ids and depth of the keyframes' pixels.
        space: occupancy grid; None: nothing is known to be free.
        config: texel sizes and budgets.
        structure: the structure, None where there is none.
    """
    rectangles = base_rectangles(found, objects, posed, space)
    meshes = [(r.entity.id, *rectangle_mesh(r)[:2]) for r in rectangles]
    meshes += [
        (o.id, transform_points(o.world_from_object, o.visual.vertices), o.visual.faces) for o in objects
    ]
    if structure is not None:
        meshes.append((structure.id, structure.visual.vertices, structure.visual.faces))
    if not meshes:
        return (), None
    hits = nearest_meshes(meshes, depth.camera, posed.world_from_camera)
    moves = [
        o.id
        for o in objects
        if not o.attached_hint and np.ptp(o.visual.vertices, axis=0).max() < config.furniture_m
    ]
    fixed = np.ones(int(pixels.ids.max()) + 1, bool)  # by id
    fixed[[i for i in (*moves, *(r.entity.id for r in rectangles)) if i < len(fixed)]] = False
    base = bake_base(rectangles, hits, fixed[pixels.ids], posed, depth, pixels, config)
    return base, build_backdrop(
        posed, depth, pixels.ids, np.concatenate([m[1] for m in meshes]), hits == 0, config
    )


def nearest_meshes(
    meshes: Sequence[tuple[int, np.ndarray, np.ndarray]], camera: Camera, poses: np.ndarray
) -> np.ndarray:
    """Return the id of the nearest mesh at each pixel, uint16 (n, h, w), 0 = none.

    Args:
        meshes: (id, vertices (v, 3) in world space, faces (f, 3)) each.
        camera: of all images.
        poses: world_from_camera (n, 4, 4).
    """
    offsets = np.cumsum([0, *(len(vertices) for _, vertices, _ in meshes[:-1])])
    vertices = np.concatenate([vertices for _, vertices, _ in meshes]).astype(np.float64)
    faces = np.concatenate([mesh[2] + offset for mesh, offset in zip(meshes, offsets)]).astype(np.int32)
    # The last entry is that of face -1: nothing.
    owner = np.append(np.repeat([key for key, _, _ in meshes], [len(f) for _, _, f in meshes]), 0).astype(
        np.uint16
    )
    return rasterize_frames(vertices, faces, camera, poses, lambda raster: owner[raster.face])
