"""Corrections of the assets: mass, friction, material, mesh, size, pose."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from reconstruction.assets.physics.materials import MATERIALS
from reconstruction.assets.replace import replace_mesh
from reconstruction.core.progress import Progress
from reconstruction.core.types import AssetSet, ObjectAsset, PhysicalRanges
from reconstruction.editing.addresses import parse_address
from reconstruction.editing.anchors import Pointer
from reconstruction.editing.moves import carried_by, moved, parse_move
from reconstruction.editing.resting import rest_of
from reconstruction.editing.sizes import parse_size, resized
from reconstruction.scene_graph.surfaces import sample_base, sample_object, sample_structure
from registry.errors import UsageError
from registry.geometry import invert_rigid, rigid

_WORTH_SAYING_M = 0.001


def edited_assets(
    assets: AssetSet, entries: list[dict], folder: Path, pointer: Pointer, progress: Progress
) -> AssetSet:
    """Apply entries in their order; within one: mesh, size, physics, move, drop_to_surface.

    Args:
        assets: the assets to correct.
        entries: of the assets stage.
        folder: meshes are relative to it.
        pointer: resolves addresses, to the objects as they were reconstructed.
        progress: receives what happened to objects that were dropped to a surface.

    Raises:
        UsageError: an entry addresses a missing object, or its change is impossible.
    """
    objects = {item.id: item for item in assets.objects}
    for entry in entries:
        item = addressed(entry, objects, pointer)
        if "mesh" in entry:
            item = replace_mesh(item, folder / entry["mesh"])
        if "size_m" in entry:
            item = resized(item, parse_size(entry["size_m"], "overrides: size_m"))
        objects[item.id] = _with_physics(item, entry)
        taken: set[int] = set()
        if "move" in entry:
            taken = _move(objects, item.id, entry["move"])
        if "drop_to_surface" in entry:
            _drop(objects, item.id, taken, assets, progress)
    return replace(assets, objects=tuple(objects[item.id] for item in assets.objects))


def addressed(entry: dict, objects: dict[int, ObjectAsset], pointer: Pointer) -> ObjectAsset:
    """Return the asset that an entry means.

    Raises:
        UsageError: there is no such object, or it was not built.
    """
    found = pointer.thing(parse_address(entry, "overrides"))
    if found.id not in objects:
        raise UsageError(f"overrides: {found.label} {found.id} was not built; objects are {sorted(objects)}")
    return objects[found.id]


def _move(objects: dict[int, ObjectAsset], number: int, value: object) -> set[int]:
    """Move an object, in place in `objects`; return the ids of the carried ones that moved along."""
    move = parse_move(value, "overrides: move")
    before = objects[number]
    objects[number] = moved(before, move)
    taken = carried_by(number, objects.values()) if move.with_carried else set()
    change = objects[number].world_from_object @ invert_rigid(before.world_from_object)
    _take_along(objects, taken, change)
    return taken


def _drop(
    objects: dict[int, ObjectAsset], number: int, taken: set[int], assets: AssetSet, progress: Progress
) -> None:
    """Move an object along +z to what is below it, in place in `objects`, with the carried ones that moved along."""
    item = objects[number]
    above = {number, *carried_by(number, objects.values())}
    others = [sample_object(o) for o in objects.values() if o.id not in above]
    others += [] if assets.structure is None else [sample_structure(assets.structure)]
    floors = [sample_base(b) for b in assets.base if b.label == "floor"]
    rest = rest_of(sample_object(item), others, floors)
    if rest is None:
        progress.note(f"overrides: nothing is below {item.label} {number}; it was not dropped")
        return
    shift = rigid(translation=np.array([0, 0, rest.shift_m]))
    pose = shift @ item.world_from_object
    objects[number] = replace(item, world_from_object=pose, support_hint=rest.carrier, attached_hint=False)
    _take_along(objects, taken, shift)
    names = {i: f"{label} {i}" for i, label in assets.static_labels.items()}
    names |= {o.id: f"{o.label} {o.id}" for o in objects.values()}
    if abs(rest.shift_m) > _WORTH_SAYING_M:
        way = "lowered" if rest.shift_m < 0 else "lifted"
        progress.note(
            f"overrides: {item.label} {number} was {way} by {abs(rest.shift_m) * 100:.1f} cm onto {names[rest.carrier]}"
        )


def _take_along(objects: dict[int, ObjectAsset], taken: set[int], change: np.ndarray) -> None:
    """Apply a rigid transform (4, 4) of the world to some objects, in place."""
    for number in taken:
        item = objects[number]
        objects[number] = replace(item, world_from_object=change @ item.world_from_object)


def _with_physics(item: ObjectAsset, entry: dict) -> ObjectAsset:
    physics = item.physics
    if "material" in entry:
        if entry["material"] not in MATERIALS:
            raise UsageError(
                f"overrides: no material {entry['material']!r}; there are {', '.join(sorted(MATERIALS))}"
            )
        chosen = MATERIALS[entry["material"]]
        density = chosen.density_kg_m3
        factor = density.value / physics.density_kg_m3
        mass = physics.mass_kg * factor
        spread = (mass * density.low / density.value, mass * density.high / density.value)
        physics = replace(
            physics, material=entry["material"], density_kg_m3=density.value, friction=chosen.friction.value,
            restitution=chosen.restitution.value, mass_kg=mass, inertia=physics.inertia * factor,
            ranges=PhysicalRanges(spread, chosen.friction[1:], chosen.restitution[1:]),
        )  # fmt: skip
    if "mass_kg" in entry:  # values by the user have a range of zero width
        mass = float(entry["mass_kg"])
        inertia = physics.inertia * (mass / physics.mass_kg)
        ranges = replace(physics.ranges, mass_kg=(mass, mass))
        physics = replace(physics, mass_kg=mass, inertia=inertia, ranges=ranges)
    if "friction" in entry:
        friction = float(entry["friction"])
        ranges = replace(physics.ranges, friction=(friction, friction))
        physics = replace(physics, friction=friction, ranges=ranges)
    if physics is item.physics:
        return item
    return replace(item, physics=physics, provenance=replace(item.provenance, physics="user"))
