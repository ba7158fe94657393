"""What is a thing's foot and what carries it as a thing of its own."""

import numpy as np
import pytest
from surfaces import floor_sheet, merged, solid_box, surface_from

from reconstruction.instances.feet import merge_feet
from reconstruction.instances.segmentation import Thing
from reconstruction.progress import NO_PROGRESS
from reconstruction.surface.mesh_graph import MeshGraph


def pile(lower_size, upper_size):
    """Return the graph of a box on a box on a floor, and both as things."""
    w, d, h = lower_size
    lower = solid_box((-w / 2, -d / 2, 0), (w / 2, d / 2, h), (200, 200, 200))
    width, depth, height = upper_size
    low, high = (-width / 2, -depth / 2, h), (width / 2, depth / 2, h + height)
    surface = surface_from(merged(floor_sheet((90, 90, 90)), lower, solid_box(low, high, (200, 200, 200))))
    graph = MeshGraph.from_surface(surface)
    points = graph.points
    # The lower edge of the upper box lies at the height of the lower one's top.
    overhang = (np.abs(points[:, 2] - h) < 1e-6) & (np.abs(points[:, :2]).max(axis=1) > w / 2 + 1e-6)
    above = (points[:, 2] > h + 1e-6) | (overhang if width > w else np.zeros(len(points), bool))
    below = (points[:, 2] > 1e-6) & ~above
    carrier = Thing(np.flatnonzero(below))
    carried = Thing(np.flatnonzero(above), rests_on=carrier)
    return graph, carrier, carried


def test_a_thin_slice_narrower_than_what_it_carries_is_its_foot():
    graph, carrier, carried = pile((0.08, 0.08, 0.02), (0.14, 0.14, 0.10))
    things = merge_feet(graph, [carrier, carried], NO_PROGRESS)
    assert len(things) == 1
    assert things[0] is carried
    assert carried.rests_on is None
    assert graph.points[carried.vertices, 2].min() < 0.02


@pytest.mark.parametrize(
    ("lower", "upper"),
    [
        ((0.25, 0.25, 0.02), (0.14, 0.14, 0.10)),  # a plate reaches beyond the bowl on it
        ((0.08, 0.08, 0.09), (0.14, 0.14, 0.10)),  # a box as high as this is a thing
        ((0.10, 0.10, 0.03), (0.14, 0.14, 0.03)),  # two books of one kind
    ],
)
def test_what_carries_as_a_thing_of_its_own_stays_one(lower, upper):
    graph, carrier, carried = pile(lower, upper)
    assert len(merge_feet(graph, [carrier, carried], NO_PROGRESS)) == 2


def test_what_carries_two_things_is_no_foot():
    graph, carrier, carried = pile((0.08, 0.08, 0.02), (0.14, 0.14, 0.10))
    other = Thing(carried.vertices[::2], rests_on=carrier)
    assert len(merge_feet(graph, [carrier, carried, other], NO_PROGRESS)) == 3
