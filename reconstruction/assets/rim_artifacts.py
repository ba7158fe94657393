"""Removal of false surface behind an object's far rim, where no frame contradicts errors of depth and ids.

Before or beside a rim, other frames see past the error of one frame. Behind it they see the rim or nothing, so that a
few outline pixels of a few frames extend the object by centimetres, away from the cameras. Such a tail is reported by
few frames, by outline pixels only, and lies beyond all well seen surface. Completion leaves whiskers of it: hardly any
volume, but centimetres of the object's box.
"""

import numpy as np

from registry.geometry import invert_rigid

_SURE_FRAMES = 2  # frames with pixels well inside the outline that make surface certain
_FEW_REPORTS = 0.35  # of the usual number of frames: weakly seen
_SHADOWED = (
    2.0  # a weak voxel is false if this many times more frames see the rim before it than surface at it
)
_AWAY_DEG = (-60.0, -30.0, 0.0, 30.0, 60.0)  # relative to the mean direction from the cameras
_ONE_SIDED = 0.5  # least length of the mean unit vector from the cameras, for them to be on one side
_WELL_PERCENT = 99.7  # of the well seen columns: the rest may be tail, too
_TAIL_SHARE = 0.06  # greatest share of the surface voxels; more is a part of the object
_WHISKER_SECTION, _WHISKER_VOLUME = 0.03, 0.0015  # of the usual cross-section, of the object's volume


def away_directions(camera_from_grid: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Return horizontal unit vectors (k, 2) away from cameras (n, 4, 4); none if they are all around `middle`."""
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
    """Return which surface voxels (nx, ny, nz) are errors at outlines.

    Args:
        near: bool (nx, ny, nz) voxels with surface, at least one.
        support: number of frames that saw it.
        inner: number of those with pixels well inside the outline.
        shadowed: number of frames that saw the object's surface close before the voxel.
        away: directions (k, 2) of `away_directions`.
    """
    weak = near & (inner < _SURE_FRAMES) & (support < _FEW_REPORTS * np.percentile(support[near], 75))
    return (weak & (shadowed > _SHADOWED * support)) | _beyond(near, weak, away)


def _beyond(near: np.ndarray, weak: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Return the weak voxels farther from the cameras than all well seen ones; none where they are too many."""
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
    """Cut thin protrusions of little volume off a signed distance field (nx, ny, nz), at its sides.

    Args:
        field: metres, positive outside.
        voxel_m: edge of a voxel.
        top: also at the top, where remains of carried objects are.
    """
    solid = field < 0
    total = int(solid.sum())
    for axis, sign in ((0, -1), (0, 1), (1, -1), (1, 1), *([(2, 1)] if top else [])):
        sections = solid.sum(axis=tuple(a for a in range(3) if a != axis))[::-sign]
        if not sections.any():
            break
        slim = sections < _WHISKER_SECTION * np.percentile(sections[sections > 0], 90)
        first = int(np.argmin(slim))  # from outside, the first thick section
        if 0 < sections[:first].sum() < _WHISKER_VOLUME * total:
            beyond = (first - 0.5 - np.arange(len(sections), dtype=np.float32)) * voxel_m
            beyond = np.moveaxis(beyond[::-sign][:, None, None], 0, axis)
            field = np.maximum(field, beyond)
            solid = field < 0
    return field
