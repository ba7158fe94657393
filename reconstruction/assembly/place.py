"""Place one object: furniture on the floor, hanging things at their wall, the rest by letting it settle."""

from collections.abc import Sequence
from dataclasses import replace

from reconstruction.assembly.config import AssemblyConfig
from reconstruction.assembly.placement import (
    TOUCH_GAP_M,
    WORTH_SAYING_M,
    Placement,
    distance_to,
    is_furniture,
    moved_by,
    normal_of,
    upright,
    world_points,
)
from reconstruction.assembly.settle import Settler
from reconstruction.assembly.tops import level_tops
from reconstruction.scene_graph.surfaces import sample_object
from reconstruction.types import AssetSet, Edge, ObjectAsset


class Placer(Settler):
    """Places objects one after another on the workbench, parents before children."""

    def __init__(
        self, assets: AssetSet, edges: Sequence[Edge], config: AssemblyConfig, movable: dict[int, bool]
    ) -> None:
        """Start with the base; `movable` is the user's word on what can move."""
        super().__init__(assets, edges, config)
        self._movable = movable
        self._samples = {o.id: sample_object(o) for o in assets.objects}

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
            placement = replace(self.let_settle(fresh), dynamic=moves)
        self.commit(placement)
        return placement

    def again(self, asset_id: int) -> Placement:
        """Settle a placed object once more from where it stands, with a flatter foot than it has."""
        old = self.placed[asset_id]
        bands = [b for b in self.config.foot_bands_mm if b > old.band_mm]
        if not bands or not old.stands or old.edge.relation == "attached_to":
            return old
        placement = self.settle_flattened(old, bands[0])
        placement = placement if placement.stands else old
        self.commit(placement)
        return placement

    def hold(self, asset_id: int, note: str) -> Placement:
        """Make a placed thing immovable; where it reaches into its neighbors it is shifted or cut first."""
        old = self.placed[asset_id].noted(note, dynamic=False)
        # Whether it stands by itself is another question, answered before.
        held = replace(self.keep_clear(old, lift=self.config.max_shift_m), stands=old.stands)
        self.commit(held)
        return held

    # Furniture and hanging things: moved as little as possible, never let go.

    def _stand_furniture(self, item: Placement) -> Placement:
        floor = self.base[item.edge.parent]
        item = replace(item, dynamic=False)
        gap = float(distance_to(floor, world_points(item.parts, item.pose)).min())
        if gap < 0:
            # What was seen of it stays where it was; its shape ends at the floor.
            item = self.cut_behind(item, floor)
            if gap < -WORTH_SAYING_M:
                item = item.noted(
                    f"its collision shape was cut off {-gap * 100:.1f} cm inside the {floor.label}"
                )
        elif gap <= self.config.max_snap_m:
            item = moved_by(item, (TOUCH_GAP_M - gap) * normal_of(floor))
        else:
            item = item.noted(
                f"its lowest part is {gap * 100:.0f} cm above the {floor.label}; left where it was seen"
            )
        item = self.out_of_walls(item)
        return self.keep_clear(item, lift=0.0)

    def _hang(self, item: Placement) -> Placement:
        parent = self.base.get(item.edge.parent)
        if parent is None:
            carrier = self.placed[item.edge.parent]
            hung = self.keep_clear(replace(item, dynamic=carrier.dynamic), lift=self.config.max_shift_m)
            if hung.stands:
                return hung
            # It cannot hang there without being inside something: let gravity find what carries it.
            standing = replace(item.edge, relation="supported_by")
            return self.let_settle(replace(item, edge=standing).noted("stands: no place to hang was free"))
        item = replace(item, dynamic=False)
        gap = float(distance_to(parent, world_points(item.parts, item.pose)).min())
        if abs(gap) <= self.config.max_wall_snap_m:
            item = moved_by(item, (TOUCH_GAP_M - gap) * normal_of(parent))
            if abs(gap) > 0.01:
                item = item.noted(
                    f"moved {abs(gap) * 100:.1f} cm {'to' if gap > 0 else 'out of'} the {parent.label}"
                )
        else:
            item = item.noted(
                f"{abs(gap) * 100:.0f} cm {'off' if gap > 0 else 'inside'} the {parent.label}; left there"
            )
        return self.keep_clear(item, lift=self.config.max_shift_m)
