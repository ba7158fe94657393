"""Place one object: furniture on the floor, attached objects at their wall, all others by simulation."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

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
from reconstruction.core.types import AssetSet, Edge, ObjectAsset
from reconstruction.scene_graph.surfaces import sample_object
from registry.report_card import MOST_GAP_MM

_FIXED_SHIFT_M = 0.01  # largest shift of static objects out of their neighbors; deeper ones are cut


class Placer(Settler):
    """Places objects one after another on the workbench, parents before children."""

    def __init__(
        self, assets: AssetSet, edges: Sequence[Edge], config: AssemblyConfig, movable: dict[int, bool]
    ) -> None:
        """Start with the base; `movable` overrides by object id whether it is dynamic."""
        super().__init__(assets, edges, config)
        self._movable = movable
        self._edges = {edge.child: edge for edge in edges}
        self._samples = {o.id: sample_object(o) for o in assets.objects}

    def place(self, asset: ObjectAsset, edge: Edge) -> Placement:
        """Place and commit an object whose parent is placed already."""
        on_base = edge.parent in self.base
        children = [self._samples[i] for i in sorted(self._carried.get(asset.id, []))]
        parts, depth = level_tops(asset.collision, self._samples[asset.id], asset.world_from_object, children)
        fresh = Placement(asset, edge, self._seen(asset, edge), parts, parts, True, 0.0, (), True)
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
        if not placement.stands and self.config.freeze_unstable:
            return self.hold(asset.id, "made immovable: it does not stand where it was seen")
        return placement

    def _seen(self, asset: ObjectAsset, edge: Edge) -> np.ndarray:
        """Return the reconstructed pose (4, 4), set upright, moved along with its parent."""
        pose = upright(asset.world_from_object, self.config.upright_tilt_deg).copy()
        parent = self.placed.get(edge.parent)
        if parent is not None:
            pose[:3, 3] += parent.pose[:3, 3] - parent.asset.world_from_object[:3, 3]
        return pose

    def again(self, asset_id: int) -> Placement:
        """Simulate a placed object again from its pose, with the next flatter underside; keep it if it stands."""
        old = self.placed[asset_id]
        bands = [b for b in self.config.foot_bands_mm if b > old.band_mm]
        if not bands or not old.stands or old.edge.relation == "attached_to":
            return old
        placement = self.settle_flattened(old, bands[0])
        placement = placement if placement.stands else old
        self.commit(placement)
        return placement

    def hold(self, asset_id: int, note: str) -> Placement:
        """Make a placed object static, at its reconstructed pose unless it carries others, cut clear of neighbors."""
        old = self.placed[asset_id]
        if not old.parts:
            return old
        old = old.noted(note, dynamic=False)
        if not any(p.edge.parent == asset_id for p in self.placed.values()):
            edge = self._edges[asset_id]
            pose, parts = self._seen(old.asset, edge), old.unflattened
            self.placed.pop(asset_id)
            old = self.out_of_walls(replace(old, edge=edge, pose=pose, parts=parts))
        # Whether it stands by itself was determined before.
        held = replace(self.let_down(self.keep_clear(old, shift_m=_FIXED_SHIFT_M)), stands=old.stands)
        self.commit(held)
        return held

    def _stand_furniture(self, item: Placement) -> Placement:
        """Place furniture without simulation: moved to its floor, cut off below it and behind walls."""
        floor = self.base[item.edge.parent]
        item = replace(item, dynamic=False)
        gap = float(distance_to(floor, world_points(item.parts, item.pose)).min())
        if gap < 0:
            item = self.cut_behind(item, floor)
            if gap < -WORTH_SAYING_M:
                inside = f"{-gap * 100:.1f} cm inside the {floor.label}"
                item = item.noted(f"its collision shape was cut off {inside}")
        elif gap <= self.config.max_snap_m:
            item = moved_by(item, (TOUCH_GAP_M - gap) * normal_of(floor))
        else:
            above = f"{gap * 100:.0f} cm above the {floor.label}"
            item = item.noted(f"its lowest part is {above}; left where it was seen")
        item = self.out_of_walls(item)
        return self.keep_clear(item, shift_m=_FIXED_SHIFT_M)

    def _hang(self, item: Placement) -> Placement:
        """Place an attached object without simulation, moved along the normal of its wall to touch it."""
        if item.edge.parent == self.structure:
            return self._hung_on(self.keep_clear(replace(item, dynamic=False), shift_m=0.0))
        parent = self.base.get(item.edge.parent)
        if parent is None:
            carrier = self.placed[item.edge.parent]
            held = replace(item, dynamic=carrier.dynamic)
            hung = self.keep_clear(held, shift_m=_FIXED_SHIFT_M, at_any_cost=False)
            if hung.stands:
                return hung
            # It cannot hang there without penetration: simulation finds its support.
            standing = replace(item.edge, relation="supported_by")
            return self.let_settle(replace(item, edge=standing).noted("stands: no place to hang was free"))
        item = replace(item, dynamic=False)
        gap = float(distance_to(parent, world_points(item.parts, item.pose)).min())
        if abs(gap) <= self.config.max_wall_snap_m:
            item = moved_by(item, (TOUCH_GAP_M - gap) * normal_of(parent))
            if abs(gap) > 0.01:
                way = "to" if gap > 0 else "out of"
                item = item.noted(f"moved {abs(gap) * 100:.1f} cm {way} the {parent.label}")
        else:
            where = "off" if gap > 0 else "inside"
            item = item.noted(f"{abs(gap) * 100:.0f} cm {where} the {parent.label}; left there")
        return self._hung_on(self.keep_clear(item, shift_m=0.0))

    def _hung_on(self, item: Placement) -> Placement:
        """Keep the parent, unless the object touches only objects attached to it: then the nearest of these."""
        self.put(item)
        near = self.bench.probe(item.asset.id, item.pose, -1e-3 * MOST_GAP_MM)
        touched = {c.second: c.separation_m for c in sorted(near, key=lambda c: -c.separation_m)}
        between = {i for i in touched if i in self.placed and self.placed[i].edge.parent == item.edge.parent}
        if item.edge.parent in touched or not between:
            return item
        parent = min(between, key=lambda i: (touched[i], i))
        evidence = f"touches it, which hangs there; before: {item.edge.parent}, {item.edge.evidence}"
        edge = replace(item.edge, parent=parent, evidence=evidence)
        return replace(item, edge=edge).noted(f"hangs on {parent} instead of {item.edge.parent}")
