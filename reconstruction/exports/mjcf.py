"""Write a scene as MJCF (`scene.xml`), with solver options that keep resting objects at rest in MuJoCo."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from reconstruction.exports.meshes import FOLDER, collision_obj, hulls_of, texture_png, visual_obj
from reconstruction.exports.numbers import text_of
from reconstruction.exports.scene import ExportBody, ExportScene
from registry.geometry import invert_rigid, quat_from_matrix
from registry.primitives import Primitive

VISUAL_GROUP, COLLISION_GROUP = 2, 3
# The elliptic friction cone and the high impratio (frictional over normal impedance) reduce creep; noslip removes the
# remaining slip. Contacts are as stiff as the time step allows (time constant 2 steps), which limits penetration.
OPTIONS = {
    "timestep": "0.002",
    "integrator": "implicitfast",
    "solver": "Newton",
    "cone": "elliptic",
    "impratio": "10",
    "iterations": "100",
    "tolerance": "1e-10",
    "noslip_iterations": "3",
    "gravity": "0 0 -9.81",
}
CONTACT = {"solref": "0.004 1", "solimp": "0.95 0.99 0.001 0.5 2", "condim": "4"}
_TORSION_M, _ROLLING_M = (
    0.002,
    0.0001,
)  # torsional and rolling friction; MuJoCo's defaults are 5 mm and 0.1 mm


def write_mjcf(scene: ExportScene, folder: Path) -> list[str]:
    """Write `scene.xml`, which refers to `meshes/`; return its path relative to the folder."""
    root = ET.Element("mujoco", model=scene.id)
    ET.SubElement(root, "compiler", angle="radian", meshdir=FOLDER, texturedir=FOLDER, autolimits="true")
    option = ET.SubElement(root, "option", OPTIONS)
    ET.SubElement(option, "flag", multiccd="enable", nativeccd="enable")
    visual = ET.SubElement(root, "visual")
    ET.SubElement(visual, "headlight", ambient="0.5 0.5 0.5", diffuse="0.5 0.5 0.5", specular="0 0 0")
    ET.SubElement(visual, "map", znear="0.01", zfar="50")
    defaults = ET.SubElement(root, "default")
    visuals = ET.SubElement(defaults, "default", {"class": "visual"})
    ET.SubElement(
        visuals, "geom", type="mesh", group=str(VISUAL_GROUP), contype="0", conaffinity="0", mass="0"
    )
    contacts = ET.SubElement(defaults, "default", {"class": "collision"})
    geom = {"type": "mesh", "group": str(COLLISION_GROUP), "mass": "0", "rgba": "0.6 0.7 0.8 0.5"}
    ET.SubElement(contacts, "geom", geom | CONTACT)
    assets, world = ET.SubElement(root, "asset"), ET.SubElement(root, "worldbody")
    ET.SubElement(world, "light", pos="0 0 4", dir="0 0 -1", directional="true", castshadow="false")
    elements: dict[int, ET.Element] = {}
    for body in scene.bodies:
        _add_assets(assets, body)
    for body in _parents_first(scene):
        parent = world if body.weld is None else elements[body.weld]
        world_from_parent = np.eye(4) if body.weld is None else scene.body(body.weld).world_from_object
        elements[body.id] = _add_body(parent, body, invert_rigid(world_from_parent) @ body.world_from_object)
    ET.indent(root)
    ET.ElementTree(root).write(folder / "scene.xml", encoding="utf-8", xml_declaration=True)
    return ["scene.xml"]


def _parents_first(scene: ExportScene) -> list[ExportBody]:
    """Sort bodies topologically: the body that others are welded to comes first."""

    def depth(body: ExportBody) -> int:
        return 0 if body.weld is None else 1 + depth(scene.body(body.weld))

    return sorted(scene.bodies, key=depth)


def _add_assets(assets: ET.Element, body: ExportBody) -> None:
    # inertia="shell" accepts visual meshes that are not closed; mass and inertia come from <inertial>.
    file = Path(visual_obj(body)).name
    ET.SubElement(assets, "mesh", name=f"{body.name}_visual", file=file, inertia="shell")
    ET.SubElement(assets, "texture", name=body.name, type="2d", file=Path(texture_png(body)).name)
    ET.SubElement(assets, "material", name=body.name, texture=body.name, specular="0", shininess="0")
    for number, _ in hulls_of(body):
        file = Path(collision_obj(body, number)).name
        ET.SubElement(assets, "mesh", name=f"{body.name}_{number:03d}", file=file, inertia="convex")


def _add_body(parent: ET.Element, body: ExportBody, parent_from_body: np.ndarray) -> ET.Element:
    element = ET.SubElement(parent, "body", {"name": body.name} | _pose(parent_from_body))
    if body.moves and body.weld is None:
        ET.SubElement(element, "freejoint", name=f"{body.name}_free")
    if not body.base:
        i = body.inertia
        full = text_of([i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]])
        center, mass = text_of(body.center_of_mass), text_of([body.mass_kg])
        ET.SubElement(element, "inertial", pos=center, mass=mass, fullinertia=full)
    mesh = {"class": "visual", "name": f"{body.name}_visual", "mesh": f"{body.name}_visual"}
    ET.SubElement(element, "geom", mesh | {"material": body.name})
    for number, primitive in enumerate(body.primitives):
        name = f"{body.name}_{number:03d}"
        friction = text_of([body.friction, _TORSION_M, _ROLLING_M])
        shape = {"mesh": name} if primitive is None else _primitive(primitive)
        ET.SubElement(element, "geom", {"class": "collision", "name": name, "friction": friction} | shape)
    return element


def _primitive(primitive: Primitive) -> dict[str, str]:
    return {"type": primitive.shape, "size": text_of(primitive.size)} | _pose(primitive.pose)


def _pose(pose: np.ndarray) -> dict[str, str]:
    return {"pos": text_of(pose[:3, 3]), "quat": text_of(quat_from_matrix(pose[:3, :3]))}
