"""Stacks are cut at the level seam where outline and color change; prints, lids and necks are no seams."""

from dataclasses import replace

import numpy as np
import pytest
from fused_surfaces import box, can, fused, tent
from surfaces import floor_sheet, frames_of, surface_from

from reconstruction.instances import InstancesConfig, find_instances
from reconstruction.instances.contact_skirts import cut_cleaned_stacks
from reconstruction.instances.cut import Shell
from reconstruction.instances.describe import describe
from reconstruction.instances.image_colors import surface_samples, with_colors
from reconstruction.instances.lying_across import without_sides
from reconstruction.instances.segmentation import Thing
from reconstruction.instances.stacks import cut_stacks
from reconstruction.progress import NO_PROGRESS
from reconstruction.surface.mesh_graph import MeshGraph, lab_from_rgb

WHITE, RED, BLUE, GREEN = (235, 235, 230), (190, 30, 30), (40, 60, 190), (40, 140, 60)
CARTON = box((-0.06, -0.05, 0.0), (0.06, 0.05, 0.15), BLUE)


def stacked(solids):
    """Return what one thing made of solids on the floor is cut into, and the graph."""
    surface = fused(solids, half_m=0.25, top_m=0.45)
    posed, depth = frames_of(surface, 480, 360)
    graph = MeshGraph.from_surface(surface)
    whole = Thing(np.flatnonzero(graph.points[:, 2] > 0.012))
    things = cut_stacks(graph, surface, [whole], posed, depth, InstancesConfig(), NO_PROGRESS)
    return things, graph


@pytest.mark.parametrize(
    "upper",
    [can((0.01, 0.0), 0.04, 0.15, 0.25, RED), box((-0.04, -0.035, 0.15), (0.05, 0.03, 0.22), WHITE, 0.2)],
    ids=["a can", "a box, turned"],
)
def test_what_stands_on_a_carton_is_a_thing(upper):
    things, graph = stacked([CARTON, upper])
    assert len(things) == 2
    low, high = things
    assert high.rests_on is low
    assert np.percentile(graph.points[low.vertices, 2], 99) < 0.16
    assert np.percentile(graph.points[high.vertices, 2], 1) > 0.14
    assert graph.areas[high.vertices].sum() > 0.8 * graph.areas[graph.points[:, 2] > 0.155].sum()


def test_a_stack_of_three_is_three():
    things, graph = stacked(
        [
            box((-0.08, -0.07, 0.0), (0.08, 0.07, 0.06), GREEN),
            box((-0.06, -0.05, 0.06), (0.06, 0.05, 0.2), WHITE),
            can((0.0, 0.0), 0.035, 0.2, 0.3, RED),
        ]
    )
    assert len(things) == 3
    tops = sorted(round(float(graph.points[thing.vertices, 2].max()), 2) for thing in things)
    np.testing.assert_allclose(tops, [0.06, 0.2, 0.3], atol=0.015)


@pytest.mark.parametrize(
    "upper",
    [
        box((-0.06, -0.05, 0.06), (0.06, 0.05, 0.16), WHITE, 0.35),
        can((0.004, 0.0), 0.06, 0.06, 0.16, WHITE),
    ],
    ids=["a box, turned", "a can"],
)
def test_what_is_as_wide_as_its_carrier_is_a_thing_where_their_outlines_cross(upper):
    things, graph = stacked([box((-0.06, -0.05, 0.0), (0.06, 0.05, 0.06), BLUE), upper])
    assert len(things) == 2
    low, high = things
    assert high.rests_on is low
    assert np.percentile(graph.points[low.vertices, 2], 98) < 0.07
    assert np.percentile(graph.points[high.vertices, 2], 2) > 0.05


@pytest.mark.parametrize("yaw", [0.0, 0.4])
def test_a_tent_with_printed_bands_stays_whole(yaw):
    """Its outline steps in all the way up, by its slant."""
    whole = ((-0.07, -0.06, 0.0), (0.07, 0.06, 0.15))
    surface = fused([tent(*whole, GREEN, yaw_rad=yaw)], half_m=0.25, top_m=0.3)
    painted = surface.colors.copy()
    painted[(surface.vertices[:, 2] > 0.05) & (surface.vertices[:, 2] < 0.1)] = WHITE
    surface = replace(surface, colors=painted)
    posed, depth = frames_of(surface, 480, 360)
    graph = MeshGraph.from_surface(surface)
    body = Thing(np.flatnonzero(graph.points[:, 2] > 0.012))
    things = cut_stacks(graph, surface, [body], posed, depth, InstancesConfig(), NO_PROGRESS)
    assert len(things) == 1


@pytest.mark.parametrize(
    "solids",
    [
        [box((-0.06, -0.05, low), (0.06, 0.05, low + 0.05), c) for low, c in ((0, RED), (0.05, WHITE), (0.1, BLUE))],
        [can((0, 0), 0.05, 0.0, 0.12, WHITE), can((0, 0), 0.035, 0.12, 0.2, WHITE)],
        [can((0, 0), 0.045, 0.0, 0.12, WHITE), can((0, 0), 0.042, 0.12, 0.15, RED)],
        [CARTON, box((0.06, -0.01, 0.05), (0.09, 0.01, 0.12), RED)],
    ],
    ids=["a printed box", "a neck of one color", "a jar with a lid", "a handle"],
)  # fmt: skip
def test_one_thing_stays_whole(solids):
    things, _ = stacked(solids)
    assert len(things) == 1


PACKAGE = box((-0.07, -0.06, 0.0), (0.07, 0.06, 0.07), BLUE)
BOOK = box((-0.1, -0.1, 0.07), (0.1, 0.1, 0.1), RED, 0.4)


@pytest.mark.parametrize(
    "upper", [can((0.01, 0.0), 0.11, 0.07, 0.09, WHITE), BOOK], ids=["a plate", "a book"]
)
def test_a_flat_thing_that_hides_what_it_lies_on_is_a_thing(upper):
    things, graph = stacked([PACKAGE, upper])
    assert len(things) == 2
    low, high = things
    assert high.rests_on is low
    assert graph.points[high.vertices, 2].min() > 0.04
    assert np.percentile(graph.points[high.vertices, 2], 2) > 0.06  # the carrier's sides are the carrier's
    assert np.percentile(graph.points[low.vertices, 2], 95) < 0.08
    ids = np.zeros(len(graph.points), np.int32)
    room = Shell.of(surface_from(floor_sheet(WHITE, 0.6, 0.3)), NO_PROGRESS)
    boxes = {o.id: o for o in describe(graph, things, room.base, ids)}
    flat = boxes[ids[high.vertices[0]]]
    assert flat.extents_m[2] < 0.05  # it does not reach down to what its carrier stands on


def test_the_sides_of_what_a_plate_lies_on_are_no_part_of_the_plate():
    """A seam that was found too low gives the plate the upper half of the package's sides."""
    surface = fused([PACKAGE, can((0.01, 0.0), 0.11, 0.07, 0.09, WHITE)], half_m=0.25, top_m=0.2)
    graph = MeshGraph.from_surface(surface)
    body = np.flatnonzero(graph.points[:, 2] > 0.012)
    piece = body[graph.points[body, 2] > 0.035]
    kept = without_sides(graph, body, piece, 0.035)
    z = graph.points[:, 2]
    assert z[kept].min() > 0.055
    assert np.isin(piece[z[piece] > 0.085], kept).all()
    assert np.isin(
        np.flatnonzero((z > 0.07) & (np.hypot(*(graph.points[:, :2] - [0.01, 0]).T) > 0.1)), kept
    ).all()


@pytest.mark.parametrize(
    "solids",
    [
        [can((0, 0), 0.02, 0.0, 0.1, RED), can((0, 0), 0.1, 0.1, 0.13, WHITE)],
        [PACKAGE, box((-0.1, -0.1, 0.07), (0.1, 0.1, 0.1), BLUE)],
        [PACKAGE, box((-0.07, -0.06, 0.07), (0.07, 0.06, 0.1), RED)],
        [can((0, 0), 0.04, 0.0, 0.1, WHITE), can((0, 0), 0.055, 0.1, 0.12, RED)],
    ],
    ids=[
        "a lamp on its stem",
        "a box with a rim of its color",
        "a box with a colored band",
        "a jar with a wide lid",
    ],
)
def test_what_reaches_out_above_its_foot_stays_whole(solids):
    things, _ = stacked(solids)
    assert len(things) == 1


def test_what_rested_on_the_stack_rests_on_its_part():
    surface = fused([CARTON, can((0.0, 0.0), 0.035, 0.15, 0.25, RED)], half_m=0.25, top_m=0.45)
    posed, depth = frames_of(surface, 480, 360)
    graph = MeshGraph.from_surface(surface)
    z = graph.points[:, 2]
    whole = Thing(np.flatnonzero((z > 0.012) & (z < 0.235)))
    lid = Thing(np.flatnonzero(z >= 0.235), rests_on=whole)
    things = cut_stacks(graph, surface, [whole, lid], posed, depth, InstancesConfig(), NO_PROGRESS)
    assert len(things) == 3
    assert things[1].rests_on is things[2]
    assert things[2].rests_on is things[0]


@pytest.mark.parametrize(("top", "kept"), [(0.018, 1), (0.05, 2)], ids=["a skirt", "a box"])
def test_a_low_part_that_hardly_reaches_out_is_a_skirt(top, kept):
    foot = box((-0.06, -0.06, 0.0), (0.06, 0.06, top), GREEN)
    surface = fused([foot, box((-0.05, -0.05, top), (0.05, 0.05, 0.15), RED)], half_m=0.25, top_m=0.3)
    posed, depth = frames_of(surface, 480, 360)
    graph = MeshGraph.from_surface(surface)
    whole = Thing(np.flatnonzero(graph.points[:, 2] > 0.004))
    things = cut_cleaned_stacks(graph, surface, [whole], posed, depth, InstancesConfig(), NO_PROGRESS)
    assert len(things) == kept
    assert things[-1].rests_on is (None if kept == 1 else things[0])
    assert np.percentile(graph.points[things[-1].vertices, 2], 1) > top - 0.01


@pytest.mark.parametrize(("top", "kept"), [(0.19, 1), (0.27, 2)], ids=["a cap", "a can"])
def test_on_a_second_look_what_is_narrow_and_low_is_a_cap(top, kept):
    bottle = box((-0.06, -0.05, 0.0), (0.06, 0.05, 0.15), BLUE)
    surface = fused([bottle, can((0.01, 0.0), 0.035, 0.15, top, RED)], half_m=0.25, top_m=0.45)
    posed, depth = frames_of(surface, 480, 360)
    graph = MeshGraph.from_surface(surface)
    body = np.flatnonzero(graph.points[:, 2] > 0.012)
    first = cut_stacks(graph, surface, [Thing(body)], posed, depth, InstancesConfig(), NO_PROGRESS)
    assert len(first) == 2
    things = cut_cleaned_stacks(graph, surface, [Thing(body)], posed, depth, InstancesConfig(), NO_PROGRESS)
    assert len(things) == kept
    assert sum(len(thing.vertices) for thing in things) == len(body)


def test_a_stack_on_a_table_is_found_whole():
    table = box((-0.4, -0.35, 0.0), (0.4, 0.35, 0.4), (120, 80, 50))
    surface = fused(
        [table, box((-0.06, -0.05, 0.4), (0.06, 0.05, 0.55), BLUE), can((0, 0), 0.042, 0.55, 0.65, RED)],
        top_m=0.75,
    )
    posed, depth = frames_of(surface, 480, 360)
    found = find_instances(posed, depth, surface, InstancesConfig(), progress=NO_PROGRESS)
    heights = sorted(round(float(o.extents_m[2]), 2) for o in found.objects)
    assert len(heights) == 3
    np.testing.assert_allclose(heights, [0.1, 0.15, 0.4], atol=0.02)


def test_colors_are_those_of_the_frames():
    """What no frame sees has no color; what is seen has that of the images, not of the mesh."""
    surface = fused([CARTON], half_m=0.25, top_m=0.3)
    posed, depth = frames_of(surface, 480, 360)
    images = posed.images.copy()
    images[..., 0], images[..., 2] = posed.images[..., 2], posed.images[..., 0]  # blue is red in the film
    graph = MeshGraph.from_surface(surface)
    carton = np.flatnonzero((graph.points[:, 2] > 0.03) & (graph.points[:, 2] < 0.12))
    filmed = posed.__class__(**{**vars(posed), "images": images})
    samples = with_colors(surface_samples(graph, surface, carton), filmed, depth)
    seen = np.isfinite(samples.lab[:, 0])
    assert seen.mean() > 0.5
    red = lab_from_rgb(np.array([[190, 60, 40]], np.uint8))[0]
    np.testing.assert_allclose(np.median(samples.lab[seen], axis=0), red, atol=6.0)
    nearer = depth.__class__(depth.camera, 0.5 * depth.depth, depth.confidence)
    hidden = with_colors(samples, filmed, nearer)
    assert not np.isfinite(hidden.lab).any()
