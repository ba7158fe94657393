"""Transforms: group axioms, round trips of conversions, Umeyama on a known similarity."""

import numpy as np
import pytest

from registry.geometry import (
    GLTF_FROM_WORLD,
    SAPIEN_CAMERA_FROM_OPENCV,
    WORLD_FROM_GLTF,
    invert_rigid,
    matrix_from_quat,
    quat_from_matrix,
    rigid,
    split_similarity,
    transform_points,
    umeyama,
)


def random_rigid(rng: np.random.Generator) -> np.ndarray:
    return rigid(matrix_from_quat(rng.normal(size=4)), rng.normal(size=3) * 10)


@pytest.mark.parametrize("seed", range(20))
def test_rigid_transforms_form_a_group(seed):
    rng = np.random.default_rng(seed)
    a, b, c = (random_rigid(rng) for _ in range(3))
    rotation = (a @ b)[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose((a @ b) @ c, a @ (b @ c), atol=1e-10)
    np.testing.assert_allclose(a @ rigid(), a)
    np.testing.assert_allclose(a @ invert_rigid(a), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(invert_rigid(a @ b), invert_rigid(b) @ invert_rigid(a), atol=1e-10)


def test_invert_rigid_works_on_batches():
    rng = np.random.default_rng(0)
    batch = np.stack([random_rigid(rng) for _ in range(6)]).reshape(2, 3, 4, 4)
    np.testing.assert_allclose(
        batch @ invert_rigid(batch), np.broadcast_to(np.eye(4), batch.shape), atol=1e-12
    )


@pytest.mark.parametrize("seed", range(20))
def test_quaternions_round_trip(seed):
    quat = np.random.default_rng(seed).normal(size=(5, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    quat *= np.where(quat[:, :1] < 0, -1, 1)
    back = quat_from_matrix(matrix_from_quat(quat))
    np.testing.assert_allclose(back, quat, atol=1e-9)
    assert (back[:, 0] >= 0).all()


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1)])
def test_half_turns_have_quaternions(axis):
    quat = np.array([0.0, *axis])
    back = quat_from_matrix(matrix_from_quat(quat))
    assert abs(back @ quat) == pytest.approx(1)


def test_quaternions_are_wxyz_and_turn_the_right_way():
    quarter_turn_about_z = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    np.testing.assert_allclose(matrix_from_quat(quarter_turn_about_z) @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_matrix_from_quat_normalises():
    quat = np.array([0.3, -0.2, 0.9, 0.1])
    np.testing.assert_allclose(matrix_from_quat(quat), matrix_from_quat(7 * quat), atol=1e-12)


def test_gltf_up_is_world_up():
    np.testing.assert_allclose(transform_points(WORLD_FROM_GLTF, np.array([[0, 1.0, 0]])), [[0, 0, 1.0]])
    np.testing.assert_allclose(WORLD_FROM_GLTF @ GLTF_FROM_WORLD, np.eye(4))
    assert np.linalg.det(WORLD_FROM_GLTF) == pytest.approx(1)


def test_sapien_camera_axes():
    opencv = np.eye(3)  # right, down, forward
    turned = transform_points(SAPIEN_CAMERA_FROM_OPENCV, opencv)
    np.testing.assert_allclose(turned, [[0, -1, 0], [0, 0, -1], [1, 0, 0]])
    assert np.linalg.det(SAPIEN_CAMERA_FROM_OPENCV) == pytest.approx(1)


@pytest.mark.parametrize("seed", range(20))
def test_umeyama_recovers_a_known_similarity(seed):
    rng = np.random.default_rng(seed)
    b_from_a = random_rigid(rng)
    scale = float(np.exp(rng.normal()))
    b_from_a[:3, :3] *= scale
    points_a = rng.normal(size=(30, 3))
    found = umeyama(points_a, transform_points(b_from_a, points_a))
    np.testing.assert_allclose(found, b_from_a, atol=1e-9)
    found_scale, rotation, translation = split_similarity(found)
    assert found_scale == pytest.approx(scale)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(translation, b_from_a[:3, 3], atol=1e-9)


def test_umeyama_never_reflects():
    rng = np.random.default_rng(1)
    points = rng.normal(size=(30, 3))
    found = umeyama(points, points * [1, 1, -1])
    assert np.linalg.det(found[:3, :3]) > 0


def test_umeyama_without_scale_is_rigid():
    rng = np.random.default_rng(2)
    points = rng.normal(size=(30, 3))
    points -= points.mean(axis=0)
    found = umeyama(points, 3 * points, with_scale=False)
    np.testing.assert_allclose(found, np.eye(4), atol=1e-9)
