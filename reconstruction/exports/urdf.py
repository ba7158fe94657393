"""Write a scene as URDF: `scene.urdf` with all bodies at their poses, and one file per object."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from reconstruction.exports.meshes import collision_obj, visual_obj
from reconstruction.exports.numbers import roll_pitch_yaw, text_of
from reconstruction.exports.scene import ExportBody, ExportScene
from registry.geometry import invert_rigid
from registry.primitives import Primitive

WORLD_LINK = "world"


def write_urdf(scene: ExportScene, folder: Path) -> list[str]:
    """Write `scene.urdf` and one file per object, which refer to `meshes/`; return their relative paths."""
    robot = ET.Element("robot", name=scene.id)
    ET.SubElement(robot, "link", name=WORLD_LINK)
    for body in scene.bodies:
        robot.append(_link(body))
    for body in scene.bodies:
        robot.append(_joint(scene, body))
    files = [_write(robot, folder, "scene.urdf")]
    for body in scene.bodies:
        if not body.base:
            single = ET.Element("robot", name=body.name)
            single.append(_link(body))
            files.append(_write(single, folder, f"{body.name}.urdf"))
    return files


def _write(robot: ET.Element, folder: Path, name: str) -> str:
    ET.indent(robot)
    ET.ElementTree(robot).write(folder / name, encoding="utf-8", xml_declaration=True)
    return name


def _joint(scene: ExportScene, body: ExportBody) -> ET.Element:
    """Return the joint that holds the pose of a body: floating if it moves on its own, else fixed."""
    floating = body.moves and body.weld is None
    parent = None if body.weld is None else scene.body(body.weld)
    world_from_parent = np.eye(4) if parent is None else parent.world_from_object
    joint = ET.Element("joint", name=f"{body.name}_joint", type="floating" if floating else "fixed")
    ET.SubElement(joint, "parent", link=WORLD_LINK if parent is None else parent.name)
    ET.SubElement(joint, "child", link=body.name)
    _origin(joint, invert_rigid(world_from_parent) @ body.world_from_object)
    return joint


def _link(body: ExportBody) -> ET.Element:
    link = ET.Element("link", name=body.name)
    if not body.base:
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "origin", xyz=text_of(body.center_of_mass), rpy="0 0 0")
        ET.SubElement(inertial, "mass", value=text_of([body.mass_kg]))
        names = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
        ET.SubElement(
            inertial, "inertia", {name: text_of([body.inertia[place]]) for name, place in names.items()}
        )
    # URDF has no friction and restitution; these are PyBullet's extension.
    if body.parts:
        contact = ET.SubElement(link, "contact")
        ET.SubElement(contact, "lateral_friction", value=text_of([body.friction]))
        ET.SubElement(contact, "restitution", value=text_of([body.restitution]))
    _mesh(link, "visual", visual_obj(body))
    for number, primitive in enumerate(body.primitives):
        if primitive is None:
            _mesh(link, "collision", collision_obj(body, number))
        else:
            _primitive(link, primitive)
    return link


def _mesh(link: ET.Element, kind: str, file: str) -> None:
    element = ET.SubElement(link, kind)
    ET.SubElement(element, "origin", xyz="0 0 0", rpy="0 0 0")
    ET.SubElement(ET.SubElement(element, "geometry"), "mesh", filename=file)


def _primitive(link: ET.Element, primitive: Primitive) -> None:
    element = ET.SubElement(link, "collision")
    _origin(element, primitive.pose)
    geometry = ET.SubElement(element, "geometry")
    if primitive.shape == "box":
        ET.SubElement(geometry, "box", size=text_of([2 * half for half in primitive.size]))
    else:
        radius, half = primitive.size
        ET.SubElement(geometry, "cylinder", radius=text_of([radius]), length=text_of([2 * half]))


def _origin(parent: ET.Element, pose: np.ndarray) -> None:
    ET.SubElement(parent, "origin", xyz=text_of(pose[:3, 3]), rpy=text_of(roll_pitch_yaw(pose[:3, :3])))
