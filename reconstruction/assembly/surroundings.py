"""What stands around an object, and how it is freed of it: moved by the least, or collision shapes cut."""

from dataclasses import replace

import numpy as np

from reconstruction.assembly.clear import make_clear
from reconstruction.assembly.collision import cut
from reconstruction.assembly.config import AssemblyConfig
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
from reconstruction.assembly.yielding import cut_out, give_way
from reconstruction.types import AssetSet, BaseAsset
from registry.simulation import pose_change

_MAX_CUTS = 3
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

    def cut_behind(self, item: Placement, base: BaseAsset) -> Placement:
        normal = normal_of(base)
        offset = float(distance_to(base, item.pose[:3, 3][None])[0]) - TOUCH_GAP_M
        inward = item.pose[:3, :3].T @ normal
        parts, unflattened = cut(item.parts, inward, offset), cut(item.unflattened, inward, offset)
        return replace(item, parts=parts, unflattened=unflattened) if parts and unflattened else item

    def keep_clear(self, item: Placement, *, shift_m: float) -> Placement:
        """Free a thing that will not be let go of its neighbors: shifted by no more than this, or cut."""
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
            opened = self.cut_clear(replace(item, stands=False))
            if opened.stands or shift_m >= self.config.max_shift_m:
                return opened
            return self.keep_clear(item, shift_m=self.config.max_shift_m)
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

    def cut_clear(self, item: Placement) -> Placement:
        """Cut off the collision shape of a thing, where it was seen, that reaches into its neighbors."""
        tolerance_m = self.config.penetration_mm * 1e-3
        whole, removed_m = item, 0.0
        for _ in range(_MAX_CUTS):
            self.bench.put(object_spec(item.asset, item.parts, item.pose, dynamic=True))
            met = self.met(item)
            if not met:
                said = f"its collision shape was cut off {removed_m * 100:.1f} cm inside a neighbor"
                return replace(item.noted(said), stands=True)
            for i in sorted(met):
                if i in self.base:
                    item = self.cut_behind(item, self.base[i])
                    continue
                other = self.placed[i]
                parts, depth = cut_out(item.parts, item.pose, other.parts, other.pose, 0.5 * tolerance_m)
                if not parts:
                    break
                item, removed_m = replace(item, parts=parts, unflattened=parts), max(removed_m, depth)
        self.bench.put(object_spec(whole.asset, whole.parts, whole.pose, dynamic=True))
        return whole.noted("still overlaps a neighbor")
