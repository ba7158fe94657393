"""Flat things that lie too low to stand out are found by their rise and outline; paint and swellings are not things."""

from dataclasses import replace

import numpy as np
import pytest
from fused_surfaces import box, can, fused, tray
from surfaces import frames_of

from reconstruction.instances import InstancesConfig
from reconstruction.instances.flats import cut_flats
from reconstruction.instances.segmentation import Thing
from reconstruction.progress import NO_PROGRESS
from reconstruction.surface.mesh_graph import MeshGraph

WOOD, DARKER = (150, 100, 60), (110, 85, 62)
TABLE = box((-0.4, -0.3, 0.0), (0.4, 0.3, 0.3), WOOD)


def flats_of(surface, others=()):
    """Return what a table that is one thing is cut into; `others` choose the vertices of things that rest on it."""
    posed, depth = frames_of(surface, 480, 360)
    graph = MeshGraph.from_surface(surface)
    above = graph.points[:, 2] > 0.012
    masks = [chosen(graph.points) & above for chosen in others]
    table = Thing(np.flatnonzero(above & ~np.any([np.zeros_like(above), *masks], axis=0)))
    things = [table, *(Thing(np.flatnonzero(mask), rests_on=table) for mask in masks)]
    return cut_flats(graph, surface, things, posed, depth, InstancesConfig(), NO_PROGRESS), graph


def swollen(surface, height_m, radius_m):
    """Return the surface with its top raised smoothly around the middle."""
    points = np.array(surface.vertices)
    top = points[:, 2] > 0.29
    bump = height_m * np.exp(-(np.linalg.norm(points[:, :2], axis=1) ** 2) / (2 * radius_m**2))
    points[top, 2] += bump[top]
    return replace(surface, vertices=points.astype(surface.vertices.dtype))


def round_relief(surface, heights_mm):
    """Return the surface with a darker disc of 12 cm radius on its top, as high as told at 0, 6, 10 and 12 cm."""
    points, colors = np.array(surface.vertices), np.array(surface.colors)
    radius = np.linalg.norm(points[:, :2], axis=1)
    top = points[:, 2] > 0.29
    points[top, 2] += 1e-3 * np.interp(radius[top], [0.0, 0.06, 0.1, 0.12, 0.13], [*heights_mm, 0.0])
    colors[top & (radius < 0.12)] = DARKER
    return replace(surface, vertices=points.astype(surface.vertices.dtype), colors=colors)


def painted(surface):
    """Return the surface with a rectangle of another color on its top."""
    colors = np.array(surface.colors)
    inside = (np.abs(surface.vertices[:, 0]) < 0.12) & (np.abs(surface.vertices[:, 1]) < 0.1)
    colors[inside & (surface.vertices[:, 2] > 0.29)] = DARKER
    return replace(surface, colors=colors)


def test_a_board_of_nearly_the_tables_color_is_found():
    things, graph = flats_of(
        fused([TABLE, box((-0.14, -0.1, 0.3), (0.14, 0.1, 0.308), DARKER, 0.3)], top_m=0.5)
    )
    assert len(things) == 2
    table, board = things
    assert board.rests_on is table
    assert 0.75 < graph.areas[board.vertices].sum() / (0.28 * 0.2) < 1.25


def test_a_tray_of_the_tables_color_is_whole_and_holds_what_stands_in_it():
    """The rules before had its bottom in the table, its sides as a thing: one tray, and the can in it rests on it."""
    solids = [
        TABLE,
        *tray((-0.17, -0.13, 0.3), (0.17, 0.13, 0.335), 0.008, DARKER),
        can((0.02, 0.0), 0.035, 0.3, 0.4, (190, 30, 30)),
    ]

    def is_can(p):
        return (np.hypot(p[:, 0] - 0.02, p[:, 1]) < 0.05) & (p[:, 2] > 0.315)

    def is_rim(p):
        outer = (np.abs(p[:, 0]) < 0.19) & (np.abs(p[:, 1]) < 0.15)
        return outer & ((np.abs(p[:, 0]) > 0.15) | (np.abs(p[:, 1]) > 0.11)) & (p[:, 2] > 0.312)

    things, graph = flats_of(fused(solids, voxel_m=0.006, half_m=0.45, top_m=0.5), [is_can, is_rim])
    assert len(things) == 3
    table, standing, found = things
    assert found.rests_on is table
    assert standing.rests_on is found
    np.testing.assert_allclose(np.ptp(graph.points[found.vertices, :2], axis=0), [0.34, 0.26], atol=0.04)


def test_a_plate_with_a_raised_rim_is_found():
    things, graph = flats_of(round_relief(fused([TABLE], top_m=0.5), (7.0, 7.0, 15.0, 15.0)))
    assert len(things) == 2
    table, plate = things
    assert plate.rests_on is table
    np.testing.assert_allclose(np.ptp(graph.points[plate.vertices, :2], axis=0), 0.24, atol=0.03)


@pytest.mark.parametrize(
    "change",
    [
        painted,
        lambda s: swollen(s, 0.012, 0.08),
        lambda s: round_relief(s, (22.0, 18.0, 8.0, 5.0)),
    ],
    ids=["paint", "a swelling of the top", "a skirt that falls off outwards, of another color"],
)
def test_what_is_no_flat_thing_stays(change):
    things, _ = flats_of(change(fused([TABLE], top_m=0.5)))
    assert len(things) == 1


def test_the_top_of_what_stands_amid_a_frame_is_no_flat_thing():
    """A wide frame, and a block of its color in it that is a little higher: there is a drop between them."""
    frame = tray((-0.2, -0.17, 0.3), (0.2, 0.17, 0.4), 0.07, WOOD)
    things, _ = flats_of(
        fused([TABLE, *frame[1:], box((-0.05, -0.05, 0.3), (0.05, 0.05, 0.41), DARKER)], top_m=0.5)
    )
    assert len(things) == 1
