"""Removal of false surface behind the far rim of an object, where depth and ids err at outlines."""

from dataclasses import replace

import numpy as np
import pytest

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.rim_artifacts import away_directions, behind_rims, without_whiskers
from reconstruction.assets.solid import box_solid
from reconstruction.assets.views import lift_object, prepare_pixels
from reconstruction.assets.volume import ObjectFrame, ObjectVolume, confirmed, fuse_volume
from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import DepthMaps
from registry.geometry import invert_rigid, rigid
from tests.reconstruction.facing import CAMERA, frames

BOX, TABLE = 1, 2
HALF, HEIGHT = 0.1, 0.03
VIEWS, WRONG = 20, (3, 9, 15)
STRIP = 3  # pixels of the table behind the box that the wrong frames take for the box


def looking_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    return rigid(np.column_stack([right, np.cross(forward, right), forward]), eye)


def fused(wrong: tuple[int, ...]) -> tuple[ObjectFrame, ObjectVolume]:
    """A flat box on a table, seen from the side of -y.

    No frame knows depth behind its far rim, but for the wrong ones, which take a strip of the table there for the box.
    """
    box = box_solid(np.array([-HALF, -HALF, 0]), np.array([HALF, HALF, HEIGHT]))
    table = box_solid(np.array([-2, -2, -0.02]), np.array([2, 2, 0.0]))
    vertices = np.concatenate([box.vertices, table.vertices])
    faces = np.concatenate([box.faces, table.faces + len(box.vertices)])
    angles = np.linspace(-0.3, 0.3, VIEWS)
    eyes = [np.array([0.8 * np.sin(t), -0.8 * np.cos(t), 0.45]) for t in angles]
    poses = np.array([looking_at(eye, np.array([0, 0, 0.01])) for eye in eyes])
    posed = replace(frames(*eyes), world_from_camera=poses)
    depth, ids = [], []
    for f, pose in enumerate(poses):
        raster = rasterize_mesh(vertices, faces, CAMERA, pose)
        own = (raster.face >= 0) & (raster.face < len(box.faces))
        z = raster.depth.copy()
        top = np.argmax(own, axis=0)
        for column in np.flatnonzero(own.any(axis=0)):
            if f in wrong:
                own[top[column] - STRIP : top[column], column] = True
            else:
                z[top[column] - 3 * STRIP : top[column], column] = 0.0
        depth.append(z)
        ids.append(np.where(own, BOX, TABLE))
    maps = DepthMaps(CAMERA, np.array(depth, np.float32), np.full(np.shape(depth), 2, np.uint8))
    pixels = prepare_pixels(posed, maps, np.array(ids))
    seen = lift_object(posed, maps, pixels, BOX)
    frame = ObjectFrame(np.eye(4), seen.points, seen.normals, True, None)
    return frame, fuse_volume(BOX, frame, 0.001, posed, maps, pixels, AssetsConfig())


def reach(volume: ObjectVolume) -> float:
    """Return the largest y at which there is surface of the thing, metres."""
    inside = volume.known & (volume.distance < 0)
    return float(volume.centers(1)[inside.any(axis=(0, 2))].max())


def test_surface_behind_the_far_rim_in_few_frames_is_dropped():
    _, good = fused(())
    frame, volume = fused(WRONG)
    assert frame.points[:, 1].max() > HALF + 0.03
    assert reach(volume) == pytest.approx(reach(good), abs=0.01)
    kept = confirmed(frame, volume).points
    assert kept[:, 1].max() < HALF + 3 * volume.voxel_m
    assert len(kept) > 0.95 * len(frame.points)


def test_surface_behind_the_far_rim_in_most_frames_stays():
    _, volume = fused(tuple(range(VIEWS)))
    assert reach(volume) > HALF + 0.03


def facing_y(*angles_deg: float) -> np.ndarray:
    eyes = [(np.sin(a), -np.cos(a), 0.5) for a in np.radians(angles_deg)]
    return np.array([invert_rigid(rigid(translation=np.array(eye))) for eye in eyes])


def test_directions_need_cameras_on_one_side():
    away = away_directions(facing_y(-30, 0, 30), np.zeros(3))
    np.testing.assert_allclose(away[2], [0, 1], atol=1e-12)
    assert (away[:, 1] > 0.49).all()
    assert len(away_directions(facing_y(0, 90, 180, 270), np.zeros(3))) == 0


@pytest.mark.parametrize("change", ["seen by many", "seen inside the outline", "a large part"])
def test_a_part_of_the_object_is_no_tail(change):
    near = np.zeros((40, 40, 10), bool)
    near[:, :20] = True
    support, inner = np.where(near, 30, 0), np.where(near, 20, 0)
    tail = np.zeros_like(near)
    tail[18:22, 20:24, :3] = True
    if change == "a large part":
        tail[:, 20:26] = True
    near |= tail
    support[tail], inner[tail] = 4, 0
    shadowed = np.zeros_like(support)
    away = np.array([[0.0, 1.0]])
    if change == "seen by many":
        support[tail] = 20
    elif change == "seen inside the outline":
        inner[tail] = 2
    assert not behind_rims(near, support, inner, shadowed, away).any()
    if change != "a large part":
        support[tail], inner[tail] = 4, 0
        np.testing.assert_array_equal(
            np.argwhere(behind_rims(near, support, inner, shadowed, away))[:, 1].min(), 21
        )
        shadowed[tail] = 9
        np.testing.assert_array_equal(behind_rims(near, support, inner, shadowed, away), tail)


def test_whiskers_are_cut_and_handles_stay():
    field = np.full((60, 60, 40), 0.01, np.float32)
    field[10:50, 10:40, 5:35] = -0.01
    whole = field.copy()
    field[30:32, 40:52, 10:12] = -0.01
    cut = without_whiskers(field, 0.005, top=False)
    np.testing.assert_array_equal(cut < 0, whole < 0)
    handle = whole.copy()
    handle[28:32, 40:55, 10:18] = -0.01
    np.testing.assert_array_equal(without_whiskers(handle, 0.005, top=False), handle)


def test_tips_at_the_top_are_cut_on_request_only():
    field = np.full((60, 60, 40), 0.01, np.float32)
    field[10:50, 10:40, 5:30] = -0.01
    field[30:32, 20:22, 30:36] = -0.01
    assert (without_whiskers(field, 0.005, top=False)[:, :, 30:36] < 0).any()
    assert not (without_whiskers(field, 0.005, top=True)[:, :, 30:36] < 0).any()
