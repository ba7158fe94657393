"""The user's corrections to the cut: relabel, drop, merge, split, make base."""

from dataclasses import replace

import numpy as np

from reconstruction.instances.base import BASE_LABELS
from reconstruction.instances.boxes import upright_box
from reconstruction.surface.base_planes import base_outline
from reconstruction.types import BaseEntity, DepthMaps, Instance, InstanceSet, Plane, PosedFrames, Surface
from registry.errors import UsageError

_ANCHOR_M = 0.3


def apply_overrides(
    found: InstanceSet,
    surface: Surface,
    overrides: list[dict],
    *,
    posed: PosedFrames | None = None,
    depth: DepthMaps | None = None,
) -> InstanceSet:
    """Apply entries of an overrides file (docs/overrides.md) in their order.

    Ids of things that an entry does not touch stay as they are; a split's second part gets the next free id.

    Args:
        found: the cut to correct.
        surface: the surface that was cut.
        overrides: the entries; those of other stages are ignored.
        posed: keyframes in world space; needed by `split`, which also cuts the id maps.
        depth: their depth; needed by `split`.

    Raises:
        UsageError: an entry names an object that is not there, or says something impossible.
    """
    for entry in overrides:
        if "merge" in entry:
            found = _merge(found, surface, entry["merge"])
            continue
        item = _find(found, entry.get("id"), entry.get("near"))
        if entry.get("drop"):
            found = _drop(found, item)
        elif "make_base" in entry:
            found = _make_base(found, surface, item, entry["make_base"])
        elif "split" in entry:
            found = _split(found, surface, item, entry["split"], posed, depth)
        if "relabel" in entry:
            item = _find(found, entry["id"], None)
            found = _with(found, replace(item, label=str(entry["relabel"]), label_confidence=1.0))
    return found


def _find(found: InstanceSet, number: object, near: object) -> Instance:
    item = next((o for o in found.objects if o.id == number), None)
    if item is None:
        raise UsageError(f"overrides: no object {number}; objects are {[o.id for o in found.objects]}")
    if near is not None:
        anchor = _vector(near, f"near of object {number}")
        # The anchor may lie anywhere on the thing: measured to its box's center, less half its diagonal.
        if np.linalg.norm(anchor - item.center) > _ANCHOR_M + 0.5 * np.linalg.norm(item.extents_m):
            where = ", ".join(f"{x:.2f}" for x in item.center)
            raise UsageError(
                f"overrides: object {number} ({item.label}) is at [{where}], not near {list(anchor)}; "
                "the file was made for another reconstruction, correct its ids"
            )
    return item


def _vector(value: object, name: str) -> np.ndarray:
    try:
        vector = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise UsageError(f"overrides: {name} must be three numbers in world metres, got {value!r}")
    return vector


def _with(found: InstanceSet, item: Instance) -> InstanceSet:
    return replace(found, objects=tuple(item if o.id == item.id else o for o in found.objects))


def _renamed(found: InstanceSet, old: int, new: int) -> InstanceSet:
    """Give vertices and pixels of id `old` to `new`, and point support hints there."""
    vertices = np.where(found.vertex_instance == old, new, found.vertex_instance).astype(np.int32)
    maps = np.where(found.id_maps == old, np.uint16(new), found.id_maps).astype(np.uint16)
    objects = tuple(
        replace(o, support_hint=new if new != o.id else 0) if o.support_hint == old else o
        for o in found.objects
    )
    return replace(found, vertex_instance=vertices, id_maps=maps, objects=objects)


def _refit(item: Instance, found: InstanceSet, surface: Surface) -> Instance:
    chosen = found.vertex_instance == item.id
    box = upright_box(np.asarray(surface.vertices, np.float64)[chosen], np.ones(chosen.sum()))
    return replace(item, center=box.center, yaw_rad=box.yaw_rad, extents_m=box.extents_m)


def _drop(found: InstanceSet, item: Instance) -> InstanceSet:
    carrier = item.support_hint
    dropped = _renamed(found, item.id, 0)
    # What stood on it stands on what it stood on.
    objects = [
        replace(new, support_hint=carrier) if old.support_hint == item.id else new
        for old, new in zip(found.objects, dropped.objects)
        if old.id != item.id
    ]
    return replace(dropped, objects=tuple(objects))


def _merge(found: InstanceSet, surface: Surface, numbers: object) -> InstanceSet:
    if not isinstance(numbers, list) or len(set(map(repr, numbers))) < 2:
        raise UsageError(f"overrides: merge needs a list of at least two ids, got {numbers!r}")
    items = [_find(found, n, None) for n in numbers]
    keep = max(items, key=lambda o: (float(np.prod(o.extents_m)), -o.id))
    for item in items:
        if item.id != keep.id:
            found = _renamed(found, item.id, keep.id)
            found = replace(found, objects=tuple(o for o in found.objects if o.id != item.id))
    merged = {item.id for item in items}
    kept = next(o for o in found.objects if o.id == keep.id)
    outside = [item.support_hint for item in (keep, *items) if item.support_hint not in merged]
    return _with(found, replace(_refit(kept, found, surface), support_hint=outside[0] if outside else 0))


def _split(
    found: InstanceSet,
    surface: Surface,
    item: Instance,
    plane: object,
    posed: PosedFrames | None,
    depth: DepthMaps | None,
) -> InstanceSet:
    if not isinstance(plane, dict) or set(plane) != {"point", "normal"}:
        raise UsageError(
            f"overrides: split of object {item.id} needs {{point: [x, y, z], normal: [x, y, z]}}"
        )
    point, normal = _vector(plane["point"], "split point"), _vector(plane["normal"], "split normal")
    if np.linalg.norm(normal) < 1e-9:
        raise UsageError(f"overrides: the split normal of object {item.id} has no direction")
    vertices = np.asarray(surface.vertices, np.float64)
    chosen = found.vertex_instance == item.id
    second = chosen & ((vertices - point) @ normal > 0)
    if not 0 < second.sum() < chosen.sum():
        where = ", ".join(f"{x:.2f}" for x in item.center)
        raise UsageError(f"overrides: the split plane misses object {item.id}, which is around [{where}]")
    number = max([0, *(b.id for b in found.base), *(o.id for o in found.objects)]) + 1
    labels = np.array(found.vertex_instance)
    labels[second] = number
    maps = np.array(found.id_maps)
    if len(maps):
        if posed is None or depth is None:
            raise ValueError("apply_overrides needs `posed` and `depth` to split the id maps")
        _split_maps(maps, surface, item.id, number, (point, normal), posed, depth)
    found = replace(found, vertex_instance=labels, id_maps=maps)
    part = replace(item, id=number)
    found = replace(found, objects=(*found.objects, part))
    for old in (item, part):
        found = _with(found, _refit(old, found, surface))
    return found


def _split_maps(
    maps: np.ndarray,
    surface: Surface,
    old: int,
    new: int,
    plane: tuple[np.ndarray, np.ndarray],
    posed: PosedFrames,
    depth: DepthMaps,
) -> None:
    """Give the pixels of `old` that show the far side of the plane to `new`, in place."""
    from reconstruction.rasterize import rasterize_mesh

    camera = depth.camera
    point, normal = plane
    for i in np.flatnonzero((maps == old).any(axis=(1, 2))):
        world_from_camera = np.asarray(posed.world_from_camera[i])
        seen = rasterize_mesh(surface.vertices, surface.faces, camera, world_from_camera).depth
        row, column = np.nonzero(maps[i] == old)
        z = np.where(seen[row, column] > 0, seen[row, column], depth.depth[i][row, column]).astype(np.float64)
        ray = np.stack([(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy], axis=1)
        in_camera = np.column_stack([ray * z[:, None], z])
        in_world = in_camera @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
        far = ((in_world - point) @ normal > 0) & (z > 0)
        maps[i, row[far], column[far]] = new


def _make_base(found: InstanceSet, surface: Surface, item: Instance, label: object) -> InstanceSet:
    """Turn a thing into a base entity: the plane through its vertices, its normal towards free space."""
    if label not in BASE_LABELS:
        raise UsageError(f"overrides: make_base of object {item.id} must be one of {', '.join(BASE_LABELS)}")
    chosen = found.vertex_instance == item.id
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
