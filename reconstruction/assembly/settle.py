"""Let one object settle, in the way that leaves it nearest to where it was seen."""

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
from reconstruction.assembly.workbench import Settled, object_spec, support_margin
from reconstruction.core.types import AssetSet, Edge, ObjectAsset
from registry.geometry import transform_points
from registry.simulation import pose_change

# What a pose costs, in millimetres from where it was seen; a degree of turn, a millimetre of foot taken off.
_TURN_MM, _BAND_MM, _FAILED_MM = 1.0, 0.3, 1000.0
_SAFE_MARGIN_MM, _EDGE_MM = 4.0, 3.0
_NEAR_ENOUGH_MM = 2.0  # no other way is tried
_FAR_MM = 10.0  # it is moved sideways, or gets legs, where that costs less


@dataclass(frozen=True)
class Tried:
    """One way to place an object."""

    cost_mm: float  # how far from where it was seen; `_FAILED_MM` and more: it does not stand
    clear: bool  # nothing was inside it
    placement: Placement

    def better(self, other: "Tried") -> "Tried":
        """Return the cheaper one."""
        return other if other.cost_mm < self.cost_mm else self


class Settler(Surroundings):
    """Lets objects go, one at a time, and repairs those that do not stand."""

    def __init__(self, assets: AssetSet, edges: Sequence[Edge], config: AssemblyConfig) -> None:
        """Start with the base; `edges` say what each object will carry."""
        super().__init__(assets, config)
        self._assets = {o.id: o for o in assets.objects}
        self._carried: dict[int, list[int]] = {}
        for edge in edges:
            if edge.relation == "supported_by":
                self._carried.setdefault(edge.parent, []).append(edge.child)

    def let_settle(self, item: Placement) -> Placement:
        item = self.give_way_to_neighbors(self.out_of_walls(item))
        seen = item.pose
        best = self._try(item, seen)
        if not best.clear:
            # No place nearby is free, whatever its foot is like.
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
            # Moving an object away from where it was seen is worth it only where it would fall otherwise.
            if best.cost_mm < _FAR_MM:
                break
            best = best.better(self._try(moved, seen))
        return best.placement

    def settle_flattened(self, item: Placement, band_mm: float) -> Placement:
        return self._try(flattened(item, band_mm), item.pose).placement

    def _seat(self, item: Placement, best: Tried) -> Tried:
        """Try its carrier's shape made level under the thing, where it was seen to stand; nobody saw the top there."""
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
        changed = replace(carrier, parts=parts, unflattened=parts).noted(said)
        self.commit(changed)
        if self.met(changed) - {item.asset.id} <= before:
            found = self._try(item, item.pose)
            if found.cost_mm < best.cost_mm:
                return found
        self.commit(carrier)
        return best

    def _in_cleared_air(self, item: Placement, best: Tried) -> Tried:
        """Try the place where a thing was seen, once what others' pieces fill there in air is hollowed out."""
        before = dict(self.placed)
        if self.clear_air(item):
            found = self._try(item, item.pose)
            if found.cost_mm < best.cost_mm:
                return found
        self.back_to(before)
        return best

    def _shifted(self, item: Placement) -> Iterator[Placement]:
        """Yield a small search around the pose."""
        flat = flattened(item, self.config.foot_bands_mm[len(self.config.foot_bands_mm) // 2])
        for radius in self.config.search_shifts_m:
            for angle in np.arange(8) * np.pi / 4:
                moved = moved_by(flat, radius * np.array([np.cos(angle), np.sin(angle), 0]))
                yield moved.noted(f"shifted {radius * 1000:.0f} mm to where it stands")

    def _try(self, item: Placement, seen: np.ndarray) -> Tried:
        """Clear, let go and judge against the pose `seen`: what it costs, in millimetres, and where it ends."""
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
            # In the simulation it would fall at once; at rest it is at least near and harmless.
            left = replace(item, pose=end.pose, edge=edge, notes=(*notes, _why(end, clear)), stands=True)
            return Tried(cost, clear, left)
        if cost >= _FAILED_MM:
            # Where it was cleared is closer to the truth than where it tumbled to.
            return Tried(
                cost, clear, replace(item, pose=pose, notes=(*notes, _why(end, clear)), stands=False)
            )
        return Tried(cost, clear, replace(item, pose=end.pose, edge=edge, notes=notes, stands=True))

    def _cost(self, item: Placement, end: Settled, clear: bool, seen: np.ndarray) -> float:
        """Return how far, in millimetres, a thing ends from where it was seen: its middle, turns, a lost foot."""
        config = self.config
        failed = (
            not clear
            or not end.at_rest
            or end.turned_deg > config.max_turn_deg
            or end.lateral_m > config.max_slide_m
            or end.drop_m > config.max_drop_m + config.max_lift_m
        )
        middle = np.append(item.asset.physics.center_of_mass, 1.0)
        moved_mm = 1e3 * float(np.linalg.norm(((end.pose - seen) @ middle)[:3]))
        # What stands on the edge of its support stands until something else is put on it.
        edge_mm = min(max(_SAFE_MARGIN_MM - self._margin_mm(item, end), 0.0), 2 * _SAFE_MARGIN_MM)
        cost = moved_mm + _TURN_MM * end.turned_deg + _BAND_MM * item.band_mm + _EDGE_MM * edge_mm
        return cost + _FAILED_MM * failed

    def _margin_mm(self, item: Placement, end: Settled) -> float:
        """Return how far inside its support a thing's center of mass is, alone and with all that it will carry."""
        alone = (end.pose @ np.append(item.asset.physics.center_of_mass, 1.0))[:2]
        shift = end.pose[:2, 3] - item.asset.world_from_object[:2, 3]
        _, loaded = self._load(item.asset)
        return 1e3 * min(support_margin(end.support, center) for center in (alone, loaded[:2] + shift))

    def _load(self, asset: ObjectAsset) -> tuple[float, np.ndarray]:
        """Return the mass (kg) and the center (3,) of an object and of all that stands on it, as reconstructed."""
        mass = float(asset.physics.mass_kg)
        center = transform_points(asset.world_from_object, asset.physics.center_of_mass[None])[0]
        for i in self._carried.get(asset.id, []):
            more, where = self._load(self._assets[i])
            mass, center = mass + more, (mass * center + more * where) / (mass + more)
        return mass, center

    def _seen_parent(self, edge: Edge, end: Settled) -> Edge:
        """Keep the parent unless the object touches it nowhere and rests wholly on something else."""
        if not end.carriers or edge.parent in end.carriers:
            return edge
        evidence = f"rests on it in the simulation; before: {edge.parent}, {edge.evidence}"
        return replace(
            edge, parent=end.carriers[0], confidence=round(0.5 * edge.confidence, 3), evidence=evidence
        )


def _why(end: Settled, clear: bool) -> str:
    if not clear:
        return "does not stand: no place free of its neighbors was found"
    if not end.at_rest:
        return "does not stand: it does not come to rest"
    return (
        f"does not stand: let go it turns by {end.turned_deg:.0f} degrees, "
        f"slides {end.lateral_m * 100:.1f} cm and drops {end.drop_m * 100:.1f} cm"
    )
