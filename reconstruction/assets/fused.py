"""An object's part of the fused surface: a reference for its depth pixels, and a substitute for its volume.

All frames contribute to the fused surface. Depth pixels far from it are matching errors of their frame, at occlusion
boundaries. A board seen edge-on by few pixels per frame may still be fused well.
"""

from dataclasses import replace

import numpy as np
from scipy import ndimage

from reconstruction.assets.views import MOST_AT_ONCE, ScenePixels
from reconstruction.assets.volume import ObjectFrame
from reconstruction.core.types import Camera, Instance, InstanceSet, PosedFrames, Surface
from reconstruction.poses.parallel import ordered_map
from registry.geometry import invert_rigid, transform_points

_CELL_M, _MAX_CELLS = 0.006, 6_000_000  # spacing of samples, and voxels of the distance field
_PAD_CELLS = 6
_REACH_M, _REACH_SIGMAS = 0.012, 2.0  # greatest distance of a pixel: this plus so many sigmas of depth
_MIN_SAMPLES = 60
_MIN_BELIEVED = 0.6  # least share of an object's pixels on its surface; with less, all are kept
_TRIM_PERCENT = 0.4  # outermost points that are dropped, on each side


def sample_surface(item: int, surface: Surface, found: InstanceSet) -> np.ndarray:
    """Return points (k, 3), world, sampled about 6 mm apart on an object's triangles of the fused surface."""
    own = found.vertex_instance == item
    if not own.any():
        return np.zeros((0, 3))
    faces = np.asarray(surface.faces)
    corners = np.asarray(surface.vertices, np.float64)[faces[own[faces].sum(axis=1) >= 2]]
    a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = 0.5 * np.linalg.norm(np.cross(u, v), axis=1)
    face = np.repeat(np.arange(len(area)), np.ceil(area / _CELL_M**2).astype(int))
    s, t = np.random.default_rng(0).random((2, len(face)))
    s, t = np.where(s + t > 1, 1 - s, s), np.where(s + t > 1, 1 - t, t)
    return a[face] + s[:, None] * u[face] + t[:, None] * v[face]


def fused_points(item: int, frame: ObjectFrame, surface: Surface, found: InstanceSet) -> np.ndarray:
    """Return points (k, 3) on an object's fused surface, in its grid frame, without the outermost ones."""
    points = transform_points(invert_rigid(frame.world_from_grid), sample_surface(item, surface, found))
    if len(points) < _MIN_SAMPLES:
        return np.zeros((0, 3))
    low, high = np.percentile(points, [_TRIM_PERCENT, 100 - _TRIM_PERCENT], axis=0)
    return points[((points >= low) & (points <= high)).all(axis=1)]


def without_strays(
    pixels: ScenePixels, posed: PosedFrames, camera: Camera, surface: Surface, found: InstanceSet
) -> ScenePixels:
    """Set the depth of pixels that lie off the fused surface of their object to unknown."""

    def strays(item: Instance) -> tuple[np.ndarray, ...] | None:
        samples = sample_surface(item.id, surface, found)
        rows, v, u = pixels.places(item.id)
        if len(samples) < _MIN_SAMPLES or len(rows) == 0:
            return None
        z = pixels.depth[rows, v, u].astype(np.float64)
        local = camera.unproject(u + 0.5, v + 0.5, z)
        pose = posed.world_from_camera[rows]
        points = np.einsum("nij,nj->ni", pose[:, :3, :3], local) + pose[:, :3, 3]
        stray = _distance(points, samples) > _REACH_M + _REACH_SIGMAS * pixels.noise_relative * z
        return (rows[stray], v[stray], u[stray]) if stray.mean() <= 1.0 - _MIN_BELIEVED else None

    depth = pixels.depth.copy()
    for places in ordered_map(strays, found.objects, MOST_AT_ONCE):
        if places is not None:
            depth[places] = 0.0
    return replace(pixels, depth=depth)


def _distance(points: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Return the distance (n,) of points to the nearest sample (k, 3), to a voxel; infinity outside their box."""
    low, high = samples.min(axis=0), samples.max(axis=0)
    cell = max(_CELL_M, float((np.prod(high - low + 0.1) / _MAX_CELLS) ** (1 / 3)))
    pad = _PAD_CELLS
    start = low - pad * cell
    shape = np.ceil((high - start) / cell).astype(int) + pad
    empty = np.ones(shape, bool)
    empty[tuple(np.floor((samples - start) / cell).astype(int).T)] = False
    distance = np.asarray(ndimage.distance_transform_edt(empty, sampling=cell)).astype(np.float32)
    index = np.floor((points - start) / cell).astype(int)
    inside = ((index >= 0) & (index < shape)).all(axis=1)
    out = np.full(len(points), np.inf, np.float32)
    out[inside] = distance[tuple(index[inside].T)]
    return out
