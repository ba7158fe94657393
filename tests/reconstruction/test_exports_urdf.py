"""The URDF export in yourdfpy: one file per object, and the scene."""

import numpy as np
import pytest
from exports_room import BOOK, FREE, KNOB, LEAF, names, solid_box, world_box
from hypothesis import given, settings
from hypothesis import strategies as st

from reconstruction.exports import export_scene
from reconstruction.exports.numbers import roll_pitch_yaw
from registry.geometry import matrix_from_quat

yourdfpy = pytest.importorskip("yourdfpy", reason="a test dependency")


@pytest.fixture(scope="module")
def folder(bundle, tmp_path_factory):
    return export_scene(bundle, ["urdf"], tmp_path_factory.mktemp("urdf_out") / "room").folder


@pytest.fixture(scope="module")
def scene(folder):
    loaded = yourdfpy.URDF.load(
        str(folder / "scene.urdf"), load_collision_meshes=True, build_collision_scene_graph=True
    )
    assert loaded.validate(), loaded.errors
    return loaded


def _box(scene, name):
    """Return the world bounding box (2, 3) of the meshes of a link."""
    below = [n for n in scene.graph.nodes_geometry if scene.graph.transforms.parents[n] == name]
    boxes = [
        scene.geometry[scene.graph[n][1]].copy().apply_transform(scene.graph[n][0]).bounds for n in below
    ]
    return np.stack([np.min(boxes, axis=0)[0], np.max(boxes, axis=0)[1]])


def test_every_link_is_where_and_how_large_the_bundle_says(bundle, scene):
    for item in (*bundle.base, *bundle.objects):
        name = names(bundle)[item.id]
        pose = getattr(item, "world_from_object", np.eye(4))
        np.testing.assert_allclose(scene.get_transform(name, "world"), pose, atol=1e-6)
        np.testing.assert_allclose(_box(scene.scene, name), world_box(bundle, item), atol=1e-6)
        tolerance = 0.51e-3 if item.id == LEAF else 1e-6
        solid = _box(scene.collision_scene, name)
        np.testing.assert_allclose(solid, solid_box(bundle, item), atol=tolerance)


def test_joints_float_where_things_move_on_their_own(bundle, scene):
    floating = {j.child for j in scene.joint_map.values() if j.type == "floating"}
    assert floating == {names(bundle)[key] for key in FREE}
    assert {j.type for j in scene.joint_map.values()} == {"floating", "fixed"}
    knob = next(j for j in scene.joint_map.values() if j.child == names(bundle)[KNOB])
    assert knob.parent == names(bundle)[BOOK]


def test_each_object_has_a_file_of_its_own_with_its_inertia(bundle, folder):
    for item in bundle.objects:
        name = names(bundle)[item.id]
        single = yourdfpy.URDF.load(str(folder / f"{name}.urdf"), load_collision_meshes=True)
        assert single.validate(), single.errors
        inertial = single.link_map[name].inertial
        assert inertial.mass == pytest.approx(item.mass_kg, rel=1e-12)
        np.testing.assert_allclose(inertial.origin[:3, 3], item.center_of_mass, atol=1e-12)
        np.testing.assert_allclose(inertial.origin[:3, :3], np.eye(3))
        np.testing.assert_allclose(inertial.inertia, item.inertia, atol=1e-12)
        assert len(single.link_map[name].collisions) == len(item.collision)


@settings(max_examples=60, deadline=None)
@given(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_angles_give_the_rotation_back(quat):
    _check_angles(matrix_from_quat(np.array(quat)))


@pytest.mark.parametrize("pitch", [-0.5, 0.5])
def test_angles_of_what_points_straight_up_or_down(pitch):
    half = np.pi * pitch / 2
    turned = matrix_from_quat(np.array([np.cos(0.4), 0, 0, np.sin(0.4)]))
    _check_angles(turned @ matrix_from_quat(np.array([np.cos(half), 0, np.sin(half), 0])))


def _check_angles(rotation):
    from scipy.spatial.transform import Rotation

    again = Rotation.from_euler("xyz", roll_pitch_yaw(rotation)).as_matrix()  # small letters: fixed axes
    np.testing.assert_allclose(again, rotation, atol=1e-7)
