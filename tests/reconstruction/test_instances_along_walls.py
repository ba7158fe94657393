"""Furniture in a row before a wall comes apart where smeared surface, which shows the wall, joins it."""

import numpy as np
import pytest
from surfaces import filmed, looking_at, merged, sheet, solid_box, surface_from

from reconstruction.instances import InstancesConfig
from reconstruction.instances.along_walls import bridges_along_walls
from reconstruction.instances.cut import Shell
from reconstruction.instances.foreign import ColorView
from reconstruction.instances.sightings import sightings
from reconstruction.progress import NO_PROGRESS
from reconstruction.surface.mesh_graph import pieces
from reconstruction.types import Camera

WOOD, BLUE, WALL = (150, 105, 60), (40, 60, 150), (215, 210, 200)
WALL_Y, DEEP_M, INNER_M = 0.8, 0.35, 0.05  # the gap between the two is twice the last
LEFT, RIGHT = (-0.6, -INNER_M), (INNER_M, 0.55)


def cabinet(span, color, low=0.0, high=0.7):
    """Return a cabinet with its back at the wall."""
    return solid_box((span[0], WALL_Y - DEEP_M, low), (span[1], WALL_Y - 0.01, high), color)


def cut(*furniture, smeared=True):
    """Return the shell, what is no base, and the bridges in it."""
    truth = merged(
        sheet((-1.3, -1.6, 0.0), (2.6, 0, 0), (0, 1.6 + WALL_Y, 0), (90, 90, 95), 0.03),
        sheet((-1.3, WALL_Y, 0.0), (2.6, 0, 0), (0, 0, 1.8), WALL, 0.03),
        *furniture,
    )
    # A sheet across the gap, a hand's breadth before the wall, from one side to the other.
    smear = sheet((-INNER_M, WALL_Y - 0.09, 0.2), (2 * INNER_M, 0, 0), (0, 0, 0.3), WALL)
    surface = surface_from(merged(truth, *([smear] if smeared else [])))
    target = np.array([0.0, 0.6, 0.4])
    places = [(x, -1.5, z) for z in (0.9, 1.3) for x in (-0.5, -0.2, 0.0, 0.2, 0.5)]
    poses = np.stack([looking_at(place, target) for place in places])
    posed, depth = filmed(truth, truth.colors, surface, poses, Camera(320, 240, 290.0, 290.0, 160.0, 120.0))
    shell = Shell.of(surface, NO_PROGRESS)
    view = ColorView.of(shell, sightings(surface, posed, depth))
    rest = np.flatnonzero((shell.owner == 0) & (shell.graph.points[:, 2] > 0.02))
    return shell, rest, bridges_along_walls(shell, rest, view, InstancesConfig())


def large_parts(shell, vertices):
    """Return the extents along the wall of large connected parts, from left to right."""
    parts = pieces(shell.graph, vertices, InstancesConfig().bridge_gap_m)
    along = [shell.graph.points[part, 0] for part in parts if shell.graph.areas[part].sum() > 0.2]
    return sorted((float(x.min()), float(x.max())) for x in along)


@pytest.mark.parametrize("color", [BLUE, WOOD], ids=["of two colors", "of one color"])
def test_two_cabinets_that_a_smear_joins_are_two(color):
    shell, rest, bridges = cut(cabinet(LEFT, WOOD), cabinet(RIGHT, color))
    assert len(large_parts(shell, rest)) == 1
    ((vertices, entity),) = bridges
    assert entity == next(base.id for base in shell.base if base.label == "wall")
    assert np.abs(shell.graph.points[vertices, 0]).max() < INNER_M + 0.06
    assert np.isin(vertices, rest).all()
    parts = large_parts(shell, np.setdiff1d(rest, vertices))
    np.testing.assert_allclose(parts, [LEFT, RIGHT], atol=0.02)


SPAN = (LEFT[0], RIGHT[1])


@pytest.mark.parametrize(
    "furniture",
    [
        [cabinet(LEFT, WOOD), cabinet(RIGHT, WOOD), cabinet(SPAN, WOOD, 0.65)],
        [cabinet(LEFT, WOOD), cabinet(RIGHT, BLUE, 0.2)],
        [
            cabinet(LEFT, WOOD),
            solid_box((INNER_M, WALL_Y - 0.1, 0.0), (INNER_M + 0.06, WALL_Y - 0.01, 0.35), BLUE),
        ],
        [cabinet(SPAN, WOOD)],
    ],
    ids=["under one top", "one hangs", "one is small", "one wide cabinet"],
)
def test_what_is_one_piece_or_beside_something_else_is_left(furniture):
    _, _, bridges = cut(*furniture)
    assert bridges == []


def test_without_a_smear_there_is_no_bridge():
    shell, rest, bridges = cut(cabinet(LEFT, WOOD), cabinet(RIGHT, BLUE), smeared=False)
    assert len(large_parts(shell, rest)) == 2
    assert bridges == []


def test_what_a_board_joins_is_one_piece():
    board = solid_box((-INNER_M, WALL_Y - 0.12, 0.2), (INNER_M, WALL_Y - 0.08, 0.5), BLUE)
    _, _, bridges = cut(cabinet(LEFT, WOOD), cabinet(RIGHT, WOOD), board, smeared=False)
    assert bridges == []
