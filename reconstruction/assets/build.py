"""Stage 7: every instance becomes a closed, textured object with collision shape and mass; base surfaces get looks."""

import numpy as np

from reconstruction.assets import completion, solid
from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.solid import Solid
from reconstruction.assets.views import ScenePixels, lift_object
from reconstruction.assets.volume import ObjectFrame, frame_object, fuse_volume
from reconstruction.types import DepthMaps, Instance, InstanceSet, PosedFrames
from registry.geometry import rigid


def object_solid(
    item: Instance, posed: PosedFrames, depth: DepthMaps, pixels: ScenePixels, found: InstanceSet, config: AssetsConfig
) -> tuple[Solid, ObjectFrame, str]:
    """Return an object's closed shape in its grid frame, that frame, and how the shape was made."""
    seen = lift_object(posed, depth, pixels, item.id)
    if len(seen.points) < config.min_points:
        return *box_fallback(item, seen.points), "box-fallback"
    frame = frame_object(item, seen, posed, depth, pixels, found)
    volume = fuse_volume(item.id, frame, posed, depth, pixels, config)
    size = np.ptp(frame.points, axis=0)
    furniture = float(size.max()) > config.furniture_m
    field = completion.complete(volume, frame, config, furniture=furniture)
    body = solid.extract(field)
    if body is None or body.volume < 1e-7:
        return *box_fallback(item, seen.points), "box-fallback"
    if frame.wall_y is None:
        tolerance = max(0.003, 1.5 * volume.noise_m, 0.8 * volume.voxel_m)
        cuboid = solid.fit_cuboid(frame.points, frame.normals, body, tolerance)
        if cuboid is not None:
            return cuboid, frame, "observed+box"
    on_bottom = np.abs(body.vertices[:, 2]) < 0.3 * volume.voxel_m
    body = solid.taubin(body, int(np.clip(round(3 + 6 * volume.noise_m / volume.voxel_m), 3, 15)), on_bottom)
    budget = config.faces_furniture if furniture else config.faces_small
    body = solid.lighten(body, budget, 0.3 * volume.voxel_m)
    return body, frame, "observed+" + ("+".join(s.split()[0] for s in field.symmetries) or "carved")


def box_fallback(item: Instance, points: np.ndarray) -> tuple[Solid, ObjectFrame]:
    """Return a box of the instance's extents standing where it was seen."""
    size = np.maximum(np.nan_to_num(item.extents_m, nan=0.02), 0.01)
    c, s = np.cos(item.yaw_rad), np.sin(item.yaw_rad)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    bottom = item.center - np.array([0, 0, size[2] / 2])
    half = size / 2
    box = solid.box_solid(np.array([-half[0], -half[1], 0.0]), np.array([half[0], half[1], size[2]]))
    local = (points - bottom) @ rotation
    return box, ObjectFrame(rigid(rotation, bottom), local, np.zeros_like(local), False, None)
