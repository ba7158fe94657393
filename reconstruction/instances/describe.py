"""Object attributes: ids by size, boxes extended to the support, support hints and coarse labels."""

import numpy as np

from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.core.types import BaseEntity, Instance
from reconstruction.instances.boxes import UprightBox, quantiles, upright_box, with_bottom
from reconstruction.instances.containment import is_inside
from reconstruction.instances.cut import Thing
from reconstruction.instances.labels import coarse_label, shape_facts

# Of flat wall-mounted objects: largest distance of the 20 and 80 % quantiles, and of the 98 % quantile, to the median.
_FLAT_SPREAD_M, _FLAT_REACH_M = 0.015, 0.03
_LEAST_FRONT_M = 0.02  # least depth of the box of a wall-mounted object
_HIDDEN_M = 0.05  # a box is extended downwards by at most this much: an occluder may hide the object's foot
_CONTAINER_FLOOR_M = 0.008  # thickness of the bottom of a bowl or a basket
_FLAT = 0.5  # flat objects have less height than this times their width
_COVERED, _RIM_M = 0.7, 0.02  # share of the support's area under a box, and the margin of that box


def describe(
    graph: MeshGraph, things: list[Thing], base: tuple[BaseEntity, ...], vertex_instance: np.ndarray,
    structure: Thing | None = None,
) -> tuple[Instance, ...]:  # fmt: skip
    """Return the objects as instances, numbered by box volume; their ids are written into `vertex_instance` (v,).

    So is that of the structure, the largest. It carries objects and contains none.
    """
    boxes = {id(t): upright_box(graph.points[t.vertices], graph.areas[t.vertices]) for t in things}
    order = sorted(things, key=lambda t: (-float(np.prod(boxes[id(t)].extents_m)), int(t.vertices[0])))
    number = {id(t): len(base) + 1 + i for i, t in enumerate(order)}
    if structure is not None:
        number[id(structure)] = len(base) + 1 + len(order)
        vertex_instance[structure.vertices] = number[id(structure)]
    out = []
    for thing in order:
        vertex_instance[thing.vertices] = number[id(thing)]
        box = _box_on_support(graph, thing, boxes[id(thing)], base)
        carries = sum(1 for t in things if t.rests_on is thing)
        on_floor = not thing.attached and thing.rests_on is None and _stands_on_floor(graph, box)
        facts = shape_facts(graph, thing.vertices, box, on_floor, thing.attached, carries)
        label, confidence = coarse_label(facts)
        hint = number[id(thing.rests_on)] if thing.rests_on is not None else 1 if on_floor else 0
        if thing.attached:
            hint = _nearest_wall(graph, thing, base)
        out.append(
            Instance(
                number[id(thing)], label, confidence, box.center, box.yaw_rad, box.extents_m, hint, thing.attached,
            )
        )  # fmt: skip
    return tuple(out)


def _stands_on_floor(graph: MeshGraph, box: UprightBox) -> bool:
    """Return whether an object without support stands on the floor, with its contact occluded or not measured.

    It does unless its top is nearer to the highest point of the room than its bottom is to the floor: then it may hang.
    """
    bottom, top = box.center[2] + 0.5 * box.extents_m[2] * np.array([-1.0, 1.0])
    return bool(bottom <= graph.points[:, 2].max() - top)


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
    """Extend the box to the support surface, since no camera sees the contact."""
    if thing.attached:
        return _box_to_wall(graph, thing, box, base)
    bottom = box.center[2] - 0.5 * box.extents_m[2]
    if thing.rests_on is None:
        return with_bottom(box, 0.0) if base[0].observed and _stands_on_floor(graph, box) else box
    one = thing.rests_on.is_object  # which may contain the thing, or be hidden by it
    if one and is_inside(graph, thing.rests_on.vertices, thing.vertices, bottom):
        floor = _bottom_of(graph, thing.rests_on, base) + _CONTAINER_FLOOR_M
        return with_bottom(box, float(np.clip(floor, bottom - box.extents_m[2], bottom)))
    under = thing.rests_on.vertices
    flat = box.extents_m[2] < _FLAT * box.extents_m[:2].min()
    if one and flat and _covers(box, graph.points[under], graph.areas[under]):
        top = quantiles(graph.points[under, 2], graph.areas[under], (0.95,))[0]
        return with_bottom(box, float(np.clip(top, bottom - _HIDDEN_M, bottom)))
    radius = 0.5 * np.linalg.norm(box.extents_m[:2]) + 0.03
    near = (np.abs(graph.points[under, :2] - box.center[:2]) < radius).all(1)
    carrying = under[near & (graph.normals[under, 2] > 0.7) & (graph.points[under, 2] < bottom + 0.02)]
    heights = graph.points[carrying, 2]
    heights = heights[heights > bottom - _HIDDEN_M]
    if len(carrying) < 5 or not len(heights):
        return box
    return with_bottom(box, min(float(np.median(heights)), bottom + 0.01))


def _covers(box: UprightBox, points: np.ndarray, areas: np.ndarray) -> bool:
    """Return whether most of the surface at points (n, 3) is below a box and inside its footprint."""
    offset = np.abs(box.plan_offsets(points))
    inside = (offset < 0.5 * box.extents_m[:2] + _RIM_M).all(axis=1) & (points[:, 2] < box.center[2])
    return float(np.average(inside, weights=np.maximum(areas, 1e-12))) > _COVERED


def _bottom_of(graph: MeshGraph, thing: Thing, base: tuple[BaseEntity, ...]) -> float:
    box = upright_box(graph.points[thing.vertices], graph.areas[thing.vertices])
    box = _box_on_support(graph, thing, box, base)
    return float(box.center[2] - 0.5 * box.extents_m[2])


def _box_to_wall(graph: MeshGraph, thing: Thing, box: UprightBox, base: tuple[BaseEntity, ...]) -> UprightBox:
    """Return a box parallel to the nearest wall, from the wall to the front of the object."""
    wall = next((b for b in base if b.id == _nearest_wall(graph, thing, base)), None)
    if wall is None:
        return box
    normal = wall.surface.plane[:3]
    yaw = float(np.arctan2(normal[1], normal[0]))
    points, areas = graph.points[thing.vertices], graph.areas[thing.vertices]
    turned = upright_box(points, areas, yaw)
    front = _front(points @ normal + wall.surface.plane[3], areas)
    along = np.array([-np.sin(yaw), np.cos(yaw)])
    center = turned.center.copy()
    center[:2] = (turned.center[:2] @ along) * along + (0.5 * front - wall.surface.plane[3]) * normal[:2]
    return UprightBox(center, yaw, np.array([front, turned.extents_m[1], turned.extents_m[2]]))


def _front(distance: np.ndarray, areas: np.ndarray) -> float:
    """Return how far an object stands out from its wall, from the distances (n,) of its vertices to the wall.

    This is the 98 % quantile; for flat objects, whose spread of distances is noise, the 80 % quantile.
    """
    low, middle, high, end = quantiles(distance, areas, (0.2, 0.5, 0.8, 0.98))
    flat = max(high - middle, middle - low) < _FLAT_SPREAD_M and end - middle < _FLAT_REACH_M
    return max(float(high if flat else end), _LEAST_FRONT_M)
