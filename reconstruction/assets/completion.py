"""From what was seen of an object to a closed signed distance field.

The seen surface is kept. The unknown is closed by contact with the support, by symmetry, and by space carving: what
no ray has freed, inside the hull of what was seen, is solid where seen surface encloses it, and empty where it only
lies in the shadow of an overhang (below a table top, between boards).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from reconstruction.assets import symmetry
from reconstruction.assets.boards import find_board, with_underside
from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.rim_artifacts import without_whiskers
from reconstruction.assets.volume import ObjectFrame, ObjectVolume

_HIDDEN_M = 0.02  # of a foot
_RIM_DIRECTIONS = 6  # of 8: what has more than its own height in so many directions lies within a rim


@dataclass(frozen=True)
class CompletedField:
    """A signed distance field without unknowns."""

    origin: np.ndarray  # float64 (3,) corner of voxel (0, 0, 0), grid frame
    voxel_m: float
    distance: np.ndarray  # float32 (nx, ny, nz), positive outside
    symmetries: tuple[str, ...]


def complete(
    volume: ObjectVolume, frame: ObjectFrame, config: AssetsConfig, *, furniture: bool
) -> CompletedField:
    """Close the unknown part of an object's volume."""
    volume = _settle_on_support(volume, frame)
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


def _settle_on_support(volume: ObjectVolume, frame: ObjectFrame) -> ObjectVolume:
    """Nothing of the object is below its support, and it goes straight down where it meets it.

    Just above the support nothing can be told free (noise), so that the layer above is carried down.
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
    distance[:, :, :first] = volume.trunc_m
    known[:, :, :first] = True
    free[:, :, :first] = True
    return replace(volume, distance=distance, known=known, free=free)


def _drop_skirts(
    distance: np.ndarray,
    known: np.ndarray,
    free: np.ndarray,
    volume: ObjectVolume,
    frame: ObjectFrame,
    first: int,
) -> None:
    """Free what lies flat on the support around the object: support surface that was labelled as the object.

    Depth is uncertain at outlines, so that a rim of the support within the noise counts as object there. What lies
    flat within the object's own rim is its floor, and so is what something stands on.
    """
    height = max(3.0 * volume.noise_m, 2.0 * volume.voxel_m)
    if float(np.percentile(frame.points[:, 2], 98)) < 3.0 * height:
        return
    last = first + int(np.ceil(height / volume.voxel_m))
    taller = ((distance[:, :, last:] < 0) & known[:, :, last:]).any(axis=2)
    # Below unseen space there may still be object.
    hidden = (~known[:, :, last : last + 2]).any(axis=2)
    within = _directions_met(~taller[:, :, None], taller[:, :, None])[:, :, 0] >= _RIM_DIRECTIONS
    skirt = ~taller & ~hidden & ~within
    if volume.carrying is not None:
        skirt &= ~volume.carrying
    for k in range(first, last):
        distance[:, :, k][skirt] = volume.trunc_m
        known[:, :, k][skirt] = True
        free[:, :, k][skirt] = True


def _apply_symmetries(volume: ObjectVolume, frame: ObjectFrame) -> tuple[ObjectVolume, list[str]]:
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
    """Voxels (nx, ny, nz) within a polyhedron of 74 directions around the seen points and their feet."""
    if to_support:
        feet = points.copy()
        feet[:, 2] = np.minimum(feet[:, 2], 0.0)
        points = np.concatenate([points, feet])
    turn = np.arange(24) * (2 * np.pi / 24)
    around = np.stack([np.cos(turn), np.sin(turn), np.zeros(24)], -1)
    up = np.array([0, 0, 1.0])
    tilted = [around * np.cos(t) + up * np.sin(t) for t in (np.radians(30), np.radians(60))]
    directions = np.concatenate([around, *tilted, up[None], -up[None]])
    limit = np.percentile(points @ directions.T, 99.8, axis=0) + 0.3 * volume.voxel_m
    x, y, z = (volume.centers(a).astype(np.float32) for a in range(3))
    inside = np.ones(volume.distance.shape, bool)
    for n, bound in zip(directions.astype(np.float32), limit.astype(np.float32)):
        inside &= (n[0] * x[:, None, None] + n[1] * y[None, :, None] + n[2] * z[None, None, :]) < bound
    return inside


def enclosed(volume: ObjectVolume, hull: np.ndarray, needed: int) -> np.ndarray:
    """Unknown voxels of the hull that meet the inside of the object in `needed` of 8 horizontal directions.

    In each direction the first voxel that is not unknown decides: inside of seen surface, or free space.
    """
    unknown = ~volume.known & hull
    inside = volume.known & (volume.distance < 0)
    return unknown & (_directions_met(unknown, inside) >= needed)


def _directions_met(unknown: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return in how many of 8 horizontal directions (nx, ny, nz) the first voxel that is not unknown is inside."""
    count = np.zeros(unknown.shape, np.uint8)
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        count += _meets(unknown, inside, dx, dy)
    return count


def _meets(unknown: np.ndarray, inside: np.ndarray, dx: int, dy: int) -> np.ndarray:
    """Whether the first voxel in direction (dx, dy) that is not unknown is inside, per voxel."""
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
    """Unknown voxels between the object and its support close below: seen surface ends there, so it stands there."""
    size = np.percentile(frame.points, 99, axis=0) - np.percentile(frame.points, 1, axis=0)
    reach = 0.03 if furniture else max(0.03, 0.4 * float(size[:2].min()))
    solid_above = volume.known & (volume.distance < 0)
    lowest = float(np.percentile(frame.points[:, 2], 1))
    if not frame.on_support:
        reach = min(reach, 0.02)
    elif not furniture and lowest > _HIDDEN_M:  # a rim hides its foot, and nothing floats
        reach = max(reach, lowest + 2 * volume.voxel_m)
        solid_above |= closed
    layers = min(int(np.ceil(reach / volume.voxel_m)), volume.distance.shape[2] - 1)
    z = volume.centers(2)
    first = int(np.searchsorted(z, 0.0))
    out = np.zeros(volume.distance.shape, bool)
    # Walk each column upwards from the support: if only unknown lies between it and the object, it is solid.
    open_column = np.ones(volume.distance.shape[:2], bool)
    reached = np.zeros(volume.distance.shape[:2], bool)
    height = np.zeros(volume.distance.shape[:2], np.int32)
    for k in range(first, min(first + layers + 1, volume.distance.shape[2])):
        hit = open_column & solid_above[:, :, k]
        reached |= hit
        height[hit] = k
        open_column &= ~volume.known[:, :, k] & ~hit
    for k in range(first, min(first + layers + 1, volume.distance.shape[2])):
        out[:, :, k] = reached & (k < height) & ~volume.known[:, :, k]
    return out & hull


def _behind_to_wall(volume: ObjectVolume, frame: ObjectFrame, config: AssetsConfig) -> np.ndarray:
    """For things that hang: solid from the seen front to the wall, at least as thick as `flat_thickness_m`."""
    y = volume.centers(1)
    surface = volume.known & (volume.distance < 0)
    seen = surface.any(axis=1)
    front = np.where(seen, y[np.argmax(surface, axis=1)], np.inf)
    wall = frame.wall_y if frame.wall_y is not None else float(y[-1])
    back = np.maximum(wall, front + config.flat_thickness_m)
    slab = (y[None, :, None] >= front[:, None, :]) & (y[None, :, None] <= back[:, None, :])
    return slab & ~volume.free


def _keep_shells(field: np.ndarray, volume: ObjectVolume, config: AssetsConfig) -> np.ndarray:
    """Limit what lies behind a one-sided shell to solid of at least the minimum thickness (already in the band)."""
    return np.clip(field, -2.0 * max(volume.voxel_m, 0.5 * config.min_thickness_m), 2.0 * volume.voxel_m)


def _blend(field: np.ndarray, volume: ObjectVolume, frame: ObjectFrame) -> np.ndarray:
    """Smooth within the noise where seen, and by two voxels where closed, then cut flat at the support."""
    sigma_seen = float(np.clip(0.7 * volume.noise_m / volume.voxel_m, 0.0, 2.0))
    seen = gaussian_filter(field, sigma_seen) if sigma_seen > 0.3 else field
    if frame.wall_y is None:
        # The cut must not round the bottom edge off: continue the field below it first.
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
