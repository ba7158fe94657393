"""Objects cropped by the image border are extended; objects seen whole are not."""

from dataclasses import replace

import numpy as np
import pytest
from facing import CAMERA, frames

from reconstruction.assets.cut_off import Room, continued, cut_off_sides, lone_front, with_copies
from reconstruction.assets.views import SeenPoints
from reconstruction.assets.volume import ObjectFrame, ObjectVolume
from reconstruction.core.types import BaseEntity, InstanceSet, Plane, PosedFrames, SpaceGrid, Surface
from registry.geometry import invert_rigid, rigid, transform_points

THING, FLOOR, WALL = 3, 1, 2
WALL_Y = 2.5


def plate(low, high, normal, count=1500, seed=0) -> tuple[np.ndarray, np.ndarray]:
    points = np.random.default_rng(seed).uniform(low, high, (count, 3))
    return points, np.tile(np.asarray(normal, float), (count, 1))


def shelf() -> tuple[np.ndarray, np.ndarray]:
    """Boards 1 m wide and 0.3 m deep every 0.3 m between two uprights; the topmost is out of every frame."""
    boards = [plate((-0.5, 2.0, z), (0.5, 2.3, z + 0.005), (0, 0, 1)) for z in (0.0, 0.3, 0.6, 0.9)]
    uprights = [plate((x, 2.0, 0.0), (x + 0.01, 2.3, 1.5), (1, 0, 0), 4000) for x in (-0.5, 0.49)]
    points, normals = (np.concatenate(parts) for parts in zip(*boards, *uprights))
    return points, normals


def front() -> tuple[np.ndarray, np.ndarray]:
    """The front of a chest, 0.5 m wide and high."""
    return plate((-0.25, 1.995, 0.0), (0.25, 2.005, 0.5), (0, -1, 0), 6000)


class Scene:
    """An object in front of a wall with the points that `posed` see of it."""

    def __init__(self, points: np.ndarray, normals: np.ndarray, posed: PosedFrames) -> None:
        maps = np.full((len(posed.images), 240, 320), WALL, np.uint16)
        depth = np.full(maps.shape, WALL_Y, np.float32)
        seen = np.full(len(points), -1)
        for row, pose in enumerate(posed.world_from_camera):
            local = transform_points(invert_rigid(pose), points)
            u = np.floor(CAMERA.fx * local[:, 0] / local[:, 2] + CAMERA.cx).astype(int)
            v = np.floor(CAMERA.fy * local[:, 1] / local[:, 2] + CAMERA.cy).astype(int)
            inside = (u >= 0) & (v >= 0) & (u < 320) & (v < 240)
            seen[inside] = row
            for du in (-2, -1, 0, 1, 2):
                for dv in (-2, -1, 0, 1, 2):
                    at = np.clip(v[inside] + dv, 0, 239), np.clip(u[inside] + du, 0, 319)
                    maps[row][at], depth[row][at] = THING, local[inside, 2]
        kept = seen >= 0
        self.seen = SeenPoints(
            points[kept], normals[kept], seen[kept].astype(np.int32), np.full(kept.sum(), 0.005)
        )
        middle = np.array([0.0, 2.0, 0.0])
        self.frame = ObjectFrame(rigid(translation=middle), points[kept] - middle, normals[kept], True, None)
        wall = BaseEntity(WALL, "wall", Plane(np.array([0, -1.0, 0, WALL_Y]), np.zeros((3, 3))), True)
        found = InstanceSet(np.zeros(0, np.int32), (wall,), (), maps)
        self.room = Room(posed, CAMERA, depth, surface(), found)

    def sides(self):
        return cut_off_sides(THING, self.frame, self.seen, self.room)

    def with_free(self, low, high) -> "Scene":
        """Return the scene with free space in a box."""
        space = self.room.surface.space
        state = space.state.copy()
        index = [
            slice(*np.round((np.array([a, b]) - o) / 0.05).astype(int))
            for a, b, o in zip(low, high, space.origin)
        ]
        state[tuple(index)] = 1
        self.room = replace(self.room, surface=surface(state))
        return self


def surface(state: np.ndarray | None = None) -> Surface:
    state = np.zeros((60, 60, 60), np.uint8) if state is None else state
    none = np.zeros((0, 3), np.float32)
    space = SpaceGrid(np.array([-1.5, 1.0, 0.0]), 0.05, state)
    return Surface(
        none, np.zeros((0, 3), np.int32), none, none.astype(np.uint8), np.zeros(0, np.float32), 0.01, space
    )


# 2 m before the shelf: these frames end 0.86 m higher than the camera is there, and show the floor.
LOW = frames((0.0, 0.0, 0.1), (0.1, 0.0, 0.1))


def test_a_shelf_is_extended_to_the_next_board():
    scene = Scene(*shelf(), LOW)
    (side,) = scene.sides()
    assert (side.axis, side.sign) == (2, 1)
    assert side.end == pytest.approx(1.22, abs=0.03)
    assert side.period == pytest.approx(0.3, abs=0.02)


def test_an_object_seen_whole_is_not_extended():
    assert Scene(*shelf(), frames((0, -0.5, 0.7), (0.1, -0.5, 0.7))).sides() == []


def test_free_space_stops_the_extension():
    assert Scene(*shelf(), LOW).with_free((-0.6, 1.9, 1.05), (0.6, 2.4, 2.0)).sides() == []


def test_a_cropped_side_becomes_as_long_as_the_object_is_deep():
    """The images end at x = 1.1 and show little of a chest 0.6 m deep."""
    top = plate((0.9, 1.6, 0.4), (1.8, 2.2, 0.405), (0, 0, 1), 8000)
    side = plate((0.9, 1.6, 0.0), (0.905, 2.2, 0.4), (-1, 0, 0), 6000)
    points, normals = (np.concatenate(parts) for parts in zip(top, side))
    (found,) = Scene(points, normals, frames((0, 0, 0.5), (-0.02, 0, 0.5))).sides()
    assert (found.axis, found.sign) == (0, 1)
    assert found.end == pytest.approx(0.9 + 0.6, abs=0.04)


def test_points_and_volume_are_copied_from_the_previous_board():
    scene = Scene(*shelf(), LOW)
    (side,) = sides = scene.sides()
    frame = with_copies(scene.frame, sides)
    new = frame.points[frame.points[:, 2] > side.cut]
    assert frame.points[:, 2].max() == pytest.approx(side.end, abs=0.02)
    assert (np.abs(new[:, 2] - 1.2) < 0.02).sum() > 500  # the next board
    voxel = 0.02
    shape = (6, 6, 80)
    z = (np.arange(80) + 0.5) * voxel
    board = np.abs((z + 0.05) % 0.3 - 0.05)  # distance to boards, as the shelf has them
    distance = np.broadcast_to(np.where(z < side.cut, board, 0.0), shape).astype(np.float32)
    known = np.broadcast_to(z < side.cut, shape).copy()
    free = np.zeros(shape, bool)
    free[0], known[0] = True, True  # rays passed through this column all along
    volume = ObjectVolume(np.zeros(3), voxel, 0.05, 0.002, distance, known, free, known.copy())
    out = continued(volume, sides)
    beyond = (z > side.cut) & (z <= side.end)
    assert out.known[3][:, beyond].all()
    np.testing.assert_allclose(out.distance[3, 0, beyond], board[beyond], atol=1.5 * voxel)
    assert not out.known[3][:, z > side.end + voxel].any()
    assert out.free[0].all()
    assert not out.free[1:].any()


def test_a_lone_front_becomes_a_box():
    scene = Scene(*front(), frames((0, -0.5, 0.4), (0.1, -0.5, 0.4)))
    body = lone_front(THING, scene.frame, scene.seen, scene.room)
    np.testing.assert_allclose(np.ptp(body.vertices, axis=0), [0.5, 0.5, 0.5], atol=0.03)
    assert body.vertices[:, 1].min() == pytest.approx(0.0, abs=0.01)  # the front stays where it was seen


def test_a_box_ends_at_the_wall_or_at_free_space():
    posed = frames((0, -0.5, 0.4), (0.1, -0.5, 0.4))
    scene = Scene(*front(), posed)
    wall = replace(scene.room.found.base[0], surface=Plane(np.array([0, -1.0, 0, 2.3]), np.zeros((3, 3))))
    scene.room = replace(scene.room, found=replace(scene.room.found, base=(wall,)))
    body = lone_front(THING, scene.frame, scene.seen, scene.room)
    assert np.ptp(body.vertices[:, 1]) == pytest.approx(0.3, abs=0.03)
    scene = Scene(*front(), posed).with_free((-0.5, 2.2, 0.0), (0.5, 3.0, 1.0))
    body = lone_front(THING, scene.frame, scene.seen, scene.room)
    assert np.ptp(body.vertices[:, 1]) == pytest.approx(0.2, abs=0.06)


def test_a_sheet_with_free_space_behind_is_no_front():
    scene = Scene(*front(), frames((0, -0.5, 0.4), (0.1, -0.5, 0.4))).with_free(
        (-0.5, 2.0, 0.0), (0.5, 3.0, 1.0)
    )
    assert lone_front(THING, scene.frame, scene.seen, scene.room) is None


def test_round_or_two_sided_objects_are_no_front():
    points, normals = shelf()
    scene = Scene(points, normals, LOW)
    assert lone_front(THING, scene.frame, scene.seen, scene.room) is None
    turn = np.random.default_rng(0).uniform(0, np.pi, 6000)
    disk = np.column_stack([0.25 * np.cos(turn), 2.0 + 0 * turn, 0.25 + 0.5 * (np.sin(turn) - 0.5)])
    ring = Scene(disk, np.tile([0, -1.0, 0], (6000, 1)), frames((0, -0.5, 0.4), (0.1, -0.5, 0.4)))
    assert lone_front(THING, ring.frame, ring.seen, ring.room) is None
