"""A table that was cut at its own top is one again; what stands on furniture stays a thing."""

import numpy as np
import pytest
from surfaces import floor_sheet, merged, solid_box, surface_from

from reconstruction.instances.segmentation import Thing
from reconstruction.instances.stands import merge_stands
from reconstruction.progress import NO_PROGRESS
from reconstruction.surface.mesh_graph import MeshGraph

WOOD = (150, 110, 70)
LEGS = [(-0.55, -0.3), (-0.55, 0.25), (0.5, -0.3), (0.5, 0.25)]


def boxes(*corners):
    """Return the graph of boxes (low, high) over a floor, and the vertices of each."""
    parts = [solid_box(low, high, WOOD) for low, high in corners]
    graph = MeshGraph.from_surface(surface_from(merged(floor_sheet((90, 90, 90)), *parts)))
    points, members = graph.points, []
    for low, high in corners:
        inside = (points >= np.array(low) - 1e-6).all(axis=1) & (points <= np.array(high) + 1e-6).all(axis=1)
        members.append(np.flatnonzero(inside & (points[:, 2] > 1e-6)))
    return graph, members


def table(height=0.7, thickness=0.04):
    legs = [((x, y, 0), (x + 0.05, y + 0.05, height - thickness)) for x, y in LEGS]
    return [*legs, ((-0.6, -0.35, height - thickness), (0.6, 0.35, height))]


def test_a_board_on_legs_is_one_with_them():
    graph, (*legs, board) = boxes(*table())
    stand = Thing(np.unique(np.concatenate(legs)))
    top = Thing(np.setdiff1d(board, stand.vertices), rests_on=stand)
    mug = Thing(np.array([0]), rests_on=top)
    things = merge_stands(graph, [stand, top, mug], NO_PROGRESS)
    assert things == [stand, mug]
    assert mug.rests_on is stand
    assert graph.points[stand.vertices, 2].max() == pytest.approx(0.7)


def test_a_top_with_one_leg_is_one_with_the_other_legs():
    graph, (first, *legs, board) = boxes(*table())
    top = Thing(np.union1d(first, board))
    stand = Thing(np.setdiff1d(np.concatenate(legs), top.vertices))
    assert len(merge_stands(graph, [top, stand], NO_PROGRESS)) == 1


@pytest.mark.parametrize(
    ("lower", "upper"),
    [
        (((-0.6, -0.35, 0), (0.6, 0.35, 0.7)), ((-0.2, -0.15, 0.7), (0.2, 0.15, 0.9))),  # a box on a chest
        (
            ((-0.1, -0.1, 0), (0.1, 0.1, 0.1)),
            ((-0.3, -0.3, 0.1), (0.3, 0.3, 0.13)),
        ),  # a tray on something low
        (
            ((-0.2, -0.2, 0), (0.2, 0.2, 0.45)),
            ((-0.15, -0.15, 0.45), (0.15, 0.15, 0.48)),
        ),  # a book on a stool
        (((-0.25, -0.25, 0), (0.25, 0.25, 0.4)), ((-0.3, -0.3, 0.4), (0.3, 0.3, 0.75))),  # a crate on a crate
    ],
)
def test_what_stands_on_furniture_stays_a_thing(lower, upper):
    graph, (below, above) = boxes(lower, upper)
    stand = Thing(below)
    thing = Thing(np.setdiff1d(above, below), rests_on=stand)
    assert len(merge_stands(graph, [stand, thing], NO_PROGRESS)) == 2
