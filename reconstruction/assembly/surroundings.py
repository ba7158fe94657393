"""Separate an object from the base and placed objects: move it by the least, or cut collision shapes."""

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
from reconstruction.assembly.structure import cut_by_structure
from reconstruction.assembly.workbench import STANDING, Workbench, object_spec
from reconstruction.core.types import AssetSet, BaseAsset
from registry.simulation import pose_change

_MAX_CUTS = 6  # rounds of cutting
_MORE_CLEARANCE_M = 5e-4  # added in each round
_LEAST_LEFT = 0.25  # share of the volume that a cut must leave
_MUCH_LEFT = 0.75  # share of the volume below which hollowing is tried instead of cutting
_NEAR_M = 0.01  # largest gap closed by `let_down`


class Surroundings:
    """The base and the placed objects on the workbench, and operations that separate an object from them."""

    def __init__(self, assets: AssetSet, config: AssemblyConfig) -> None:
        """Start with the base."""
        self.config = config
        self.assets = assets
        self.base = {b.id: b for b in assets.base}
        self.structure = 0 if assets.structure is None else assets.structure.id
        self._plates = () if assets.structure is None else assets.structure.collision
        self.bench = Workbench(base_specs(assets))
        self.placed: dict[int, Placement] = {}
        self.tolerance_m = config.penetration_mm * 1e-3  # penetration that counts as contact

    def put(self, item: Placement) -> None:
        """Put an object on the workbench as its placement says, or replace it there."""
        self.bench.put(object_spec(item.asset, item.parts, item.pose, dynamic=True))

    def commit(self, placement: Placement) -> None:
        """Record a placement, and put the object on the workbench."""
        self.placed[placement.asset.id] = placement
        self.put(placement)

    def met(self, item: Placement) -> set[int]:
        """Return the ids of the bodies that an object on the workbench penetrates."""
        return {c.second for c in self.bench.probe(item.asset.id, item.pose, self.tolerance_m)}

    def out_of_walls(self, item: Placement) -> Placement:
        """Cut off the collision shape behind walls; a dynamic object is first moved out if too much would be cut."""
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
        """Cut off the collision shape behind a base surface, unless nothing would be left."""
        normal = normal_of(base)
        offset = float(distance_to(base, item.pose[:3, 3][None])[0]) - TOUCH_GAP_M - clearance_m
        inward = item.pose[:3, :3].T @ normal
        parts, unflattened = cut(item.parts, inward, offset), cut(item.unflattened, inward, offset)
        return replace(item, parts=parts, unflattened=unflattened) if parts and unflattened else item

    def keep_clear(self, item: Placement, *, shift_m: float, at_any_cost: bool = True) -> Placement:
        """Separate a static object from its neighbors: shift it, or cut the shapes of both.

        Args:
            item: the object at its reconstructed pose.
            shift_m: largest shift before shapes are cut.
            at_any_cost: hollow out a neighbor that fills all of its place; if that fails, the object loses its
                collision shape. Otherwise it does not stand then.
        """
        item = self.give_way_to_neighbors(item)
        self.put(item)
        pose, clear = make_clear(
            self.bench,
            item.asset.id,
            item.pose,
            max_lift_m=0.0,
            max_shift_m=shift_m,
            tolerance_m=self.tolerance_m,
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
        """Move a static object down to its support, if that is less than a centimetre below."""
        self.put(item)
        near = self.bench.probe(item.asset.id, item.pose, -_NEAR_M)
        gap = min((c.separation_m for c in near if c.normal[2] > STANDING), default=0.0)
        return moved_by(item, np.array([0.0, 0.0, TOUCH_GAP_M - gap])) if gap > TOUCH_GAP_M else item

    def give_way_to_neighbors(self, item: Placement) -> Placement:
        """Cut the shapes of an object and its neighbors where they overlap sideways by little."""
        self.put(item)
        for i in sorted(self.met(item) & set(self.placed)):
            other = self.placed[i]
            parts, others, depth = give_way(
                item.parts,
                item.pose,
                other.parts,
                other.pose,
                tolerance_m=self.tolerance_m,
                most_m=self.config.max_give_m,
                rests_on=i == item.edge.parent or other.edge.parent == item.asset.id,
            )
            if depth > 0:
                said = f"its collision shape gave way by up to {depth * 500:.0f} mm to"
                item = item.noted(f"{said} {other.asset.label} {i}", parts=parts, unflattened=parts)
                name = f"{item.asset.label} {item.asset.id}"
                self.commit(other.noted(f"{said} {name}", parts=others, unflattened=others))
        return item

    def cut_clear(self, item: Placement, *, at_any_cost: bool = False) -> Placement:
        """Cut the collision shapes of an object and of the bodies that it penetrates, until they are apart.

        A neighbor whose parts fill air there is hollowed out; otherwise the object is cut. If that would leave little
        of it, the object does not stand or, at any cost, the neighbor is hollowed out even so, or the object loses its
        collision shape.
        """
        before = dict(self.placed)
        opened, removed_m, clearance_m, whole_m3 = item, 0.0, 0.0, volume(item.parts)
        met: set[int] = set()
        for _ in range(_MAX_CUTS):
            self.put(opened)
            met = self.met(opened)
            if not met:
                said = f"its collision shape was cut off {removed_m * 100:.1f} cm inside a neighbor"
                return replace(opened.noted(said) if removed_m > WORTH_SAYING_M else opened, stands=True)
            for i in sorted(met):
                if i in self.base:
                    opened = self.cut_behind(opened, self.base[i], clearance_m)
                    continue
                if i == self.structure:
                    opened, depth_m = self._off_structure(opened, whole_m3, clearance_m)
                    removed_m = max(removed_m, depth_m)
                    continue
                opened, depth_m = self._apart(opened, self.placed[i], whole_m3, clearance_m, at_any_cost)
                removed_m = max(removed_m, depth_m)
            # PhysX merges nearly coplanar faces, so that its hulls are up to millimetres larger.
            clearance_m += _MORE_CLEARANCE_M
        self.back_to(before)
        if at_any_cost:
            names = ", ".join(self._name_of(i) for i in sorted(met))
            said = f"left without a collision shape: no place is free of {names}"
            return item.noted(said, parts=(), unflattened=(), dynamic=False, stands=True)
        self.put(item)
        return item.noted("still overlaps a neighbor", stands=False)

    def _apart(
        self, item: Placement, other: Placement, whole_m3: float, clearance_m: float, at_any_cost: bool
    ) -> tuple[Placement, float]:
        """Cut an object or its neighbor: the object, and the depth that was cut off it."""
        if fills_air(other, item, 0.5 * self.tolerance_m) and self._make_room(other, item, clearance_m):
            return item, 0.0
        tolerance_m = 0.5 * self.tolerance_m
        parts, depth = cut_out(item.parts, item.pose, other.parts, other.pose, tolerance_m, clearance_m)
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

    def _off_structure(self, item: Placement, whole_m3: float, clearance_m: float) -> tuple[Placement, float]:
        """Cut an object by the plates of the structure, unless little would be left: the object, and the depth."""
        parts, depth = cut_by_structure(item, self._plates, 0.5 * self.tolerance_m, clearance_m)
        if volume(parts) < _LEAST_LEFT * whole_m3:
            return item, 0.0
        return replace(item, parts=parts, unflattened=parts), depth

    def clear_air(self, item: Placement) -> bool:
        """Hollow out neighbors whose parts fill air where an object was seen; tell whether there was one."""
        self.put(item)
        met = [self.placed[i] for i in sorted(self.met(item)) if i in self.placed]
        filling = [other for other in met if fills_air(other, item, 0.5 * self.tolerance_m)]
        return any([self._make_room(other, item, 0.0) for other in filling])

    def _make_room(self, other: Placement, item: Placement, clearance_m: float) -> bool:
        """Hollow out a placed object in the place of another; False if little would be left of it."""
        parts = hollowed(other, item, 0.5 * self.tolerance_m, clearance_m)
        if volume(parts) < _LEAST_LEFT * volume(other.parts):
            return False
        said = f"its collision shape was hollowed out where {item.asset.label} {item.asset.id} is"
        known = other if said in other.notes else other.noted(said)
        self.commit(replace(known, parts=parts, unflattened=parts))
        return True

    def back_to(self, before: dict[int, Placement]) -> None:
        """Restore placements of neighbors that changed since `before`."""
        for i, placement in before.items():
            if self.placed.get(i) is not placement:
                self.commit(placement)

    def _name_of(self, i: int) -> str:
        labels = self.assets.static_labels
        return f"{labels[i] if i in labels else self.placed[i].asset.label} {i}"
