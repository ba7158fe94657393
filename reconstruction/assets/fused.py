"""What the fused surface knows of a thing: where it is at all, and what no single frame's depth should be believed of.

The surface has been put together from all frames and cut with the votes of many. Depth at outlines, where windows of
the matcher see two surfaces, strays from it: such a pixel of a thing is an error of its frame. And a board seen edge
on by few pixels a frame may still have been fused well.
"""

from dataclasses import replace

import numpy as np
from scipy import ndimage

from reconstruction.assets.views import ScenePixels
from reconstruction.assets.volume import ObjectFrame
from reconstruction.core.types import Camera, InstanceSet, PosedFrames, Surface
from registry.geometry import invert_rigid, transform_points

_CELL_M, _MAX_CELLS = 0.006, 6_000_000
_PAD_CELLS = 6
_REACH_M, _REACH_SIGMAS = 0.012, 2.0
_MIN_SAMPLES = 60
_MIN_BELIEVED = 0.6  # of a thing's pixels; with less, its surface is too poor to judge them
_TRIM_PERCENT = 0.4


def sample_surface(item: int, surface: Surface, found: InstanceSet) -> np.ndarray:
    """Return points (k, 3), world, spread over the triangles of the fused surface that are a thing's, 6 mm apart."""
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
    """Return points (k, 3) on the fused surface of a thing in its grid frame, its outermost slivers left out."""
    points = transform_points(invert_rigid(frame.world_from_grid), sample_surface(item, surface, found))
    if len(points) < _MIN_SAMPLES:
        return np.zeros((0, 3))
    low, high = np.percentile(points, [_TRIM_PERCENT, 100 - _TRIM_PERCENT], axis=0)
    return points[((points >= low) & (points <= high)).all(axis=1)]


def without_strays(
    pixels: ScenePixels, posed: PosedFrames, camera: Camera, surface: Surface, found: InstanceSet
) -> ScenePixels:
    """Return the pixels without the depth of those that lie off the surface of the thing that they show."""
    depth = pixels.depth.copy()
    for item in found.objects:
        samples = sample_surface(item.id, surface, found)
        rows, v, u = np.nonzero((pixels.ids == item.id) & (pixels.depth > 0))
        if len(samples) < _MIN_SAMPLES or len(rows) == 0:
            continue
        z = pixels.depth[rows, v, u].astype(np.float64)
        local = np.stack(
            [(u + 0.5 - camera.cx) / camera.fx * z, (v + 0.5 - camera.cy) / camera.fy * z, z], -1
        )
        pose = posed.world_from_camera[rows]
        points = np.einsum("nij,nj->ni", pose[:, :3, :3], local) + pose[:, :3, 3]
        stray = _distance(points, samples) > _REACH_M + _REACH_SIGMAS * pixels.noise_relative * z
        if stray.mean() <= 1.0 - _MIN_BELIEVED:
            depth[rows[stray], v[stray], u[stray]] = 0.0
    return replace(pixels, depth=depth)


def _distance(points: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Return how far points (n, 3) are from the nearest of some samples (k, 3), to a cell; infinity where far."""
    low, high = samples.min(axis=0), samples.max(axis=0)
    cell = max(_CELL_M, float((np.prod(high - low + 0.1) / _MAX_CELLS) ** (1 / 3)))
    pad = _PAD_CELLS
    start = low - pad * cell
    shape = np.ceil((high - start) / cell).astype(int) + pad
    empty = np.ones(shape, bool)
    empty[tuple(np.floor((samples - start) / cell).astype(int).T)] = False
    distance = ndimage.distance_transform_edt(empty, sampling=cell).astype(np.float32)
    index = np.floor((points - start) / cell).astype(int)
    inside = ((index >= 0) & (index < shape)).all(axis=1)
    out = np.full(len(points), np.inf, np.float32)
    out[inside] = distance[tuple(index[inside].T)]
    return out
