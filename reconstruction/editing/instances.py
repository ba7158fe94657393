"""Corrections of the instances: add, relabel, drop, merge, split, make base."""

from dataclasses import replace

import numpy as np

from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.core.types import BaseEntity, Instance, InstanceSet, Plane, Surface
from reconstruction.editing.adding import add_thing
from reconstruction.editing.addresses import KINDS, parse_address, parse_addresses, parse_parts, vector
from reconstruction.editing.anchors import Footage, Pointer
from reconstruction.editing.clicked_split import clicked_parts, split_maps
from reconstruction.editing.outlines import parse_add
from reconstruction.instances.base import BASE_LABELS
from reconstruction.instances.boxes import UprightBox, upright_box
from reconstruction.instances.labels import coarse_label, shape_facts
from reconstruction.surface.base_planes import base_outline
from registry.errors import UsageError

_STEP_M = 0.03  # a part whose bottom is higher than the lowest part's by more than this may rest on that


def apply_overrides(
    found: InstanceSet, surface: Surface, overrides: list[dict], footage: Footage | None = None
) -> InstanceSet:
    """Apply entries of an overrides file (docs/overrides.md) in their order.

    Other objects keep their ids. The first part of a split keeps the id, the others get the next free ones.

    Args:
        found: the instances to correct.
        surface: the surface that was segmented.
        overrides: the entries; those of other stages are ignored.
        footage: frames and cameras; needed by clicks, and by `split` and `add`, which also change the id maps.

    Raises:
        UsageError: an entry addresses a missing object, or its change is impossible.
    """
    for entry in overrides:
        pointer = Pointer(found, surface, footage)
        if "add" in entry:
            if footage is None:
                raise ValueError("`add` needs the footage that the outlines were drawn in")
            found = add_thing(found, surface, footage, parse_add(entry["add"], "overrides: add"))
            continue
        if "merge" in entry:
            found = _merge(found, surface, _merged_things(pointer, entry["merge"]))
            continue
        item = _thing(pointer, entry)
        if entry.get("drop"):
            found = _drop(found, item)
        elif "make_base" in entry:
            found = _make_base(found, surface, item, entry["make_base"])
        elif "split" in entry:
            found = _split(pointer, item, entry["split"])
        if "relabel" in entry:
            item = next(o for o in found.objects if o.id == item.id)
            found = _with(found, replace(item, label=str(entry["relabel"]), label_confidence=1.0))
    return found


def _thing(pointer: Pointer, entry: dict) -> Instance:
    """Return the object of an entry; a split by clicks may address it by these clicks alone."""
    if isinstance(entry.get("split"), list) and not set(entry) & set(KINDS):
        return _split_thing(pointer, entry["split"])
    return pointer.thing(parse_address(entry, "overrides"))


def _merged_things(pointer: Pointer, values: object) -> list[Instance]:
    items = [pointer.thing(a) for a in parse_addresses(values, "overrides: merge", fewest=2)]
    if len({item.id for item in items}) < 2:
        raise UsageError(f"overrides: merge: all addresses mean the same thing, object {items[0].id}")
    return list({item.id: item for item in items}.values())


def _with(found: InstanceSet, item: Instance) -> InstanceSet:
    return replace(found, objects=tuple(item if o.id == item.id else o for o in found.objects))


def _renamed(found: InstanceSet, old: int, new: int) -> InstanceSet:
    """Replace the id `old` by `new` in vertices, id maps and support hints."""
    vertices = np.where(found.vertex_instance == old, new, found.vertex_instance).astype(np.int32)
    maps = np.where(found.id_maps == old, np.uint16(new), found.id_maps).astype(np.uint16)
    objects = tuple(
        replace(o, support_hint=new if new != o.id else 0) if o.support_hint == old else o
        for o in found.objects
    )
    return replace(found, vertex_instance=vertices, id_maps=maps, objects=objects)


def _refit(item: Instance, found: InstanceSet, surface: Surface) -> Instance:
    """Return an object with the box of its vertices."""
    chosen = found.vertex_instance == item.id
    if not chosen.any():
        return item  # its box comes from mask outlines
    box = upright_box(np.asarray(surface.vertices, np.float64)[chosen], np.ones(chosen.sum()))
    return replace(item, center=box.center, yaw_rad=box.yaw_rad, extents_m=box.extents_m)


def _surface_of(item: Instance, found: InstanceSet) -> np.ndarray:
    """Return the vertices int (k,) of an object.

    Raises:
        UsageError: it has none, since its box comes from mask outlines.
    """
    chosen = np.flatnonzero(found.vertex_instance == item.id)
    if len(chosen) == 0:
        raise UsageError(
            f"overrides: object {item.id} has no surface, only an outline on its wall; it can be dropped, relabeled "
            "or merged, not split or made base"
        )
    return chosen


def _drop(found: InstanceSet, item: Instance) -> InstanceSet:
    carrier = item.support_hint
    dropped = _renamed(found, item.id, 0)
    # Objects that rested on it get its support.
    objects = [
        replace(new, support_hint=carrier) if old.support_hint == item.id else new
        for old, new in zip(found.objects, dropped.objects)
        if old.id != item.id
    ]
    return replace(dropped, objects=tuple(objects))


def _merge(found: InstanceSet, surface: Surface, items: list[Instance]) -> InstanceSet:
    keep = max(items, key=lambda o: (float(np.prod(o.extents_m)), -o.id))
    for item in items:
        if item.id != keep.id:
            found = _renamed(found, item.id, keep.id)
            found = replace(found, objects=tuple(o for o in found.objects if o.id != item.id))
    merged = {item.id for item in items}
    kept = next(o for o in found.objects if o.id == keep.id)
    outside = [item.support_hint for item in (keep, *items) if item.support_hint not in merged]
    return _with(found, replace(_refit(kept, found, surface), support_hint=outside[0] if outside else 0))


def _split(pointer: Pointer, item: Instance, how: object) -> InstanceSet:
    """Split an object; each part gets a box, a label by its shape, and a support."""
    found, surface, footage = pointer.found, pointer.surface, pointer.footage
    if footage is None:
        raise ValueError("a split needs the footage: it also changes the id maps")
    chosen = _surface_of(item, found)
    if isinstance(how, dict):
        part = _beyond_plane(pointer, item, how, chosen)
    else:
        seeds = [[pointer.vertex(a, item) for a in clicks] for clicks in parse_parts(how, "overrides: split")]
        if len({v for seed in seeds for v in seed}) < sum(map(len, seeds)):
            raise UsageError(
                f"overrides: split of {item.label} {item.id}: two points are the same spot of it; move one of them"
            )
        part = clicked_parts(surface, footage.affinities, chosen, seeds)
    first = found.last_id + 1
    numbers = np.array([item.id, *range(first, first + int(part.max()))])
    labels = np.array(found.vertex_instance)
    labels[chosen] = numbers[part]
    maps = np.array(found.id_maps)
    split_maps(maps, footage.seen_in_keyframe, labels, item.id, numbers.tolist())
    parts = [replace(item, id=int(number)) for number in numbers]
    others = tuple(parts[0] if o.id == item.id else o for o in found.objects)
    out = replace(found, vertex_instance=labels, id_maps=maps, objects=(*others, *parts[1:]))
    graph = MeshGraph.from_surface(surface)
    fitted = _stacked([_refit(part, out, surface) for part in parts])
    for part in fitted:
        out = _with(out, part)
    for part in fitted:
        out = _with(out, _renamed_by_shape(part, out, graph))
    return out


def _stacked(parts: list[Instance]) -> list[Instance]:
    """Set the support of parts above the lowest one to that; the others keep the support of the whole."""
    bottoms = [float(part.center[2] - 0.5 * part.extents_m[2]) for part in parts]
    lowest = parts[int(np.argmin(bottoms))]
    out = []
    for part, bottom in zip(parts, bottoms):
        away = np.linalg.norm(part.center[:2] - lowest.center[:2])
        over = away < 0.5 * np.linalg.norm(lowest.extents_m[:2]) and bottom > min(bottoms) + _STEP_M
        out.append(replace(part, support_hint=lowest.id) if over and not part.attached_hint else part)
    return out


def _renamed_by_shape(part: Instance, found: InstanceSet, graph: MeshGraph) -> Instance:
    """Return a part with a label by its own shape."""
    on_floor = any(b.id == part.support_hint and b.label == "floor" for b in found.base)
    carries = sum(o.support_hint == part.id for o in found.objects)
    chosen = np.flatnonzero(found.vertex_instance == part.id)
    box = UprightBox(part.center, part.yaw_rad, part.extents_m)
    label, confidence = coarse_label(
        shape_facts(graph, chosen, box, on_floor and not part.attached_hint, part.attached_hint, carries)
    )
    return replace(part, label=label, label_confidence=confidence)


def _split_thing(pointer: Pointer, how: object) -> Instance:
    """Return the object that all clicks of a split lie on."""
    clicks = [a for part in parse_parts(how, "overrides: split") for a in part]
    hit = [(a, pointer.thing(a)) for a in clicks]
    if len({item.id for _, item in hit}) > 1:
        said = "; ".join(f"{a} shows {item.label} {item.id}" for a, item in hit)
        raise UsageError(f"overrides: split: the points lie on different things already: {said}")
    return hit[0][1]


def _beyond_plane(pointer: Pointer, item: Instance, how: dict, chosen: np.ndarray) -> np.ndarray:
    """Return int (k,): 1 for the vertices of an object on the side of the plane that its normal points to, else 0."""
    if set(how) != {"point", "normal"}:
        raise UsageError(
            f"overrides: split of object {item.id} needs {{point: [x, y, z], normal: [x, y, z]}}, "
            "or a list with a click on each part"
        )
    if isinstance(how["point"], dict):
        point = pointer.point(parse_address(how["point"], "overrides: split point"))
    else:
        point = np.array(vector(how["point"], "overrides: split point"))
    normal = np.array(vector(how["normal"], "overrides: split normal"))
    if np.linalg.norm(normal) < 1e-9:
        raise UsageError(f"overrides: the split normal of object {item.id} has no direction")
    beyond = (np.asarray(pointer.surface.vertices, np.float64)[chosen] - point) @ normal > 0
    if not 0 < beyond.sum() < len(chosen):
        where = ", ".join(f"{x:.2f}" for x in item.center)
        raise UsageError(f"overrides: the split plane misses object {item.id}, whose center is [{where}]")
    return beyond.astype(np.int64)


def _make_base(found: InstanceSet, surface: Surface, item: Instance, label: object) -> InstanceSet:
    """Turn an object into a base entity: a plane through its vertices with the normal towards free space."""
    if label not in BASE_LABELS:
        raise UsageError(f"overrides: make_base of object {item.id} must be one of {', '.join(BASE_LABELS)}")
    chosen = _surface_of(item, found)
    points = np.asarray(surface.vertices, np.float64)[chosen]
    center = np.median(points, axis=0)
    if label == "wall":
        flat = points[:, :2] - center[:2]
        normal = np.append(np.linalg.eigh(flat.T @ flat)[1][:, 0], 0.0)
    else:
        normal = np.array([0, 0, 1.0])
    mean_normal = np.asarray(surface.normals, np.float64)[chosen].mean(axis=0)
    if normal @ mean_normal < 0:
        normal = -normal
    plane = np.append(normal, -normal @ center)
    entity = BaseEntity(item.id, label, Plane(plane, base_outline(points, plane)), True)
    objects = tuple(o for o in found.objects if o.id != item.id)
    return replace(found, base=(*found.base, entity), objects=objects)
