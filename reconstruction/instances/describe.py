"""Things become objects: numbered by size, with boxes that reach what carries them, hints and coarse labels."""

import numpy as np

from reconstruction.instances.boxes import UprightBox, upright_box, with_bottom
from reconstruction.instances.labels import coarse_label, shape_facts
from reconstruction.instances.segmentation import Thing
from reconstruction.surface.mesh_graph import MeshGraph
from reconstruction.types import BaseEntity, Instance


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
