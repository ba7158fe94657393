"""Place one object by simulating it until it rests, with the repair that keeps it nearest to its reconstructed pose."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from reconstruction.assembly.config import AssemblyConfig
from reconstruction.assembly.depenetration import make_clear
from reconstruction.assembly.placement import (
    WORTH_SAYING_M,
    Placement,
    flattened,
    moved_by,
    on_legs,
    world_points,
)
from reconstruction.assembly.surroundings import Surroundings
from reconstruction.assembly.tops import seat
from reconstruction.assembly.workbench import Settled, support_margin
from reconstruction.core.types import AssetSet, Edge, ObjectAsset
from registry.geometry import transform_points
from registry.simulation import pose_change

# Costs in millimetres of displacement: of a degree of rotation, a millimetre of flattened underside, a failure.
_TURN_MM, _BAND_MM, _FAILED_MM = 1.0, 0.3, 1000.0
_SAFE_MARGIN_MM, _EDGE_MM = 4.0, 3.0  # support margin that costs nothing; cost of a millimetre less
_NEAR_ENOUGH_MM = 2.0  # cost below which no repair is tried
_FAR_MM = 10.0  # cost from which legs, seats and shifts are tried


@dataclass(frozen=True)
class Tried:
    """A simulated placement of an object."""

    cost_mm: float  # distance to the reconstructed pose, with penalties; `_FAILED_MM` or more: it fell
    clear: bool  # free of penetration before simulation
    placement: Placement

    def better(self, other: "Tried") -> "Tried":
        """Return the cheaper one."""
        return other if other.cost_mm < self.cost_mm else self


class Settler(Surroundings):
    """Simulates objects, one at a time, and repairs those that do not stand."""

    def __init__(self, assets: AssetSet, edges: Sequence[Edge], config: AssemblyConfig) -> None:
        """Start with the base; `edges` tell what each object supports."""
        super().__init__(assets, config)
        self._assets = {o.id: o for o in assets.objects}
        self._carried: dict[int, list[int]] = {}
        for edge in edges:
            if edge.relation == "supported_by":
                self._carried.setdefault(edge.parent, []).append(edge.child)

    def let_settle(self, item: Placement) -> Placement:
        """Simulate an object until it rests, and try repairs, mildest first, until one costs little enough."""
        item = self.give_way_to_neighbors(self.out_of_walls(item))
        seen = item.pose
        best = self._try(item, seen)
        if not best.clear:
            # No pose nearby is free of penetration: cut shapes.
            before = dict(self.placed)
            opened = self.cut_clear(item)
            cleared = best.better(self._try(opened, seen)) if opened.stands else best
            if cleared is best:
                self.back_to(before)
            return cleared.placement
        if best.cost_mm >= _FAR_MM:
            best = self._in_cleared_air(item, best)
        for band in self.config.foot_bands_mm:
            if best.cost_mm < _NEAR_ENOUGH_MM:
                return best.placement
            best = best.better(self._try(flattened(item, band), seen))
        legged = on_legs(item)
        if best.cost_mm >= _FAR_MM and legged is not item:
            best = best.better(self._try(legged, seen))
        if best.cost_mm >= _FAR_MM:
            best = self._seat(item, best)
        for moved in self._shifted(item):
            # A shift is worth it only if the object would fall otherwise.
            if best.cost_mm < _FAR_MM:
                break
            best = best.better(self._try(moved, seen))
        return best.placement

    def settle_flattened(self, item: Placement, band_mm: float) -> Placement:
        """Simulate an object from its pose, with its underside flattened by `band_mm`."""
        return self._try(flattened(item, band_mm), item.pose).placement

    def _seat(self, item: Placement, best: Tried) -> Tried:
        """Try with the carrier's shape leveled under the object, where its top is hidden."""
        carrier = self.placed.get(item.edge.parent)
        if carrier is None:
            return best
        points = world_points(item.parts, item.pose)
        foot = float(points[:, 2].min())
        place = points[points[:, 2] < foot + WORTH_SAYING_M, :2]
        parts = seat(carrier.parts, carrier.pose, place, foot, 2 * self.config.max_give_m)
        if parts is carrier.parts:
            return best
        said = f"its collision shape was made level under {item.asset.label} {item.asset.id}"
        before = self.met(carrier) - {item.asset.id}
        changed = carrier.noted(said, parts=parts, unflattened=parts)
        self.commit(changed)
        if self.met(changed) - {item.asset.id} <= before:
            found = self._try(item, item.pose)
            if found.cost_mm < best.cost_mm:
                return found
        self.commit(carrier)
        return best

    def _in_cleared_air(self, item: Placement, best: Tried) -> Tried:
        """Try with neighbors hollowed out whose parts fill air in the place of the object."""
        before = dict(self.placed)
        if self.clear_air(item):
            found = self._try(item, item.pose)
            if found.cost_mm < best.cost_mm:
                return found
        self.back_to(before)
        return best

    def _shifted(self, item: Placement) -> Iterator[Placement]:
        """Yield flattened placements shifted sideways around the pose."""
        flat = flattened(item, self.config.foot_bands_mm[len(self.config.foot_bands_mm) // 2])
        for radius in self.config.search_shifts_m:
            for angle in np.arange(8) * np.pi / 4:
                moved = moved_by(flat, radius * np.array([np.cos(angle), np.sin(angle), 0]))
                yield moved.noted(f"shifted {radius * 1000:.0f} mm to where it stands")

    def _try(self, item: Placement, seen: np.ndarray) -> Tried:
        """Move an object out of penetration, simulate it, and rate the result against the pose `seen`."""
        config, body = self.config, item.asset.id
        self.put(item)
        pose, clear = make_clear(
            self.bench,
            body,
            item.pose,
            max_lift_m=config.max_lift_m,
            max_shift_m=config.max_shift_m,
            tolerance_m=self.tolerance_m,
        )
        lift = pose[2, 3] - item.pose[2, 3]
        shift = float(np.hypot(*(pose[:2, 3] - item.pose[:2, 3])))
        end = self.bench.settle(body, pose, config.settle_s)
        cost = self._cost(item, end, clear, seen)
        notes = item.notes
        if lift > WORTH_SAYING_M:
            notes = (*notes, f"lifted {lift * 1000:.0f} mm out of what it was in")
        if shift > WORTH_SAYING_M:
            notes = (*notes, f"shifted {shift * 1000:.0f} mm out of its neighbors")
        edge = self._seen_parent(item.edge, end)
        if edge is not item.edge:
            notes = (*notes, f"came to rest on {edge.parent} instead of {item.edge.parent}")
        fell = pose_change(pose, end.pose)[0]
        if cost >= _FAILED_MM and clear and end.at_rest and fell < config.max_fall_m:
            # It would fall in any simulation; here it is at rest and near its reconstructed pose.
            notes = (*notes, _why(end, clear))
        elif cost >= _FAILED_MM:
            # The pose before simulation is nearer to the reconstructed one than where it tumbled to.
            notes = (*notes, _why(end, clear))
            return Tried(cost, clear, replace(item, pose=pose, notes=notes, stands=False))
        return Tried(cost, clear, replace(item, pose=end.pose, edge=edge, notes=notes, stands=True))

    def _cost(self, item: Placement, end: Settled, clear: bool, seen: np.ndarray) -> float:
        """Return the cost (mm) of displacement of the center of mass, rotation, flattening, a small margin, failure."""
        config = self.config
        tipped = end.turned_deg > config.max_turn_deg or end.lateral_m > config.max_slide_m
        fell = end.drop_m > config.max_drop_m + config.max_lift_m
        failed = not clear or not end.at_rest or tipped or fell
        middle = np.append(item.asset.physics.center_of_mass, 1.0)
        moved_mm = 1e3 * float(np.linalg.norm(((end.pose - seen) @ middle)[:3]))
        # An object at the edge of its support may tip once something is put on it.
        edge_mm = min(max(_SAFE_MARGIN_MM - self._margin_mm(item, end), 0.0), 2 * _SAFE_MARGIN_MM)
        cost = moved_mm + _TURN_MM * end.turned_deg + _BAND_MM * item.band_mm + _EDGE_MM * edge_mm
        return cost + _FAILED_MM * failed

    def _margin_mm(self, item: Placement, end: Settled) -> float:
        """Return the support margin (mm) of the center of mass: the least of alone and with all that it will carry."""
        alone = (end.pose @ np.append(item.asset.physics.center_of_mass, 1.0))[:2]
        shift = end.pose[:2, 3] - item.asset.world_from_object[:2, 3]
        _, loaded = self._load(item.asset)
        return 1e3 * min(support_margin(end.support, center) for center in (alone, loaded[:2] + shift))

    def _load(self, asset: ObjectAsset) -> tuple[float, np.ndarray]:
        """Return mass (kg) and center of mass (3,) of an object and of all that it carries, as reconstructed."""
        mass = float(asset.physics.mass_kg)
        center = transform_points(asset.world_from_object, asset.physics.center_of_mass[None])[0]
        for i in self._carried.get(asset.id, []):
            more, where = self._load(self._assets[i])
            mass, center = mass + more, (mass * center + more * where) / (mass + more)
        return mass, center

    def _seen_parent(self, edge: Edge, end: Settled) -> Edge:
        """Keep the parent, unless the object rests on other bodies only; then the strongest of these."""
        if not end.carriers or edge.parent in end.carriers:
            return edge
        evidence = f"rests on it in the simulation; before: {edge.parent}, {edge.evidence}"
        confidence = round(0.5 * edge.confidence, 3)
        return replace(edge, parent=end.carriers[0], confidence=confidence, evidence=evidence)


def _why(end: Settled, clear: bool) -> str:
    if not clear:
        return "does not stand: no place free of its neighbors was found"
    if not end.at_rest:
        return "does not stand: it does not come to rest"
    return (
        f"does not stand: let go it turns by {end.turned_deg:.0f} degrees, "
        f"slides {end.lateral_m * 100:.1f} cm and drops {end.drop_m * 100:.1f} cm"
    )
