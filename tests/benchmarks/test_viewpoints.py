"""Viewpoints in the true scene: occluded shares, visible points, invalid camera positions."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from benchmarks.true_views import TrueViews, winding_number
from reconstruction.core.types import Camera
from reconstruction.measure.ground_truth import GroundTruth, TrueEntity
from reconstruction.views.cameras import look_at

CAMERA = Camera(320, 240, 280.0, 280.0, 160.0, 120.0)
FRONT, SIDE = np.array([0.0, -2.0, 0.2]), np.array([2.0, 0.0, 0.2])


def entity(number, name, extents, center, base=False):
    mesh = trimesh.creation.box(extents, trimesh.transformations.translation_matrix(center))
    found = TrueEntity(number, name, name, base, None, None, base, 5000, Path(name))
    found.__dict__["mesh"] = SimpleNamespace(vertices=mesh.vertices, faces=mesh.faces)
    return found


@pytest.fixture(scope="module")
def scene():
    box = entity(2, "box", (0.4, 0.4, 0.4), (0, 0, 0.2))
    screen = entity(3, "screen", (0.4, 0.02, 0.2), (0, -0.4, 0.1))
    wall = entity(4, "wall", (6, 0.1, 2), (0, 1.05, 1), base=True)
    floor = entity(1, "floor", (6, 6, 0.1), (0, 0, -0.05), base=True)
    film = {0: look_at(FRONT, np.array([0, 0, 0.2]), 80.0)}
    return TrueViews(GroundTruth(Path(), CAMERA, film, (floor, box, screen, wall), np.array([0, 0, 1.0])))


def test_what_stands_before_a_thing_hides_its_share(scene):
    hidden = scene.hidden_shares([look_at(FRONT, np.array([0, 0, 0.2]), 80.0)])
    assert 0.4 < hidden[2] < 0.65  # the screen is nearer, and half as high
    assert hidden[3] == 0.0
    assert scene.hidden_shares([look_at(SIDE, np.array([0, 0, 0.2]), 80.0)])[2] == 0.0
    away = look_at(FRONT, FRONT + np.array([0, -1.0, 0]), 80.0)
    assert 2 not in scene.hidden_shares([away])  # it is not in the picture


def test_one_side_of_a_box_is_a_sixth_of_it(scene):
    points = scene.points_of(scene.truth.entities[1])
    side = scene.seen(points, CAMERA, look_at(SIDE, np.array([0, 0, 0.2]), 80.0))
    assert side.mean() == pytest.approx(1 / 6, abs=0.02)
    front = scene.seen(points, CAMERA, look_at(FRONT, np.array([0, 0, 0.2]), 80.0))
    assert front.mean() < 0.6 * side.mean()
    poses = [look_at(eye, np.array([0, 0, 0.2]), 80.0) for eye in (FRONT, SIDE)]
    both = scene.seen_by_any({7: points[:100], 2: points}, CAMERA, poses)
    np.testing.assert_array_equal(both[2], side | front)
    np.testing.assert_array_equal(both[7], (side | front)[:100])


@pytest.mark.parametrize(
    ("eye", "place"),
    [
        ((0.0, 0.0, 0.2), "box"),
        ((0.0, 1.04, 1.0), "wall"),
        ((0.0, 1.5, 1.0), "behind wall"),
        ((0.0, 0.5, -0.3), "behind floor"),
        ((0.0, -1.0, 0.5), None),
        ((0.0, -0.3, 0.1), None),
    ],
)
def test_places_where_no_camera_can_be(scene, eye, place):
    assert scene.inside(np.array(eye)) == place


def test_winding_number_of_a_closed_mesh():
    ball = trimesh.creation.icosphere(2, 0.5)
    assert winding_number(np.array([0.1, 0.2, 0.0]), ball.vertices, ball.faces) == pytest.approx(1.0)
    assert winding_number(np.array([0.6, 0.2, 0.0]), ball.vertices, ball.faces) == pytest.approx(
        0.0, abs=1e-9
    )
