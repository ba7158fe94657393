"""Write a scene as USD with UsdPhysics schemas (`scene.usd`, z up, metres), for Isaac Sim and others.

Needs usd-core (the extra `simrecon[exports]`).
"""

from pathlib import Path
from typing import Any

import numpy as np

from reconstruction.assets.gltf import read_glb, vertex_normals
from reconstruction.core.types import TexturedMesh
from reconstruction.exports.meshes import texture_png, write_texture
from reconstruction.exports.scene import ExportBody, ExportScene, Hull
from registry.errors import EnvironmentMissing
from registry.geometry import invert_rigid, quat_from_matrix
from registry.primitives import Primitive

_ROOT = "/World"
_ROUGHNESS = 0.85  # of UsdPreviewSurface; nothing is measured


def write_usd(scene: ExportScene, folder: Path) -> list[str]:
    """Write `scene.usd` and its textures; return their paths relative to the folder.

    Raises:
        EnvironmentMissing: usd-core is not installed.
    """
    pxr = _pxr()
    stage = pxr.Usd.Stage.CreateNew(str(folder / "scene.usd"))
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.z)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    pxr.UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    root = pxr.UsdGeom.Xform.Define(stage, _ROOT).GetPrim()
    stage.SetDefaultPrim(root)
    pxr.Usd.ModelAPI(root).SetKind(pxr.Kind.Tokens.assembly)
    root.SetCustomDataByKey("simrecon", {"scene": scene.id, "revision": scene.revision})
    for group in ("Base", "Objects"):
        prim = pxr.UsdGeom.Xform.Define(stage, f"{_ROOT}/{group}").GetPrim()
        pxr.Usd.ModelAPI(prim).SetKind(pxr.Kind.Tokens.group)
    gravity = pxr.UsdPhysics.Scene.Define(stage, f"{_ROOT}/PhysicsScene")
    gravity.CreateGravityDirectionAttr(pxr.Gf.Vec3f(0, 0, -1))
    gravity.CreateGravityMagnitudeAttr(9.81)
    textures = [_add_body(pxr, stage, body, folder) for body in scene.bodies]
    for body in scene.bodies:
        if body.weld is not None:
            _weld(pxr, stage, body, scene.body(body.weld))
    stage.GetRootLayer().Save()
    return ["scene.usd", *textures]


def prim_path(body: ExportBody) -> str:
    """Return the prim path of a body."""
    return f"{_ROOT}/{'Base' if body.base else 'Objects'}/{body.name}"


def _pxr() -> Any:
    """Import usd-core."""
    try:
        import pxr
        from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt  # noqa: F401
    except ImportError as error:
        raise EnvironmentMissing(
            f"USD export needs usd-core, which cannot be imported ({error}); "
            'run `pip install "simrecon[exports]"` (or `pip install usd-core`) and export again'
        ) from error
    return pxr


def _add_body(pxr: Any, stage: Any, body: ExportBody, folder: Path) -> str:
    """Add a body with visual mesh, colliders, mass and materials; return the path of its texture."""
    path = prim_path(body)
    xform = pxr.UsdGeom.Xform.Define(stage, path)
    prim = xform.GetPrim()
    pxr.Usd.ModelAPI(prim).SetKind(pxr.Kind.Tokens.component)
    _set_pose(pxr, xform, body.world_from_object)
    facts = {"id": body.id, "label": body.label}
    if not body.base:
        facts["mass_kg"] = float(body.mass_kg)
    if body.relation is not None:
        facts["relation"], facts["parent"] = body.relation
    prim.SetCustomDataByKey("simrecon", facts)
    if body.moves:
        pxr.UsdPhysics.RigidBodyAPI.Apply(prim)
        _set_mass(pxr, prim, body)
    mesh = read_glb(body.visual)
    write_texture(mesh, folder / texture_png(body))
    visual = _add_mesh(pxr, stage, f"{path}/visual", mesh.vertices, mesh.faces)
    _add_appearance(pxr, stage, visual, mesh, f"{path}/Looks/surface", texture_png(body))
    material = _physics_material(pxr, stage, f"{path}/Looks/contact", body)
    for number, part in enumerate(body.parts):
        place, primitive = f"{path}/collision_{number:03d}", body.primitives[number]
        if primitive is None:
            piece = _add_hull(pxr, stage, place, part)
        else:
            piece = _add_primitive(pxr, stage, place, primitive)
        _make_collider(pxr, piece, material)
    return texture_png(body)


def _set_pose(pxr: Any, xform: Any, pose: np.ndarray) -> None:
    xform.AddTranslateOp().Set(pxr.Gf.Vec3d(*pose[:3, 3].tolist()))
    quat = quat_from_matrix(pose[:3, :3]).tolist()
    xform.AddOrientOp(pxr.UsdGeom.XformOp.PrecisionDouble).Set(pxr.Gf.Quatd(*quat))


def _set_mass(pxr: Any, prim: Any, body: ExportBody) -> None:
    moments, axes = np.linalg.eigh(body.inertia)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    w, x, y, z = quat_from_matrix(axes).tolist()
    mass = pxr.UsdPhysics.MassAPI.Apply(prim)
    mass.CreateMassAttr(float(body.mass_kg))
    mass.CreateCenterOfMassAttr(pxr.Gf.Vec3f(*body.center_of_mass.tolist()))
    mass.CreateDiagonalInertiaAttr(pxr.Gf.Vec3f(*moments.tolist()))
    mass.CreatePrincipalAxesAttr(pxr.Gf.Quatf(w, x, y, z))


def _add_mesh(pxr: Any, stage: Any, path: str, vertices: np.ndarray, faces: np.ndarray) -> Any:
    mesh = pxr.UsdGeom.Mesh.Define(stage, path)
    points = np.ascontiguousarray(vertices, np.float32)
    mesh.CreatePointsAttr(pxr.Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateFaceVertexIndicesAttr(pxr.Vt.IntArray.FromNumpy(np.ascontiguousarray(faces, np.int32).ravel()))
    mesh.CreateFaceVertexCountsAttr(pxr.Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateSubdivisionSchemeAttr(pxr.UsdGeom.Tokens.none)
    extent = np.ascontiguousarray([points.min(axis=0), points.max(axis=0)], np.float32)
    mesh.CreateExtentAttr(pxr.Vt.Vec3fArray.FromNumpy(extent))
    return mesh


def _add_appearance(pxr: Any, stage: Any, visual: Any, mesh: TexturedMesh, path: str, texture: str) -> None:
    """Add normals, texture coordinates and a textured UsdPreviewSurface material to a mesh."""
    Sdf, UsdShade, tokens = pxr.Sdf, pxr.UsdShade, pxr.UsdGeom.Tokens
    normals = np.ascontiguousarray(vertex_normals(mesh.vertices, mesh.faces), np.float32)
    visual.CreateNormalsAttr(pxr.Vt.Vec3fArray.FromNumpy(normals))
    visual.SetNormalsInterpolation(tokens.vertex)
    st = pxr.UsdGeom.PrimvarsAPI(visual).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, tokens.vertex
    )
    st.Set(pxr.Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(mesh.uvs, np.float32)))
    pxr.UsdGeom.Scope.Define(stage, path.rsplit("/", 1)[0])
    material = UsdShade.Material.Define(stage, path)
    reader = UsdShade.Shader.Define(stage, f"{path}/st")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    image = UsdShade.Shader.Define(stage, f"{path}/texture")
    image.CreateIdAttr("UsdUVTexture")
    image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(f"./{texture}")
    image.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
    for axis in ("wrapS", "wrapT"):
        image.CreateInput(axis, Sdf.ValueTypeNames.Token).Set("clamp")
    image.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(
        reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    )
    shader = UsdShade.Shader.Define(stage, f"{path}/preview")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(
        image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    )
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(_ROUGHNESS)
    shader.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(0.0)
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(visual.GetPrim()).Bind(material)


def _physics_material(pxr: Any, stage: Any, path: str, body: ExportBody) -> Any:
    material = pxr.UsdShade.Material.Define(stage, path)
    physics = pxr.UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    physics.CreateStaticFrictionAttr(float(body.friction))
    physics.CreateDynamicFrictionAttr(float(body.friction))
    physics.CreateRestitutionAttr(float(body.restitution))
    return material


def _add_hull(pxr: Any, stage: Any, path: str, part: Hull) -> Any:
    piece = _add_mesh(pxr, stage, path, part.vertices, part.faces)
    shape = pxr.UsdPhysics.MeshCollisionAPI.Apply(piece.GetPrim())
    shape.CreateApproximationAttr(pxr.UsdPhysics.Tokens.convexHull)
    return piece


def _add_primitive(pxr: Any, stage: Any, path: str, primitive: Primitive) -> Any:
    """Add a box (a scaled cube) or a cylinder along z."""
    if primitive.shape == "box":
        piece = pxr.UsdGeom.Cube.Define(stage, path)
        piece.CreateSizeAttr(2.0)
        extent = np.ones(3)
    else:
        piece = pxr.UsdGeom.Cylinder.Define(stage, path)
        radius, half = primitive.size
        piece.CreateRadiusAttr(radius)
        piece.CreateHeightAttr(2 * half)
        piece.CreateAxisAttr(pxr.UsdGeom.Tokens.z)
        extent = np.array([radius, radius, half])
    piece.CreateExtentAttr(pxr.Vt.Vec3fArray.FromNumpy(np.array([-extent, extent], np.float32)))
    _set_pose(pxr, piece, primitive.pose)
    if primitive.shape == "box":
        piece.AddScaleOp(pxr.UsdGeom.XformOp.PrecisionDouble).Set(pxr.Gf.Vec3d(*primitive.size))
    return piece


def _make_collider(pxr: Any, piece: Any, material: Any) -> None:
    """Make a prim a collider that is not rendered (purpose `guide`)."""
    piece.CreatePurposeAttr(pxr.UsdGeom.Tokens.guide)
    prim = piece.GetPrim()
    pxr.UsdPhysics.CollisionAPI.Apply(prim)
    pxr.UsdShade.MaterialBindingAPI.Apply(prim).Bind(
        material, pxr.UsdShade.Tokens.weakerThanDescendants, "physics"
    )


def _weld(pxr: Any, stage: Any, child: ExportBody, parent: ExportBody) -> None:
    """Add a fixed joint between two moving bodies, which then do not collide with each other."""
    joint = pxr.UsdPhysics.FixedJoint.Define(stage, f"{prim_path(child)}/weld")
    joint.CreateBody0Rel().SetTargets([prim_path(parent)])
    joint.CreateBody1Rel().SetTargets([prim_path(child)])
    parent_from_child = invert_rigid(parent.world_from_object) @ child.world_from_object
    w, x, y, z = quat_from_matrix(parent_from_child[:3, :3]).tolist()
    joint.CreateLocalPos0Attr(pxr.Gf.Vec3f(*parent_from_child[:3, 3].tolist()))
    joint.CreateLocalRot0Attr(pxr.Gf.Quatf(w, x, y, z))
    joint.CreateLocalPos1Attr(pxr.Gf.Vec3f(0.0))
    joint.CreateLocalRot1Attr(pxr.Gf.Quatf(1.0))
