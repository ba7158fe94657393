"""Flat objects on walls become slabs; cropped sides are extended, seen ones are not."""

import numpy as np
import pytest
from facing import CAMERA, frames

from reconstruction.assets import AssetsConfig
from reconstruction.assets.hanging import hanging_slab, is_outlined, outlined_slab
from reconstruction.assets.hanging_front import first_minimum, front_of
from reconstruction.assets.volume import ObjectFrame
from reconstruction.core.types import BaseEntity, Instance, InstanceSet, Plane, PosedFrames
from registry.geometry import rigid, transform_points

TWICE = ((0.0, 0.0, 1.3), (0.1, 0.0, 1.3))


def seen(width=0.8, height=0.3, thickness=0.03, noise=0.004, wall_y=0.02, seed=0) -> ObjectFrame:
    """Points on the front of a picture whose lower edge is at z = 0; the wall is 2 m before the cameras."""
    rng = np.random.default_rng(seed)
    points = np.column_stack(
        [
            rng.uniform(-width / 2, width / 2, 4000),
            np.full(4000, wall_y - thickness) + rng.normal(0, noise, 4000),
            rng.uniform(0, height, 4000),
        ]
    )
    normals = np.tile([0.0, -1.0, 0.0], (4000, 1))
    return ObjectFrame(rigid(translation=np.array([0, 2.0, 1.2])), points, normals, False, wall_y)


WALL = BaseEntity(1, "wall", Plane(np.array([0, -1.0, 0, 2.0]), np.zeros((3, 3))), True)


def slab(frame: ObjectFrame, posed: PosedFrames, config: AssetsConfig | None = None, blind_rows: int = 0):
    """Fit the slab; instance maps show wall everywhere but in the uppermost `blind_rows`, where nothing is known."""
    maps = np.ones((len(posed.images), 240, 320), np.uint16)
    maps[:, :blind_rows] = 0
    found = InstanceSet(np.zeros(0, np.int32), (WALL,), (), maps)
    return hanging_slab(2, frame, posed, CAMERA, found, config or AssetsConfig())


def size_of(hanging) -> np.ndarray:
    return np.ptp(hanging.body.vertices, axis=0)


def test_a_picture_seen_whole_is_a_slab_of_its_size():
    found = slab(seen(), frames((0, 0, 1.3), (0.3, 0, 1.3)))
    assert not found.completed
    assert size_of(found) == pytest.approx([0.8, 0.03, 0.3], abs=0.02)
    assert found.body.vertices[:, 1].max() == pytest.approx(0.02)  # its back is on the wall
    assert found.body.volume == pytest.approx(np.prod(size_of(found)))


def test_a_picture_cropped_at_the_top_becomes_square():
    """The camera is at z = 0.66: the image ends at z = 1.51, just above the seen part of the picture."""
    low_eye = (0.0, 0.0, 0.655)
    found = slab(seen(), frames(low_eye, low_eye))
    assert found.completed
    assert size_of(found) == pytest.approx([0.8, 0.03, 0.8], abs=0.03)
    assert found.body.vertices[:, 2].min() == pytest.approx(0.0, abs=0.02)  # only the unseen side moves


def test_a_part_in_few_frames_belongs_to_the_picture():
    """The upper third is at the image border, in one of fifty frames."""
    frame = seen(height=0.3)
    rare = frame.points[:, 2] > 0.2
    keep = ~rare | (np.random.default_rng(1).random(len(rare)) < 0.3)
    many = np.concatenate([frame.points[~rare]] * 20 + [frame.points[rare & keep]])
    frame = ObjectFrame(
        frame.world_from_grid, many, np.tile([0.0, -1.0, 0.0], (len(many), 1)), False, frame.wall_y
    )
    found = slab(frame, frames(*TWICE))
    assert size_of(found) == pytest.approx([0.8, 0.03, 0.3], abs=0.03)


def test_wall_in_two_frames_stops_the_extension():
    found = slab(seen(), frames((0.0, 0.0, 0.655), *TWICE))
    assert not found.completed


def test_unknown_pixels_beyond_a_side_are_no_wall():
    """Depth is missing along the image border, though the camera sees it."""
    found = slab(seen(), frames(*TWICE), blind_rows=100)
    assert found.completed


def test_a_flush_print_gets_the_least_thickness():
    config = AssetsConfig()
    found = slab(seen(thickness=0.001), frames(*TWICE), config)
    assert size_of(found)[1] == pytest.approx(config.flat_thickness_m)


def test_thick_bent_or_standing_objects_are_no_slabs():
    assert slab(seen(thickness=0.25), frames(*TWICE)) is None
    assert slab(seen(noise=0.05), frames(*TWICE)) is None
    standing = ObjectFrame(np.eye(4), seen().points, seen().normals, True, None)
    assert slab(standing, frames(*TWICE)) is None


def filmed(pattern, thickness: float, eyes) -> PosedFrames:
    """Frames of a wall at y = 2.02 with a picture of a pattern, a function of x and z in metres, in front of it."""
    posed = frames(*eyes)
    v, u = np.mgrid[:240, :320] + 0.0
    rays = np.stack([(u - 160) / 280, np.ones_like(u), -(v - 120) / 280], axis=-1)
    for image, pose in zip(posed.images, posed.world_from_camera):
        front = pose[:3, 3] + rays * (2.02 - thickness - pose[1, 3])
        inside = (np.abs(front[..., 0]) < 0.4) & (front[..., 2] > 1.2) & (front[..., 2] < 1.6)
        image[:] = np.where(inside, pattern(front[..., 0], front[..., 2]), 180.0)[..., None]
    return posed


EYES = tuple((x, 0.0, z) for x in (-0.7, -0.35, 0.0, 0.35, 0.7) for z in (1.0, 1.5))


def front(posed: PosedFrames) -> float | None:
    maps = np.full((len(posed.images), 240, 320), 2, np.uint16)
    found = InstanceSet(np.zeros(0, np.int32), (WALL,), (), maps)
    grid = rigid(translation=np.array([0, 2.0, 1.2]))
    return front_of(grid, 0.02, np.array([-0.38, 0.02]), np.array([0.38, 0.38]), 2, posed, CAMERA, found)


@pytest.mark.parametrize("thickness", [0.015, 0.035])
def test_the_images_measure_the_thickness(thickness):
    def waves(x, z):
        return 120 + 60 * np.sin(x * 90) * np.sin(z * 70)

    assert front(filmed(waves, thickness, EYES)) == pytest.approx(thickness, abs=0.004)


def test_the_nearest_of_several_minima_is_the_front():
    near = np.linspace(5, 9, 13)
    curve = np.concatenate([near[::-1], [5.2, 6, 5.4, 4.9, 5.6, 6.5, 8, 9, 10, 11, 12, 13]])
    assert first_minimum(curve) == 12
    curve[:14] += 2.0
    assert first_minimum(curve) == int(np.argmin(curve))


def test_a_plain_picture_or_a_still_camera_give_no_thickness():
    assert front(filmed(lambda x, z: 180.0, 0.03, EYES)) is None
    assert front(filmed(lambda x, z: 120 + 60 * np.sin(x * 90), 0.03, ((0.0, 0.0, 1.3),) * 6)) is None


def test_a_plain_middle_at_the_wall_does_not_shrink_the_picture():
    """Depth has the frame 3 cm before the wall, and the plain middle on the wall."""
    frame = seen(noise=0.002)
    x, z = frame.points[:, 0], frame.points[:, 2]
    middle = (np.abs(x) < 0.32) & (z > 0.06) & (z < 0.24)
    frame.points[middle, 1] = 0.02
    assert size_of(slab(frame, frames(*TWICE)))[[0, 2]] == pytest.approx([0.8, 0.3], abs=0.02)


def test_an_object_known_by_its_outline_is_a_box_on_the_wall():
    turn = np.radians(30)
    normal = np.array([np.cos(turn), np.sin(turn), 0.0])
    center = np.array([1.0, 2.0, 1.4]) + 0.1 * normal
    shelf = Instance(2, "unknown", 0.0, center, turn, np.array([0.2, 0.8, 0.3]), 1, True)
    assert is_outlined(shelf, np.zeros((0, 3)))
    along = np.array([-np.sin(turn), np.cos(turn), 0.0])
    corners = center + np.array([[a * along[0], a * along[1], b] for a in (-0.4, 0.4) for b in (-0.15, 0.15)])
    assert is_outlined(shelf, center + 0.6 * (corners - center))
    assert not is_outlined(shelf, corners)
    behind = np.concatenate([np.repeat(corners - 0.08 * normal, 9, axis=0), corners + 0.09 * normal])
    assert is_outlined(shelf, behind)  # depth saw through most of it
    nothing = InstanceSet(np.zeros(0, np.int32), (WALL,), (shelf,), np.zeros((2, 240, 320), np.uint16))
    body, frame = outlined_slab(shelf, frames(*TWICE), CAMERA, nothing, AssetsConfig())
    world = transform_points(frame.world_from_grid, body.vertices)
    assert np.ptp((world - center) @ np.stack([normal, along, [0, 0, 1.0]], axis=1), axis=0) == pytest.approx(
        [0.2, 0.8, 0.3]
    )
    assert world.mean(axis=0) == pytest.approx(center)
    assert frame.world_from_grid[:3, 1] == pytest.approx(-normal)  # +y of its grid points into the wall
