"""A plate under a bowl is told from it by its color and its width; a foot of the bowl's own is not."""

import numpy as np
import pytest
from fused_surfaces import can, fused
from surfaces import frames_of

from reconstruction.instances import InstancesConfig
from reconstruction.instances.segmentation import Thing
from reconstruction.instances.stacks import cut_stacks
from reconstruction.progress import NO_PROGRESS
from reconstruction.surface.mesh_graph import MeshGraph

RED, WHITE = (190, 30, 30), (235, 235, 230)
PLATE_M, TOP_M = 0.024, 0.1


def parts(plate_radius_m, plate_color, *, container=True):
    """Return the graph and what a bowl, 12 cm wide, on a round plate that is one thing with it is cut into."""
    bowl = can((0.0, 0.0), 0.06, 0.0, TOP_M, RED)
    surface = fused([bowl, can((0.0, 0.0), plate_radius_m, 0.0, PLATE_M, plate_color)], half_m=0.2, top_m=0.2)
    graph = MeshGraph.from_surface(surface)
    whole = Thing(np.flatnonzero(graph.points[:, 2] > 0.006), container=container)
    inner = Thing(whole.vertices[graph.points[whole.vertices, 2] > TOP_M - 0.01][:20], whole)
    posed, depth = frames_of(surface, 480, 360)
    config = InstancesConfig()
    return graph, cut_stacks(graph, surface, [whole, inner], posed, depth, config, NO_PROGRESS)


def test_a_plate_of_another_color_under_a_bowl_is_a_thing():
    graph, (plate, inner, bowl) = parts(0.1, WHITE)
    assert bowl.rests_on is plate
    assert bowl.container
    assert not plate.container
    assert inner.rests_on is bowl
    assert len(np.intersect1d(bowl.vertices, plate.vertices)) == 0
    assert np.ptp(graph.points[plate.vertices, 0]) == pytest.approx(0.2, abs=0.015)
    assert np.ptp(graph.points[bowl.vertices, 0]) == pytest.approx(0.12, abs=0.04)
    assert graph.points[plate.vertices, 2].max() < PLATE_M + 0.015
    assert graph.points[bowl.vertices, 2].max() > TOP_M - 0.01


@pytest.mark.parametrize(
    ("radius_m", "color"), [(0.1, RED), (0.06, WHITE)], ids=["of its color", "as wide as the bowl"]
)
def test_a_foot_is_the_bowls(radius_m, color):
    assert len(parts(radius_m, color)[1]) == 2
