"""One object's volume: surface, free or unknown, on a grid in a frame that stands upright on the object's support.

The `grid` frame has its origin at the support below the object's centre, +z up, x along the object's yaw. It becomes
object space once the shape is complete (only shifted, so that the origin is at the bottom centre).
"""

from dataclasses import dataclass, replace

import numpy as np

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.tails import away_directions, behind_rims
from reconstruction.assets.views import ScenePixels, SeenPoints
from reconstruction.types import DepthMaps, Instance, InstanceSet, PosedFrames
from registry.geometry import invert_rigid, rigid, transform_points

_SMEAR_M = (0.025, 0.06)  # smeared depth ends before, and what lies farther off says little
_SMEAR_HEIGHT_M = 0.03
_LEVEL_M = 0.003
_MIN_CONFIRMED = 0.7  # of a thing's points, or its volume is too poor to judge them
_SHADOW_M = 0.05  # behind a thing's rim: there ends what errs at its outline


@dataclass(frozen=True)
class ObjectVolume:
    """Evidence per voxel. Signed distance is positive outside, negative inside."""

    origin: np.ndarray  # float64 (3,) corner of voxel (0, 0, 0), grid frame
    voxel_m: float
    trunc_m: float
    noise_m: float  # 1-sigma of depth at the object's distance
    distance: np.ndarray  # float32 (nx, ny, nz), meaningful where `known`
    known: np.ndarray  # bool (nx, ny, nz)
    free: np.ndarray  # bool (nx, ny, nz) a ray passed through
    seen: np.ndarray  # bool (nx, ny, nz) close to measured surface of the object

    def centers(self, axis: int) -> np.ndarray:
        """Return the coordinates of voxel centres along one axis."""
        return self.origin[axis] + (np.arange(self.distance.shape[axis]) + 0.5) * self.voxel_m


@dataclass(frozen=True)
class ObjectFrame:
    """Where an object stands and what was seen of it."""

    world_from_grid: np.ndarray  # float64 (4, 4)
    points: np.ndarray  # float64 (k, 3) seen points, grid frame, outliers removed
    normals: np.ndarray  # float64 (k, 3)
    on_support: bool  # z = 0 is the top of a known support
    wall_y: float | None  # the wall plane is at this y of the grid frame (things that hang)


def frame_object(item: Instance, seen: SeenPoints, support: float | None, found: InstanceSet) -> ObjectFrame:
    """Choose an upright frame: yaw from vertical faces, bottom at the height of the support, where known."""
    points, normals = without_outliers(seen)
    wall = _wall_of(item, found)
    if wall is not None:
        yaw = float(np.arctan2(wall[1], wall[0]) + np.pi / 2)  # grid +y looks into the wall, x along it
        yaw = float(np.arctan2(np.sin(yaw), np.cos(yaw)))
    else:
        yaw = refine_yaw(normals, item.yaw_rad)
    rotation = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])
    local = points @ rotation
    low, high = np.percentile(local, 0.5, axis=0), np.percentile(local, 99.5, axis=0)
    support = None if wall is not None else support
    bottom = float(low[2]) if support is None else support
    center = rotation @ np.array([*((low + high) / 2)[:2], 0.0])
    world_from_grid = rigid(rotation, np.array([center[0], center[1], bottom]))
    grid_from_world = invert_rigid(world_from_grid)
    points = transform_points(grid_from_world, points)
    wall_y = None
    if wall is not None:
        # n . x + d = 0 at the object's centre; in the grid frame n is -y.
        middle = transform_points(world_from_grid, np.array([[0.0, 0.0, float(np.median(points[:, 2]))]]))[0]
        wall_y = float(wall[:3] @ middle + wall[3])
    return ObjectFrame(world_from_grid, points, normals @ rotation, support is not None, wall_y)


def refine_yaw(normals: np.ndarray, yaw_rad: float) -> float:
    """Turn the yaw to the object's vertical faces where they agree on two perpendicular directions."""
    flat = normals[np.abs(normals[:, 2]) < 0.35]
    flat = flat[np.linalg.norm(flat, axis=1) > 0.5]
    if len(flat) < 200:
        return float(yaw_rad)
    angle = np.arctan2(flat[:, 1], flat[:, 0])
    for _ in range(3):
        mean = np.exp(4j * angle).mean()
        best = np.angle(mean) / 4
        off = np.abs(np.angle(np.exp(4j * (angle - best)))) / 4
        if abs(mean) < 0.35:
            return float(yaw_rad)
        angle = angle[off < np.radians(20)] if (off < np.radians(20)).sum() > 100 else angle
    turns = np.round((yaw_rad - best) / (np.pi / 2))
    return float(best + turns * np.pi / 2)


def without_outliers(seen: SeenPoints) -> tuple[np.ndarray, np.ndarray]:
    """Keep points whose neighbourhood several frames report, and that is not nearly empty.

    Depth errors at outlines fly between surfaces, in every frame elsewhere.
    """
    from scipy.ndimage import uniform_filter

    points = seen.points
    robust = np.percentile(points, 97, axis=0) - np.percentile(points, 3, axis=0)
    cell = max(0.004, 0.03 * float(robust.max()), 1.5 * float(np.median(seen.pixel_m)))
    keys = np.floor(points / cell).astype(np.int64)
    keys -= keys.min(axis=0)
    dims = keys.max(axis=0) + 3
    if dims.prod() > 3e7:
        return points, seen.normals
    flat = np.ravel_multi_index((keys + 1).T, dims)
    count = np.bincount(flat, minlength=int(dims.prod())).reshape(dims).astype(np.float32)
    pairs = np.unique(np.stack([flat, seen.frames.astype(np.int64)]), axis=1)[0]
    frames = np.bincount(pairs, minlength=int(dims.prod())).reshape(dims).astype(np.float32)
    density = uniform_filter(count, 3, mode="constant").ravel()[flat] * 27
    reports = uniform_filter(frames, 3, mode="constant").ravel()[flat] * 27
    keep = (density > 0.08 * np.median(density)) & (reports > 0.12 * np.median(reports))
    if keep.sum() < 0.6 * len(points):
        return points, seen.normals
    return points[keep], seen.normals[keep]


def _wall_of(item: Instance, found: InstanceSet) -> np.ndarray | None:
    """Return the plane of the wall that a thing hangs on."""
    if not item.attached_hint:
        return None
    walls = [b for b in found.base if b.label == "wall"]
    for base in walls:
        if base.id == item.support_hint:
            return base.surface.plane
    near = [b for b in walls if abs(b.surface.plane[:3] @ item.center + b.surface.plane[3]) < 0.15]
    if near:
        return min(
            near, key=lambda b: abs(b.surface.plane[:3] @ item.center + b.surface.plane[3])
        ).surface.plane
    return None


def support_height(
    item: Instance, points: np.ndarray, carrier: SeenPoints | None, found: InstanceSet
) -> float | None:
    """Return the height of what the object stands on, just below it, or None where that is not known.

    Floors are planes. Other supports are measured: their points (`carrier`) in a ring around the footprint.
    """
    lowest = float(np.percentile(points[:, 2], 0.5))
    height = float(np.percentile(points[:, 2], 99.5)) - lowest
    for base in found.base:
        if base.id == item.support_hint and base.label == "floor":
            n, d = base.surface.plane[:3], base.surface.plane[3]
            center = np.median(points[:, :2], axis=0)
            level = float(-(d + n[:2] @ center) / n[2]) if abs(n[2]) > 0.5 else 0.0
            return level if level < lowest + 0.05 else None
    if carrier is None:
        return None
    ring = _support_ring(points, carrier)
    if len(ring) < 30:
        return None
    level = float(np.percentile(ring, 30))
    # What encloses the object (a tray's rim) rises beside it; it stands on the low part.
    if level > lowest + 0.01:
        level = float(np.percentile(ring, 8))
    if level > lowest + 0.02 or lowest - level > max(0.04, 0.6 * height):
        return None
    around = _level_around(points, carrier)
    # Depth smears what is flat into a slope around it, as wide as a few centimetres: it stands at the slope's foot.
    if around is not None and level - _SMEAR_HEIGHT_M < around < level:
        level = around
    return min(level, lowest + 0.004)


def _level_around(points: np.ndarray, support: SeenPoints) -> float | None:
    """Return the height of a flat support a few centimetres off an object, or None: not flat, or not all around it."""
    low, high = points[:, :2].min(axis=0) - _SMEAR_M[1], points[:, :2].max(axis=0) + _SMEAR_M[1]
    inside = np.all((support.points[:, :2] > low) & (support.points[:, :2] < high), axis=1)
    near = support.points[inside & (support.normals[:, 2] > 0.7)]
    if len(near) < 60:
        return None
    away = _footprint_distance(points, near)
    ring = near[(away > _SMEAR_M[0]) & (away < _SMEAR_M[1])]
    offset = ring[:, :2] - np.median(points[:, :2], axis=0)
    sector = np.floor((np.arctan2(offset[:, 1], offset[:, 0]) / np.pi + 1) * 6).astype(int) % 12
    heights = [np.median(ring[sector == k, 2]) for k in range(12) if (sector == k).sum() >= 5]
    if len(heights) < 6:
        return None
    level = float(np.median(heights))
    agree = np.abs(np.array(heights) - level) < _LEVEL_M
    return level if agree.mean() >= 0.75 else None


def _footprint_distance(points: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return how far (n,) points `near` are from an object's points, seen from above."""
    from scipy.spatial import cKDTree

    return cKDTree(points[:: max(1, len(points) // 5000), :2]).query(near[:, :2])[0]


def _support_ring(points: np.ndarray, support: SeenPoints) -> np.ndarray:
    """Heights of the support's surface in a ring of a few centimetres around the object."""
    if len(support.points) == 0:
        return np.zeros(0)
    low, high = points[:, :2].min(axis=0) - 0.04, points[:, :2].max(axis=0) + 0.04
    upward = (support.normals[:, 2] > 0.7) | (np.linalg.norm(support.normals, axis=1) < 0.5)
    inside = np.all((support.points[:, :2] > low) & (support.points[:, :2] < high), axis=1) & upward
    near = support.points[inside]
    if len(near) < 30:
        return np.zeros(0)
    distance = _footprint_distance(points, near)
    for reach in (0.012, 0.025, 0.04):
        ring = near[distance < reach, 2]
        if len(ring) >= 60:
            return ring
    return near[:, 2]


def fuse_volume(
    target: int,
    frame: ObjectFrame,
    noise_relative: float,
    posed: PosedFrames,
    depth: DepthMaps,
    pixels: ScenePixels,
    config: AssetsConfig,
) -> ObjectVolume:
    """Fuse the object's pixels into its grid, and the free space of all pixels."""
    from reconstruction.assets.kernels import fuse_object

    low, high = np.percentile(frame.points, 0.2, axis=0), np.percentile(frame.points, 99.8, axis=0)
    size = np.maximum(high - low, 0.01)
    # Unseen sides may lie a little beyond what was seen, by symmetry.
    margin = np.array([0.12, 0.12, 0.03]) * max(size[:2].min(), 0.2 * size.max()) + 0.004
    if frame.wall_y is not None:
        margin[:] = 0.006
        high[1] = max(high[1], frame.wall_y, low[1] + config.flat_thickness_m)
        high[1] = min(high[1], low[1] + max(config.flat_thickness_m, 0.25 * max(size[0], size[2])))
    else:
        low[2] = min(low[2], 0.0)
    span = high - low + 2 * margin
    # Flat and thin things have few voxels along their short sides: they can afford finer ones, down to the noise.
    frames = np.flatnonzero((pixels.ids == target).reshape(len(pixels.ids), -1).sum(axis=1) > 8).astype(
        np.int32
    )
    depths = invert_rigid(frame.world_from_grid)[None] @ posed.world_from_camera[frames]
    distance_m = float(np.median(np.linalg.norm(depths[:, :3, 3], axis=1))) if len(frames) else 1.0
    noise = noise_relative * distance_m
    finest = max(config.voxel_min_m, 0.7 * noise, 0.7 * distance_m / depth.camera.fx)
    cubic = float((span.prod() / (0.7 * config.cells_along_longest**3)) ** (1 / 3))
    voxel = max(min(float(span.max()) / config.cells_along_longest, max(cubic, finest)), config.voxel_min_m)
    if size.max() > config.furniture_m:
        voxel = float((span.prod() / config.max_voxels) ** (1 / 3))
        voxel = float(np.clip(voxel, 0.004, 0.02))
    voxel = max(voxel, float((span.prod() / config.max_voxels) ** (1 / 3)))
    pad = 2
    origin = low - margin - pad * voxel
    if frame.wall_y is None:
        # z = 0 lies between two layers, so that bottoms come out flat on the support.
        origin[2] = -np.ceil(max(-(low[2] - margin[2]), 0.0) / voxel) * voxel - pad * voxel
    shape = tuple(int(np.ceil((high[a] + margin[a] - origin[a]) / voxel)) + pad for a in range(3))
    camera_from_grid = np.stack(
        [invert_rigid(posed.world_from_camera[f]) @ frame.world_from_grid for f in frames]
    )
    trunc = max(2.5 * voxel, 3.0 * noise)
    tau = max(0.6 * trunc, 2.0 * noise)
    camera = depth.camera
    shell = max(2.2 * voxel, config.min_thickness_m)
    numerator, denominator, freed, support, outside, behind, inner, shadowed = fuse_object(
        pixels.depth, pixels.confidence, pixels.ids, pixels.cosine, pixels.inner, frames, camera_from_grid, camera.fx,
        camera.fy, camera.cx, camera.cy, target, shape, origin, voxel, trunc, tau, shell, _SHADOW_M,
    )  # fmt: skip
    # Surface that only one or two of many frames report is a depth error at an outline.
    near = (denominator > 0) & (support >= int(np.clip(len(frames) // 8, 1, 3)))
    # What lies outside the outline in many frames that see past it is skirt: outlines are sharper than depth.
    skirt = (outside >= 2) & (outside > 0.35 * support)
    near &= ~skirt
    if size.max() <= config.furniture_m and near.any():
        near &= support >= 0.12 * np.percentile(support[near], 75)
    if near.any():
        away = away_directions(camera_from_grid, 0.5 * (low + high))
        near &= ~behind_rims(near, support, inner, shadowed, away)
    distance = np.where(near, numerator / np.maximum(denominator, 1e-12), 0).astype(np.float32)
    # One stray ray does not free a voxel that many frames saw as surface.
    enough = np.minimum(2, max(1, len(frames) // 6))
    free = (freed >= enough) | skirt
    vote = freed.astype(np.float32) * np.exp(1.0) * 0.7
    mixed = near & free
    blended = (numerator + vote * trunc) / np.maximum(denominator + vote, 1e-12)
    distance[mixed] = blended[mixed]
    distance[free & ~near] = trunc
    # A wall thinner than the noise is freed from its other side; what many frames saw just before it keeps it.
    usual = np.percentile(behind[near], 85) if near.any() else 0.0
    wall = mixed & (behind >= max(3.0, 0.35 * usual)) & (behind > 0.7 * freed) & (distance > -1.5 * voxel)
    distance[wall] = -1.5 * voxel
    return ObjectVolume(origin, voxel, trunc, noise, distance, near | free, free & (distance > 0), near)


def confirmed(frame: ObjectFrame, volume: ObjectVolume) -> ObjectFrame:
    """Return the frame without points where all frames together see no surface of the object."""
    from scipy.ndimage import binary_dilation

    near = binary_dilation(volume.seen, np.ones((3, 3, 3)))
    cell = np.floor((frame.points - volume.origin) / volume.voxel_m).astype(int)
    inside = np.all((cell >= 0) & (cell < near.shape), axis=1)
    keep = np.zeros(len(cell), bool)
    keep[inside] = near[tuple(cell[inside].T)]
    if keep.mean() < _MIN_CONFIRMED:
        return frame
    return replace(frame, points=frame.points[keep], normals=frame.normals[keep])
