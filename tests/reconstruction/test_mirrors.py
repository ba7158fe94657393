"""Mirrors: found by the reflected room behind them, told from windows and doors, and hung on their wall."""

from dataclasses import replace

import numpy as np
import pytest

from reconstruction.core.reflections import glass_depth, without_reflections
from reconstruction.core.types import BaseEntity, InstanceSet, Plane, Surface
from reconstruction.instances.mirrors import hang_mirrors
from reconstruction.world.mirrors import find_mirrors
from synthetic.camera_paths import handheld_path
from synthetic.capture import make_test_capture
from synthetic.film import prepare, render_stereo_depth, render_truth
from synthetic.mirrors import glass_plane, with_wall_mirror
from synthetic.room import EAST_M, NORTH_M, WEST_M, build_room

pytestmark = pytest.mark.stage

PLANES = [
    (np.array([0.0, 0.0, 1.0]), 0.0),
    (np.array([0.0, -1.0, 0.0]), -NORTH_M),
    (np.array([1.0, 0.0, 0.0]), WEST_M),
    (np.array([-1.0, 0.0, 0.0]), -EAST_M),
]
PATH = handheld_path(14, height_m=1.38, target=(0.02, 0.4, 0.75))


@pytest.fixture(scope="module")
def room():
    return with_wall_mirror(build_room(0, step_m=0.1, density=0.1))


@pytest.fixture(scope="module")
def film_set(room):
    return prepare(room, shadow_px=64, mirror=glass_plane(room))


@pytest.fixture(scope="module")
def capture():
    return make_test_capture(14, 200, 150, objects=("table",), path=PATH, density=0.1)


@pytest.fixture(scope="module")
def seen(capture, film_set):
    """Return the frames and depth maps in which the mirror shows the room."""
    rows = [
        int(np.flatnonzero(np.all(np.isclose(PATH, p), axis=(1, 2)))[0])
        for p in capture.posed.world_from_camera
    ]
    depth = np.stack([render_stereo_depth(film_set, capture.depth.camera, PATH[row]) for row in rows])
    confidence = np.where(depth > 0, 2, 0).astype(np.uint8)
    return capture.posed, replace(capture.depth, depth=depth, confidence=confidence)


@pytest.fixture(scope="module")
def glass(room):
    """Return the corners, low and high, of the true glass."""
    points = np.concatenate(
        [p.vertices for p in room.entity("picture").patches if p.texture == "picture/art"]
    )
    return points.min(axis=0), points.max(axis=0)


@pytest.fixture(scope="module")
def found(seen):
    return find_mirrors(*seen, PLANES)


def test_a_mirror_is_found_with_its_outline_and_plane(found, glass):
    assert len(found) == 1
    low, high = found[0].polygon.min(axis=0), found[0].polygon.max(axis=0)
    assert found[0].plane[:3] == pytest.approx([0, -1, 0], abs=0.01)
    assert low[1] == pytest.approx(glass[0][1], abs=0.015)  # the glass is in front of the wall
    assert low[[0, 2]] == pytest.approx(glass[0][[0, 2]], abs=0.06)
    assert high[0] == pytest.approx(glass[1][0], abs=0.06)  # its top is out of view


def test_depth_behind_the_glass_becomes_that_of_the_glass(seen, found, film_set):
    posed, depth = seen
    mended = without_reflections(depth, posed.world_from_camera, found)
    rays = depth.camera.pixel_rays()
    looking = 0
    for row, pose in enumerate(posed.world_from_camera):
        true, _ = render_truth(film_set, depth.camera, pose)
        shown = glass_depth(found[0], rays, pose) > 0
        wrong = shown & (depth.depth[row] > 1.05 * true)
        looking += wrong.sum()
        assert np.abs(mended.depth[row][wrong] / true[wrong] - 1).max(initial=0) < 0.02
        assert np.array_equal(mended.depth[row][~shown], depth.depth[row][~shown])
    assert looking > 2000


@pytest.mark.parametrize("behind_m", [1.0, 3.0])
def test_a_window_is_no_mirror(seen, found, behind_m):
    """A wall with things before it, and the floor that goes on, are behind the same opening."""
    posed, depth = seen
    rays = depth.camera.pixel_rays()
    z = np.array(depth.depth)
    for row, pose in enumerate(posed.world_from_camera):
        opening = glass_depth(found[0], rays, pose) > 0
        directions = rays @ pose[:3, :3].T
        bumps = 0.3 * np.sin(3 * np.arange(z.shape[2])[None] * 0.05)
        far = (NORTH_M + behind_m + bumps - pose[1, 3]) / np.maximum(directions[..., 1], 1e-6)
        floor = np.where(directions[..., 2] < 0, -pose[2, 3] / np.minimum(directions[..., 2], -1e-6), np.inf)
        z[row][opening] = np.minimum(far, floor)[opening]
    assert find_mirrors(posed, replace(depth, depth=z), PLANES) == ()


def test_a_room_without_openings_has_no_mirror(seen, found):
    posed, depth = seen
    closed = without_reflections(depth, posed.world_from_camera, found)
    closed = replace(closed, confidence=np.full_like(closed.confidence, 2))
    assert find_mirrors(posed, closed, PLANES) == ()


def square(low, high, y, step=0.04):
    x, z = np.meshgrid(np.arange(low[0], high[0], step), np.arange(low[1], high[1], step))
    return np.column_stack([x.ravel(), np.full(x.size, y), z.ravel()])


def test_a_mirror_becomes_an_object_with_its_frame(seen, found):
    posed, depth = seen
    low, high = found[0].polygon.min(axis=0)[[0, 2]], found[0].polygon.max(axis=0)[[0, 2]]
    wall = square((WEST_M, 0), (EAST_M, 2.4), NORTH_M)
    frame = square(low - 0.06, high + 0.06, NORTH_M - 0.025, 0.02)
    bar = ((frame[:, [0, 2]] < low) | (frame[:, [0, 2]] > high)).any(axis=1)
    far = square((1.0, 0.2), (1.4, 0.6), NORTH_M - 0.5)
    points = np.concatenate([wall, frame[bar], far]).astype(np.float32)
    owner = np.repeat([1, 2, 3], [len(wall), bar.sum(), len(far)]).astype(np.int32)
    surface = Surface(
        points, np.zeros((0, 3), np.int32), np.tile(np.float32([0, -1, 0]), (len(points), 1)),
        np.zeros((len(points), 3), np.uint8), np.ones(len(points), np.float32), 0.008, capture_space(),
    )  # fmt: skip
    corners = np.array(
        [[WEST_M, NORTH_M, 0], [EAST_M, NORTH_M, 0], [EAST_M, NORTH_M, 2.4], [WEST_M, NORTH_M, 2.4]]
    )
    base = (BaseEntity(1, "wall", Plane(np.array([0, -1.0, 0, NORTH_M]), corners), True),)
    ids = np.ones(depth.depth.shape, np.uint16)
    cut = InstanceSet(owner, base, (thing(2), thing(3)), ids)
    hung = hang_mirrors(
        cut, found, surface, posed, without_reflections(depth, posed.world_from_camera, found)
    )
    by_id = {o.id: o for o in hung.objects}
    assert set(by_id) == {2, 3}
    assert by_id[2].label == "mirror"
    assert by_id[2].attached_hint
    assert by_id[2].support_hint == 1
    size = high - low + 0.12
    assert by_id[2].extents_m == pytest.approx([0.025, *size], abs=0.04)
    assert by_id[3] == cut.objects[1]
    assert (hung.vertex_instance[owner == 3] == 3).all()
    assert (hung.vertex_instance[owner == 2] == 2).all()
    middle = np.abs(wall[:, [0, 2]] - 0.5 * (low + high)).max(axis=1) < 0.2
    assert (hung.vertex_instance[: len(wall)][middle] == 2).all()
    shown = np.stack(
        [glass_depth(found[0], depth.camera.pixel_rays(), p) > 0 for p in posed.world_from_camera]
    )
    assert (hung.id_maps[shown] == 2).mean() > 0.8


def test_a_mirror_without_a_wall_is_no_object(seen, found):
    posed, depth = seen
    points = square((0, 0), (1, 1), 0.0).astype(np.float32)
    surface = Surface(
        points, np.zeros((0, 3), np.int32), np.tile(np.float32([0, -1, 0]), (len(points), 1)),
        np.zeros((len(points), 3), np.uint8), np.ones(len(points), np.float32), 0.008, capture_space(),
    )  # fmt: skip
    cut = InstanceSet(np.zeros(len(points), np.int32), (), (), np.zeros(depth.depth.shape, np.uint16))
    assert hang_mirrors(cut, found, surface, posed, depth) is cut


def test_planes_move_with_the_space(found):
    turn = np.eye(4)
    turn[:3, :3] = 0.4 * np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    turn[:3, 3] = [1.0, -2.0, 0.5]
    moved = found[0].moved(turn)
    assert np.abs(moved.polygon @ moved.plane[:3] + moved.plane[3]).max() < 1e-9
    assert np.linalg.norm(moved.plane[:3]) == pytest.approx(1)
    back = moved.moved(np.linalg.inv(turn))
    assert back.polygon == pytest.approx(found[0].polygon)
    assert back.plane == pytest.approx(found[0].plane)


def capture_space():
    from reconstruction.core.types import SpaceGrid

    return SpaceGrid(np.zeros(3), 0.1, np.zeros((1, 1, 1), np.uint8))


def thing(number):
    from reconstruction.core.types import Instance

    return Instance(number, "unknown", 0.0, np.zeros(3), 0.0, np.ones(3), 1, False)
