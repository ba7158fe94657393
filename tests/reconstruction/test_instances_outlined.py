"""Things on walls that depth shows nothing of: the outlines of their masks on the wall's plane say where they are."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from surfaces import floor_sheet, frames_of, looking_at, merged, sheet, solid_box, surface_from

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import BaseEntity, Camera, DepthMaps, Plane
from reconstruction.editing.instances import apply_overrides
from reconstruction.instances import InstancesConfig, find_instances
from reconstruction.instances.outlined_box import Wall, WallBox, WallMask, fit_box, silhouette
from reconstruction.measure.alignment import Alignment
from reconstruction.measure.object_boxes import instance_boxes
from registry.errors import UsageError

CAMERA = Camera(320, 240, 260.0, 260.0, 160.0, 120.0)
WALL = Wall.of(BaseEntity(2, "wall", Plane(np.array([0.0, -1.0, 0.0, 1.0]), np.zeros((3, 3))), True))  # y = 1
SHADES = np.array([[0, 0, 0], [120, 120, 110], [200, 200, 190], [120, 80, 50], [40, 60, 160]], np.uint8)


def window(box: WallBox, eye, target=(0.0, 1.0, 1.2)) -> WallMask:
    pose = looking_at(np.array(eye, float), np.array(target))
    found = WallMask.of(silhouette(box, WALL, CAMERA, pose), WALL, CAMERA, pose)
    assert found is not None
    return found


def places(x0: float, x1: float) -> np.ndarray:
    """Return coordinates along the wall of two x, in order."""
    return np.sort(WALL.points(np.zeros((1, 2)))[0] @ WALL.along + np.array([x0, x1]) * WALL.along[0])


def test_how_far_a_box_stands_out_shows_in_its_outlines_from_two_sides():
    low, high = places(-0.3, 0.3)
    shelf = WallBox(np.array([low, 1.1]), np.array([high, 1.4]), 0.25)
    found = fit_box(WALL, [window(shelf, (x, -0.8, 1.9)) for x in (-1.2, 0.2, 1.3)])
    assert found.front == pytest.approx(0.25, abs=0.051)
    assert [*found.low, *found.high] == pytest.approx([*shelf.low, *shelf.high], abs=0.03)


def test_what_outlines_say_nothing_of_is_flat_and_a_bar_is_as_deep_as_it_is_high():
    low, high = places(-0.3, 0.3)
    picture = WallBox(np.array([low, 1.0]), np.array([high, 1.4]), 0.025)
    found = fit_box(WALL, [window(picture, (0.1, -1.5, 1.3))])
    assert found.front == pytest.approx(0.025)
    assert [*found.low, *found.high] == pytest.approx([*picture.low, *picture.high], abs=0.02)
    bar = WallBox(np.array([low, 1.2]), np.array([high, 1.3]), 0.025)
    assert fit_box(WALL, [window(bar, (0.0, -1.5, 1.25))]).front == pytest.approx(0.1, abs=0.02)


def test_a_side_that_the_picture_cuts_off_counts_only_where_no_frame_shows_it():
    low, high = places(-0.3, 0.3)
    picture = WallBox(np.array([low, 1.0]), np.array([high, 1.4]), 0.025)
    whole = window(picture, (0.1, -1.5, 1.3))
    half = window(picture, (0.1, -1.0, 1.3), target=(1.3, 1.0, 1.2))
    assert half.cut.any()
    assert not whole.cut.any()
    for windows in ([whole, half, half], [half, half, whole]):
        found = fit_box(WALL, windows)
        assert [*found.low, *found.high] == pytest.approx([*picture.low, *picture.high], abs=0.02)


def test_a_picture_that_every_frame_cuts_off_is_as_long_as_it_is_wide():
    low, high = places(-0.3, 0.3)
    picture = WallBox(np.array([low, 1.0]), np.array([high, 1.6]), 0.025)
    upper = window(picture, (0.1, -1.0, 1.2), target=(0.0, 1.0, 0.5))
    assert upper.cut.tolist() == [[False, False], [False, True]]
    assert upper.sides[1, 1] < 1.5
    found = fit_box(WALL, [upper])
    assert [*found.low, *found.high] == pytest.approx([*picture.low, *picture.high], abs=0.03)


@pytest.fixture(scope="module")
def room():
    """A floor, a table, and a wall with a hole in its surface where a picture hangs."""
    gray = (200, 200, 190)
    floor, table = (
        floor_sheet((120, 120, 110), 1.0, 0.025),
        solid_box((-0.4, -0.3, 0), (0.4, 0.3, 0.4), (120, 80, 50)),
    )
    wall = [
        sheet((-1.0, 1.0, 0), (2.0, 0, 0), (0, 0, 0.6), gray, 0.025),
        sheet((-1.0, 1.0, 0.6), (0.6, 0, 0), (0, 0, 0.6), gray, 0.025),
        sheet((0.3, 1.0, 0.6), (0.7, 0, 0), (0, 0, 0.6), gray, 0.025),
    ]
    surface = surface_from(merged(floor, *wall, table))
    whole = [floor, sheet((-1.0, 1.0, 0), (2.0, 0, 0), (0, 0, 1.2), gray, 0.025), table]
    picture = sheet((-0.3, 0.98, 0.7), (0.5, 0, 0), (0, 0, 0.4), (40, 60, 160))
    center, angles = np.array([0.0, 0.0, 0.5]), np.linspace(-2.3, -0.8, 6)
    poses = np.stack(
        [looking_at(center + np.array([2.0 * np.cos(a), 2.0 * np.sin(a), 0.7]), center) for a in angles]
    )
    camera = Camera(160, 120, 128.0, 128.0, 80.0, 60.0)
    depth = np.stack([rasterize_mesh(surface.vertices, surface.faces, camera, p).depth for p in poses])
    ids = np.zeros((len(poses), 120, 160), np.uint16)
    for row, pose in enumerate(poses):
        nearest = np.full(ids.shape[1:], np.inf)
        for number, part in enumerate([*whole, picture], start=1):
            drawn = rasterize_mesh(part.vertices, part.faces, camera, pose).depth
            closer = (drawn > 0) & (drawn < nearest)
            ids[row][closer], nearest = number, np.where(closer, drawn, nearest)
    posed = replace(
        frames_of(surface)[0], camera=camera, images=SHADES[ids], indices=np.arange(1, 7, dtype=np.int32),
        times_s=np.arange(6) / 10, world_from_camera=poses, sharpness=np.ones(6, np.float32),
        held_out_images=np.zeros((0, 120, 160, 3), np.uint8),
    )  # fmt: skip
    return surface, posed, DepthMaps(camera, depth, np.where(depth > 0, 2, 0).astype(np.uint8)), ids


def find(room, ids, folder, notes):
    surface, posed, depth, _ = room
    for index, image in zip(posed.indices, ids):
        cv2.imwrite(str(folder / f"{index:05d}.png"), image.astype(np.uint8))

    class Listener:
        start = advance = staticmethod(lambda *_: None)
        note = staticmethod(notes.append)

    config = InstancesConfig(masks="folder", masks_path=str(folder))
    return find_instances(posed, depth, surface, config, progress=Listener())


def test_a_picture_without_any_depth_is_found_by_its_masks(room, tmp_path):
    notes: list[str] = []
    found = find(room, room[3], tmp_path, notes)
    wall = next(b.id for b in found.base if b.label == "wall")
    picture = next(o for o in found.objects if o.attached_hint)
    assert (picture.support_hint, picture.label) == (wall, "picture")
    assert picture.center == pytest.approx([-0.05, 0.99, 0.9], abs=0.03)
    assert picture.extents_m == pytest.approx([0.025, 0.5, 0.4], abs=0.04)
    assert sum("outlines" in note for note in notes) == 1
    same = Alignment(np.eye(4), np.zeros(0, np.int32), np.zeros(0), np.zeros(0), 0.0)
    row = [o.id for o in found.objects].index(picture.id)
    box = instance_boxes(room[0].vertices, found, same)[row]
    assert box == pytest.approx(np.array([[-0.3, 0.975, 0.7], [0.2, 1.0, 1.1]]), abs=0.03)
    true = room[3] == 4
    assert (found.id_maps[true] == picture.id).mean() > 0.85
    assert (found.id_maps[~true] == picture.id).mean() < 0.02


def test_a_piece_of_the_wall_in_a_mask_of_its_own_is_no_thing(room, tmp_path):
    surface, posed, depth, ids = room
    plain = (surface, replace(posed, images=SHADES[np.where(ids == 4, 2, ids)]), depth, ids)
    assert not any(o.attached_hint for o in find(plain, ids, tmp_path, []).objects)


def test_a_mask_that_most_frames_do_not_confirm_is_no_thing(room, tmp_path):
    ids = np.where(room[3] == 4, 2, room[3])
    ids[2] = room[3][2]
    assert not any(o.attached_hint for o in find(room, ids, tmp_path, []).objects)


def test_a_thing_that_is_only_an_outline_can_be_dropped_and_not_made_base(room, tmp_path):
    surface = room[0]
    found = find(room, room[3], tmp_path, [])
    picture = next(o for o in found.objects if o.attached_hint)
    dropped = apply_overrides(found, surface, [{"id": picture.id, "drop": True}])
    assert picture.id not in [o.id for o in dropped.objects]
    with pytest.raises(UsageError, match="has no surface, only an outline"):
        apply_overrides(found, surface, [{"id": picture.id, "make_base": "wall"}])
