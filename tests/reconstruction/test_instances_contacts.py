"""What a thing stands on, where that shows around its foot and where the thing itself hides it."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from surfaces import floor_sheet, merged, sheet, solid_box, surface_from

from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.core.progress import NO_PROGRESS
from reconstruction.instances.base import base_entities
from reconstruction.instances.contacts import carriers
from reconstruction.instances.cut import Thing
from reconstruction.instances.describe import describe

BROWN = (120, 80, 50)
TABLE = solid_box((-0.5, -0.4, 0.0), (0.5, 0.4, 0.4), BROWN)
# The sides of a box of 16 x 12 x 6 cm, its top hidden below a plate of 24 cm.
SIDES = merged(
    sheet((-0.08, -0.06, 0.4), (0.16, 0, 0), (0, 0, 0.06), BROWN, 0.01),
    sheet((0.08, -0.06, 0.4), (0, 0.12, 0), (0, 0, 0.06), BROWN, 0.01),
)
PLATE = sheet((-0.12, -0.12, 0.465), (0.24, 0, 0), (0, 0.24, 0), (200, 200, 200), 0.01)


def carriers_of(*parts) -> list[int]:
    graph = MeshGraph.from_surface(surface_from(merged(*parts)))
    tree = cKDTree(graph.points)
    return carriers(graph, [np.unique(tree.query(part.vertices)[1]) for part in parts])


def test_a_plate_that_hides_the_top_of_a_box_stands_on_it_and_not_on_the_table():
    assert carriers_of(TABLE, SIDES, PLATE) == [-1, 0, 1]


def test_a_box_beside_its_foot_does_not_carry_a_plate():
    beside = solid_box((0.2, -0.06, 0.4), (0.3, 0.06, 0.455), BROWN)
    low = sheet((-0.12, -0.12, 0.41), (0.24, 0, 0), (0, 0.24, 0), (200, 200, 200), 0.01)
    assert carriers_of(TABLE, beside, low) == [-1, 0, 0]


@pytest.mark.parametrize(("height_m", "stands"), [(0.7, True), (1.9, False)])
def test_a_board_that_nothing_carries_stands_on_the_floor_unless_it_is_near_the_ceiling(height_m, stands):
    wall = sheet((-1.2, -1.2, 0), (2.4, 0, 0), (0, 0, 2.4), (240, 240, 235), 0.02)
    board = sheet((-0.5, -0.3, height_m), (1.0, 0, 0), (0, 0.6, 0), BROWN, 0.01)
    surface = surface_from(merged(floor_sheet((200, 200, 190)), wall, board))
    graph = MeshGraph.from_surface(surface)
    vertices = np.unique(cKDTree(graph.points).query(board.vertices)[1])
    base = base_entities(surface, NO_PROGRESS)
    (found,) = describe(graph, [Thing(vertices)], base, np.zeros(len(graph.points), np.int32))
    bottom = found.center[2] - 0.5 * found.extents_m[2]
    assert (found.support_hint == base[0].id) == stands
    assert bottom == pytest.approx(0.0 if stands else height_m, abs=0.02)
