"""Predicted effect of acts that are not applied yet: ids, poses and split parts, without a run."""

from typing import Any

import numpy as np

from reconstruction.core.types import InstanceSet
from reconstruction.editing.addresses import Address, parse_address, parse_parts
from reconstruction.editing.anchors import Footage, Pointer
from reconstruction.editing.entries import ACTIONS
from reconstruction.editing.moves import parse_move
from reconstruction.editing.overrides import Overrides
from reconstruction.measure.stage_results import StageResults
from reconstruction.poses.lens import Lens
from registry import SceneBundle
from registry.errors import SimReconError
from registry.geometry import matrix_from_quat, rigid
from studio.correcting.pending import Preview, pending_entries


class Previewer:
    """Makes previews for one revision of a scene."""

    def __init__(self, bundle: SceneBundle, results: StageResults) -> None:
        self._bundle, self._results = bundle, results
        self._pointer: Pointer | None = None
        self._by_anchor = {
            (anchor["frame"], anchor["x"], anchor["y"]): item["id"]
            for item in bundle.scene["objects"]
            if (anchor := item.get("anchor"))
        }

    def quick(self, entries: list[dict]) -> Preview:
        """Return the changes that follow from ids and anchors alone, in milliseconds."""
        pending, taken_back = pending_entries(entries, self._bundle)
        out = Preview(len(pending), taken_back)
        if not taken_back:
            for entry in pending:
                if isinstance(entry, dict):
                    self._follow(out, entry)
        return out

    def full(self, entries: list[dict]) -> Preview:
        """Return `quick`, with the parts of split objects and the first error of the cut; takes seconds."""
        out = self.quick(entries)
        pending, taken_back = pending_entries(entries, self._bundle)
        cut = Overrides([entry for entry in pending if isinstance(entry, dict)])
        pointer = self.pointer()
        if taken_back or pointer is None or not cut.of_stage("instances"):
            return out
        try:
            after = cut.apply_to_instances(pointer)
        except SimReconError as error:
            out.error = " ".join(str(error).split())
            return out
        out.parts = _parts(pointer.found, after, np.asarray(pointer.surface.vertices))
        return out

    def pointer(self) -> Pointer | None:
        """Return the resolver of addresses in this revision; None if its stage results are gone."""
        if self._pointer is None:
            read = ("instances", "surface", "poses", "world", "gaussians")
            results = {name: result for name in read if (result := self._results.get(name)) is not None}
            if len(results) < len(read):
                return None
            found, surface, posed, world, scene = (results[name] for name in read)
            placed = world.apply_to(scene.posed(posed))
            depth = world.depth_in_world(scene.depth, placed)
            self._pointer = Pointer(found, surface, Footage(placed, depth, Lens.of(posed), surface))
        return self._pointer

    def _follow(self, out: Preview, entry: dict[str, Any]) -> None:
        if "merge" in entry:
            ids = {self._id_of(value) for value in entry["merge"]} - {None}
            joined = {i for i in ids if i is not None}
            for group in [g for g in out.merged if g & joined]:
                out.merged.remove(group)
                joined |= group
            if len(joined) > 1:
                out.merged.append(joined)
            return
        if set(entry) & {*ACTIONS["world"], "add"}:
            return
        number = self._id_of(entry)
        if number is None:
            return
        group = next((g for g in out.merged if number in g), {number})
        if "relabel" in entry:
            out.labels |= dict.fromkeys(group, str(entry["relabel"]))
        if entry.get("drop"):
            out.hidden |= group
        if "split" in entry:
            out.split.add(number)
        if "size_m" in entry:
            out.sizes |= dict.fromkeys(group, np.array(entry["size_m"], np.float64))
        if "move" in entry:
            self._move(out, number, entry["move"])

    def _move(self, out: Preview, number: int, value: Any) -> None:
        item = next((o for o in self._bundle.objects if o.id == number), None)
        move = parse_move(value, "move")
        if item is None or move.with_carried:
            return
        pose = out.poses.get(number, np.asarray(item.world_from_object))
        if move.wxyz is not None:
            pose = rigid(matrix_from_quat(np.array(move.wxyz)), pose[:3, 3])
        if move.to is not None:
            pose = rigid(pose[:3, :3], np.array(move.to))
        if move.by is not None:
            pose = rigid(pose[:3, :3], pose[:3, 3] + np.array(move.by))
        out.poses[number] = pose

    def _id_of(self, value: Any) -> int | None:
        """Return the object of the revision shown that an address means; None if it is not known."""
        try:
            if isinstance(value, dict) and isinstance(value.get("split"), list):
                value = (
                    value
                    if set(value) & {"id", "at", "pixel"}
                    else _first(parse_parts(value["split"], "split"))
                )
            address = value if isinstance(value, Address) else parse_address(value, "")
            if address.kind == "id":
                return address.id
            known = self._by_anchor.get((address.frame, *address.pixel)) if address.kind == "pixel" else None
            if known is not None:
                return known
            pointer = self.pointer()
            return None if pointer is None else pointer.thing(address).id
        except SimReconError:
            return None


def _first(parts: list[list[Address]]) -> Address:
    return parts[0][0]


def _parts(before: InstanceSet, after: InstanceSet, vertices: np.ndarray) -> list[np.ndarray]:
    """Return the surface points of each part of the objects that were split."""
    old, new = np.asarray(before.vertex_instance), np.asarray(after.vertex_instance)
    fresh = {o.id for o in after.objects} - {o.id for o in before.objects}
    out = []
    for number in sorted({int(i) for i in np.unique(old[np.isin(new, list(fresh))])} - {0}):
        mine = old == number
        out += [vertices[mine & (new == part)] for part in np.unique(new[mine]) if part]
    return out
