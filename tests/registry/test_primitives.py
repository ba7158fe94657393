"""Primitives are recognized by their vertices after file and float32 round trips; other parts are not."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from registry.geometry import rigid
from registry.primitives import SIZES, Primitive, corners_of, primitive_of
from registry.simulation import BodySpec, Physics, pose_change, standing_primitive

LYING = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
KINDS = {
    "box": "PhysxCollisionShapeBox", "cylinder": "PhysxCollisionShapeCylinder", "hull": "PhysxCollisionShapeConvexMesh"
}  # fmt: skip


def made(shape: str, size: tuple, rotation: np.ndarray | None = None, place=(0.0, 0.0, 0.0)) -> Primitive:
    return Primitive(shape, tuple(size), rigid(rotation, np.asarray(place, float)))


@pytest.mark.parametrize("shape", SIZES)
def test_a_primitive_survives_files_and_turns(shape):
    rng = np.random.default_rng(3)
    for turn in range(25):
        size = rng.uniform(0.01, 0.4, SIZES[shape])
        rotation = Rotation.random(random_state=turn).as_matrix() if turn else np.eye(3)
        wanted = made(shape, size, rotation, rng.normal(size=3))
        corners = rng.permutation(corners_of(wanted))
        text = np.array([[float(f"{x:.7g}") for x in row] for row in corners.astype(np.float32)])
        found = primitive_of(text)
        assert found.shape == shape
        np.testing.assert_allclose(sorted(found.size), sorted(size), atol=5e-5)
        gaps = np.linalg.norm(corners_of(found)[:, None] - corners[None], axis=2)
        assert max(gaps.min(axis=0).max(), gaps.min(axis=1).max()) < 5e-5
        assert np.linalg.det(found.pose[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("shape", SIZES)
def test_corners_lie_on_the_primitive_and_are_a_hull_that_physx_takes(shape):
    corners = corners_of(made(shape, (0.05, 0.08, 0.03)[: SIZES[shape]]))
    assert len(corners) <= 255
    assert len(ConvexHull(corners).vertices) == len(corners)


@pytest.mark.parametrize("shape", [name for name in SIZES if name != "box"])
def test_what_was_changed_is_no_primitive(shape):
    corners = corners_of(made(shape, (0.05, 0.08)[: SIZES[shape]]))
    stretched = corners * [1.0, 1.002, 1.0]
    dented = corners.copy()
    dented[3] *= 0.99
    for changed in (stretched, dented, corners[1:]):
        assert primitive_of(changed) is None


def test_eight_corners_are_not_yet_a_box():
    box = corners_of(made("box", (0.1, 0.05, 0.03)))
    sheared = box + np.outer(box[:, 2], [0.05, 0.0, 0.0])
    frustum = box * np.where(box[:, 2:] > 0, 0.9, 1.0)
    assert primitive_of(box) is not None
    assert primitive_of(sheared) is None
    assert primitive_of(frustum) is None
    assert primitive_of(np.zeros((8, 3))) is None
    assert primitive_of(np.full((8, 3), np.nan)) is None


@pytest.mark.parametrize(
    ("primitive", "height", "kind"),
    [
        (made("box", (0.1, 0.05, 0.03)), 0.03, "box"),
        (made("cylinder", (0.04, 0.06)), 0.06, "cylinder"),
        (made("cylinder", (0.04, 0.06), LYING), 0.04, "hull"),
        (made("sphere", (0.04,)), 0.04, "hull"),
        (made("capsule", (0.03, 0.05), LYING), 0.03, "hull"),
    ],
    ids=lambda value: value.shape if isinstance(value, Primitive) else None,
)
def test_what_stands_is_simulated_as_it_is_and_nothing_rolls_away(primitive, height, kind):
    points = corners_of(primitive)
    assert (standing_primitive(points) is not None) == (kind != "hull")
    ground = corners_of(made("box", (3.0, 3.0, 0.05), place=(0.0, 0.0, -0.05)))
    physics = Physics(1 / 240, 0.0)
    still = (1.0, np.zeros(3), None, 0.5, 0.0)
    physics.add(BodySpec(1, "ground", (ground,), *still, np.eye(4), False, base=True))
    start = rigid(None, np.array([0.0, 0.0, height + 0.002]))
    physics.add(BodySpec(2, "thing", (points,), *still, start, True))
    physics.step(720)
    end = physics.pose(2)
    assert np.linalg.norm(end[:2, 3]) < 0.02
    assert end[2, 3] == pytest.approx(height, abs=1.5e-3)
    if kind != "hull":
        assert pose_change(start, end)[1] < 0.1
    bodies = {int(e.name): e.components[0] for e in physics.scene.entities}
    assert type(bodies[1].collision_shapes[0]).__name__ == KINDS["hull"]
    assert type(bodies[2].collision_shapes[0]).__name__ == KINDS[kind]
