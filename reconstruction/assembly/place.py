"""Place one object: furniture on the floor, hanging things at their wall, the rest by letting it settle."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from reconstruction.assembly.base import base_slabs
from reconstruction.assembly.collision import cut, flatten_foot, with_legs
from reconstruction.assembly.config import AssemblyConfig
from reconstruction.assembly.tops import level_tops
from reconstruction.assembly.workbench import Settled, Workbench, make_clear, object_spec
from reconstruction.scene_graph.surfaces import sample_object
from reconstruction.types import AssetSet, BaseAsset, ConvexPart, Edge, ObjectAsset
from registry.geometry import rigid, transform_points
from registry.simulation import BASE_FRICTION, BASE_RESTITUTION, BodySpec, pose_change

_FURNITURE_LABELS = (
    "table",
    "desk",
    "shelf",
    "bookshelf",
    "cabinet",
    "sofa",
    "bed",
    "chair",
    "counter",
    "wardrobe",
)
_TOUCH_GAP_M = 2e-4  # hanging things and furniture stop this far short of what they touch
_MAX_CUTS = 8


@dataclass(frozen=True)
class Placement:
    """Where an object stands so far."""

    asset: ObjectAsset
    edge: Edge
    pose: np.ndarray  # (4, 4)
    parts: tuple[ConvexPart, ...]
    unflattened: tuple[ConvexPart, ...]  # before its foot was
    dynamic: bool
    band_mm: float  # how much of its foot was flattened
    notes: tuple[str, ...]
    stands: bool

    def noted(self, note: str, **changes: object) -> "Placement":
        """Return a copy with one more note."""
        return replace(self, notes=(*self.notes, note), **changes)


def base_specs(assets: AssetSet) -> list[BodySpec]:
    """Describe floor, walls and ceiling to the physics."""
    return [
        BodySpec(
            b.id,
            f"{b.label}_{b.id}",
            tuple(np.asarray(p.vertices, np.float64) for p in base_slabs(b)),
            0.0,
            np.zeros(3),
            None,
            BASE_FRICTION,
            BASE_RESTITUTION,
            np.eye(4),
            False,
            base=True,
        )
        for b in assets.base
    ]


def world_points(parts: tuple[ConvexPart, ...], pose: np.ndarray) -> np.ndarray:
    """Return all collision vertices (n, 3) in world space."""
    return transform_points(pose, np.concatenate([np.asarray(p.vertices, np.float64) for p in parts]))


def is_furniture(asset: ObjectAsset, on_base: bool, config: AssemblyConfig) -> bool:
    """Tell whether an object is too large or too heavy to be moved by a robot arm or a bump."""
    extent = float(np.ptp(np.asarray(asset.visual.vertices), axis=0).max())
    labelled = any(word in asset.label.lower().split() for word in _FURNITURE_LABELS)
    large = extent > config.fixed_extent_m or (labelled and extent > 0.65 * config.fixed_extent_m)
    return (on_base and large) or asset.physics.mass_kg > config.fixed_mass_kg


def moves_by_rule(
    asset: ObjectAsset, edge: Edge, on_base: bool, parent_moves: bool, config: AssemblyConfig
) -> bool:
    """Tell whether an object can move in the simulation: furniture cannot, nor what hangs on what cannot."""
    if edge.relation == "attached_to":
        return parent_moves
    return not is_furniture(asset, on_base, config)


def upright(pose: np.ndarray, max_tilt_deg: float) -> np.ndarray:
    """Remove the tilt of a pose that is nearly upright; heading and position stay."""
    up = pose[:3, 2]
    axis = np.cross(up, [0, 0, 1.0])
    sine, cosine = np.linalg.norm(axis), up[2]
    angle = np.degrees(np.arctan2(sine, cosine))
    if angle < 1e-6 or angle > max_tilt_deg:
        return pose
    axis = axis / sine
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = np.eye(3) + sine * k + (1 - cosine) * k @ k
    return rigid(turn @ pose[:3, :3], pose[:3, 3])


class Placer:
    """Places objects one after another on the workbench, parents before children."""

    def __init__(
        self, assets: AssetSet, edges: Sequence[Edge], config: AssemblyConfig, movable: dict[int, bool]
    ) -> None:
        """Start with the base; `movable` is the user's word on what can move."""
        self.config = config
        self._movable = movable
        self._samples = {o.id: sample_object(o) for o in assets.objects}
        self._carried: dict[int, list[int]] = {}
        for edge in edges:
            if edge.relation == "supported_by":
                self._carried.setdefault(edge.parent, []).append(edge.child)
        self.base = {b.id: b for b in assets.base}
        self.bench = Workbench(base_specs(assets))
        self.placed: dict[int, Placement] = {}

    def place(self, asset: ObjectAsset, edge: Edge) -> Placement:
        """Place an object whose parent is placed already."""
        start = upright(asset.world_from_object, self.config.upright_tilt_deg).copy()
        parent = self.placed.get(edge.parent)
        if parent is not None:
            # A parent that was moved takes along what stands on it; its turn is left to gravity.
            start[:3, 3] += parent.pose[:3, 3] - parent.asset.world_from_object[:3, 3]
        on_base = edge.parent in self.base
        children = [self._samples[i] for i in sorted(self._carried.get(asset.id, []))]
        parts, depth = level_tops(asset.collision, self._samples[asset.id], asset.world_from_object, children)
        fresh = Placement(asset, edge, start, parts, parts, True, 0.0, (), True)
        if depth > 0:
            fresh = fresh.noted(f"collision shape cut by up to {depth * 1000:.0f} mm to its visible top")
        moves = self._movable.get(asset.id, not is_furniture(asset, on_base, self.config))
        if edge.relation == "attached_to":
            placement = self._hang(fresh)
        elif on_base and not moves:
            placement = self._stand_furniture(fresh)
        else:
            placement = replace(self._let_settle(fresh), dynamic=moves)
        self.commit(placement)
        return placement

    def commit(self, placement: Placement) -> None:
        """Hold an object still where its placement says."""
        self.placed[placement.asset.id] = placement
        self.bench.put(object_spec(placement.asset, placement.parts, placement.pose, dynamic=True))

    def again(self, asset_id: int) -> Placement:
        """Settle a placed object once more from where it stands, with a flatter foot than it has."""
        old = self.placed[asset_id]
        bands = [b for b in self.config.foot_bands_mm if b > old.band_mm]
        if not bands or old.edge.relation == "attached_to":
            return old
        placement = self._settle_flattened(old, bands[0])
        self.commit(placement)
        return placement

    def hold(self, asset_id: int, note: str) -> Placement:
        """Make a placed thing immovable; where it reaches into its neighbors it is shifted or cut first."""
        old = self.placed[asset_id].noted(note, dynamic=False)
        # Whether it stands by itself is another question, answered before.
        held = replace(self._keep_clear(old, lift=self.config.max_shift_m), stands=old.stands)
        self.commit(held)
        return held

    # Furniture and hanging things: moved as little as possible, never let go.

    def _stand_furniture(self, item: Placement) -> Placement:
        floor = self.base[item.edge.parent]
        item = replace(item, dynamic=False)
        gap = float(_distance(floor, world_points(item.parts, item.pose)).min())
        if gap < -self.config.max_snap_m:
            item = self._cut_behind(item, floor)
            item = item.noted(f"its collision shape was cut off {-gap * 100:.1f} cm inside the {floor.label}")
        elif gap <= self.config.max_snap_m:
            item = _moved(item, (_TOUCH_GAP_M - gap) * _normal(floor))
        else:
            item = item.noted(
                f"its lowest part is {gap * 100:.0f} cm above the {floor.label}; left where it was seen"
            )
        item = self._out_of_walls(item)
        return self._keep_clear(item, lift=0.0)

    def _out_of_walls(self, item: Placement) -> Placement:
        """Move a thing that reaches into a wall out of it a little, and cut its shape off where that is not enough."""
        for wall in self.base.values():
            depth = -float(_distance(wall, world_points(item.parts, item.pose)).min())
            if wall.label == "floor" or depth <= 0 or not _beside(wall, item):
                continue
            push = min(depth + _TOUCH_GAP_M, self.config.max_snap_m)
            item = _moved(item, push * _normal(wall))
            if push < depth:
                item = self._cut_behind(item, wall)
                item = item.noted(
                    f"its collision shape was cut off {depth * 100:.1f} cm inside {wall.label} {wall.id}"
                )
        return item

    def _hang(self, item: Placement) -> Placement:
        parent = self.base.get(item.edge.parent)
        if parent is None:
            carrier = self.placed[item.edge.parent]
            hung = self._keep_clear(replace(item, dynamic=carrier.dynamic), lift=self.config.max_shift_m)
            if hung.stands:
                return hung
            # It cannot hang there without being inside something: let gravity find what carries it.
            standing = replace(item.edge, relation="supported_by")
            return self._let_settle(replace(item, edge=standing).noted("stands: no place to hang was free"))
        item = replace(item, dynamic=False)
        gap = float(_distance(parent, world_points(item.parts, item.pose)).min())
        if abs(gap) <= self.config.max_wall_snap_m:
            item = _moved(item, (_TOUCH_GAP_M - gap) * _normal(parent))
            if abs(gap) > 0.01:
                item = item.noted(
                    f"moved {abs(gap) * 100:.1f} cm {'to' if gap > 0 else 'out of'} the {parent.label}"
                )
        else:
            item = item.noted(
                f"{abs(gap) * 100:.0f} cm {'off' if gap > 0 else 'inside'} the {parent.label}; left there"
            )
        return self._keep_clear(item, lift=self.config.max_shift_m)

    def _cut_behind(self, item: Placement, base: BaseAsset) -> Placement:
        normal = _normal(base)
        offset = float(_distance(base, item.pose[:3, 3][None])[0]) - _TOUCH_GAP_M
        inward = item.pose[:3, :3].T @ normal
        parts, unflattened = cut(item.parts, inward, offset), cut(item.unflattened, inward, offset)
        return replace(item, parts=parts, unflattened=unflattened) if parts and unflattened else item

    def _keep_clear(self, item: Placement, lift: float) -> Placement:
        """Shift a thing that will not be let go out of its neighbors."""
        self.bench.put(object_spec(item.asset, item.parts, item.pose, dynamic=True))
        pose, clear = make_clear(
            self.bench,
            item.asset.id,
            item.pose,
            max_lift_m=lift,
            max_shift_m=self.config.max_shift_m,
            tolerance_m=self.config.penetration_mm * 1e-3,
        )
        moved = pose_change(item.pose, pose)[0]
        if moved > 1e-3:
            item = item.noted(f"shifted {moved * 1000:.0f} mm out of its neighbors")
        item = replace(item, pose=pose, stands=clear)
        return item if clear else self._cut_clear(item)

    def _cut_clear(self, item: Placement) -> Placement:
        """Cut off the collision shape of a thing that stays fixed where it still reaches into its neighbors."""
        tolerance_m = self.config.penetration_mm * 1e-3
        whole, removed_m = item, 0.0
        for _ in range(_MAX_CUTS):
            self.bench.put(object_spec(item.asset, item.parts, item.pose, dynamic=True))
            contacts = self.bench.probe(item.asset.id, item.pose, tolerance_m)
            if not contacts:
                return replace(
                    item.noted(f"its collision shape was cut off {removed_m * 100:.1f} cm inside a neighbor"),
                    stands=True,
                )
            deepest = min(contacts, key=lambda c: c.separation_m)
            removed_m = max(removed_m, -deepest.separation_m)
            # The neighbor ends at the contact; what lies deeper than that, along its normal, goes.
            level = deepest.normal @ deepest.position - deepest.separation_m + _TOUCH_GAP_M
            inward = item.pose[:3, :3].T @ deepest.normal
            offset = float(deepest.normal @ item.pose[:3, 3] - level)
            parts, unflattened = cut(item.parts, inward, offset), cut(item.unflattened, inward, offset)
            if not parts or not unflattened:
                break
            item = replace(item, parts=parts, unflattened=unflattened)
        self.bench.put(object_spec(whole.asset, whole.parts, whole.pose, dynamic=True))
        return whole.noted("still overlaps a neighbor")

    # Everything else: cleared, let go, repaired where it does not stand.

    def _let_settle(self, item: Placement) -> Placement:
        item = self._out_of_walls(item)
        best = self._try(item, item.pose)
        for band in self.config.foot_bands_mm:
            if best[0] < 1.0:
                return best[1]
            best = min(best, self._try(_flattened(item, band), item.pose), key=lambda found: found[0])
        legged = _on_legs(item)
        if best[0] >= 5.0 and legged is not item:
            best = min(best, self._try(legged, item.pose), key=lambda found: found[0])
        for moved in self._shifted(item):
            # Moving an object away from where it was seen is worth it only where it would fall otherwise.
            if best[0] < 5.0:
                break
            best = min(best, self._try(moved, item.pose), key=lambda found: found[0])
        return best[1]

    def _shifted(self, item: Placement) -> Iterator[Placement]:
        """Yield a small search around the pose."""
        flat = _flattened(item, self.config.foot_bands_mm[len(self.config.foot_bands_mm) // 2])
        for radius in self.config.search_shifts_m:
            for angle in np.arange(8) * np.pi / 4:
                moved = _moved(flat, radius * np.array([np.cos(angle), np.sin(angle), 0]))
                yield moved.noted(f"shifted {radius * 1000:.0f} mm to where it stands")

    def _settle_flattened(self, item: Placement, band_mm: float) -> Placement:
        return self._try(_flattened(item, band_mm), item.pose)[1]

    def _try(self, item: Placement, seen: np.ndarray) -> tuple[float, Placement]:
        """Clear, let go and judge against the pose `seen`: cost below 1 is good, below 10 acceptable."""
        config, body = self.config, item.asset.id
        self.bench.put(object_spec(item.asset, item.parts, item.pose, dynamic=True))
        pose, clear = make_clear(
            self.bench,
            body,
            item.pose,
            max_lift_m=config.max_lift_m,
            max_shift_m=config.max_shift_m,
            tolerance_m=config.penetration_mm * 1e-3,
        )
        lift = pose[2, 3] - item.pose[2, 3]
        shift = float(np.hypot(*(pose[:2, 3] - item.pose[:2, 3])))
        end = self.bench.settle(body, pose, config.settle_s)
        away = float(np.hypot(*(pose[:2, 3] - seen[:2, 3])))
        cost = self._cost(end, clear, away)
        notes = item.notes
        if lift > 0.005:
            notes = (*notes, f"lifted {lift * 1000:.0f} mm out of what it was in")
        if shift > 0.005:
            notes = (*notes, f"shifted {shift * 1000:.0f} mm out of its neighbors")
        edge = self._seen_parent(item.edge, end)
        if edge is not item.edge:
            notes = (*notes, f"came to rest on {edge.parent} instead of {item.edge.parent}")
        fell = pose_change(pose, end.pose)[0]
        if cost >= 10 and clear and end.at_rest and fell < config.max_fall_m:
            # In the simulation it would fall at once; at rest it is at least near and harmless.
            return cost, replace(
                item, pose=end.pose, edge=edge, notes=(*notes, _why(end, clear)), stands=True
            )
        if cost >= 10:
            # Where it was cleared is closer to the truth than where it tumbled to.
            return cost, replace(item, pose=pose, notes=(*notes, _why(end, clear)), stands=False)
        return cost, replace(item, pose=end.pose, edge=edge, notes=notes, stands=True)

    def _cost(self, end: Settled, clear: bool, away_m: float) -> float:
        config = self.config
        failed = (
            not clear
            or not end.at_rest
            or end.turned_deg > config.max_turn_deg
            or end.lateral_m > config.max_slide_m
            or end.drop_m > config.max_drop_m + config.max_lift_m
        )
        slip = end.lateral_m / (0.3 * config.max_slide_m)
        return max(end.turned_deg / config.good_turn_deg, slip) + away_m / 0.005 * 0.5 + 10 * failed

    def _seen_parent(self, edge: Edge, end: Settled) -> Edge:
        """Keep the parent unless the object touches it nowhere and rests wholly on something else."""
        if not end.carriers or edge.parent in end.carriers:
            return edge
        evidence = f"rests on it in the simulation; before: {edge.parent}, {edge.evidence}"
        return replace(
            edge, parent=end.carriers[0], confidence=round(0.5 * edge.confidence, 3), evidence=evidence
        )


def _flattened(item: Placement, band_mm: float) -> Placement:
    up = item.pose[:3, :3].T @ np.array([0, 0, 1.0])
    parts = flatten_foot(item.unflattened, up, band_mm * 1e-3)
    kept = tuple(n for n in item.notes if not n.startswith("foot flattened"))
    return replace(item, parts=parts, band_mm=band_mm, notes=(*kept, f"foot flattened by {band_mm:g} mm"))


def _on_legs(item: Placement) -> Placement:
    """Give an upright thing that tips the legs that it must have had, since it stood; slim ones escape the depth."""
    if item.pose[2, 2] < 1 - 1e-6:
        return item
    unflattened = with_legs(item.unflattened)
    if unflattened is item.unflattened:
        return item
    item = item.noted("tips as it was seen: it got legs at its corners, in its collision shape only")
    return replace(item, parts=unflattened, unflattened=unflattened)


def _moved(item: Placement, shift: np.ndarray) -> Placement:
    pose = item.pose.copy()
    pose[:3, 3] += shift
    return replace(item, pose=pose)


def _why(end: Settled, clear: bool) -> str:
    if not clear:
        return "does not stand: no place free of its neighbors was found"
    if not end.at_rest:
        return "does not stand: it does not come to rest"
    return (
        f"does not stand: let go it turns by {end.turned_deg:.0f} degrees, "
        f"slides {end.lateral_m * 100:.1f} cm and drops {end.drop_m * 100:.1f} cm"
    )


def _normal(base: BaseAsset) -> np.ndarray:
    normal = np.asarray(base.plane[:3], np.float64)
    return normal / np.linalg.norm(normal)


def _distance(base: BaseAsset, points: np.ndarray) -> np.ndarray:
    plane = np.asarray(base.plane, np.float64) / np.linalg.norm(base.plane[:3])
    return points @ plane[:3] + plane[3]


def _beside(base: BaseAsset, item: Placement) -> bool:
    """Tell whether an object reaches the part of a wall that exists."""
    points = world_points(item.parts, item.pose)
    low, high = np.asarray(base.visual.vertices).min(axis=0), np.asarray(base.visual.vertices).max(axis=0)
    return bool(np.all(points.max(axis=0) > low - 0.05) and np.all(points.min(axis=0) < high + 0.05))
