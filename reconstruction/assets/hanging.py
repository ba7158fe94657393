"""Flat things on walls: pictures, mirrors, boards. A slab fits them better than any volume.

Their depth hardly differs from the wall's, so a fused volume is as thick as its noise. And they are often cut by the
image's edge: where no frame ever looked beyond a side, that side is not the thing's own, and the slab goes on until
it is as long as it is wide, which is the likeliest guess for a picture.
"""

from dataclasses import dataclass

import numpy as np

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.solid import Solid, box_solid
from reconstruction.assets.volume import ObjectFrame
from reconstruction.types import PosedFrames
from registry.geometry import transform_points

_MAX_THICKNESS_M = 0.10
_MAX_SPREAD_M = 0.018
_MIN_FLAT_SHARE = 0.6
_TRIM_PERCENT = 1.5
_BEYOND_SHARE, _BEYOND_MIN_M = 0.04, 0.02
_IMAGE_MARGIN = 0.01
_PROBES = 7


@dataclass(frozen=True)
class Hanging:
    """A slab in the grid frame, its back on the wall."""

    body: Solid
    completed: bool  # it goes on where no frame looked


def hanging_slab(frame: ObjectFrame, posed: PosedFrames, config: AssetsConfig) -> Hanging | None:
    """Return the slab of a thing that hangs flat on its wall; None for what is thick, bent or not on a wall.

    Args:
        frame: What was seen of the thing; +y of its grid frame looks into the wall.
        posed: The cameras, in world space: they tell how far the video looked.
        config: `flat_thickness_m` is the least thickness.
    """
    if frame.wall_y is None or len(frame.points) < config.min_points:
        return None
    away_m = frame.wall_y - frame.points[:, 1]
    thickness = float(np.median(away_m))
    spread = 1.4826 * float(np.median(np.abs(away_m - thickness)))
    flat = np.abs(away_m - thickness) < max(2.5 * spread, 0.01)
    if thickness > _MAX_THICKNESS_M or spread > _MAX_SPREAD_M or flat.mean() < _MIN_FLAT_SHARE:
        return None
    thickness = max(thickness, config.flat_thickness_m)
    across = frame.points[flat][:, [0, 2]]
    low, high = np.percentile(across, [_TRIM_PERCENT, 100 - _TRIM_PERCENT], axis=0)
    # Seen points cover the rectangle evenly, so that the trimmed range tells the whole one.
    lost = (high - low) * (0.5 / (1 - 0.02 * _TRIM_PERCENT) - 0.5)
    low, high = low - lost, high + lost
    size = high - low
    if size.min() < 2 * thickness:
        return None
    new_low, new_high = low.copy(), high.copy()
    for axis in (0, 1):
        missing = size[1 - axis] - size[axis]
        if missing <= 0:
            continue
        open_low, open_high = (
            not _looked_beyond(frame, posed, frame.wall_y - thickness, low, high, axis, upper)
            for upper in (False, True)
        )
        if open_low or open_high:
            share = 0.5 if open_low and open_high else 1.0
            new_low[axis] -= missing * share * open_low
            new_high[axis] += missing * share * open_high
    completed = bool((new_low < low).any() or (new_high > high).any())
    front, back = frame.wall_y - thickness, frame.wall_y
    body = box_solid(np.array([new_low[0], front, new_low[1]]), np.array([new_high[0], back, new_high[1]]))
    return Hanging(body, completed)


def _looked_beyond(
    frame: ObjectFrame,
    posed: PosedFrames,
    y: float,
    low: np.ndarray,
    high: np.ndarray,
    axis: int,
    upper: bool,
) -> bool:
    """Tell whether some frame holds most of a strip just beyond one side of the rectangle."""
    size = high - low
    beyond = max(_BEYOND_SHARE * float(size.max()), _BEYOND_MIN_M)
    probes = np.empty((_PROBES, 3))
    along = np.linspace(low[1 - axis], high[1 - axis], _PROBES)
    edge = high[axis] + beyond if upper else low[axis] - beyond
    probes[:, 1] = y
    probes[:, 0 if axis == 0 else 2] = edge
    probes[:, 2 if axis == 0 else 0] = along
    world = transform_points(frame.world_from_grid, probes)
    camera = posed.camera
    margin = _IMAGE_MARGIN * camera.width
    for pose in posed.world_from_camera:
        local = (world - pose[:3, 3]) @ pose[:3, :3]
        z = np.maximum(local[:, 2], 1e-6)
        u = camera.fx * local[:, 0] / z + camera.cx
        v = camera.fy * local[:, 1] / z + camera.cy
        inside = (local[:, 2] > 0.05) & (u > margin) & (u < camera.width - margin)
        inside &= (v > margin) & (v < camera.height - margin)
        if inside.mean() > 0.5:
            return True
    return False
