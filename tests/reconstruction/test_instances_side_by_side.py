"""Things that touch side by side are cut at the waist of their outline, or where their colors meet in a bay of it."""

import numpy as np
import pytest
from fused_surfaces import box, can, fused
from surfaces import frames_of

from reconstruction.instances import InstancesConfig
from reconstruction.instances.segmentation import Thing
from reconstruction.instances.side_by_side import cut_side_by_side
from reconstruction.progress import NO_PROGRESS
from reconstruction.surface.mesh_graph import MeshGraph

GRAY, RED, BLUE = (150, 150, 155), (190, 30, 30), (40, 60, 190)


def scene(*solids):
    """Return solids on a floor, joined as fusion does, and all that stands above the floor."""
    surface = fused(list(solids), half_m=0.25, top_m=0.3)
    graph = MeshGraph.from_surface(surface)
    return surface, graph, np.flatnonzero(graph.points[:, 2] > 0.012)


def cut(surface, graph, things):
    """Return what things are cut into, filmed from all around."""
    posed, depth = frames_of(surface, 480, 360)
    return cut_side_by_side(graph, surface, things, posed, depth, InstancesConfig(), NO_PROGRESS)


@pytest.mark.parametrize("second_top_m", [0.1, 0.12], ids=["of one height", "one higher"])
def test_two_cans_with_a_smear_between_them_are_two(second_top_m):
    surface, graph, above = scene(
        can((-0.048, 0.0), 0.04, 0.0, 0.1, GRAY),
        can((0.048, 0.01), 0.04, 0.0, second_top_m, GRAY),
        box((-0.03, -0.018, 0.0), (0.03, 0.028, 0.09), GRAY),
    )
    whole = Thing(above)
    lid = Thing(
        above[(graph.points[above, 0] > 0.03) & (graph.points[above, 2] > second_top_m - 0.02)], whole
    )
    things = cut(surface, graph, [whole, lid])
    assert len(things) == 3
    left, right = sorted((things[0], things[2]), key=lambda thing: graph.points[thing.vertices, 0].mean())
    assert lid.rests_on is right
    assert graph.points[left.vertices, 0].max() < 0.02
    assert graph.points[right.vertices, 0].min() > -0.02
    assert len(np.intersect1d(left.vertices, right.vertices)) == 0
    assert len(np.union1d(left.vertices, right.vertices)) == len(above)


@pytest.mark.parametrize(
    "solids",
    [
        [can((0.0, 0.0), 0.045, 0.0, 0.1, GRAY), box((0.04, -0.008, 0.02), (0.08, 0.008, 0.08), GRAY)],
        [box((-0.1, -0.05, 0.0), (0.1, 0.05, 0.08), GRAY)],
        [
            box((-0.1, -0.04, 0.0), (0.1, 0.03, 0.12), GRAY),
            box((-0.1, -0.04, 0.0), (-0.03, 0.12, 0.12), GRAY),
        ],
        [can((0.0, 0.0), 0.04, 0.0, 0.1, GRAY), box((0.0, -0.03, 0.0), (0.12, 0.03, 0.015), GRAY)],
    ],
    ids=["a mug", "a box", "an L", "a can with a skirt"],
)
def test_what_has_no_waist_stays_whole(solids):
    surface, graph, above = scene(*solids)
    assert len(cut(surface, graph, [Thing(above)])) == 1


@pytest.mark.parametrize("yaw", [0.2, 0.5, 1.0])
@pytest.mark.parametrize("strut", [False, True], ids=["a board", "a picture on its strut"])
def test_a_board_that_stands_stays_whole(yaw, strut):
    """It is so slim from above that the cells of its outline pinch it somewhere."""
    solids = [box((-0.09, -0.018, 0.0), (0.09, 0.018, 0.2), GRAY, yaw)]
    if strut:
        solids.append(box((-0.012, 0.0, 0.0), (0.012, 0.06, 0.12), GRAY, yaw))
    surface, graph, above = scene(*solids)
    assert len(cut(surface, graph, [Thing(above)])) == 1


@pytest.mark.parametrize("container", [False, True])
def test_a_small_thing_beside_a_large_one_is_cut_off_by_its_color(container):
    """There is a bay on one side of them at most, so no waist."""
    large, small = (
        box((-0.12, -0.1, 0.0), (0.0, 0.1, 0.06), RED),
        box((0.0, -0.09, 0.0), (0.08, -0.02, 0.09), BLUE),
    )
    surface, graph, above = scene(large, small)
    things = cut(surface, graph, [Thing(above, container=container)])
    assert len(things) == 2
    assert graph.points[things[0].vertices, 0].max() < 0.02
    assert graph.points[things[1].vertices, 0].min() > -0.02
    assert sum(len(thing.vertices) for thing in things) == len(above)


def test_level_tops_of_two_heights_tell_two_things_of_two_colors():
    """There is no bay between them, but a step where the colors meet."""
    surface, graph, above = scene(
        box((-0.12, -0.05, 0.0), (0.0, 0.05, 0.06), RED), box((0.0, -0.05, 0.0), (0.08, 0.05, 0.085), BLUE)
    )
    things = cut(surface, graph, [Thing(above)])
    assert len(things) == 2
    left, right = sorted(things, key=lambda thing: graph.points[thing.vertices, 0].mean())
    assert graph.points[left.vertices, 0].max() < 0.02
    assert graph.points[right.vertices, 0].min() > -0.02


@pytest.mark.parametrize(
    "solids",
    [
        [box((-0.12, -0.1, 0.0), (0.0, 0.1, 0.06), RED), box((0.0, -0.09, 0.0), (0.08, -0.02, 0.09), RED)],
        [box((-0.12, -0.05, 0.0), (0.0, 0.05, 0.06), RED), box((0.0, -0.05, 0.0), (0.08, 0.05, 0.085), RED)],
        [box((-0.12, -0.05, 0.0), (0.0, 0.05, 0.08), RED), box((0.0, -0.05, 0.0), (0.12, 0.05, 0.08), BLUE)],
        [can((0.0, 0.0), 0.045, 0.0, 0.1, RED), box((0.04, -0.008, 0.03), (0.08, 0.008, 0.08), BLUE)],
    ],
    ids=["of one color", "of one color and two heights", "without a bay", "a handle above the ground"],
)
def test_neither_a_bay_nor_colors_alone_cut(solids):
    surface, graph, above = scene(*solids)
    assert len(cut(surface, graph, [Thing(above)])) == 1
