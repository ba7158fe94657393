"""What seems to be behind a thing's far rim: depth and ids err at outlines, and there no frame contradicts them.

Before a rim, or beside it, other frames see past what one frame got wrong. Behind it they see the rim itself or nothing
at all, so that two or three pixels of a few frames draw a thing out by centimetres, on the side that no camera was on.
Such a tail is reported by few frames, by pixels at the outline only, and lies beyond all that was seen well. What is
left of it are whiskers: next to no volume, but whole centimetres of the thing's box.
"""

import numpy as np

from registry.geometry import invert_rigid

_SURE_FRAMES = 2  # saw the surface well inside the thing's outline
_FEW_REPORTS = 0.35  # of the usual number of frames
_SHADOWED = 2.0  # times as many frames as report surface see the rim before it
_AWAY_DEG = (-60.0, -30.0, 0.0, 30.0, 60.0)  # off the direction from the cameras to a thing
_ONE_SIDED = 0.5  # mean of the unit vectors from the cameras, for them to be on one side
_WELL_PERCENT = 99.7  # of the columns that were seen well: the rest may be tail, too
_TAIL_SHARE = 0.06  # of the voxels where surface was seen: more is a part of the thing
_WHISKER_SECTION, _WHISKER_VOLUME = 0.03, 0.0015  # of the usual section, of the thing's volume


def away_directions(camera_from_grid: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Return level unit vectors (k, 2) away from cameras (n, 4, 4); k = 0 where they look from all around."""
    centers = np.array([invert_rigid(pose)[:2, 3] for pose in camera_from_grid]).reshape(-1, 2)
    ways = middle[:2] - centers
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-9)
    if len(ways) == 0 or np.linalg.norm(ways.mean(axis=0)) < _ONE_SIDED:
        return np.zeros((0, 2))
    x, y = ways.mean(axis=0)
    angle = np.arctan2(y, x) + np.radians(_AWAY_DEG)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def behind_rims(
    near: np.ndarray, support: np.ndarray, inner: np.ndarray, shadowed: np.ndarray, away: np.ndarray
) -> np.ndarray:
    """Tell which voxels (nx, ny, nz) with surface only have it by what went wrong at outlines.

    Args:
        near: bool, some frames report surface; at least one voxel.
        support: how many do.
        inner: how many of them with pixels well inside the thing's outline.
        shadowed: how many frames see the thing's surface close before the voxel.
        away: level directions (k, 2) away from the cameras.
    """
    weak = near & (inner < _SURE_FRAMES) & (support < _FEW_REPORTS * np.percentile(support[near], 75))
    return (weak & (shadowed > _SHADOWED * support)) | _beyond(near, weak, away)


def _beyond(near: np.ndarray, weak: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Tell which weakly seen voxels lie farther from the cameras than what was seen well; a large part is no tail."""
    out = np.zeros(near.shape, bool)
    well = np.argwhere((near & ~weak).any(axis=2))
    columns = np.stack(np.meshgrid(*(np.arange(n) for n in near.shape[:2]), indexing="ij"), axis=-1)
    for direction in away if len(well) else ():
        end = float(np.percentile(well @ direction, _WELL_PERCENT))
        own = weak & (columns @ direction > end + 1.0)[:, :, None]
        if own.sum() < _TAIL_SHARE * near.sum():
            out |= own
    return out


def without_whiskers(field: np.ndarray, voxel_m: float, *, top: bool) -> np.ndarray:
    """Return a signed distance field (nx, ny, nz) without what sticks out sideways and is next to nothing.

    Args:
        field: metres, positive outside.
        voxel_m: size of a voxel.
        top: also without what sticks out upwards, such as remains of things that stood on it.
    """
    solid = field < 0
    total = int(solid.sum())
    for axis, sign in ((0, -1), (0, 1), (1, -1), (1, 1), *([(2, 1)] if top else [])):
        sections = solid.sum(axis=tuple(a for a in range(3) if a != axis))[::-sign]
        if not sections.any():
            break
        slim = sections < _WHISKER_SECTION * np.percentile(sections[sections > 0], 90)
        first = int(np.argmin(slim))  # from outside, the first section that is not slim
        if 0 < sections[:first].sum() < _WHISKER_VOLUME * total:
            beyond = (first - 0.5 - np.arange(len(sections), dtype=np.float32)) * voxel_m
            beyond = np.moveaxis(beyond[::-sign][:, None, None], 0, axis)
            field = np.maximum(field, beyond)
            solid = field < 0
    return field
