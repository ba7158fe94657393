"""The MJCF export in MuJoCo: bodies, poses, masses, and stability."""

import itertools

import numpy as np
import pytest
from exports_room import (
    BOOK,
    FREE,
    KNOB,
    LEAF,
    MOVING,
    MUG,
    are_boxes,
    generated_room,
    names,
    solid_box,
    world_box,
)

from reconstruction.exports import export_scene
from reconstruction.exports.meshes import write_meshes
from reconstruction.exports.mjcf import write_mjcf
from registry.geometry import matrix_from_quat, rigid
from registry.simulation import pose_change

mujoco = pytest.importorskip("mujoco", reason="needs simrecon[exports]")


@pytest.fixture(scope="module")
def model(bundle, tmp_path_factory):
    out = tmp_path_factory.mktemp("mjcf_out") / "room"
    return mujoco.MjModel.from_xml_path(str(export_scene(bundle, ["mjcf"], out).main["mjcf"]))


@pytest.fixture
def data(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def _pose(data, number):
    return rigid(matrix_from_quat(data.xquat[number]), data.xpos[number].copy())


def _geom_points(model, data, geom):
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        points = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * model.geom_size[geom]
    else:
        mesh = model.geom_dataid[geom]
        start = model.mesh_vertadr[mesh]
        points = model.mesh_vert[start : start + model.mesh_vertnum[mesh]].astype(np.float64)
    return points @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]


def _box(model, data, body, group):
    geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body and model.geom_group[g] == group]
    points = np.concatenate([_geom_points(model, data, g) for g in geoms])
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _rest(model, seconds):
    """Simulate without damping; return {name: (moved m, turned deg)} of all moving bodies."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    bodies = [b for b in range(1, model.nbody) if model.body_weldid[b] != 0]
    before = {b: _pose(data, b) for b in bodies}
    mujoco.mj_step(model, data, round(seconds / model.opt.timestep))
    assert not model.dof_damping.any()
    return {model.body(b).name: pose_change(before[b], _pose(data, b)) for b in bodies}


def test_every_body_is_where_and_how_large_the_bundle_says(bundle, model, data):
    for item in (*bundle.base, *bundle.objects):
        body = model.body(names(bundle)[item.id]).id
        pose = getattr(item, "world_from_object", np.eye(4))
        np.testing.assert_allclose(_pose(data, body), pose, atol=1e-6)
        np.testing.assert_allclose(_box(model, data, body, 2), world_box(bundle, item), atol=1e-6)
        solid = _box(model, data, body, 3)
        if item.id == LEAF:  # one piece is flat and gets a millimetre
            np.testing.assert_allclose(solid, solid_box(bundle, item), atol=0.51e-3)
        else:
            np.testing.assert_allclose(solid, solid_box(bundle, item), atol=1e-6)


def test_mass_inertia_and_friction_are_those_of_the_bundle(bundle, model):
    for item in bundle.objects:
        body = model.body(names(bundle)[item.id])
        assert body.mass[0] == pytest.approx(item.mass_kg, rel=1e-9)
        np.testing.assert_allclose(body.ipos, item.center_of_mass, atol=1e-9)
        axes = matrix_from_quat(body.iquat)
        np.testing.assert_allclose((axes * body.inertia) @ axes.T, item.inertia, rtol=1e-6, atol=1e-12)
        geoms = [
            g for g in range(model.ngeom) if model.geom_bodyid[g] == body.id and model.geom_group[g] == 3
        ]
        assert len(geoms) == len(item.collision)
        boxes = [model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX for g in geoms]
        assert boxes == are_boxes(bundle, item)
        np.testing.assert_allclose(model.geom_friction[geoms, 0], item.friction)


def test_what_moves_moves_and_what_hangs_is_fixed(bundle, model):
    name = names(bundle)
    free = {model.body(model.jnt_bodyid[j]).name for j in range(model.njnt)}
    assert (model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).all()
    assert free == {name[key] for key in FREE}
    moving = {model.body(b).name for b in range(1, model.nbody) if model.body_weldid[b] != 0}
    assert moving == {name[key] for key in MOVING}
    assert model.body(name[KNOB]).parentid[0] == model.body(name[BOOK]).id


def test_looks_are_textured_and_touch_nothing(model):
    looks = model.geom_group == 2
    assert not model.geom_contype[looks].any()
    assert not model.geom_conaffinity[looks].any()
    assert (model.geom_matid[looks] >= 0).all()
    assert model.ntex == looks.sum()


def test_it_rests_for_two_seconds(model):
    for name, (moved, turned) in _rest(model, 2.0).items():
        assert moved < 0.005, name
        assert turned < 1.0, name


@pytest.mark.end_to_end
def test_it_rests_for_ten_seconds_within_the_thresholds_of_the_report_card(model):
    changes = _rest(model, 10.0)
    stable = [moved < 0.02 and turned < 5.0 for moved, turned in changes.values()]
    assert len(stable) == len(MOVING)
    assert np.mean(stable) >= 0.95, changes


@pytest.mark.end_to_end
@pytest.mark.parametrize(("seed", "objects"), [(2, 15), (7, 40)])
def test_generated_rooms_with_stacks_and_containers_rest_for_ten_seconds(seed, objects, tmp_path):
    scene = generated_room(tmp_path, seed, objects)
    write_meshes(scene.bodies, tmp_path)
    write_mjcf(scene, tmp_path)
    changes = _rest(mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml")), 10.0)
    stable = [moved < 0.02 and turned < 5.0 for moved, turned in changes.values()]
    assert len(stable) == sum(body.moves for body in scene.bodies)
    assert len(stable) > 0.7 * objects
    assert np.mean(stable) >= 0.95, changes


def test_a_pushed_mug_slides_and_then_stops(bundle, model):
    """From 1 m/s friction stops it after v^2 / 2 mu g, about 13 cm."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mug = model.body(names(bundle)[MUG])
    data.qvel[model.body_dofadr[mug.id]] = -0.6
    start = data.xpos[mug.id].copy()
    mujoco.mj_step(model, data, 500)
    slid = np.linalg.norm((data.xpos[mug.id] - start)[:2])
    friction = 0.6  # MuJoCo takes the larger one of mug and table
    assert slid == pytest.approx(0.6**2 / (2 * friction * 9.81), rel=0.25)
    assert np.abs(data.qvel[model.body_dofadr[mug.id] :][:3]).max() < 0.01
