"""What stands around an object, and how it is freed of it: moved by the least, or collision shapes cut."""

from dataclasses import replace

from reconstruction.assembly.clear import make_clear
from reconstruction.assembly.collision import cut
from reconstruction.assembly.config import AssemblyConfig
from reconstruction.assembly.placement import (
    TOUCH_GAP_M,
    Placement,
    base_specs,
    beside,
    distance_to,
    moved_by,
    normal_of,
    world_points,
)
from reconstruction.assembly.workbench import Workbench, object_spec
from reconstruction.assembly.yielding import give_way
from reconstruction.types import AssetSet, BaseAsset
from registry.simulation import pose_change

_MAX_CUTS = 8


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
        """Move a thing that reaches into a wall out of it a little, and cut its shape off where that is not enough."""
        for wall in self.base.values():
            depth = -float(distance_to(wall, world_points(item.parts, item.pose)).min())
            if wall.label == "floor" or depth <= 0 or not beside(wall, item):
                continue
            push = min(depth + TOUCH_GAP_M, self.config.max_snap_m)
            item = moved_by(item, push * normal_of(wall))
            if push < depth:
                item = self.cut_behind(item, wall)
                item = item.noted(
                    f"its collision shape was cut off {depth * 100:.1f} cm inside {wall.label} {wall.id}"
                )
        return item

    def cut_behind(self, item: Placement, base: BaseAsset) -> Placement:
        normal = normal_of(base)
        offset = float(distance_to(base, item.pose[:3, 3][None])[0]) - TOUCH_GAP_M
        inward = item.pose[:3, :3].T @ normal
        parts, unflattened = cut(item.parts, inward, offset), cut(item.unflattened, inward, offset)
        return replace(item, parts=parts, unflattened=unflattened) if parts and unflattened else item

    def keep_clear(self, item: Placement, lift: float) -> Placement:
        """Shift a thing that will not be let go out of its neighbors."""
        item = self.give_way_to_neighbors(item)
        self.bench.put(object_spec(item.asset, item.parts, item.pose, dynamic=True))
        pose, clear = make_clear(
            self.bench,
            item.asset.id,
            item.pose,
            max_lift_m=lift,
            max_shift_m=self.config.max_shift_m,
            tolerance_m=self.config.penetration_mm * 1e-3,
            settles=False,
        )
        moved = pose_change(item.pose, pose)[0]
        if moved > 1e-3:
            item = item.noted(f"shifted {moved * 1000:.0f} mm out of its neighbors")
        item = replace(item, pose=pose, stands=clear)
        return item if clear else self.cut_clear(item)

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
            level = deepest.normal @ deepest.position - deepest.separation_m + TOUCH_GAP_M
            inward = item.pose[:3, :3].T @ deepest.normal
            offset = float(deepest.normal @ item.pose[:3, 3] - level)
            parts, unflattened = cut(item.parts, inward, offset), cut(item.unflattened, inward, offset)
            if not parts or not unflattened:
                break
            item = replace(item, parts=parts, unflattened=unflattened)
        self.bench.put(object_spec(whole.asset, whole.parts, whole.pose, dynamic=True))
        return whole.noted("still overlaps a neighbor")
