"""A fine, dense reconstruction of one box of space, for the assets of single objects."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from reconstruction.types import DepthMaps, PosedFrames

if TYPE_CHECKING:
    from reconstruction.surface.pixels import FusionViews


@dataclass(frozen=True)
class LocalVolume:
    """A dense volume; voxel (i, j, k) has its centre at origin + (ijk + 0.5) voxel_size_m in world space."""

    origin: np.ndarray  # float64 (3,) corner of voxel (0, 0, 0)
    voxel_size_m: float
    tsdf: np.ndarray  # float32 (nx, ny, nz) metres along the normal, > 0 in front; NaN where unobserved
    weight: np.ndarray  # float32 (nx, ny, nz) 0 where unobserved
    color: np.ndarray  # uint8 (nx, ny, nz, 3) meaningful near the surface only
    free: np.ndarray  # bool (nx, ny, nz) at least two views measured something behind the voxel


def prepare_fusion(posed: PosedFrames, depth: DepthMaps, *, completed_weight: float = 0.1) -> "FusionViews":
    """Weigh all pixels once (about half a second), to fuse many boxes from them."""
    from reconstruction.surface.pixels import prepare_views

    return prepare_views(
        depth, posed.world_from_camera, posed.images, reference_depth=1.5, max_depth=np.inf,
        completed_weight=completed_weight,
    )  # fmt: skip


def fuse_box(
    posed: PosedFrames,
    depth: DepthMaps,
    box_min: np.ndarray,
    box_max: np.ndarray,
    voxel_size_m: float,
    mask: np.ndarray | None = None,
    *,
    truncation_voxels: float = 4.0,
    min_free_views: int = 2,
    views: "FusionViews | None" = None,
) -> LocalVolume:
    """Fuse the depth maps inside an axis-aligned box of world space.

    Args:
        posed: Frames in world space.
        depth: Their depth maps in metres.
        box_min: (3,) lower corner.
        box_max: (3,) upper corner.
        voxel_size_m: Edge of a voxel; 3 to 4 mm suits things that stand on a table.
        mask: bool (n, h, w) pixels that may make surface. All pixels tell of free space. None: all of both.
        truncation_voxels: Half width of the band of averaging; at least 12 mm are used whatever it says, since
            depth is no better than a few millimetres.
        min_free_views: Views that must look through a voxel before it is called free.
        views: What `prepare_fusion(posed, depth)` returned, to spare that work when many boxes are fused.
    """
    from reconstruction.surface.tsdf import BLOCK, integrate

    low, high = np.asarray(box_min, np.float64), np.asarray(box_max, np.float64)
    size = np.maximum(np.ceil((high - low) / voxel_size_m - 1e-6).astype(int), 1)
    shape = tuple(int(s) for s in -(-size // BLOCK))
    near = _views_of_box(posed, depth, low, high)
    views = (views or prepare_fusion(posed, depth)).subset(near)
    blocks = np.argwhere(np.ones(shape, bool)).astype(np.int32)
    truncation = max(truncation_voxels * voxel_size_m, 0.012)
    part = None if mask is None else np.asarray(mask)[near]
    volume = integrate(views, blocks, shape, low, voxel_size_m, truncation, part)

    def dense(values: np.ndarray) -> np.ndarray:
        grid = values.reshape(*shape, BLOCK, BLOCK, BLOCK, *values.shape[4:])
        grid = np.moveaxis(grid, (3, 4, 5), (1, 3, 5)).reshape(*(s * BLOCK for s in shape), *values.shape[4:])
        return np.ascontiguousarray(grid[: size[0], : size[1], : size[2]])

    weight = dense(volume.weight)
    tsdf = dense(volume.distance) * np.float32(truncation)
    tsdf[weight <= 0] = np.nan
    return LocalVolume(
        low,
        float(voxel_size_m),
        tsdf,
        weight,
        dense(volume.color),
        dense(volume.free_views) >= min_free_views,
    )


def _views_of_box(posed: PosedFrames, depth: DepthMaps, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the rows of the views whose frustum may contain part of the box (at least one view)."""
    center, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    pose = posed.world_from_camera
    local = np.einsum("nij,ni->nj", pose[:, :3, :3], center - pose[:, :3, 3])
    camera = depth.camera
    reach = np.hypot(
        *np.maximum([camera.cx, camera.cy], [camera.width - camera.cx, camera.height - camera.cy])
    )
    angle = np.arctan2(np.hypot(local[:, 0], local[:, 1]), local[:, 2])
    distance = np.linalg.norm(local, axis=1)
    slack = np.arcsin(np.minimum(1.0, radius / np.maximum(distance, 1e-9)))
    seen = (distance <= radius) | (angle - slack < np.arctan(reach / min(camera.fx, camera.fy)))
    return np.flatnonzero(seen) if seen.any() else np.arange(1)
