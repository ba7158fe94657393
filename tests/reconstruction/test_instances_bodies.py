"""Bodies: pieces that a hole in the surface tore apart are joined, and the base's own noise does not hang on them."""

import numpy as np
from surfaces import Patchwork, floor_sheet, frames_of, merged, sheet, solid_box, surface_from

from reconstruction.instances import InstancesConfig, find_instances
from reconstruction.instances.base import base_planes, base_skirts
from reconstruction.instances.bodies import find_bodies
from reconstruction.progress import NO_PROGRESS
from reconstruction.surface.base_planes import base_owner
from reconstruction.surface.mesh_graph import MeshGraph
from reconstruction.types import Surface

FLOOR, WOOD, RED = (200, 200, 190), (120, 80, 50), (200, 30, 30)
TABLE = ((-0.5, -0.4, 0.0), (0.5, 0.4, 0.5), WOOD)


def without(part: Patchwork, gone: np.ndarray) -> Patchwork:
    """Cut the faces with a vertex in `gone` (v,) out."""
    used = ~gone
    number = np.cumsum(used) - 1
    faces = number[part.faces[used[part.faces].all(axis=1)]]
    return Patchwork(part.vertices[used], faces, part.normals[used], part.colors[used])


def bodies_of(surface: Surface):
    graph = MeshGraph.from_surface(surface)
    rest = np.flatnonzero(base_owner(base_planes(surface), len(graph.points)) == 0)
    return graph, find_bodies(graph, rest, InstancesConfig())


def test_a_thing_above_a_hole_in_a_gleaming_top_stands_on_it():
    """The top was not seen for 10 cm and more around the thing, as far as the table's edge."""
    table = solid_box(*TABLE)
    x, y, z = table.vertices.T
    table = without(table, (z > 0.45) & (np.abs(x) < 0.32) & (y < 0.28))
    surface = surface_from(
        merged(floor_sheet(FLOOR), table, solid_box((-0.06, -0.1, 0.51), (0.06, 0.0, 0.7), RED))
    )
    posed, depth = frames_of(surface)
    found = find_instances(posed, depth, surface, InstancesConfig(), progress=NO_PROGRESS)
    assert len(found.objects) == 2
    table, box = found.objects
    assert box.support_hint == table.id
    np.testing.assert_allclose(box.extents_m, [0.12, 0.1, 0.19], atol=0.025)


def test_an_island_of_a_top_belongs_to_the_table():
    """A patch of the top inside a hole, with nothing on it, is no thing."""
    table = solid_box(*TABLE)
    x, y, z = table.vertices.T
    ring = np.maximum(np.abs(x), np.abs(y))
    table = without(table, (z > 0.49) & (ring > 0.12) & (ring < 0.3))
    _, bodies = bodies_of(surface_from(merged(floor_sheet(FLOOR), table)))
    assert len(bodies.whole) == 1
    assert bodies.standing == []


def test_the_torn_edge_of_a_board_is_joined_and_a_strange_scrap_is_not():
    """A shelf of which a side and the far edge of its top were seen; a scrap of another color floats near it."""
    dark = (40, 35, 30)
    shelf = merged(
        sheet((0, 0, 0), (0, 0.5, 0), (0, 0, 0.5), dark),
        sheet((0.08, 0.4, 0.5), (0.4, 0, 0), (0, 0.05, 0), dark),
    )
    scrap = sheet((0.08, 0.05, 0.45), (0.3, 0, 0), (0, 0.05, 0), (90, 120, 200))
    graph, bodies = bodies_of(surface_from(merged(floor_sheet(FLOOR), shelf, scrap)))
    assert len(bodies.whole) == 2
    assert graph.points[bodies.whole[0], 0].max() > 0.45
    assert np.ptp(graph.points[bodies.whole[1], 0]) < 0.32


def test_a_sheet_of_floor_that_hangs_on_a_leg_is_floor_again():
    """Noise lifts a part of the floor off its plane: of its color it is floor, of another color a thing's foot."""
    for color, joined in ((FLOOR, False), (RED, True)):
        blade = sheet((0.3, 0, 0.025), (0, -0.3, 0), (0.5, 0, 0), color)
        blade.normals[:] = (0, 0, 1)
        blade.faces = blade.faces[:, ::-1]
        box = solid_box((0, -0.3, 0.0), (0.3, 0, 0.5), WOOD)
        surface = surface_from(merged(floor_sheet(FLOOR), box, blade))
        graph = MeshGraph.from_surface(surface)
        planes = base_planes(surface)
        rest = np.flatnonzero(base_owner(planes, len(graph.points)) == 0)
        given = base_skirts(graph, rest, planes, 0.02)
        assert all(number == 1 for _, number in given)
        area = sum(graph.areas[vertices].sum() for vertices, _ in given)
        assert (area < 0.01) if joined else (0.1 < area < 0.15)
