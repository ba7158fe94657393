"""Contact between each object and its carrier: height, footprint, and the volume that a carrier must not fill.

Depth maps bleed over occlusion boundaries, so that a fused table top carries rims of the objects on it. The carrier's
volume is freed where its children stand, and its collision shape is cut level there.
"""

from dataclasses import dataclass, replace

import numpy as np

from reconstruction.assets.support import support_height
from reconstruction.assets.views import MOST_AT_ONCE, ScenePixels, SeenPoints, lift_object, within_outlines
from reconstruction.assets.volume import ObjectFrame, ObjectVolume, without_outliers
from reconstruction.core.types import DepthMaps, Instance, InstanceSet, PosedFrames
from reconstruction.poses.parallel import ordered_map
from registry.geometry import invert_rigid, transform_points

_SAME_LEVEL_M = 0.015  # levels of one parent's children that differ by less are the same level
_BOARD_M = 0.02  # least thickness of the unseen support right below a child
_FOOTPRINT_SHRINK_M = 0.006
_BLEED_REACH_M = 0.06  # how far a child's depth bleeds onto the carrier around it
_RISE_M = 0.004  # least height of a rise above the contact level
_LEAST_HIDDEN_M = 0.01  # least occluded height of a foot
_HIDDEN_BELOW_M = 0.02  # a measured support this far above the foot is the occluding rim
_LEAST_COVERED_M = 0.02  # least visible height of the sides of a covered carrier
_COVERED_REACH_M, _COVERED_OVERLAP_M = 0.008, 0.012  # tolerance of the sides, sideways and upwards
_COVERED_SHARE, _COVERED_POINTS = 0.5, 30  # share and number of the upper side points below the child
_MOST_BEHIND = 0.5  # a wall that cuts off a larger share of the volume is ignored
_LEVEL_AROUND = 0.8  # least share of a rise's surroundings at the contact level


@dataclass(frozen=True)
class Standing:
    """Contact of one object with its carrier."""

    child: int
    parent: int
    level_m: float  # world height of the contact
    known: bool  # the carrier's surface was measured there; False: `level_m` is the object's lowest point
    outline: np.ndarray  # float64 (k, 2) convex footprint of the child, world, counter-clockwise
    top_m: float


@dataclass(frozen=True)
class Stands:
    """All contacts of a scene, and the object points that they were measured from."""

    seen: dict[int, SeenPoints]
    by_child: dict[int, Standing]

    def level(self, child: int) -> float | None:
        """Return the world height of a child's contact; None where it was not measured."""
        found = self.by_child.get(child)
        return found.level_m if found is not None and found.known else None

    def on(self, parent: int) -> tuple[Standing, ...]:
        """Return the contacts of all children of a parent."""
        return tuple(s for s in self.by_child.values() if s.parent == parent)


def find_stands(posed: PosedFrames, depth: DepthMaps, pixels: ScenePixels, found: InstanceSet) -> Stands:
    """Measure where each object with 30 seen points or more touches the carrier that its `support_hint` names."""
    from scipy.spatial import ConvexHull, QhullError

    def seen_points(item: Instance) -> SeenPoints:
        return within_outlines(lift_object(posed, depth, pixels, item.id), posed, depth, pixels, item.id)

    every = ordered_map(seen_points, found.objects, MOST_AT_ONCE)
    seen = {item.id: points for item, points in zip(found.objects, every)}
    # An unlabeled carrier may be the lower part of the object itself: it gets no covered top.
    shaped = {o.id for o in found.objects if o.label != "unknown"}
    by_child: dict[int, Standing] = {}
    carriers: dict[int, SeenPoints] = {}
    for item in found.objects:
        if item.attached_hint or item.support_hint == 0 or len(seen[item.id].points) < 30:
            continue
        points, _ = without_outliers(seen[item.id])
        parent = item.support_hint
        if parent not in carriers:
            carriers[parent] = lift_object(posed, depth, pixels, parent, 150_000)
        low, high = np.percentile(points[:, 2], [0.5, 99.5])
        level = support_height(item, points, carriers.get(parent), found)
        foot = _hidden_foot(item, float(low), float(high))
        if foot is not None and (level is None or level - foot > _HIDDEN_BELOW_M):
            level = foot
        middle = np.median(points[:, :2], axis=0)
        # The outermost points are errors at occlusion boundaries: drop them before the hull.
        flat = points[:: max(1, len(points) // 20_000), :2]
        far = np.linalg.norm(flat - middle, axis=1)
        flat = flat[far <= np.percentile(far, 99.5)]
        try:
            outline = flat[ConvexHull(flat).vertices]
        except (QhullError, ValueError):
            continue
        if level is not None and parent in shaped:
            level = _covered_top(outline, float(low), level, seen[parent].points) or level
        by_child[item.id] = Standing(
            item.id, parent, float(low if level is None else level), level is not None, outline, float(high)
        )
    return Stands(seen, _agreed(by_child))


def _hidden_foot(item: Instance, low: float, high: float) -> float | None:
    """Return the bottom of the instance's box where a container's rim occludes the object's foot; else None.

    At most the lower half of an object counts as occluded.
    """
    bottom = float(item.center[2] - 0.5 * item.extents_m[2])
    return bottom if _LEAST_HIDDEN_M < low - bottom <= high - low else None


def _covered_top(outline: np.ndarray, low: float, level: float, carrier: np.ndarray) -> float | None:
    """Return the height of a carrier's top that its child covers completely; None where it does not.

    Only the sides of such a carrier are seen, and the height where they meet their own support was taken for its top.
    The wall of a container rises as high, but outside the footprint.

    Args:
        outline: the child's footprint (k, 2).
        low: lowest seen height of the child, world.
        level: measured height of the carrier's surface, world.
        carrier: points of the carrier (n, 3), world.
    """
    if low - level < _LEAST_COVERED_M:
        return None
    sides = carrier[carrier[:, 2] > 0.5 * (low + level)]
    below = _within(sides[:, :2], outline, _COVERED_REACH_M)
    if below.sum() < _COVERED_POINTS or below.mean() < _COVERED_SHARE:
        return None
    top = float(np.percentile(sides[below, 2], 95))
    return top if top < low + _COVERED_OVERLAP_M else None


def _agreed(by_child: dict[int, Standing]) -> dict[int, Standing]:
    """Give children of one parent a common level where their levels differ by noise only.

    In a group that mostly agrees, children up to 3 cm lower than the others are raised to its level.
    """
    out = dict(by_child)
    for parent in {s.parent for s in by_child.values()}:
        rest = sorted((s.level_m, s.child) for s in by_child.values() if s.parent == parent and s.known)
        while rest:
            group = [x for x in rest if x[0] - rest[0][0] < 2 * _SAME_LEVEL_M]
            level = float(np.median([x[0] for x in group]))
            agreeing = [x for x in group if abs(x[0] - level) < _SAME_LEVEL_M]
            if len(agreeing) > 0.5 * len(group):
                group = [x for x in group if x[0] < level + _SAME_LEVEL_M]
            else:
                group = agreeing or group[:1]
            for own, child in group:
                out[child] = replace(out[child], level_m=level if len(group) > 1 else own)
            rest = [x for x in rest if x not in group]
    return out


def without_children(
    volume: ObjectVolume, frame: ObjectFrame, standing: tuple[Standing, ...], grow_m: float
) -> ObjectVolume:
    """Free a carrier's volume where its children are, and fill in the board below them.

    Free: above each contact, within the child's footprint grown by `grow_m` and where its depth bleeds onto the carrier
    (`_bleeding`). Solid: a board right below the contact, within the child's footprint and the carrier's own outline,
    as the child occluded it.
    """
    if not standing:
        return volume
    distance, known, free, seen = volume.distance, volume.known, volume.free, volume.seen
    grid_from_world = invert_rigid(frame.world_from_grid)
    x, y, z = (volume.centers(axis) for axis in range(3))
    plane = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    corners_of = [
        transform_points(grid_from_world, np.column_stack([s.outline, np.full(len(s.outline), s.level_m)]))
        for s in standing
    ]
    shape = (len(x), len(y))
    filled = [_within(plane, corners[:, :2], grow_m).reshape(shape) for corners in corners_of]
    every = np.any(filled, axis=0)
    # Children may overhang: a plate on a small box.
    own_plan = np.ones(shape, bool)
    if len(frame.points):
        own_plan = _within(plane, _outline(frame.points[:, :2]), volume.voxel_m).reshape(shape)
    carrying = np.zeros(shape, bool)
    for s, corners, own in zip(standing, corners_of, filled):
        near = _within(plane, corners[:, :2], _BLEED_REACH_M).reshape(shape)
        top = corners[0, 2] + s.top_m - s.level_m
        inside = own | _bleeding(volume, near, every, float(corners[0, 2]), float(top)) if s.known else own
        above = z - corners[0, 2]
        # The field is zero exactly at the contact, which keeps it smooth there.
        wanted = np.clip(above, 0.0, volume.trunc_m).astype(np.float32)
        freed = inside[:, :, None] & (above > 0) & (z < corners[0, 2] + (s.top_m - s.level_m) + grow_m)
        distance = np.where(freed, np.maximum(np.where(known, distance, -np.inf), wanted), distance)
        known, free = known | freed, free | freed
        seen = np.where(freed, above < volume.trunc_m, seen)
        core = _within(plane, corners[:, :2], -_FOOTPRINT_SHRINK_M).reshape(shape) & own_plan
        carrying |= core
        board = core[:, :, None] & (above <= 0) & (above > -max(_BOARD_M, 2.5 * volume.voxel_m))
        wanted = np.maximum(above, -volume.trunc_m).astype(np.float32)
        distance = np.where(board, np.minimum(np.where(known, distance, np.inf), wanted), distance)
        known, free = known | board, free & ~board
    return replace(volume, distance=distance, known=known, free=free, seen=seen, carrying=carrying)


def _bleeding(
    volume: ObjectVolume, near: np.ndarray, filled: np.ndarray, level: float, top: float
) -> np.ndarray:
    """Return the columns (nx, ny) of a carrier that are raised only by depth bleeding from a child beside them.

    A connected rise is bleeding where all of it is near the child and no higher than the child, and the carrier around
    it is at the contact level. The rim of a container extends farther, or has nothing beyond it.

    Args:
        volume: the carrier.
        near: bool (nx, ny) columns within `_BLEED_REACH_M` of the child's footprint.
        filled: bool (nx, ny) columns below any child.
        level: contact height, grid frame.
        top: height of the child's top, grid frame.
    """
    from scipy.ndimage import binary_dilation, label

    z = volume.centers(2)
    solid = volume.known & (volume.distance < 0)
    least = level + max(_RISE_M, 0.5 * volume.voxel_m)
    raised = solid[:, :, z > least].any(axis=2) & ~filled
    tall = solid[:, :, z > top + volume.voxel_m].any(axis=2)
    at_level = (
        solid[:, :, (z < least) & (z > level - _BOARD_M - volume.voxel_m)].any(axis=2) & ~raised & ~filled
    )
    out = np.zeros(raised.shape, bool)
    rises = label(raised, np.ones((3, 3)))[0]  # pyright: ignore[reportIndexIssue]
    for number in np.unique(rises[near & raised]):
        own = rises == number
        around = binary_dilation(own, np.ones((3, 3))) & ~own & ~filled
        if (own & ~near).any() or (own & tall).any() or not around.any():
            continue
        if at_level[around].mean() >= _LEVEL_AROUND:
            out |= own
    return out


def within_walls(volume: ObjectVolume, frame: ObjectFrame, found: InstanceSet) -> ObjectVolume:
    """Free the columns behind a wall: wall pixels between the boards of a shelf are not the shelf's."""
    walls = [b.surface.plane for b in found.base if b.label == "wall"]
    if not walls or frame.wall_y is not None:
        return volume
    x, y = volume.centers(0), volume.centers(1)
    corners = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    world = transform_points(frame.world_from_grid, np.column_stack([corners, np.zeros(len(corners))]))
    behind = np.zeros(len(world), bool)
    for plane in walls:
        behind |= world @ plane[:3] + plane[3] < 0
    behind = behind.reshape(len(x), len(y))
    if not behind.any() or behind.mean() > _MOST_BEHIND:
        return volume
    distance, known, free, seen = (
        getattr(volume, name).copy() for name in ("distance", "known", "free", "seen")
    )
    distance[behind], known[behind], free[behind], seen[behind] = volume.trunc_m, True, True, False
    return replace(volume, distance=distance, known=known, free=free, seen=seen)


def _outline(points: np.ndarray) -> np.ndarray:
    """Return the convex outline (k, 2), counter-clockwise, of points (n, 2) without the outermost ones."""
    from scipy.spatial import ConvexHull, QhullError

    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    inner = points[((points >= low) & (points <= high)).all(axis=1)]
    try:
        return inner[ConvexHull(inner).vertices]
    except (QhullError, ValueError):
        return np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])


def _within(points: np.ndarray, outline: np.ndarray, grow_m: float) -> np.ndarray:
    """Return which points (n, 2) lie in a counter-clockwise convex outline offset outwards by `grow_m`."""
    inside = np.ones(len(points), bool)
    for a, b in zip(outline, np.roll(outline, -1, axis=0)):
        edge = b - a
        length = np.linalg.norm(edge)
        if length > 1e-9:
            normal = np.array([edge[1], -edge[0]]) / length
            inside &= (points - a) @ normal < grow_m
    return inside
