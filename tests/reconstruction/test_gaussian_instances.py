"""Instance ids of Gaussians: from the nearest labeled surface, and in a file that 3DGS readers still read."""

import numpy as np
import pytest

from reconstruction.gaussians import read_ply, write_ply
from reconstruction.gaussians.model import from_packed
from reconstruction.instances.gaussian_ids import gaussian_instances


def some_gaussians(count: int = 50):
    rng = np.random.default_rng(1)
    packed = rng.normal(size=(count, 13))
    packed[:, 3:7] /= np.linalg.norm(packed[:, 3:7], axis=1, keepdims=True)
    return from_packed(packed)


def test_nearest_labeled_surface():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 0.03, 0], [2, 0, 0]], np.float32)
    ids = np.array([3, 7, 0, 9])
    means = np.array([[0.01, 0, 0], [1, 0, 0.04], [0, 0.031, 0], [1.5, 0, 0], [2, 0, 0]])
    np.testing.assert_array_equal(gaussian_instances(means, vertices, ids), [3, 7, 3, 0, 9])
    assert gaussian_instances(means, vertices, np.zeros(4, int)).tolist() == [0] * 5
    assert gaussian_instances(means[:0], vertices, ids).shape == (0,)


def test_ids_in_the_file_and_everything_else_as_before(tmp_path):
    path, plain = tmp_path / "a.ply", tmp_path / "b.ply"
    gaussians = some_gaussians()
    ids = np.arange(50, dtype=np.int32) * 1000
    write_ply(gaussians, path, ids)
    write_ply(gaussians, plain)
    one, two = read_ply(path), read_ply(plain)
    np.testing.assert_array_equal(one.means, two.means)
    np.testing.assert_array_equal(one.colors, two.colors)
    np.testing.assert_array_equal(one.quaternions, two.quaternions)
    trimesh = pytest.importorskip("trimesh")
    raw = trimesh.load(path).metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(np.asarray(raw["instance_id"]).ravel(), ids)
    np.testing.assert_allclose(np.asarray(raw["x"]).ravel(), gaussians.means[:, 0], rtol=1e-6)


def test_wrong_number_of_ids(tmp_path):
    with pytest.raises(ValueError, match="50"):
        write_ply(some_gaussians(), tmp_path / "a.ply", np.zeros(49, np.int32))
