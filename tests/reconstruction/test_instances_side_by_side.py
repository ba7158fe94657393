"""Things that touch side by side are cut at the waist of their outline, where colors meet, or where one rises alone."""

import numpy as np
import pytest
from fused_surfaces import box, can, fused, tray
from surfaces import floor_sheet, frames_of, merged, sheet, solid_box, surface_from

from reconstruction.instances import InstancesConfig
from reconstruction.instances.segmentation import Thing
from reconstruction.instances.side_by_side import cut_side_by_side
from reconstruction.progress import NO_PROGRESS
from reconstruction.surface.mesh_graph import MeshGraph

GRAY, RED, BLUE, WOOD, CREAM, GREEN = (
    (150, 150, 155), (190, 30, 30), (40, 60, 190), (150, 105, 60), (225, 215, 190), (40, 140, 60)
)  # fmt: skip
RIM_M = 0.05
TRAY = tray((-0.15, -0.1, 0.0), (0.15, 0.1, RIM_M), 0.014, WOOD)


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


def bounds(graph, thing):
    return graph.points[thing.vertices].min(axis=0), graph.points[thing.vertices].max(axis=0)


def beside_tray(color):
    """Return a tray, and a carton at its rim that a sheet as high as the rim joins to it."""
    carton = box((-0.04, 0.115, 0.0), (0.04, 0.175, 0.2), color)
    return scene(*TRAY, carton, box((-0.04, 0.09, 0.0), (0.04, 0.12, RIM_M), color))


@pytest.mark.parametrize("container", [False, True])
def test_a_carton_at_the_rim_of_a_tray_is_cut_off_it(container):
    """At most heights there is the carton alone, so neither a waist nor a line that tells colors."""
    surface, graph, above = beside_tray(BLUE)
    whole = Thing(above, container=container)
    in_tray, lid = (Thing(above[:0], whole) for _ in range(2))
    in_tray.vertices = above[(np.abs(graph.points[above, :2]) < 0.05).all(axis=1)][:20]
    lid.vertices = above[graph.points[above, 2] > 0.19]
    things = cut(surface, graph, [whole, in_tray, lid])
    assert len(things) == 4
    assert things[0] is whole
    assert whole.container == container
    carton = things[3]
    np.testing.assert_allclose(bounds(graph, whole), [(-0.15, -0.1, 0.01), (0.15, 0.1, RIM_M)], atol=0.015)
    np.testing.assert_allclose(bounds(graph, carton), [(-0.04, 0.1, 0.01), (0.04, 0.175, 0.2)], atol=0.015)
    np.testing.assert_array_equal(np.union1d(whole.vertices, carton.vertices), above)
    assert len(np.intersect1d(whole.vertices, carton.vertices)) == 0
    assert not carton.container
    assert in_tray.rests_on is whole
    assert lid.rests_on is carton


HOUSE = box((-0.1, -0.1, 0.0), (0.1, 0.1, 0.08), WOOD)


@pytest.mark.parametrize(
    "solids",
    [
        [HOUSE, box((-0.02, 0.04, 0.0), (0.03, 0.1, 0.2), BLUE)],
        [can((0.0, 0.0), 0.04, 0.0, 0.16, BLUE), box((0.03, -0.015, 0.05), (0.1, 0.015, 0.1), WOOD)],
    ],
    ids=["a chimney over its house", "a handle that does not reach the ground"],
)
def test_what_rises_of_one_thing_is_not_cut_off_it(solids):
    surface, graph, above = scene(*solids)
    assert len(cut(surface, graph, [Thing(above)])) == 1


def test_a_carton_in_the_color_of_the_tray_beside_it_stays_with_it():
    surface, graph, above = beside_tray(WOOD)
    assert len(cut(surface, graph, [Thing(above, container=True)])) == 1


def on_ground(*parts):
    """Return into how many things is cut what stands on a cream ground."""
    surface = surface_from(merged(floor_sheet(CREAM, 0.4), *parts))
    graph = MeshGraph.from_surface(surface)
    near = (np.abs(graph.points[:, :2]) < 0.3).all(axis=1)
    ground, whole = (
        Thing(np.flatnonzero(near & side)) for side in (graph.points[:, 2] < 1e-3, graph.points[:, 2] > 1e-3)
    )
    whole.rests_on = ground
    things = cut(surface, graph, [ground, whole])
    assert all(thing.rests_on is ground for thing in things[1:])
    return len(things) - 1


def slope(x_m, width_m, color):
    """Return a sheet that falls from half the height of a tall thing to the ground, as smeared depth does."""
    return sheet((x_m, 0.04, 0.06), (width_m, 0, 0), (0, 0.1, -0.055), color)


@pytest.mark.parametrize(
    ("low", "things"),
    [
        ([slope(-0.06, 0.12, GREEN)], 2),
        ([slope(-0.06, 0.12, CREAM)], 1),
        ([slope(x, 0.02, GREEN) for x in (-0.06, -0.01, 0.04)], 1),
        ([solid_box((-0.06, 0.04, 0.0), (0.06, 0.14, 0.06), CREAM)], 2),
    ],
    ids=[
        "of its own color",
        "of the ground's color",
        "with little surface",
        "of the ground's color, with sides",
    ],
)
def test_a_smeared_sheet_beside_a_tall_thing_is_not_told_for_a_low_one(low, things):
    assert on_ground(solid_box((-0.03, -0.03, 0.0), (0.03, 0.03, 0.2), BLUE), *low) == things


def test_a_tray_between_two_cans_is_three_things():
    """A tray between two cans of different colors that touch its ends."""
    smears = [
        box((-0.17, -0.02, 0.0), (-0.14, 0.02, RIM_M), BLUE),
        box((0.14, -0.02, 0.0), (0.17, 0.02, RIM_M), GREEN),
    ]
    cans = [can((-0.19, 0.0), 0.035, 0.0, 0.15, BLUE), can((0.19, 0.0), 0.035, 0.0, 0.2, GREEN)]
    surface, graph, above = scene(*TRAY, *cans, *smears)
    things = cut(surface, graph, [Thing(above, container=True)])
    assert len(things) == 3
    np.testing.assert_array_equal(np.sort(np.concatenate([thing.vertices for thing in things])), above)
    left, middle, right = sorted(things, key=lambda thing: graph.points[thing.vertices, 0].mean())
    np.testing.assert_allclose(
        bounds(graph, left), [(-0.225, -0.035, 0.01), (-0.155, 0.035, 0.15)], atol=0.015
    )
    np.testing.assert_allclose(bounds(graph, middle), [(-0.15, -0.1, 0.01), (0.15, 0.1, RIM_M)], atol=0.015)
    np.testing.assert_allclose(bounds(graph, right), [(0.155, -0.035, 0.01), (0.225, 0.035, 0.2)], atol=0.015)


@pytest.mark.parametrize("smears_m", [(0.024, 0.024), (0.028, 0.012, 0.028)], ids=["three", "four"])
def test_a_row_of_cans_is_as_many_things(smears_m):
    """A waist cuts them in two, of which one or both have another waist."""
    at = 0.096 * (np.arange(len(smears_m) + 1) - 0.5 * len(smears_m))
    row = [can((x, 0.0), 0.04, 0.0, 0.1, GRAY) for x in at]
    smears = [
        box((x + 0.033, -0.5 * wide, 0.0), (x + 0.063, 0.5 * wide, 0.09), GRAY)
        for x, wide in zip(at, smears_m)
    ]
    surface, graph, above = scene(*row, *smears)
    things = cut(surface, graph, [Thing(above)])
    assert len(things) == len(at)
    middles = sorted(0.5 * sum(bounds(graph, thing))[0] for thing in things)
    np.testing.assert_allclose(middles, at, atol=0.015)


@pytest.mark.parametrize(("length_m", "things"), [(0.56, 2), (0.72, 1)])
def test_a_tray_and_a_carton_at_its_end_may_be_longer_than_either(length_m, things):
    """What is longer than 80 cm with it may be furniture."""
    end = 0.5 * length_m
    board = box((-end, -0.08, 0.0), (end - 0.01, 0.08, RIM_M), WOOD)
    carton = box((end, -0.06, 0.0), (end + 0.1, 0.06, 0.2), BLUE)
    surface = fused([board, carton], half_m=end + 0.14, top_m=0.25)
    graph = MeshGraph.from_surface(surface)
    assert len(cut(surface, graph, [Thing(np.flatnonzero(graph.points[:, 2] > 0.012))])) == things


@pytest.mark.parametrize("second_top_m", [0.08, 0.15], ids=["of two heights", "of one height"])
def test_two_cans_at_one_side_of_a_tray_are_three_things(second_top_m):
    """A line between the cans has other colors on either side, but the tray goes on below them."""
    smears = [
        box((-0.11, 0.09, 0.0), (-0.07, 0.12, RIM_M), BLUE),
        box((0.07, 0.09, 0.0), (0.11, 0.12, RIM_M), GREEN),
    ]
    cans = [can((-0.09, 0.145), 0.035, 0.0, 0.15, BLUE), can((0.09, 0.145), 0.035, 0.0, second_top_m, GREEN)]
    surface, graph, above = scene(*TRAY, *cans, *smears)
    things = cut(surface, graph, [Thing(above, container=True)])
    assert len(things) == 3
    np.testing.assert_allclose(
        bounds(graph, things[0]), [(-0.15, -0.1, 0.01), (0.15, 0.1, RIM_M)], atol=0.015
    )
