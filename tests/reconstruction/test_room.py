"""Walls completed to the room's corners, and the backdrop that closes the view."""

from dataclasses import replace

import numpy as np
import pytest

from reconstruction.assembly import base_slabs
from reconstruction.assets.backdrop import build_backdrop
from reconstruction.assets.base_rectangles import base_rectangles
from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.room import build_room, nearest_meshes
from reconstruction.assets.shell import box_distance, room_shell
from reconstruction.assets.views import prepare_pixels
from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import BaseEntity, InstanceSet, Plane, SpaceGrid
from reconstruction.measure.rendering import before_backdrop, render_views, score_pictures
from registry.simulation import BodySpec, base_spec, build_physics

CONFIG = AssetsConfig(texture_max_px=256, texture_frames=4, base_texel_m=0.02)
LOW, HIGH = np.array([-2.0, -1.5, -0.1]), np.array([2.0, 1.5, 2.5])
CENTER = np.array([0.3, -0.2, 1.2])
NONE = np.zeros((0, 3))


def entity(key, label, plane, corners):
    return BaseEntity(key, label, Plane(np.array(plane, float), np.array(corners, float)), True)


def corner_room():
    """Floor, a wall at y = 2 seen for x in [-1, 1] and one at x = 2 seen for y in [-1, 1.5]; the corner is unseen."""
    floor = entity(1, "floor", [0, 0, 1, 0], [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    north = entity(2, "wall", [0, -1, 0, 2], [[-1, 2, 0.5], [1, 2, 0.5], [1, 2, 1.4], [-1, 2, 1.4]])
    east = entity(3, "wall", [-1, 0, 0, 2], [[2, -1, 0], [2, 1.5, 0], [2, 1.5, 2.2], [2, -1, 2.2]])
    return InstanceSet(np.zeros(0, np.int32), (floor, north, east), (), np.zeros((1, 4, 4), np.uint16))


def space_with_free(low, high):
    """A grid of 5 cm over the room that is free in a box and unknown elsewhere."""
    state = np.zeros((120, 120, 60), np.uint8)
    origin = np.array([-3.0, -3.0, -0.1])
    a, b = (((np.array(p) - origin) / 0.05).round().astype(int) for p in (low, high))
    state[a[0] : b[0], a[1] : b[1], a[2] : b[2]] = 1
    return SpaceGrid(origin, 0.05, state)


def spans(posed, space):
    """Return the bounds (2, 3) of each base rectangle of the corner room by id."""
    out = {}
    for rectangle in base_rectangles(corner_room(), (), posed, space):
        points = rectangle.world(np.array([rectangle.low, rectangle.high]))
        out[rectangle.entity.id] = np.array([points.min(axis=0), points.max(axis=0)])
    return out


@pytest.fixture(scope="module")
def posed(small_capture):
    return small_capture.posed


def test_walls_meet_in_their_corner_stand_on_the_floor_and_are_equally_high(posed):
    found = spans(posed, space_with_free((0, 0, 0), (0, 0, 0)))
    np.testing.assert_allclose(found[2], [[-1, 2, 0], [2, 2, 2.2]], atol=1e-9)
    np.testing.assert_allclose(found[3], [[2, -1, 0], [2, 2, 2.2]], atol=1e-9)
    assert (found[1][0, :2] <= -1).all()
    assert (found[1][1, :2] >= 2).all()


def test_no_wall_is_completed_across_an_opening(posed):
    """Rays passed through the unseen strip of the wall at y = 2, as through a door."""
    found = spans(posed, space_with_free((1.0, 1.0, 0.0), (2.0, 2.9, 2.0)))
    np.testing.assert_allclose(found[2][:, 0], [-1, 1], atol=1e-9)
    np.testing.assert_allclose(found[3][:, 1], [-1, 1.5], atol=1e-9)


def test_a_low_wall_with_free_space_above_stays_low(posed):
    found = spans(posed, space_with_free((-1.5, 1.0, 1.45), (2.0, 2.9, 2.4)))
    assert found[2][1, 2] == pytest.approx(1.4)


def test_the_floor_reaches_below_whoever_filmed(posed):
    floor = spans(posed, None)[1]
    eyes = posed.world_from_camera[:, :2, 3]
    assert (eyes > floor[0, :2]).all()
    assert (eyes < floor[1, :2]).all()


def test_the_shell_is_closed_faces_inward_and_lies_on_the_box():
    vertices, faces, uvs = room_shell(CENTER, LOW, HIGH, NONE, NONE).mesh()
    corner = vertices[faces] - CENTER
    volume = np.einsum("fc,fc->f", corner[:, 0], np.cross(corner[:, 1], corner[:, 2]))
    assert (volume < 0).all()
    assert abs(volume.sum() / 6) == pytest.approx(np.prod(HIGH - LOW), rel=0.01)
    _, place = np.unique(vertices.round(9), axis=0, return_inverse=True)
    edges = np.sort(
        np.concatenate([place.ravel()[faces[:, [a, b]]] for a, b in ((0, 1), (1, 2), (2, 0))]), axis=1
    )
    edges = edges[edges[:, 0] != edges[:, 1]]
    assert (np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all()
    assert np.abs(np.maximum(LOW - vertices, vertices - HIGH).max(axis=1)).max() < 1e-9
    assert uvs.min() == 0
    assert uvs.max() == 1


def test_the_shell_reaches_to_measured_points_beyond_the_box_and_never_into_it():
    rng = np.random.default_rng(0)
    far = np.column_stack([np.full(4000, 5.0), rng.uniform(-0.8, 0.8, 4000), rng.uniform(0.8, 1.8, 4000)])
    near = np.column_stack([np.full(4000, -1.0), rng.uniform(-0.8, 0.8, 4000), rng.uniform(0.8, 1.8, 4000)])
    shell = room_shell(CENTER, LOW, HIGH, np.concatenate([far, near]), NONE)
    vertices = shell.points.reshape(-1, 3)
    away = vertices - CENTER
    radius = np.linalg.norm(away, axis=1)
    assert (radius >= box_distance(CENTER, away / radius[:, None], LOW, HIGH) - 1e-9).all()
    level = (np.abs(away[:, 1]) < 0.1 * np.abs(away[:, 0])) & (np.abs(away[:, 2]) < 0.05 * np.abs(away[:, 0]))
    ahead, behind = level & (away[:, 0] > 0), level & (away[:, 0] < 0)
    assert min(ahead.sum(), behind.sum()) > 10
    np.testing.assert_allclose(vertices[ahead, 0], 5.0, atol=0.1)
    np.testing.assert_allclose(vertices[behind, 0], LOW[0], atol=1e-9)


def test_texture_coordinates_lead_to_the_points_of_the_mesh():
    shell = room_shell(CENTER, LOW, HIGH, NONE, NONE)
    vertices, _, uvs = shell.mesh()
    np.testing.assert_allclose(shell.at(uvs[:, 0], uvs[:, 1]), vertices, atol=1e-6)


@pytest.fixture(scope="module")
def open_room(small_capture):
    """The generated room with its floor alone: no wall was found and no object was made."""
    capture = small_capture
    low, high = next(e for e in capture.entities if e.name == "floor").mesh().bounds
    corners = [[low[0], low[1], 0], [high[0], low[1], 0], [high[0], high[1], 0], [low[0], high[1], 0]]
    floor = next(e for e in capture.entities if e.name == "floor")
    found = InstanceSet(
        np.zeros(0, np.int32), (entity(floor.id, "floor", [0, 0, 1, 0], corners),), (), capture.id_maps
    )
    pixels = prepare_pixels(capture.posed, capture.depth, capture.id_maps)
    return capture, build_room(capture.posed, capture.depth, found, (), pixels, None, CONFIG)


def test_the_backdrop_leaves_no_hole_and_shows_what_was_filmed(open_room):
    capture, (base, backdrop) = open_room
    poses = list(capture.posed.held_out_world_from_camera)
    true = list(capture.posed.held_out_images)
    pictures, covered = render_views([(b.visual, np.eye(4)) for b in base], capture.posed.camera, poses)
    shown, closed = before_backdrop(pictures, covered, backdrop.visual, capture.posed.camera, poses)
    assert np.mean(covered) < 0.9
    assert np.all(closed)
    whole = [np.ones_like(mask) for mask in covered]
    assert score_pictures(shown, whole, true).psnr_db > score_pictures(pictures, whole, true).psnr_db + 3
    assert 0 < backdrop.observed_fraction < 1


def test_equal_inputs_give_equal_backdrops(open_room):
    capture, (base, _) = open_room
    vertices = base[0].visual.vertices.astype(np.float64)
    opened = nearest_meshes(
        [(1, vertices, base[0].visual.faces)], capture.depth.camera, capture.posed.world_from_camera
    )
    again = [
        build_backdrop(capture.posed, capture.depth, capture.id_maps, vertices, opened == 0, CONFIG)
        for _ in range(2)
    ]
    np.testing.assert_array_equal(again[0].visual.texture, again[1].visual.texture)
    np.testing.assert_array_equal(again[0].visual.vertices, again[1].visual.vertices)


def test_nothing_of_the_backdrop_stands_before_a_measured_surface(open_room):
    """In no keyframe is the backdrop nearer than the floor where the floor is seen."""
    capture, (base, backdrop) = open_room
    for pose in capture.posed.world_from_camera:
        floor = rasterize_mesh(
            base[0].visual.vertices, base[0].visual.faces, capture.depth.camera, pose
        ).depth
        shell = rasterize_mesh(
            backdrop.visual.vertices, backdrop.visual.faces, capture.depth.camera, pose
        ).depth
        assert (shell > 0).all()
        assert (shell[floor > 0] > floor[floor > 0] - 1e-3).all()


@pytest.mark.stage
def test_nothing_falls_off_the_floor(open_room):
    """A box that slides over the floor's edge and a metre on stays at the floor's height."""
    _, (base, _) = open_room
    floor = base_spec(1, "floor", [part.vertices for part in base_slabs(base[0])])
    half = 0.05 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    pose = np.eye(4)
    pose[:2, 3] = base[0].visual.vertices[:, :2].max(axis=0) + 1.0
    pose[2, 3] = 0.06
    box = BodySpec(2, "box", (half,), 0.5, np.zeros(3), None, 0.5, 0.0, pose, True)
    physics = build_physics([floor, replace(box, world_from_object=pose)])
    physics.step(480)
    assert physics.pose(2)[2, 3] == pytest.approx(0.05, abs=2e-3)
