"""One object's evidence on a voxel grid: surface, free or unknown.

The `grid` frame has its origin on the support below the object's center, +z up, x along the object's yaw. Object space
is the grid frame shifted to the bottom center of the completed shape.
"""

from dataclasses import dataclass, replace

import numpy as np

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.rim_artifacts import away_directions, behind_rims
from reconstruction.assets.views import FEW_PIXELS, ScenePixels, SeenPoints
from reconstruction.core.types import DepthMaps, Instance, InstanceSet, PosedFrames
from registry.geometry import invert_rigid, rigid, transform_points

_MIN_CONFIRMED = 0.7  # least share of seen points on the volume's surface; below it, all points are kept
_SHADOW_M = 0.05  # length of the space behind seen surface in which errors at outlines lie


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
    carrying: np.ndarray | None = None  # bool (nx, ny) columns that something stands on

    def centers(self, axis: int) -> np.ndarray:
        """Return the coordinates of the voxel centers along one axis, grid frame."""
        return self.origin[axis] + (np.arange(self.distance.shape[axis]) + 0.5) * self.voxel_m

    def lookup(self, field: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return a voxel field's values at points (n, 3), zero outside of the grid, and which points are inside."""
        cell = np.floor((points - self.origin) / self.voxel_m).astype(np.int64)
        inside = np.all((cell >= 0) & (cell < field.shape), axis=1)
        out = np.zeros(len(points), field.dtype)
        out[inside] = field[tuple(cell[inside].T)]
        return out, inside


@dataclass(frozen=True)
class ObjectFrame:
    """Pose of an object's grid, and its seen points."""

    world_from_grid: np.ndarray  # float64 (4, 4)
    points: np.ndarray  # float64 (k, 3) seen points, grid frame, outliers removed
    normals: np.ndarray  # float64 (k, 3)
    on_support: bool  # z = 0 is the top of a measured support
    wall_y: float | None  # y of the wall plane in the grid frame; None: does not hang


def frame_object(item: Instance, seen: SeenPoints, support: float | None, found: InstanceSet) -> ObjectFrame:
    """Choose an object's grid frame: hanging objects are aligned with their wall, others with their vertical faces.

    z = 0 is at world height `support`, or at the lowest point where that is None.
    """
    points, normals = without_outliers(seen)
    wall = _wall_of(item, found)
    if wall is not None:
        yaw = float(np.arctan2(wall[1], wall[0]) + np.pi / 2)  # grid +y points into the wall, x along it
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
        # The distance of the object's center to the wall; the normal is -y in the grid frame.
        middle = transform_points(world_from_grid, np.array([[0.0, 0.0, float(np.median(points[:, 2]))]]))[0]
        wall_y = float(wall[:3] @ middle + wall[3])
    return ObjectFrame(world_from_grid, points, normals @ rotation, support is not None, wall_y)


def refine_yaw(normals: np.ndarray, yaw_rad: float) -> float:
    """Align the yaw with the vertical faces, where their normals (k, 3) agree modulo 90 degrees."""
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
    """Return points and normals (k, 3) without flying pixels.

    Kept are points in cells with enough points and enough frames, relative to the median: errors at occlusion
    boundaries lie elsewhere in every frame.
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
    frame_count = int(seen.frames.max()) + 1
    pairs = np.unique(flat * frame_count + seen.frames) // frame_count
    frames = np.bincount(pairs, minlength=int(dims.prod())).reshape(dims).astype(np.float32)
    density = uniform_filter(count, 3, mode="constant").ravel()[flat] * 27
    reports = uniform_filter(frames, 3, mode="constant").ravel()[flat] * 27
    keep = (density > 0.08 * np.median(density)) & (reports > 0.12 * np.median(reports))
    if keep.sum() < 0.6 * len(points):
        return points, seen.normals
    return points[keep], seen.normals[keep]


def _wall_of(item: Instance, found: InstanceSet) -> np.ndarray | None:
    """Return the plane (4,) of the wall that an object hangs on; None where it does not hang or no wall is near."""
    if not item.attached_hint:
        return None
    walls = [b for b in found.base if b.label == "wall"]
    for base in walls:
        if base.id == item.support_hint:
            return base.surface.plane
    near = [
        b.surface.plane for b in walls if abs(b.surface.plane[:3] @ item.center + b.surface.plane[3]) < 0.15
    ]
    return min(near, key=lambda plane: abs(plane[:3] @ item.center + plane[3]), default=None)


def fuse_volume(
    target: int, frame: ObjectFrame, noise_relative: float, posed: PosedFrames, depth: DepthMaps,
    pixels: ScenePixels, config: AssetsConfig,
) -> ObjectVolume:  # fmt: skip
    """Fuse the depth pixels of object `target` and the free space of all pixels into its grid.

    `noise_relative` is the 1-sigma of its depth over depth.
    """
    from reconstruction.assets.kernels import fuse_object

    frames = np.flatnonzero(pixels.counts(target) > FEW_PIXELS).astype(np.int32)
    grid_from_camera = invert_rigid(frame.world_from_grid)[None] @ posed.world_from_camera[frames]
    distance_m = float(np.median(np.linalg.norm(grid_from_camera[:, :3, 3], axis=1))) if len(frames) else 1.0
    camera, noise = depth.camera, noise_relative * distance_m
    box = _box(frame, config)
    voxel = _voxel_size(box, max(0.7 * noise, 0.7 * distance_m / camera.fx), config)
    origin, shape = _grid(box, voxel, standing=frame.wall_y is None)
    camera_from_grid = np.stack(
        [invert_rigid(posed.world_from_camera[f]) @ frame.world_from_grid for f in frames]
    )
    trunc = max(2.5 * voxel, 3.0 * noise)
    tau = max(0.6 * trunc, 2.0 * noise)
    shell = max(2.2 * voxel, config.min_thickness_m)
    evidence = _Evidence(*fuse_object(
        pixels.depth, pixels.confidence, pixels.ids, pixels.cosine, pixels.inner, frames, camera_from_grid,
        camera.fx, camera.fy, camera.cx, camera.cy, target, shape, origin, voxel, trunc, tau, shell, _SHADOW_M,
    ))  # fmt: skip
    # Outlines are sharper than depth: voxels that many frames see outside the outline are skirts.
    skirt = (evidence.outside >= 2) & (evidence.outside > 0.35 * evidence.support)
    near = evidence.surface(len(frames), skirt, small=box.size.max() <= config.furniture_m)
    if near.any():
        away = away_directions(camera_from_grid, 0.5 * (box.low + box.high))
        near &= ~behind_rims(near, evidence.support, evidence.inner, evidence.shadowed, away)
    # A single ray does not free a voxel.
    enough = np.minimum(2, max(1, len(frames) // 6))
    free = (evidence.freed >= enough) | skirt
    distance = evidence.distances(near, free, voxel, trunc)
    return ObjectVolume(origin, voxel, trunc, noise, distance, near | free, free & (distance > 0), near)


@dataclass(frozen=True)
class _Box:
    """Bounds of an object's grid, grid frame, metres."""

    low: np.ndarray  # float64 (3,) of the seen points, down to the support
    high: np.ndarray  # float64 (3,)
    margin: np.ndarray  # float64 (3,) added on either side
    size: np.ndarray  # float64 (3,) of the seen points alone

    @property
    def span(self) -> np.ndarray:
        """Return the size with margins (3,)."""
        return self.high - self.low + 2 * self.margin


def _box(frame: ObjectFrame, config: AssetsConfig) -> _Box:
    low, high = np.percentile(frame.points, 0.2, axis=0), np.percentile(frame.points, 99.8, axis=0)
    size = np.maximum(high - low, 0.01)
    # Symmetry may put unseen sides a little beyond the seen ones.
    margin = np.array([0.12, 0.12, 0.03]) * max(size[:2].min(), 0.2 * size.max()) + 0.004
    if frame.wall_y is not None:
        margin[:] = 0.006
        high[1] = max(high[1], frame.wall_y, low[1] + config.flat_thickness_m)
        high[1] = min(high[1], low[1] + max(config.flat_thickness_m, 0.25 * max(size[0], size[2])))
    else:
        low[2] = min(low[2], 0.0)
    return _Box(low, high, margin, size)


def _voxel_size(box: _Box, finest_m: float, config: AssetsConfig) -> float:
    """Return the voxel's edge in metres: finer for flat and thin objects, whose grids have few voxels."""
    span = box.span
    finest = max(config.voxel_min_m, finest_m)
    cubic = float((span.prod() / (0.7 * config.cells_along_longest**3)) ** (1 / 3))
    affordable = float((span.prod() / config.max_voxels) ** (1 / 3))
    voxel = max(min(float(span.max()) / config.cells_along_longest, max(cubic, finest)), config.voxel_min_m)
    if box.size.max() > config.furniture_m:
        voxel = float(np.clip(affordable, 0.004, 0.02))
    return max(voxel, affordable)


def _grid(box: _Box, voxel: float, *, standing: bool) -> tuple[np.ndarray, tuple[int, ...]]:
    """Return the corner (3,) of a grid around a box, and its number of voxels along each axis."""
    pad = 2
    origin = box.low - box.margin - pad * voxel
    if standing:
        # A layer boundary at z = 0 makes bottoms flat on the support.
        origin[2] = -np.ceil(max(-(box.low[2] - box.margin[2]), 0.0) / voxel) * voxel - pad * voxel
    return origin, tuple(
        int(np.ceil((box.high[a] + box.margin[a] - origin[a]) / voxel)) + pad for a in range(3)
    )


@dataclass(frozen=True)
class _Evidence:
    """Sums over all frames per voxel (nx, ny, nz), in the order of `fuse_object`; counts are in frames."""

    numerator: np.ndarray  # float32, of the mean signed distance
    denominator: np.ndarray  # float32
    freed: np.ndarray  # saw the voxel free
    support: np.ndarray  # saw the object's surface at it
    outside: np.ndarray  # saw something else there that does not occlude it
    behind: np.ndarray  # saw the surface less than the shell's thickness in front of it
    inner: np.ndarray  # saw the surface at it, well inside the outline
    shadowed: np.ndarray  # saw the surface in front of it, within `_SHADOW_M`

    def surface(self, frames: int, skirt: np.ndarray, *, small: bool) -> np.ndarray:
        """Return the voxels with surface; reports of few of `frames` frames are errors at outlines."""
        near = (self.denominator > 0) & (self.support >= int(np.clip(frames // 8, 1, 3)))
        near &= ~skirt
        if small and near.any():
            near &= self.support >= 0.12 * np.percentile(self.support[near], 75)
        return near

    def distances(self, near: np.ndarray, free: np.ndarray, voxel: float, trunc: float) -> np.ndarray:
        """Return signed distances in metres (float32) where there is surface or free space."""
        distance = np.where(near, self.numerator / np.maximum(self.denominator, 1e-12), 0).astype(np.float32)
        vote = self.freed.astype(np.float32) * np.exp(1.0) * 0.7
        mixed = near & free
        blended = (self.numerator + vote * trunc) / np.maximum(self.denominator + vote, 1e-12)
        distance[mixed] = blended[mixed]
        distance[free & ~near] = trunc
        # Rays behind a wall thinner than the noise free it; it is kept where many frames saw its front.
        usual = np.percentile(self.behind[near], 85) if near.any() else 0.0
        wall = mixed & (self.behind >= max(3.0, 0.35 * usual)) & (self.behind > 0.7 * self.freed)
        distance[wall & (distance > -1.5 * voxel)] = -1.5 * voxel
        return distance


def confirmed(frame: ObjectFrame, volume: ObjectVolume) -> ObjectFrame:
    """Drop the points at voxels where all frames together see no surface of the object."""
    from scipy.ndimage import binary_dilation

    keep, _ = volume.lookup(np.asarray(binary_dilation(volume.seen, np.ones((3, 3, 3)))), frame.points)
    if keep.mean() < _MIN_CONFIRMED:
        return frame
    return replace(frame, points=frame.points[keep], normals=frame.normals[keep])
