"""The URDF export in PyBullet: size, mass, inertia, friction and pose of every object."""

import numpy as np
import pytest
from exports_room import names, solid_box

from reconstruction.exports import export_scene
from registry.geometry import quat_from_matrix, transform_points

pybullet = pytest.importorskip("pybullet", reason="needs simrecon[bullet]")

OWN_INERTIA = pybullet.URDF_USE_INERTIA_FROM_FILE
_MARGIN_M = 0.004  # that Bullet puts around the box of a convex hull


@pytest.fixture(scope="module")
def folder(bundle, tmp_path_factory):
    return export_scene(bundle, ["urdf"], tmp_path_factory.mktemp("bullet") / "room").folder


@pytest.fixture
def client():
    number = pybullet.connect(pybullet.DIRECT)
    yield number
    pybullet.disconnect(number)


def _load(client, folder, name, pose, flags=0):
    w, x, y, z = quat_from_matrix(pose[:3, :3])
    return pybullet.loadURDF(
        str(folder / f"{name}.urdf"),
        basePosition=pose[:3, 3],
        baseOrientation=(x, y, z, w),
        flags=flags,
        physicsClientId=client,
    )


def test_every_object_is_as_large_as_the_bundle_says(bundle, folder, client):
    for item in bundle.objects:
        body = _load(client, folder, names(bundle)[item.id], np.eye(4))
        assert len(pybullet.getCollisionShapeData(body, -1, physicsClientId=client)) == len(item.collision)
        wanted = solid_box(bundle, item, "object") + np.array([[-_MARGIN_M], [_MARGIN_M]])
        found = pybullet.getAABB(body, physicsClientId=client)
        # A piece is at least 1 mm thick.
        np.testing.assert_allclose(found, wanted, atol=0.6e-3, err_msg=item.label)


def test_every_object_has_its_mass_and_place(bundle, folder, client):
    for item in bundle.objects:
        body = _load(client, folder, names(bundle)[item.id], item.world_from_object, OWN_INERTIA)
        mass, friction, moments, center, *_ = pybullet.getDynamicsInfo(body, -1, physicsClientId=client)
        assert mass == pytest.approx(item.mass_kg)
        assert friction == pytest.approx(item.friction)
        np.testing.assert_allclose(center, item.center_of_mass, atol=1e-6)
        np.testing.assert_allclose(np.sort(moments), np.linalg.eigvalsh(item.inertia), rtol=1e-3)
        place, _ = pybullet.getBasePositionAndOrientation(
            body, physicsClientId=client
        )  # of the center of mass
        wanted = transform_points(item.world_from_object, np.array([item.center_of_mass]))[0]
        np.testing.assert_allclose(place, wanted, atol=1e-6, err_msg=item.label)


def test_the_scene_is_one_tree_with_everything_at_its_place(bundle, folder, client):
    body = pybullet.loadURDF(str(folder / "scene.urdf"), useFixedBase=True, physicsClientId=client)
    links = {}
    for number in range(pybullet.getNumJoints(body, physicsClientId=client)):
        links[pybullet.getJointInfo(body, number, physicsClientId=client)[12].decode()] = number
    assert set(links) == set(names(bundle).values())
    for item in bundle.objects:
        state = pybullet.getLinkState(body, links[names(bundle)[item.id]], physicsClientId=client)
        np.testing.assert_allclose(state[4], item.world_from_object[:3, 3], atol=1e-5, err_msg=item.label)
