"""What a thing stands on, where that shows around its foot and where the thing itself hides it."""

import numpy as np
from scipy.spatial import cKDTree
from surfaces import merged, sheet, solid_box, surface_from

from reconstruction.instances.contacts import carriers
from reconstruction.surface.mesh_graph import MeshGraph

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
