"""The USD export in usd-core: valid stage, physics schemas, correct poses."""

import itertools

import numpy as np
import pytest
from exports_room import BOOK, FLOOR, KNOB, LEAF, MOVING, are_boxes, names, solid_box, world_box

from reconstruction.exports import export_scene
from registry.geometry import matrix_from_quat

pytest.importorskip("pxr", reason="needs simrecon[exports]")
from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdValidation


@pytest.fixture(scope="module")
def stage(bundle, tmp_path_factory):
    out = tmp_path_factory.mktemp("usd_out") / "room"
    return Usd.Stage.Open(str(export_scene(bundle, ["usd"], out).main["usd"]))


def _prim(stage, bundle, key):
    group = "Base" if key in {item.id for item in bundle.base} else "Objects"
    return stage.GetPrimAtPath(f"/World/{group}/{names(bundle)[key]}")


def test_the_validators_of_usdchecker_find_nothing(stage):
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetErrorAsString() for error in errors] == []


def test_metres_kilograms_z_up_and_gravity(stage):
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdPhysics.GetStageKilogramsPerUnit(stage) == 1.0
    assert stage.GetDefaultPrim().GetPath() == "/World"
    scene = UsdPhysics.Scene(stage.GetPrimAtPath("/World/PhysicsScene"))
    assert scene.GetGravityDirectionAttr().Get() == Gf.Vec3f(0, 0, -1)
    assert scene.GetGravityMagnitudeAttr().Get() == pytest.approx(9.81)


def _points(prim):
    """Return the points of a mesh or the corners of a box, in the parent's space."""
    if not prim.IsA(UsdGeom.Cube):
        return np.asarray(UsdGeom.Mesh(prim).GetPointsAttr().Get())
    low, high = np.array(UsdGeom.Cube(prim).GetExtentAttr().Get())
    corners = np.array(list(itertools.product(*zip(low, high))))
    local = np.array(UsdGeom.Xformable(prim).GetLocalTransformation())
    return corners @ local[:3, :3] + local[3, :3]


def test_every_prim_is_where_and_how_large_the_bundle_says(bundle, stage):
    for item in (*bundle.base, *bundle.objects):
        prim = _prim(stage, bundle, item.id)
        matrix = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))
        pose = getattr(item, "world_from_object", np.eye(4))
        np.testing.assert_allclose(matrix.T, pose, atol=1e-6)
        for kind, wanted in (("visual", world_box(bundle, item)), ("collision", solid_box(bundle, item))):
            points = [_points(child) for child in prim.GetChildren() if child.GetName().startswith(kind)]
            placed = np.concatenate(points) @ matrix[:3, :3] + matrix[3, :3]
            tolerance = 0.51e-3 if (item.id, kind) == (LEAF, "collision") else 1e-6
            np.testing.assert_allclose([placed.min(axis=0), placed.max(axis=0)], wanted, atol=tolerance)


def test_bodies_have_the_mass_and_inertia_of_the_bundle(bundle, stage):
    rigid = set()
    for item in bundle.objects:
        prim = _prim(stage, bundle, item.id)
        if not prim.HasAPI(UsdPhysics.RigidBodyAPI):
            assert not prim.HasAPI(UsdPhysics.MassAPI)
            continue
        rigid.add(item.id)
        mass = UsdPhysics.MassAPI(prim)
        assert mass.GetMassAttr().Get() == pytest.approx(item.mass_kg, rel=1e-6)
        np.testing.assert_allclose(mass.GetCenterOfMassAttr().Get(), item.center_of_mass, atol=1e-6)
        quat = mass.GetPrincipalAxesAttr().Get()
        axes = matrix_from_quat(np.array([quat.GetReal(), *quat.GetImaginary()]))
        tensor = (axes * np.array(mass.GetDiagonalInertiaAttr().Get())) @ axes.T
        np.testing.assert_allclose(tensor, item.inertia, atol=1e-6 * np.abs(item.inertia).max())
    assert rigid == MOVING


def test_pieces_are_convex_colliders_with_the_friction_of_their_object(bundle, stage):
    for item in (*bundle.base, *bundle.objects):
        pieces = [c for c in _prim(stage, bundle, item.id).GetChildren() if c.HasAPI(UsdPhysics.CollisionAPI)]
        assert len(pieces) == len(item.collision)
        for piece, box in zip(pieces, are_boxes(bundle, item)):
            if item.id > 2 and box:
                assert piece.IsA(UsdGeom.Cube)
            else:
                assert UsdPhysics.MeshCollisionAPI(piece).GetApproximationAttr().Get() == "convexHull"
            assert UsdGeom.Imageable(piece).GetPurposeAttr().Get() == "guide"
            bound, _ = UsdShade.MaterialBindingAPI(piece).ComputeBoundMaterial("physics")
            material = UsdPhysics.MaterialAPI(bound.GetPrim())
            friction = 0.5 if item.id <= 2 else item.friction
            assert material.GetStaticFrictionAttr().Get() == pytest.approx(friction)
            assert material.GetDynamicFrictionAttr().Get() == pytest.approx(friction)
            restitution = 0.0 if item.id <= 2 else item.restitution
            assert material.GetRestitutionAttr().Get() == pytest.approx(restitution)


def test_what_hangs_on_something_that_moves_is_jointed_to_it(bundle, stage):
    joints = [UsdPhysics.FixedJoint(p) for p in stage.Traverse() if p.IsA(UsdPhysics.FixedJoint)]
    assert len(joints) == 1
    book, knob = _prim(stage, bundle, BOOK), _prim(stage, bundle, KNOB)
    assert joints[0].GetBody0Rel().GetTargets() == [book.GetPath()]
    assert joints[0].GetBody1Rel().GetTargets() == [knob.GetPath()]
    items = {item.id: item.world_from_object for item in bundle.objects}
    wanted = np.linalg.inv(items[BOOK]) @ items[KNOB]
    np.testing.assert_allclose(joints[0].GetLocalPos0Attr().Get(), wanted[:3, 3], atol=1e-6)
    quat = joints[0].GetLocalRot0Attr().Get()
    turned = matrix_from_quat(np.array([quat.GetReal(), *quat.GetImaginary()]))
    np.testing.assert_allclose(turned, wanted[:3, :3], atol=1e-6)


def test_looks_have_a_texture_that_can_be_found(bundle, stage):
    looks = _prim(stage, bundle, FLOOR).GetChild("visual")
    material, _ = UsdShade.MaterialBindingAPI(looks).ComputeBoundMaterial()
    shader, _, _ = material.ComputeSurfaceSource()
    image = shader.GetInput("diffuseColor").GetConnectedSource()[0]
    asset = UsdShade.Shader(image.GetPrim()).GetInput("file").Get()
    assert asset.resolvedPath
    assert UsdGeom.PrimvarsAPI(looks).GetPrimvar("st").HasValue()
