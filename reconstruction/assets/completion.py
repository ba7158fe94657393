"""Completion of an object's volume to a closed signed distance field.

Seen surface is kept. Unknown voxels are decided by contact with the support, by symmetry, and by space carving: those
that no ray freed, inside the hull of the seen points, are solid where seen surface encloses them, and empty where they
only lie in the shadow of an overhang (below a table top, between boards).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from reconstruction.assets import symmetry
from reconstruction.assets.boards import find_board, with_underside
from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.rim_artifacts import without_whiskers
from reconstruction.assets.volume import ObjectFrame, ObjectVolume

_HIDDEN_M = 0.02  # an object whose seen points start higher has an occluded foot
_RIM_DIRECTIONS = 6  # of 8 in which taller voxels surround a low one: it lies within the object's rim


@dataclass(frozen=True)
class CompletedField:
    """A signed distance field without unknown voxels."""

    origin: np.ndarray  # float64 (3,) corner of voxel (0, 0, 0), grid frame
    voxel_m: float
    distance: np.ndarray  # float32 (nx, ny, nz), positive outside
    symmetries: tuple[str, ...]  # applied ones with their scores


def complete(
    volume: ObjectVolume, frame: ObjectFrame, config: AssetsConfig, *, furniture: bool
) -> CompletedField:
    """Decide the unknown voxels of an object's volume; see the module."""
    volume = settle_on_support(volume, frame)
    names: list[str] = []
    if config.symmetry and frame.wall_y is None:
        volume, names = _apply_symmetries(volume, frame)
    if frame.wall_y is not None:
        solid = _behind_to_wall(volume, frame, config)
    else:
        hull = hull_region(volume, frame.points, to_support=True)
        solid = enclosed(volume, hull, config.enclosed_directions)
        solid |= _contact(volume, hull, frame, solid, furniture=furniture)
        board = find_board(volume, frame) if furniture else None
        if board is not None:
            volume, solid = with_underside(volume, solid, board)
    field = np.where(volume.known, volume.distance, np.where(solid, -volume.trunc_m, volume.trunc_m))
    field = _keep_shells(field.astype(np.float32), volume, config)
    field = _blend(field, volume, frame)
    if frame.wall_y is None:
        field = without_whiskers(field, volume.voxel_m, top=furniture)
    return CompletedField(volume.origin, volume.voxel_m, field, tuple(names))


def settle_on_support(volume: ObjectVolume, frame: ObjectFrame) -> ObjectVolume:
    """Free everything below the support, and extend the object straight down to it.

    Noise hides free space just above the support: unknown voxels there take the value above them.
    """
    if frame.wall_y is not None:
        return volume
    distance, known, free = volume.distance.copy(), volume.known.copy(), volume.free.copy()
    z = volume.centers(2)
    first = int(np.searchsorted(z, 0.0))
    top = min(int(np.searchsorted(z, 1.1 * volume.trunc_m)), len(z) - 1)
    if frame.on_support:
        for k in range(top - 1, first - 1, -1):
            carry = ~known[:, :, k] & known[:, :, k + 1]
            distance[:, :, k][carry] = distance[:, :, k + 1][carry]
            free[:, :, k][carry] = free[:, :, k + 1][carry]
            known[:, :, k] |= carry
        _drop_skirts(distance, known, free, volume, frame, first)
    distance[:, :, :first], known[:, :, :first], free[:, :, :first] = volume.trunc_m, True, True
    return replace(volume, distance=distance, known=known, free=free)


def _drop_skirts(
    distance: np.ndarray, known: np.ndarray, free: np.ndarray, volume: ObjectVolume, frame: ObjectFrame, first: int
) -> None:  # fmt: skip
    """Free (in place) support surface around the object that was labeled as the object.

    It is low and outside the object's rim, as depth noise at occlusion boundaries leaves it. Low voxels within the rim
    are the object's floor; so are columns that children stand on.
    """
    height = max(3.0 * volume.noise_m, 2.0 * volume.voxel_m)
    if float(np.percentile(frame.points[:, 2], 98)) < 3.0 * height:
        return
    last = first + int(np.ceil(height / volume.voxel_m))
    taller = np.any((distance[:, :, last:] < 0) & known[:, :, last:], axis=2, keepdims=True)
    # Unseen space above may hide the object.
    hidden = (~known[:, :, last : last + 2]).any(axis=2)
    within = _directions_met(~taller, taller) >= _RIM_DIRECTIONS
    skirt = ~(taller | within)[:, :, 0] & ~hidden
    if volume.carrying is not None:
        skirt &= ~volume.carrying
    low = np.s_[first:last]
    distance[skirt, low], known[skirt, low], free[skirt, low] = volume.trunc_m, True, True


def _apply_symmetries(volume: ObjectVolume, frame: ObjectFrame) -> tuple[ObjectVolume, list[str]]:
    """Complete a volume by rotation symmetry, else by mirror symmetries; return it with what was applied."""
    axis = symmetry.fit_axis(frame.points, frame.normals)
    if axis is not None and np.linalg.norm(axis) < 0.35 * np.ptp(frame.points[:, :2], axis=0).max():
        distance, known, score = symmetry.rotate_complete(volume, axis, frame.points, frame.normals)
        if score > 0.75:
            return replace(volume, distance=distance, known=known), [f"rotation {score:.2f}"]
    names = []
    for direction in (0, 1):
        found = symmetry.find_mirror(volume, frame.points, direction)
        if found is not None:
            distance, known = symmetry.mirror_complete(volume, found)
            volume = replace(volume, distance=distance, known=known)
            names.append(f"{found.kind} {found.agreement:.2f}")
    return volume, names


def hull_region(volume: ObjectVolume, points: np.ndarray, *, to_support: bool) -> np.ndarray:
    """Return the voxels (nx, ny, nz) in the discrete hull, of 74 directions, of points (k, 3) and their feet."""
    if to_support:
        feet = points.copy()
        feet[:, 2] = np.minimum(feet[:, 2], 0.0)
        points = np.concatenate([points, feet])
    turn = np.arange(24) * (2 * np.pi / 24)
    around = np.stack([np.cos(turn), np.sin(turn), np.zeros(24)], -1)
    up = np.array([0, 0, 1.0])
    tilted = [around * np.cos(t) + up * np.sin(t) for t in (np.radians(30), np.radians(60))]
    directions = np.concatenate([around, *tilted, up[None], -up[None]])
    limits = np.percentile(directions @ points.T, 99.8, axis=1) + 0.3 * volume.voxel_m
    x, y, z = (volume.centers(a) for a in range(3))
    # Per column: whether it is inside sideways, and between which heights.
    within = np.ones((len(x), len(y)), bool)
    lowest, highest = -limits[-1], np.full(within.shape, np.inf)
    for n, limit in zip(directions[:-1], limits):
        left = limit - n[0] * x[:, None] - n[1] * y
        if n[2] > 0:
            highest = np.minimum(highest, left / n[2])
        else:
            within &= left > 0
    return within[:, :, None] & (z > lowest) & (z < highest[:, :, None])


def enclosed(volume: ObjectVolume, hull: np.ndarray, needed: int) -> np.ndarray:
    """Return the unknown voxels of the hull that are enclosed: in `needed` of 8 horizontal directions.

    In each direction the first voxel that is not unknown decides: inside the object, or free.
    """
    unknown = ~volume.known & hull
    inside = volume.known & (volume.distance < 0)
    return unknown & (_directions_met(unknown, inside) >= needed)


def _directions_met(unknown: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return in how many of 8 horizontal directions the first voxel that is not unknown is inside: (nx, ny, nz)."""
    count = np.zeros(unknown.shape, np.uint8)
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        count += _meets(unknown, inside, dx, dy)
    return count


def _meets(unknown: np.ndarray, inside: np.ndarray, dx: int, dy: int) -> np.ndarray:
    """Return whether the first voxel in direction (dx, dy) that is not unknown is inside, per voxel."""
    if dx == 0:
        return _meets(unknown.swapaxes(0, 1), inside.swapaxes(0, 1), dy, 0).swapaxes(0, 1)
    out = inside.copy()
    order = range(unknown.shape[0] - 2, -1, -1) if dx > 0 else range(1, unknown.shape[0])
    for i in order:
        ahead = out[i + dx]
        if dy:
            shifted = np.zeros_like(ahead)
            if dy > 0:
                shifted[:-1] = ahead[1:]
            else:
                shifted[1:] = ahead[:-1]
            ahead = shifted
        out[i] = np.where(unknown[i], ahead, inside[i])
    return out


def _contact(
    volume: ObjectVolume, hull: np.ndarray, frame: ObjectFrame, closed: np.ndarray, *, furniture: bool
) -> np.ndarray:
    """Return the unknown voxels between an object's seen surface and its support: objects stand, they do not float."""
    size = np.percentile(frame.points, 99, axis=0) - np.percentile(frame.points, 1, axis=0)
    reach = 0.03 if furniture else max(0.03, 0.4 * float(size[:2].min()))
    solid_above = volume.known & (volume.distance < 0)
    lowest = float(np.percentile(frame.points[:, 2], 1))
    if not frame.on_support:
        reach = min(reach, 0.02)
    elif not furniture and lowest > _HIDDEN_M:  # a rim occludes its foot
        reach = max(reach, lowest + 2 * volume.voxel_m)
        solid_above |= closed
    layers = min(int(np.ceil(reach / volume.voxel_m)), volume.distance.shape[2] - 1)
    z = volume.centers(2)
    first = int(np.searchsorted(z, 0.0))
    # Walk each column up from the support: where only unknown lies between it and the object, that is solid.
    open_column = np.ones(volume.distance.shape[:2], bool)
    height = np.zeros(volume.distance.shape[:2], np.int32)
    for k in range(first, min(first + layers + 1, volume.distance.shape[2])):
        hit = open_column & solid_above[:, :, k]
        height[hit] = k
        open_column &= ~volume.known[:, :, k] & ~hit
    layer = np.arange(volume.distance.shape[2])
    return (layer >= first) & (layer < height[:, :, None]) & ~volume.known & hull


def _behind_to_wall(volume: ObjectVolume, frame: ObjectFrame, config: AssetsConfig) -> np.ndarray:
    """Return the solid voxels of a hanging object: from its seen front to the wall, at least `flat_thickness_m`."""
    assert frame.wall_y is not None
    y = volume.centers(1)
    surface = volume.known & (volume.distance < 0)
    seen = surface.any(axis=1)
    front = np.where(seen, y[np.argmax(surface, axis=1)], np.inf)
    back = np.maximum(frame.wall_y, front + config.flat_thickness_m)
    slab = (y[None, :, None] >= front[:, None, :]) & (y[None, :, None] <= back[:, None, :])
    return slab & ~volume.free


def _keep_shells(field: np.ndarray, volume: ObjectVolume, config: AssetsConfig) -> np.ndarray:
    """Clip the field to about the minimum thickness inside and two voxels outside."""
    return np.clip(field, -2.0 * max(volume.voxel_m, 0.5 * config.min_thickness_m), 2.0 * volume.voxel_m)


def _blend(field: np.ndarray, volume: ObjectVolume, frame: ObjectFrame) -> np.ndarray:
    """Smooth by the noise where seen and by two voxels where completed, then cut flat at the support."""
    sigma_seen = float(np.clip(0.7 * volume.noise_m / volume.voxel_m, 0.0, 2.0))
    seen = gaussian_filter(field, sigma_seen) if sigma_seen > 0.3 else field
    if frame.wall_y is None:
        # Continue the field below the cut first, so that smoothing does not round the bottom edge.
        first = int(np.searchsorted(volume.centers(2), 0.0))
        if 0 < first < field.shape[2]:
            field = field.copy()
            field[:, :, :first] = field[:, :, first : first + 1]
            seen = np.concatenate([field[:, :, :first], seen[:, :, first:]], axis=2)
    closed = gaussian_filter(field, 1.8)
    weight = np.clip(2.0 * gaussian_filter(volume.seen.astype(np.float32), 0.8), 0.0, 1.0)
    out = weight * seen + (1 - weight) * closed
    if frame.wall_y is None:
        z = volume.centers(2).astype(np.float32)
        out = np.maximum(out, -z[None, None, :])
    border = 1.0 * volume.voxel_m
    for axis in range(3):
        view = np.moveaxis(out, axis, 0)
        view[0], view[-1] = np.maximum(view[0], border), np.maximum(view[-1], border)
    return np.ascontiguousarray(out, np.float32)
