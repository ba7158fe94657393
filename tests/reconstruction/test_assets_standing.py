"""Contacts of objects with their carriers, and removal of depth bleeding from the carrier."""

from dataclasses import replace

import numpy as np
import pytest

from reconstruction.assets.completion import settle_on_support
from reconstruction.assets.standing import (
    Standing,
    _agreed,
    _covered_top,
    _hidden_foot,
    within_walls,
    without_children,
)
from reconstruction.assets.support import support_height
from reconstruction.assets.views import SeenPoints
from reconstruction.assets.volume import ObjectFrame, ObjectVolume
from reconstruction.core.types import BaseEntity, Instance, InstanceSet, Plane
from registry.geometry import rigid

PLATE = Instance(5, "plate", 0.5, np.array([0, 0, 0.415]), 0.0, np.array([0.22, 0.22, 0.02]), 4, False)
NOTHING = InstanceSet(np.zeros(0, np.int32), (), (PLATE,), np.zeros((1, 2, 2), np.uint16))
TOP_M = 0.40
VOXEL_M = 0.01


def seen(points: np.ndarray) -> SeenPoints:
    up = np.tile([0, 0, 1.0], (len(points), 1))
    return SeenPoints(points, up, np.zeros(len(points), np.int32), np.full(len(points), 0.002))


def disc(radius: float, height: float) -> np.ndarray:
    x, y = np.meshgrid(*(np.arange(-radius, radius, 0.004),) * 2)
    inside = np.hypot(x, y) < radius
    return np.column_stack([x[inside], y[inside], np.full(inside.sum(), height)])


def carrier(height_at) -> SeenPoints:
    """A top 60 cm wide whose height is a function of the distance from the plate's outline (r = 11 cm)."""
    x, y = np.meshgrid(*(np.arange(-0.3, 0.3, 0.004),) * 2)
    away = np.hypot(x, y) - 0.11
    points = np.column_stack([x.ravel(), y.ravel(), height_at(away).ravel()])
    return seen(points[away.ravel() > 0])


def test_a_plate_stands_at_the_foot_of_the_slope_of_its_depth_bleeding():
    table = carrier(lambda away: TOP_M + np.clip(0.016 - 0.6 * away, 0, None))
    level = support_height(PLATE, disc(0.11, TOP_M + 0.02), table, NOTHING)
    assert level == pytest.approx(TOP_M, abs=1e-3)


def test_an_object_on_a_tray_stands_on_the_tray():
    # The rim rises from 2 cm off the thing on; the tray's bottom beside it counts.
    tray = carrier(lambda away: np.where(away < 0.02, TOP_M, TOP_M + 0.04))
    level = support_height(PLATE, disc(0.11, TOP_M + 0.003), tray, NOTHING)
    assert level == pytest.approx(TOP_M, abs=1e-3)


def test_an_object_on_a_narrow_step_stays_on_the_step():
    # Two boards of one carrier, 6 cm apart in height: the lower one shows all around.
    steps = carrier(lambda away: np.where(away < 0.024, TOP_M, TOP_M - 0.06))
    level = support_height(PLATE, disc(0.11, TOP_M + 0.003), steps, NOTHING)
    assert level == pytest.approx(TOP_M, abs=1e-3)


def slab_with(ring) -> ObjectVolume:
    """A board 60 x 60 x 10 cm, z = 0 at its top, raised by 3 cm where `ring` of the distance from the center says."""
    x = -0.4 + (np.arange(80) + 0.5) * VOXEL_M
    z = -0.15 + (np.arange(30) + 0.5) * VOXEL_M
    a, b = np.meshgrid(x, x, indexing="ij")
    height = np.where(ring(np.hypot(a, b)), 0.03, 0.0)
    board = np.maximum(np.abs(a), np.abs(b)) < 0.3
    distance = np.where(
        board[..., None], np.abs(z - (height[..., None] - 0.1) / 2) - (height[..., None] + 0.1) / 2, 0.05
    )
    every = np.ones(distance.shape, bool)
    free = distance > 0
    return ObjectVolume(
        np.array([-0.4, -0.4, -0.15]),
        VOXEL_M,
        0.05,
        0.002,
        distance.astype(np.float32),
        every,
        free,
        every & ~free,
    )


def raised_columns(volume: ObjectVolume) -> int:
    return int((volume.distance[:, :, volume.centers(2) > 0.01] < 0).any(axis=2).sum())


def stand(volume: ObjectVolume) -> ObjectVolume:
    frame = ObjectFrame(np.eye(4), np.zeros((0, 3)), np.zeros((0, 3)), True, None)
    angle = np.arange(24) * np.pi / 12
    outline = 0.08 * np.column_stack([np.cos(angle), np.sin(angle)])
    return without_children(volume, frame, (Standing(5, 4, 0.0, True, outline, 0.1),), 0.01)


def test_a_rise_around_an_object_only_is_depth_bleeding():
    smeared = slab_with(lambda r: r < 0.12)
    made = stand(smeared)
    assert raised_columns(smeared) > 400
    assert raised_columns(made) == 0
    # The board below it is whole.
    assert (made.distance[20:60, 20:60, 10] < 0).all()


def test_a_wide_rim_and_a_rim_at_the_edge_stay():
    for ring in (lambda r: (r > 0.11) & (r < 0.2), lambda r: r > 0.11):
        rimmed = slab_with(ring)
        assert raised_columns(stand(rimmed)) == raised_columns(rimmed)


def test_an_overhanging_object_does_not_enlarge_its_carrier():
    # A plate of 32 cm on a box of 12 cm that only one side of was seen, its top hidden.
    volume = slab_with(lambda r: r < 0)
    unknown = np.zeros(volume.distance.shape, bool)
    volume = replace(volume, known=unknown, free=unknown, seen=unknown)
    x, z = np.meshgrid(np.linspace(-0.06, 0.06, 30), np.linspace(-0.1, 0.0, 20))
    points = np.concatenate(
        [np.column_stack([x.ravel(), np.full(x.size, y), z.ravel()]) for y in (-0.06, 0.06)]
    )
    frame = ObjectFrame(np.eye(4), points, np.zeros_like(points), True, None)
    angle = np.arange(24) * np.pi / 12
    outline = 0.16 * np.column_stack([np.cos(angle), np.sin(angle)])
    made = without_children(volume, frame, (Standing(5, 4, 0.0, True, outline, 0.02),), 0.01)
    solid = np.argwhere(made.known & (made.distance < 0))
    low, high = volume.origin + solid.min(axis=0) * VOXEL_M, volume.origin + (solid.max(axis=0) + 1) * VOXEL_M
    assert low[:2] == pytest.approx([-0.06, -0.06], abs=0.015)
    assert high == pytest.approx([0.06, 0.06, 0.0], abs=0.015)


def standing_at(*levels: float) -> dict[int, Standing]:
    none = np.zeros((0, 2))
    return {k: Standing(k, 1, level, True, none, level + 0.1) for k, level in enumerate(levels, start=2)}


def test_an_object_measured_too_low_is_raised_to_the_common_level():
    levels = [s.level_m for s in _agreed(standing_at(0.80, 0.802, 0.778, 0.801)).values()]
    assert levels == pytest.approx([0.8005] * 4, abs=1e-3)


def test_objects_at_other_levels_keep_theirs():
    agreed = _agreed(standing_at(0.80, 0.802, 0.825, 0.60))
    assert [agreed[k].level_m for k in (4, 5)] == [0.825, 0.60]


def test_an_occluded_foot_is_on_the_floor_of_the_container():
    can = Instance(6, "can", 0.5, np.array([0, 0, 0.46]), 0.0, np.array([0.07, 0.07, 0.11]), 4, False)
    assert _hidden_foot(can, 0.46, 0.515) == pytest.approx(0.405)
    assert _hidden_foot(can, 0.41, 0.515) is None  # its foot was seen
    assert _hidden_foot(can, 0.50, 0.515) is None  # hardly any of it was seen: the box may be wrong


def test_volume_behind_a_wall_is_free():
    volume = slab_with(lambda r: r < 0)
    frame = ObjectFrame(
        rigid(translation=np.array([1.0, 0, 0])), np.zeros((0, 3)), np.zeros((0, 3)), True, None
    )
    wall = BaseEntity(1, "wall", Plane(np.array([-1.0, 0, 0, 1.2]), np.zeros((3, 3))), True)  # x = 1.2

    def solid_columns(walls: tuple[BaseEntity, ...], hung: ObjectFrame = frame) -> np.ndarray:
        cut = within_walls(volume, hung, InstanceSet(NOTHING.vertex_instance, walls, (), NOTHING.id_maps))
        return volume.centers(0)[(cut.distance < 0).any(axis=(1, 2))]

    assert solid_columns(()).max() == pytest.approx(0.295)
    assert solid_columns((wall,)).max() == pytest.approx(0.195)
    assert solid_columns((wall,)).min() == pytest.approx(-0.295)
    before = replace(
        wall, surface=Plane(np.array([1.0, 0, 0, -1.2]), np.zeros((3, 3)))
    )  # most is behind: no wall
    assert solid_columns((before,)).min() == pytest.approx(-0.295)
    assert solid_columns((wall,), replace(frame, wall_y=0.0)).max() == pytest.approx(0.295)


def flat_on_its_support(rim) -> tuple[ObjectVolume, ObjectFrame]:
    """7 mm of object all over a support at z = 0, and 5 cm of it where `rim` of x and y says so."""
    voxel = 0.005
    x, z = -0.2 + (np.arange(80) + 0.5) * voxel, -0.02 + (np.arange(20) + 0.5) * voxel
    a, b = np.meshgrid(x, x, indexing="ij")
    top = np.where(rim(a, b), 0.05, 0.007)
    distance = np.clip(z - top[..., None], -0.02, 0.02).astype(np.float32)
    every = np.ones(distance.shape, bool)
    tall = rim(a, b)
    points = np.column_stack([a[tall], b[tall], np.full(tall.sum(), 0.05)])
    volume = ObjectVolume(
        np.array([-0.2, -0.2, -0.02]), voxel, 0.02, 0.004, distance, every, distance > 0, every
    )
    return volume, ObjectFrame(np.eye(4), points, np.zeros_like(points), True, None)


def lowest_layer(volume: ObjectVolume, frame: ObjectFrame) -> np.ndarray:
    """Columns (nx, ny) where the object is solid just above its support."""
    made = settle_on_support(volume, frame)
    return made.distance[:, :, int(np.searchsorted(made.centers(2), 0.0))] < 0


def test_a_thin_floor_within_a_rim_stays_and_skirts_are_dropped():
    tray = flat_on_its_support(lambda x, y: (np.hypot(x, y) > 0.1) & (np.hypot(x, y) < 0.11))
    solid = lowest_layer(*tray)
    assert solid[40, 40]
    assert solid[30, 45]
    assert not solid[2:10].any()
    assert not solid[40, 70:].any()


def test_a_thin_floor_below_a_child_stays_with_half_a_rim():
    volume, frame = flat_on_its_support(
        lambda x, y: ((x > 0.1) & (x < 0.11) & (y < 0.11)) | ((y > 0.1) & (y < 0.11) & (x < 0.11))
    )
    assert not lowest_layer(volume, frame)[30, 30]
    angle = np.arange(24) * np.pi / 12
    outline = 0.04 * np.column_stack([np.cos(angle), np.sin(angle)]) - 0.05
    everywhere = np.concatenate([frame.points, [[-0.2, -0.2, 0.0], [0.2, -0.2, 0.0], [-0.2, 0.2, 0.0]] * 9])
    standing = (Standing(5, 4, 0.007, True, outline, 0.1),)
    made = without_children(volume, replace(frame, points=everywhere), standing, 0.01)
    solid = lowest_layer(made, frame)
    assert solid[30, 30]
    assert not solid[2:10, :55].any()


def test_an_object_that_covers_its_carrier_stands_on_top_of_the_seen_sides():
    outline = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
    x, z = np.meshgrid(np.linspace(-0.1, 0.1, 60), np.linspace(0.4, 0.44, 20))
    side = np.column_stack([x.ravel(), np.full(x.size, -0.098), z.ravel()])
    other = side[:, [1, 0, 2]]
    book = np.concatenate([side, other])
    assert _covered_top(outline, 0.438, 0.405, book) == pytest.approx(0.44, abs=1e-3)
    # It was seen down to where it seemed to stand; what is below it is a wall of what it is in, higher than it ends.
    assert _covered_top(outline, 0.41, 0.405, book) is None
    assert _covered_top(0.8 * outline, 0.438, 0.405, book) is None
    assert _covered_top(outline, 0.42, 0.39, book + np.array([0, 0, 0.1])) is None
