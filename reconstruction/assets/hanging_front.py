"""How far a flat thing stands out from its wall, by the images: there its front agrees between views.

A picture is 1 to 4 cm thick, which is within the noise of depth maps and of every surface fused from them. But between
places a metre apart its front shifts by several pixels a centimetre, so that views rectified onto the right plane
agree, and onto any other one do not.
"""

import cv2
import numpy as np

from reconstruction.core.types import Camera, InstanceSet, PosedFrames
from registry.geometry import invert_rigid, transform_points

_CELL_M, _MAX_CELLS = 0.005, 160
_STEP_M, _FAR_M = 0.004, 0.1
_RIM_CELLS = 3
_MAX_VIEWS = 24
_MIN_VIEWS = 4
_MIN_SEEN = 0.25  # of the rectangle, for a view to count
_SMOOTH_CELLS = 6.0  # coarser than this is light, not a pattern
_NEARLY = 0.25  # of the rise from the least to the ends
_MIN_CONTRAST = 0.9  # the best plane's variance over that of the wall's or the farthest one
_MIN_RISE = 1.0  # squared gray levels: below it, no view differs from any other


def front_of(
    world_from_grid: np.ndarray, wall_y: float, low: np.ndarray, high: np.ndarray, item: int, posed: PosedFrames,
    camera: Camera, found: InstanceSet,
) -> float | None:  # fmt: skip
    """Return the distance in metres of a thing's front from its wall; None where the images do not tell.

    Args:
        world_from_grid: float64 (4, 4) of a frame whose +y looks into the wall and whose z is up.
        wall_y: where the wall is.
        low: float64 (2,) x and z of the thing's lower corner.
        high: of its upper corner.
        item: the thing's id.
        posed: keyframes in the same world.
        camera: the camera at the resolution of the instance maps.
        found: its instance maps tell where the thing is seen.
    """
    cell = max(_CELL_M, float((high - low).max()) / _MAX_CELLS)
    rim = _RIM_CELLS * cell  # a plain front shows only in its outline
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
    best, ends = _first_minimum(scores), min(scores[0], scores[-1])
    if not 0 < best < len(away) - 1 or scores[best] > min(_MIN_CONTRAST * ends, ends - _MIN_RISE):
        return None
    before, here, after = scores[best - 1 : best + 2]
    return float(away[best] + 0.5 * _STEP_M * (before - after) / max(before - 2 * here + after, 1e-12))


def _first_minimum(scores: np.ndarray) -> int:
    """Return the minimum nearest to the wall of those that hardly differ from the least: few views agree on several."""
    least = float(scores.min())
    inner = np.arange(1, len(scores) - 1)
    low = (scores[inner] <= scores[inner - 1]) & (scores[inner] <= scores[inner + 1])
    near = inner[low & (scores[inner] < least + _NEARLY * (min(scores[0], scores[-1]) - least))]
    return int(near[0]) if len(near) else int(np.argmin(scores))


def _project(
    points: np.ndarray, pose: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return float32 columns and rows in pixels, and where points (h, w, 3) are inside the image."""
    local = transform_points(invert_rigid(np.asarray(pose)), points)
    depth = np.maximum(local[..., 2], 1e-6)
    u = camera.fx * local[..., 0] / depth + camera.cx
    v = camera.fy * local[..., 1] / depth + camera.cy
    inside = (local[..., 2] > 0.05) & (u > 1) & (v > 1) & (u < camera.width - 2) & (v < camera.height - 2)
    return u.astype(np.float32), v.astype(np.float32), inside


def _seen(
    points: np.ndarray, posed: PosedFrames, i: int, camera: Camera, ids: np.ndarray, item: int
) -> np.ndarray:
    u, v, inside = _project(points, posed.world_from_camera[i], camera)
    out = np.zeros(inside.shape, bool)
    out[inside] = ids[v[inside].astype(int), u[inside].astype(int)] == item
    return cv2.dilate(out.astype(np.uint8), np.ones((2 * _RIM_CELLS + 1,) * 2, np.uint8)) > 0


def _disagreement(points: np.ndarray, posed: PosedFrames, views: list[tuple[int, np.ndarray]]) -> float:
    """Return the variance between views of the pattern on a plane, points (h, w, 3) in world space."""
    total, squares, count = 0.0, 0.0, 0.0
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
