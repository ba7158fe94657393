"""The stage itself: base planes, pictures, things, boxes and labels, id maps."""

from dataclasses import replace

import numpy as np

from reconstruction.instances.base import base_entities, base_planes
from reconstruction.instances.boxes import UprightBox, upright_box, with_bottom
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.feet import merge_feet
from reconstruction.instances.id_maps import render_id_maps
from reconstruction.instances.labels import coarse_label, shape_facts
from reconstruction.instances.pictures import find_pictures
from reconstruction.instances.segmentation import Thing, segment
from reconstruction.instances.stands import merge_stands
from reconstruction.progress import Progress
from reconstruction.surface.base_planes import FittedPlane, base_owner, behind_base
from reconstruction.surface.mesh_graph import MeshGraph
from reconstruction.types import BaseEntity, DepthMaps, Instance, InstanceSet, PosedFrames, Surface


def find_instances(
    posed: PosedFrames, depth: DepthMaps, surface: Surface, config: InstancesConfig, *, progress: Progress
) -> InstanceSet:
    """Cut the surface into base entities and separate things.

    Args:
        posed: keyframes with cameras in world space.
        depth: their depth in metres.
        surface: the fused surface in world space, floor at z = 0, walls roughly along the axes.
        config: thresholds.
        progress: told of decisions: a floor that had to be assumed, an empty room.

    Returns:
        The instances; ids count from 1, base entities first (floor, walls, ceiling), then objects by size.
    """
    progress.start(4, "base planes and things")
    graph = MeshGraph.from_surface(surface)
    planes = base_planes(surface)
    owner = base_owner(planes, len(graph.points))
    progress.advance()
    base = base_entities(surface, progress)
    things = _pictures(graph, planes, owner, posed, depth, config)
    hung = np.zeros(len(graph.points), bool)
    for thing in things:
        hung[thing.vertices] = True
    behind = behind_base(graph, planes)
    rest = np.flatnonzero((owner == 0) & ~hung & ~behind)
    progress.advance()
    segmented, crumbs = _without_base_crumbs(graph, segment(graph, rest, config), planes)
    for vertices, number in crumbs:
        owner[vertices] = number
    things = _merge_attached(graph, things + _mark_attached(graph, segmented, planes))
    things = merge_stands(graph, merge_feet(graph, things, progress), progress)
    things = _without_fragments(graph, things, base[0].observed, config, progress)
    for thing in things:
        if thing.attached:
            owner[thing.vertices] = 0
    progress.advance()
    vertex_instance = np.where(hung, 0, owner).astype(np.int32)
    objects = describe(graph, things, base, vertex_instance)
    progress.advance()
    if not objects:
        progress.note("No separate things were found: the scene is an empty room.")
    id_maps = render_id_maps(posed, depth, surface, vertex_instance, config, progress=progress)
    return _without_unseen(InstanceSet(vertex_instance, base, objects, id_maps), config, progress)


def _without_unseen(found: InstanceSet, config: InstancesConfig, progress: Progress) -> InstanceSet:
    """Leave out what shows in no keyframe once depth and image edges had their say: surface without a thing."""
    count = max((o.id for o in found.objects), default=0) + 1
    best = np.zeros(count, np.int64)
    for id_map in found.id_maps:
        seen = np.bincount(id_map.ravel(), minlength=count)[:count]
        best = np.maximum(best, seen)
    fewest = config.min_object_image_share * found.id_maps[0].size
    gone = {o.id: o.support_hint for o in found.objects if best[o.id] < fewest}
    if not gone:
        return found
    progress.note(f"{len(gone)} scraps that show in no keyframe are not kept as things")

    def carrier(hint: int) -> int:
        while hint in gone:
            hint = gone[hint]
        return hint

    erased = np.array(sorted(gone))
    return InstanceSet(
        np.where(np.isin(found.vertex_instance, erased), 0, found.vertex_instance).astype(np.int32),
        found.base,
        tuple(replace(o, support_hint=carrier(o.support_hint)) for o in found.objects if o.id not in gone),
        np.where(np.isin(found.id_maps, erased), 0, found.id_maps).astype(np.uint16),
    )


def _pictures(
    graph: MeshGraph,
    planes: list[FittedPlane],
    owner: np.ndarray,
    posed: PosedFrames,
    depth: DepthMaps,
    config: InstancesConfig,
) -> list[Thing]:
    found: list[Thing] = []
    used = np.zeros(len(owner), bool)
    for plane in planes:
        if plane.label != "wall":
            continue
        taken = (owner > 0) & ~plane.members
        for vertices in find_pictures(graph, plane, taken | used, owner == 0, posed, depth, config):
            used[vertices] = True
            found.append(Thing(vertices, attached=True))
    return found


def _without_fragments(
    graph: MeshGraph, things: list[Thing], floor_seen: bool, config: InstancesConfig, progress: Progress
) -> list[Thing]:
    """Leave out scraps of surface that are no things: tiny ones, and small ones in mid-air or flat on a wall."""
    carriers = {id(thing.rests_on) for thing in things}
    kept = []
    for thing in things:
        points = graph.points[thing.vertices]
        extents = np.sort(np.ptp(points, axis=0))
        in_air = floor_seen and not thing.attached and thing.rests_on is None and points[:, 2].min() > 0.1
        tiny = graph.areas[thing.vertices].sum() < config.min_object_area_m2
        scrap = (in_air and extents[2] < config.min_floating_m) or (
            thing.attached and extents[1] < config.min_picture_m
        )
        if id(thing) in carriers or not (tiny or scrap):
            kept.append(thing)
    if len(kept) < len(things):
        progress.note(
            f"{len(things) - len(kept)} scraps of surface, tiny or in mid-air, are not kept as things"
        )
    return kept


def _without_base_crumbs(
    graph: MeshGraph, things: list[Thing], planes: list[FittedPlane]
) -> tuple[list[Thing], list[tuple[np.ndarray, int]]]:
    """Give bumps of the floor and the walls back to them: small, thin, hugging the base all over."""
    first = 1 if planes and planes[0].label == "floor" else 2
    kept: list[Thing] = []
    crumbs = []
    carriers: set[int] = set()
    for thing in reversed(things):  # what rests on a thing comes after it
        points = graph.points[thing.vertices]
        if not planes or id(thing) in carriers:
            kept.append(thing)
            carriers.add(id(thing.rests_on))
            continue
        distances = np.stack([np.abs(plane.distance(points)) for plane in planes])
        nearest = distances.min(axis=0)
        spread = np.sort(np.ptp(points, axis=0))
        thin = np.percentile(nearest, 90) < 0.035 or (spread[2] < 0.12 and np.median(nearest) < 0.025)
        if (thin and spread[2] < 0.6) or (nearest < 0.05).mean() > 0.8:
            crumbs.append((thing.vertices, first + int(np.argmin(np.median(distances, axis=1)))))
        else:
            kept.append(thing)
            carriers.add(id(thing.rests_on))
    return kept[::-1], crumbs


def _mark_attached(graph: MeshGraph, things: list[Thing], planes: list[FittedPlane]) -> list[Thing]:
    """Mark things that touch a wall and have nothing below them."""
    for thing in things:
        points = graph.points[thing.vertices]
        if thing.rests_on is not None or points[:, 2].min() < 0.15:
            continue
        for plane in planes:
            if plane.label == "wall" and np.percentile(plane.distance(points), 5) < 0.06:
                thing.attached = True
    return things


def _merge_attached(graph: MeshGraph, things: list[Thing]) -> list[Thing]:
    """Join hanging things whose boxes overlap: a picture's frame, its inside, its sides."""
    hanging = sorted((t for t in things if t.attached), key=lambda t: -float(graph.areas[t.vertices].sum()))
    out = [t for t in things if not t.attached]
    kept: list[Thing] = []
    for thing in hanging:
        points = graph.points[thing.vertices]
        for other in kept:
            around = graph.points[other.vertices]
            low, high = around.min(axis=0) - 0.03, around.max(axis=0) + 0.03
            if ((points > low) & (points < high)).all(axis=1).mean() > 0.5:
                other.vertices = np.union1d(other.vertices, thing.vertices)
                break
        else:
            kept.append(thing)
    return kept + out


def describe(
    graph: MeshGraph, things: list[Thing], base: tuple[BaseEntity, ...], vertex_instance: np.ndarray
) -> tuple[Instance, ...]:
    """Number things by size, write their ids into `vertex_instance` and describe them."""
    boxes = {id(t): upright_box(graph.points[t.vertices], graph.areas[t.vertices]) for t in things}
    order = sorted(things, key=lambda t: (-float(np.prod(boxes[id(t)].extents_m)), int(t.vertices[0])))
    number = {id(t): len(base) + 1 + i for i, t in enumerate(order)}
    out = []
    for thing in order:
        vertex_instance[thing.vertices] = number[id(thing)]
        box = _box_on_support(graph, thing, boxes[id(thing)], base)
        carries = sum(1 for t in things if t.rests_on is thing)
        on_floor = (
            not thing.attached and thing.rests_on is None and box.center[2] - 0.5 * box.extents_m[2] < 0.1
        )
        label, confidence = coarse_label(
            shape_facts(graph, thing.vertices, box, on_floor, thing.attached, carries)
        )
        hint = number[id(thing.rests_on)] if thing.rests_on is not None else 1 if on_floor else 0
        if thing.attached:
            hint = _nearest_wall(graph, thing, base)
        out.append(
            Instance(
                number[id(thing)],
                label,
                confidence,
                box.center,
                box.yaw_rad,
                box.extents_m,
                hint,
                thing.attached,
            )
        )
    return tuple(out)


def _nearest_wall(graph: MeshGraph, thing: Thing, base: tuple[BaseEntity, ...]) -> int:
    walls = [b for b in base if b.label == "wall"]
    if not walls:
        return 0
    points = graph.points[thing.vertices]
    gaps = [abs(float(np.median(points @ b.surface.plane[:3] + b.surface.plane[3]))) for b in walls]
    return walls[int(np.argmin(gaps))].id


def _box_on_support(
    graph: MeshGraph, thing: Thing, box: UprightBox, base: tuple[BaseEntity, ...]
) -> UprightBox:
    """Let the box reach the surface that the thing rests on, whose contact no camera sees."""
    if thing.attached:
        return _box_to_wall(graph, thing, box, base)
    bottom = box.center[2] - 0.5 * box.extents_m[2]
    if thing.rests_on is None:
        return (
            with_bottom(box, 0.0) if base[0].observed and bottom < max(0.06, 0.15 * box.extents_m[2]) else box
        )
    under = thing.rests_on.vertices
    near = (
        np.abs(graph.points[under, :2] - box.center[:2]) < 0.5 * np.linalg.norm(box.extents_m[:2]) + 0.03
    ).all(1)
    carrying = under[near & (graph.normals[under, 2] > 0.7) & (graph.points[under, 2] < bottom + 0.02)]
    if len(carrying) < 5:
        return box
    level = (
        float(np.median(graph.points[carrying, 2][graph.points[carrying, 2] > bottom - 0.05], axis=0))
        if (graph.points[carrying, 2] > bottom - 0.05).any()
        else bottom
    )
    return with_bottom(box, min(level, bottom + 0.01))


def _box_to_wall(graph: MeshGraph, thing: Thing, box: UprightBox, base: tuple[BaseEntity, ...]) -> UprightBox:
    """Return a box parallel to the wall, from the wall to the front of the thing."""
    wall = next((b for b in base if b.id == _nearest_wall(graph, thing, base)), None)
    if wall is None:
        return box
    normal = wall.surface.plane[:3]
    yaw = float(np.arctan2(normal[1], normal[0]))
    points, areas = graph.points[thing.vertices], graph.areas[thing.vertices]
    turned = upright_box(points, areas, yaw)
    distance = points @ normal + wall.surface.plane[3]
    front = max(float(np.percentile(distance, 80)), 0.02)
    along = np.array([-np.sin(yaw), np.cos(yaw)])
    center = turned.center.copy()
    center[:2] = (turned.center[:2] @ along) * along + (0.5 * front - wall.surface.plane[3]) * normal[:2]
    return UprightBox(center, yaw, np.array([front, turned.extents_m[1], turned.extents_m[2]]))
