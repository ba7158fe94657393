"""Thickness of a flat object on a wall, by a plane sweep over the images.

A picture is 1 to 4 cm thick, which is within the noise of depth maps and of surfaces fused from them. Between views a
metre apart its front shifts by several pixels per centimetre: images rectified onto the right plane agree.
"""

import cv2
import numpy as np

from reconstruction.core.types import Camera, InstanceSet, PosedFrames
from registry.geometry import invert_rigid, transform_points

_CELL_M, _MAX_CELLS = 0.005, 160  # sampling of a plane
_STEP_M, _FAR_M = 0.004, 0.1  # planes: their spacing, and the farthest one from the wall
_RIM_CELLS = 3  # border around the object: a plain front has texture only at its outline
_MAX_VIEWS = 24
_MIN_VIEWS = 4
_MIN_SEEN = 0.25  # share of the rectangle that a view must show
_SMOOTH_CELLS = 6.0  # sigma of the high-pass filter that removes illumination
_NEARLY = 0.25  # tolerance of a minimum, as a share of the rise from the least score to the ends
_MIN_CONTRAST = 0.9  # greatest score of the best plane, relative to the first and last one
_MIN_RISE = 1.0  # least difference to them, squared gray levels


def front_of(
    world_from_grid: np.ndarray, wall_y: float, low: np.ndarray, high: np.ndarray, item: int, posed: PosedFrames,
    camera: Camera, found: InstanceSet,
) -> float | None:  # fmt: skip
    """Return the distance in metres of an object's front from its wall; None where the images do not tell.

    Args:
        world_from_grid: float64 (4, 4); +y of the grid frame points into the wall, +z up.
        wall_y: the wall's y in the grid frame.
        low: float64 (2,) x and z of the object's lower corner.
        high: of its upper corner.
        item: the object's id.
        posed: keyframes in world space.
        camera: the camera at the resolution of the instance maps.
        found: the instances; their maps tell where the object is seen.
    """
    cell = max(_CELL_M, float((high - low).max()) / _MAX_CELLS)
    rim = _RIM_CELLS * cell
    x, z = np.meshgrid(
        np.arange(low[0] - rim, high[0] + rim, cell), np.arange(low[1] - rim, high[1] + rim, cell)
    )
    wall = np.stack([x, np.full_like(x, wall_y), z], axis=-1)
    views = [
        (i, mask)
        for i, ids in enumerate(found.id_maps)
        if (mask := _seen(transform_points(world_from_grid, wall), posed, i, camera, ids, item)).mean()
        > _MIN_SEEN
    ]
    if len(views) < _MIN_VIEWS:
        return None
    views = [views[k] for k in np.unique(np.linspace(0, len(views) - 1, _MAX_VIEWS).round().astype(int))]
    away = np.arange(0.0, _FAR_M, _STEP_M)
    scores = np.array(
        [_disagreement(transform_points(world_from_grid, wall - [0, t, 0]), posed, views) for t in away]
    )
    best, ends = first_minimum(scores), min(scores[0], scores[-1])
    if not 0 < best < len(away) - 1 or scores[best] > min(_MIN_CONTRAST * ends, ends - _MIN_RISE):
        return None
    before, here, after = scores[best - 1 : best + 2]
    return float(away[best] + 0.5 * _STEP_M * (before - after) / max(before - 2 * here + after, 1e-12))


def first_minimum(scores: np.ndarray) -> int:
    """Return the local minimum nearest to the wall among those close to the least score: few views tell them apart."""
    least = float(scores.min())
    inner = np.arange(1, len(scores) - 1)
    low = (scores[inner] <= scores[inner - 1]) & (scores[inner] <= scores[inner + 1])
    near = inner[low & (scores[inner] < least + _NEARLY * (min(scores[0], scores[-1]) - least))]
    return int(near[0]) if len(near) else int(np.argmin(scores))


def _project(
    points: np.ndarray, pose: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return float32 columns and rows (h, w) in pixels of world points (h, w, 3), and which are inside the image."""
    local = transform_points(invert_rigid(np.asarray(pose)), points)
    in_front = local[..., 2] > 0.05
    local[..., 2] = np.maximum(local[..., 2], 1e-6)
    u, v = camera.project(local)
    inside = in_front & (u > 1) & (v > 1) & (u < camera.width - 2) & (v < camera.height - 2)
    return u.astype(np.float32), v.astype(np.float32), inside


def _seen(
    points: np.ndarray, posed: PosedFrames, i: int, camera: Camera, ids: np.ndarray, item: int
) -> np.ndarray:
    """Return which plane points (h, w, 3) show the object in view `i`, dilated by `_RIM_CELLS`."""
    u, v, inside = _project(points, posed.world_from_camera[i], camera)
    out = np.zeros(inside.shape, bool)
    out[inside] = ids[v[inside].astype(int), u[inside].astype(int)] == item
    return cv2.dilate(out.astype(np.uint8), np.ones((2 * _RIM_CELLS + 1,) * 2, np.uint8)) > 0


def _disagreement(points: np.ndarray, posed: PosedFrames, views: list[tuple[int, np.ndarray]]) -> float:
    """Return the variance between views of the high-pass filtered images on a plane of points (h, w, 3), world."""
    shape = points.shape[:2]
    total, squares = np.zeros((*shape, 3), np.float32), np.zeros((*shape, 3), np.float32)
    count = np.zeros((*shape, 1), np.float32)
    for i, mask in views:
        u, v, inside = _project(points, posed.world_from_camera[i], posed.camera)
        image = cv2.remap(np.asarray(posed.images[i]), u, v, cv2.INTER_LINEAR).astype(np.float32)
        weight = (mask & inside).astype(np.float32)[..., None]
        light = cv2.GaussianBlur(image * weight, (0, 0), _SMOOTH_CELLS)
        light /= cv2.GaussianBlur(weight, (0, 0), _SMOOTH_CELLS)[..., None] + 1e-3
        pattern = (image - light) * weight
        total, squares, count = total + pattern, squares + pattern**2, count + weight
    known = count[..., 0] >= _MIN_VIEWS
    if not known.any():
        return float("inf")
    mean = total[known] / count[known]
    return float((squares[known] / count[known] - mean**2).sum(axis=1).mean())
