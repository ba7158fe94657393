"""What lies on furniture is told from it by colors that the furniture has nowhere else; smears and paint are not."""

import numpy as np
import pytest
from surfaces import Patchwork, filmed, looking_at, merged, sheet, solid_box, surface_from

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


def cut_room(*on_it, smears=()):
    """Cut a cabinet before a wall, one piece with what is on it; return its points and the things."""
    truth = merged(
        sheet((-1.2, -1.6, 0.0), (2.4, 0, 0), (0, 1.6 + WALL_Y, 0), (90, 90, 95), 0.03),
        sheet((-1.2, WALL_Y, 0.0), (2.4, 0, 0), (0, 0, 1.6), WALL, 0.03),
        solid_box(LOW, HIGH, WOOD),
        *on_it,
    )
    surface = surface_from(merged(truth, *smears))
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
    assert all(thing.foreign and thing.rests_on is whole for thing in things[1:])
    return points, things


def cut(book_color, *, raised=True, smeared=False):
    """Cut a cabinet with a book on it; return its points, the things and the points of the book."""
    book = solid_box(BOOK_LOW, BOOK_HIGH, book_color)
    if not raised:
        book.vertices[:, 2] = np.minimum(book.vertices[:, 2], 0.605)
    away = WALL_Y - 0.02 - HIGH[1]
    smear = sheet((-0.4, HIGH[1], 0.6), (0.8, 0, 0), (0, away, 0.08), WALL)  # from its far edge to the wall
    points, things = cut_room(book, smears=[smear] if smeared else [])
    of_book = (points[:, 2] > 0.601) & (points[:, 1] < HIGH[1] - 0.05)
    return points, things, np.flatnonzero(of_book)


@pytest.mark.parametrize("smeared", [False, True])
def test_a_book_of_another_color_is_cut_off_its_cabinet(smeared):
    points, things, book = cut(BLUE, smeared=smeared)
    assert len(things) == 2
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


HALF_WALL = tuple((np.add(WOOD, WALL) // 2).tolist())


def assert_boxes(points, things, *boxes, atol=0.03):
    """Assert that things are boxes, given as corners (2, 3) from left to right, but for sides that no frame sees."""
    assert len(things) == len(boxes)
    found = sorted((points[thing.vertices] for thing in things), key=lambda p: p[:, 0].mean())
    for vertices, corners in zip(found, boxes):
        np.testing.assert_allclose([vertices.min(axis=0), vertices.max(axis=0)], corners, atol=atol)


@pytest.mark.parametrize("rise_m", [0.005, 0.03], ids=["flat", "a smeared rim"])
def test_two_boxes_that_a_strip_of_furniture_and_wall_joins_are_two(rise_m):
    """Pixels at the cabinet's far edge show half of it, half the wall: neither's color, and no thing's."""
    corners = [[(x - 0.05, 0.49, 0.6), (x + 0.05, 0.59, 0.7)] for x in (-0.15, 0.15)]
    strip = solid_box((-0.4, 0.57, 0.6), (0.4, 0.6, 0.6 + rise_m), HALF_WALL)
    points, things = cut_room(*(solid_box(*box, BLUE) for box in corners), strip)
    assert_boxes(points, things[1:], *corners)


def test_a_box_whose_color_is_between_those_of_furniture_and_wall_is_found():
    corners = [(-0.05, 0.3, 0.6), (0.05, 0.4, 0.67)]
    points, things = cut_room(solid_box(*corners, HALF_WALL))
    assert_boxes(points, things[1:], corners)


def bowl(center_xy, radius_m, depth_m, color, wall_m=0.008):
    """Return an open bowl on the cabinet: the same dish twice, facing up and down."""
    sides = []
    for up in (1, -1):
        low = (center_xy[0] - radius_m, center_xy[1] - radius_m, HIGH[2])
        flat = sheet(low, (2 * radius_m, 0, 0), (0, 2 * radius_m, 0), color)
        offset = (flat.vertices[:, :2] - center_xy) / radius_m
        out = np.linalg.norm(offset, axis=1)
        flat.vertices[:, 2] += depth_m * out**2 + (wall_m if up > 0 else 0.0)
        normals = up * np.column_stack([-2 * depth_m / radius_m * offset, np.ones(len(out))])
        faces = flat.faces[(out[flat.faces] < 1.02).all(axis=1)][:, ::up]
        rows, faces = np.unique(faces, return_inverse=True)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        sides.append(Patchwork(flat.vertices[rows], faces.reshape(-1, 3), normals[rows], flat.colors[rows]))
    return merged(*sides)


def test_an_open_bowl_is_found_though_it_does_not_bulge():
    """Its inside turns inwards by as much as its outside outwards, or more."""
    points, things = cut_room(bowl((0.0, 0.38), 0.09, 0.05, BLUE))
    assert_boxes(points, things[1:], [(-0.09, 0.29, 0.6), (0.09, 0.47, 0.658)], atol=0.02)


@pytest.mark.parametrize(
    "sheets",
    [
        [sheet((-0.15, 0.3, 0.602), (0.3, 0, 0), (0, 0.12, 0.05), BLUE)],
        [
            sheet((-0.1, 0.3, 0.602), (0.2, 0, 0), (0, 0.05, 0.015), BLUE),
            sheet((-0.1, 0.35, 0.617), (0.05, 0, 0), (0, 0.15, 0.045), BLUE),
        ],
    ],
    ids=["a strip", "an L"],
)
def test_a_sheet_that_is_not_as_round_as_a_bowl_is_no_thing(sheets):
    assert len(cut_room(*sheets)[1]) == 1


def test_a_lid_in_the_furnitures_color_goes_with_its_box():
    corners = [(-0.05, 0.3, 0.6), (0.05, 0.4, 0.7)]
    body, lid = (
        solid_box((-0.05, 0.3, low), (0.05, 0.4, high), color)
        for low, high, color in ((0.6, 0.67, BLUE), (0.67, 0.7, WOOD))
    )
    points, things = cut_room(body, lid)
    assert_boxes(points, things[1:], corners, atol=0.015)
    top = (points[:, 2] > 0.69) & (points[:, 1] < 0.395) & (np.abs(points[:, 0]) < 0.045)
    on_lid = np.flatnonzero(top & (points[:, 1] > 0.305))
    assert np.isin(on_lid, things[1].vertices).mean() > 0.8


def test_what_shows_the_wall_over_a_box_is_no_lid_of_it():
    """A sheet from its far edge upwards, that depth smeared there."""
    corners = [(-0.05, 0.3, 0.6), (0.05, 0.4, 0.67)]
    smear = sheet((-0.04, 0.385, 0.672), (0.08, 0, 0), (0, 0, 0.04), WALL)
    points, things = cut_room(solid_box(*corners, BLUE), smears=[smear])
    assert_boxes(points, things[1:], corners, atol=0.015)
