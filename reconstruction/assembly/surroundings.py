"""What stands around an object, and how it is freed of it: moved by the least, or collision shapes cut."""

from dataclasses import replace

import numpy as np

from reconstruction.assembly.collision import cut
from reconstruction.assembly.collision_trimming import cut_out, give_way
from reconstruction.assembly.config import AssemblyConfig
from reconstruction.assembly.depenetration import make_clear
from reconstruction.assembly.hollow import fills_air, hollowed, volume
from reconstruction.assembly.placement import (
    TOUCH_GAP_M,
    WORTH_SAYING_M,
    Placement,
    base_specs,
    beside,
    distance_to,
    moved_by,
    normal_of,
    world_points,
)
from reconstruction.assembly.workbench import STANDING, Workbench, object_spec
from reconstruction.core.types import AssetSet, BaseAsset
from registry.simulation import pose_change

_MAX_CUTS = 6
_MORE_CLEARANCE_M = 5e-4  # each time
_LEAST_LEFT = 0.25  # of a shape: of which less would be left is in the other thing rather than beside it
_MUCH_LEFT = 0.75
_NEAR_M = 0.01


class Surroundings:
    """The base and all that is placed already, on the workbench."""

    def __init__(self, assets: AssetSet, config: AssemblyConfig) -> None:
        """Start with the base."""
        self.config = config
        self.assets = assets
        self.base = {b.id: b for b in assets.base}
        self.bench = Workbench(base_specs(assets))
        self.placed: dict[int, Placement] = {}

    def commit(self, placement: Placement) -> None:
        """Hold an object still where its placement says."""
        self.placed[placement.asset.id] = placement
        self.bench.put(object_spec(placement.asset, placement.parts, placement.pose, dynamic=True))

    def met(self, item: Placement) -> set[int]:
        """Return what an object on the workbench overlaps where it stands."""
        tolerance_m = self.config.penetration_mm * 1e-3
        return {c.second for c in self.bench.probe(item.asset.id, item.pose, tolerance_m)}

    def out_of_walls(self, item: Placement) -> Placement:
        """Cut off what reaches into a wall; what is let go is moved out of it if it would lose too much."""
        for wall in self.base.values():
            depth = -float(distance_to(wall, world_points(item.parts, item.pose)).min())
            if wall.label == "floor" or depth <= 0 or not beside(wall, item):
                continue
            if item.dynamic and depth > self.config.max_give_m:
                push = min(depth - self.config.max_give_m, self.config.max_snap_m)
                item = moved_by(item, push * normal_of(wall))
            item = self.cut_behind(item, wall)
            if depth > WORTH_SAYING_M:
                said = f"its collision shape was cut off {depth * 100:.1f} cm inside {wall.label} {wall.id}"
                item = item.noted(said)
        return item

    def cut_behind(self, item: Placement, base: BaseAsset, clearance_m: float = 0.0) -> Placement:
        normal = normal_of(base)
        offset = float(distance_to(base, item.pose[:3, 3][None])[0]) - TOUCH_GAP_M - clearance_m
        inward = item.pose[:3, :3].T @ normal
        parts, unflattened = cut(item.parts, inward, offset), cut(item.unflattened, inward, offset)
        return replace(item, parts=parts, unflattened=unflattened) if parts and unflattened else item

    def keep_clear(self, item: Placement, *, shift_m: float, at_any_cost: bool = True) -> Placement:
        """Free a thing that will not be let go of its neighbors: shifted, or the shapes of both cut.

        Args:
            item: Where it was seen.
            shift_m: How far it may be shifted before shapes are cut.
            at_any_cost: A neighbor that takes all of its place is hollowed out; where nothing else is left, the
                thing has no collision shape. Otherwise it does not stand then.
        """
        item = self.give_way_to_neighbors(item)
        self.bench.put(object_spec(item.asset, item.parts, item.pose, dynamic=True))
        pose, clear = make_clear(
            self.bench,
            item.asset.id,
            item.pose,
            max_lift_m=0.0,
            max_shift_m=shift_m,
            tolerance_m=self.config.penetration_mm * 1e-3,
            settles=False,
        )
        if not clear:
            last = shift_m >= self.config.max_shift_m
            opened = self.cut_clear(replace(item, stands=False), at_any_cost=at_any_cost and last)
            if opened.stands or last:
                return opened
            return self.keep_clear(item, shift_m=self.config.max_shift_m, at_any_cost=at_any_cost)
        moved = pose_change(item.pose, pose)[0]
        if moved > 1e-3:
            item = item.noted(f"shifted {moved * 1000:.0f} mm out of its neighbors")
        return replace(item, pose=pose, stands=True)

    def let_down(self, item: Placement) -> Placement:
        """Let a thing that is held touch what carries it, where that is less than a centimetre below."""
        self.bench.put(object_spec(item.asset, item.parts, item.pose, dynamic=True))
        near = self.bench.probe(item.asset.id, item.pose, -_NEAR_M)
        gap = min((c.separation_m for c in near if c.normal[2] > STANDING), default=0.0)
        return moved_by(item, np.array([0.0, 0.0, TOUCH_GAP_M - gap])) if gap > TOUCH_GAP_M else item

    def give_way_to_neighbors(self, item: Placement) -> Placement:
        """Where a thing overlaps its neighbors sideways by less than they are known, cut both shapes, not move it."""
        tolerance_m, most_m = self.config.penetration_mm * 1e-3, self.config.max_give_m
        self.bench.put(object_spec(item.asset, item.parts, item.pose, dynamic=True))
        for i in sorted(self.met(item) & set(self.placed)):
            other = self.placed[i]
            parts, others, depth = give_way(
                item.parts,
                item.pose,
                other.parts,
                other.pose,
                tolerance_m=tolerance_m,
                most_m=most_m,
                rests_on=i == item.edge.parent or other.edge.parent == item.asset.id,
            )
            if depth > 0:
                said = f"its collision shape gave way by up to {depth * 500:.0f} mm to"
                item = replace(item, parts=parts, unflattened=parts).noted(f"{said} {other.asset.label} {i}")
                self.commit(
                    replace(other, parts=others, unflattened=others).noted(
                        f"{said} {item.asset.label} {item.asset.id}"
                    )
                )
        return item

    def cut_clear(self, item: Placement, *, at_any_cost: bool = False) -> Placement:
        """Cut the collision shapes of a thing, where it was seen, and of what it is in, until they are apart.

        A neighbor that fills air there is hollowed out; of what is in its visible surface, the thing is cut off. Where
        that would leave little of it, the thing does not stand, or, at any cost, the neighbor is hollowed out even so,
        or the thing has no collision shape.
        """
        before = dict(self.placed)
        opened, removed_m, clearance_m = item, 0.0, 0.0
        for _ in range(_MAX_CUTS):
            self.bench.put(object_spec(opened.asset, opened.parts, opened.pose, dynamic=True))
            met = self.met(opened)
            if not met:
                said = f"its collision shape was cut off {removed_m * 100:.1f} cm inside a neighbor"
                return replace(opened.noted(said) if removed_m > WORTH_SAYING_M else opened, stands=True)
            for i in sorted(met):
                if i in self.base:
                    opened = self.cut_behind(opened, self.base[i], clearance_m)
                    continue
                made = self._apart(opened, self.placed[i], volume(item.parts), clearance_m, at_any_cost)
                opened, removed_m = made[0], max(removed_m, made[1])
            # PhysX merges faces that are nearly level with each other, so that its hulls are up to millimetres larger.
            clearance_m += _MORE_CLEARANCE_M
        self.back_to(before)
        if at_any_cost:
            names = ", ".join(self._name_of(i) for i in sorted(met))
            said = f"left without a collision shape: no place is free of {names}"
            return replace(item.noted(said), parts=(), unflattened=(), dynamic=False, stands=True)
        self.bench.put(object_spec(item.asset, item.parts, item.pose, dynamic=True))
        return item.noted("still overlaps a neighbor", stands=False)

    def _apart(
        self, item: Placement, other: Placement, whole_m3: float, clearance_m: float, at_any_cost: bool
    ) -> tuple[Placement, float]:
        """Cut a thing or what it is in: the thing, and how deep it was in what it was cut off at."""
        tolerance_m = 0.5 * self.config.penetration_mm * 1e-3
        if fills_air(other, item, tolerance_m) and self._make_room(other, item, clearance_m):
            return item, 0.0
        parts, depth = cut_out(
            item.parts, item.pose, other.parts, other.pose, tolerance_m, clearance_m=clearance_m
        )
        left = volume(parts)
        if left < _MUCH_LEFT * whole_m3:
            around = hollowed(item, other, tolerance_m, clearance_m)
            if volume(around) > left:
                parts, left = around, volume(around)
        if left >= _LEAST_LEFT * whole_m3:
            return replace(item, parts=parts, unflattened=parts), depth
        if not at_any_cost or self._make_room(other, item, clearance_m) or not parts:
            return item, 0.0
        return replace(item, parts=parts, unflattened=parts), depth

    def clear_air(self, item: Placement) -> bool:
        """Hollow out the neighbors whose pieces fill air where a thing was seen; tell whether there was one."""
        self.bench.put(object_spec(item.asset, item.parts, item.pose, dynamic=True))
        tolerance_m = 0.5 * self.config.penetration_mm * 1e-3
        met = [self.placed[i] for i in sorted(self.met(item)) if i in self.placed]
        filling = [other for other in met if fills_air(other, item, tolerance_m)]
        return any([self._make_room(other, item, 0.0) for other in filling])

    def _make_room(self, other: Placement, item: Placement, clearance_m: float) -> bool:
        """Hollow out what is placed already where a thing is; False where little would be left of it."""
        parts = hollowed(other, item, 0.5 * self.config.penetration_mm * 1e-3, clearance_m)
        if volume(parts) < _LEAST_LEFT * volume(other.parts):
            return False
        said = f"its collision shape was hollowed out where {item.asset.label} {item.asset.id} is"
        known = other if said in other.notes else other.noted(said)
        self.commit(replace(known, parts=parts, unflattened=parts))
        return True

    def back_to(self, before: dict[int, Placement]) -> None:
        """Take back what was done to neighbors since."""
        for i, placement in before.items():
            if self.placed.get(i) is not placement:
                self.commit(placement)

    def _name_of(self, i: int) -> str:
        return f"{self.base[i].label if i in self.base else self.placed[i].asset.label} {i}"
