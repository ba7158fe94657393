"""What lies on furniture is told from it by colors that the furniture has nowhere else; smears and paint are not."""

import numpy as np
import pytest
from surfaces import filmed, looking_at, merged, sheet, solid_box, surface_from

from reconstruction.instances import InstancesConfig
from reconstruction.instances.cut import Shell
from reconstruction.instances.foreign import ColorView, cut_foreign
from reconstruction.instances.segmentation import Thing
from reconstruction.instances.sightings import sightings
from reconstruction.progress import NO_PROGRESS
from reconstruction.types import Camera

WOOD, BLUE, WALL = (150, 105, 60), (40, 60, 150), (215, 210, 200)
LOW, HIGH, WALL_Y = np.array([-0.4, 0.2, 0.0]), np.array([0.4, 0.6, 0.6]), 0.75
BOOK_LOW, BOOK_HIGH = np.array([-0.12, 0.3, 0.6]), np.array([0.12, 0.48, 0.64])


def cut(book_color, *, raised=True, smeared=False):
    """Cut a cabinet before a wall, one piece with what is on it; return its points, those cut off and of the book."""
    room = (
        sheet((-1.2, -1.6, 0.0), (2.4, 0, 0), (0, 1.6 + WALL_Y, 0), (90, 90, 95), 0.03),
        sheet((-1.2, WALL_Y, 0.0), (2.4, 0, 0), (0, 0, 1.6), WALL, 0.03),
    )
    cabinet = solid_box(LOW, HIGH, WOOD)
    book = solid_box(BOOK_LOW, BOOK_HIGH, book_color)
    if not raised:
        book.vertices[:, 2] = np.minimum(book.vertices[:, 2], 0.605)
    away = WALL_Y - 0.02 - HIGH[1]
    smear = sheet((-0.4, HIGH[1], 0.6), (0.8, 0, 0), (0, away, 0.08), WALL)  # from its far edge to the wall
    truth = merged(*room, cabinet, book)
    surface = surface_from(merged(*room, cabinet, book, *([smear] if smeared else [])))
    target = np.array([0.0, 0.3, 0.5])
    poses = np.stack(
        [looking_at((x, -1.6, z), target) for z in (1.1, 1.4) for x in (-0.8, -0.4, 0, 0.4, 0.8)]
    )
    posed, depth = filmed(truth, truth.colors, surface, poses, Camera(240, 180, 220.0, 220.0, 120.0, 90.0))
    shell = Shell.of(surface, NO_PROGRESS)
    points = shell.graph.points
    whole = Thing(np.flatnonzero((shell.owner == 0) & (points[:, 2] > 0.02)))
    frames = sightings(surface, posed, depth)
    things = cut_foreign(
        shell, [whole], shell.owner, ColorView.of(shell, frames), InstancesConfig(), NO_PROGRESS
    )
    assert things[0] is whole
    of_book = (points[:, 2] > 0.601) & (points[:, 1] < HIGH[1] - 0.05)
    return points, things, np.flatnonzero(of_book)


@pytest.mark.parametrize("smeared", [False, True])
def test_a_book_of_another_color_is_cut_off_its_cabinet(smeared):
    points, things, book = cut(BLUE, smeared=smeared)
    assert len(things) == 2
    assert things[1].rests_on is things[0]
    assert things[1].foreign
    found = things[1].vertices
    assert len(np.intersect1d(found, things[0].vertices)) == 0
    assert np.isin(book, found).mean() > 0.8
    np.testing.assert_allclose(points[found].min(axis=0)[:2], BOOK_LOW[:2], atol=0.02)
    np.testing.assert_allclose(points[found].max(axis=0), BOOK_HIGH, atol=0.02)


@pytest.mark.parametrize("told", [{"book_color": WOOD}, {"book_color": BLUE, "raised": False}])
def test_a_bump_of_its_color_and_paint_on_it_are_the_cabinet(told):
    _, things, _ = cut(**told)
    assert len(things) == 1


def test_a_smear_to_the_wall_is_no_thing():
    _, things, _ = cut(WOOD, smeared=True)
    assert len(things) == 1
