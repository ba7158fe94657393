"""Meshes of a robot's links for the page: the visuals of its URDF, else its collision shapes, thinned."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from registry.geometry import rigid, transform_points

logger = logging.getLogger(__name__)
_MOST_FACES = (
    1500  # of a part: a robot of 25 parts stays below 40,000, and keeps its silhouette at arm's length
)
_GRAY = (0.62, 0.64, 0.67)
_PRIMITIVES = ("box", "cylinder", "sphere")


@dataclass(frozen=True)
class LinkPart:
    """One mesh of a link, of one color."""

    vertices: np.ndarray  # float32 (v, 3) link space, metres
    faces: np.ndarray  # uint32 (f, 3)
    color: tuple[float, float, float]  # sRGB, 0 to 1


def link_parts(agent: Any) -> list[tuple[LinkPart, ...]]:
    """Return the meshes of every link of a ManiSkill agent, in the order of `agent.robot.links`."""
    visuals = _urdf_visuals(Path(agent.urdf_path)) if getattr(agent, "urdf_path", None) else {}
    return [tuple(visuals.get(link.name) or _collision_parts(link._objs[0])) for link in agent.robot.links]


def _urdf_visuals(file: Path) -> dict[str, list[LinkPart]]:
    """Read the visuals of a URDF by link; a link with an unreadable mesh is left out."""
    root = ElementTree.parse(file).getroot()
    colors = {m.get("name"): _rgb(m) for m in root.findall("material") if m.find("color") is not None}
    found: dict[str, list[LinkPart]] = {}
    for link in root.findall("link"):
        parts: list[LinkPart] = []
        try:
            for visual in link.findall("visual"):
                parts += _visual_parts(visual, file.parent, colors)
        except Exception as error:  # readers of mesh files raise anything
            logger.info("%s: link %s is shown by its collision shapes (%s)", file, link.get("name"), error)
            continue
        found[str(link.get("name"))] = parts
    return found


def _visual_parts(visual: Any, folder: Path, colors: dict) -> Iterator[LinkPart]:
    import trimesh

    geometry, origin, material = visual.find("geometry"), visual.find("origin"), visual.find("material")
    link_from_visual = _origin(origin)
    told = None if material is None else _rgb(material) or colors.get(material.get("name"))
    if (mesh := geometry.find("mesh")) is not None:
        scene: Any = trimesh.load(folder / mesh.get("filename").removeprefix("package://"), force="scene")
        scale = np.array([float(x) for x in mesh.get("scale", "1 1 1").split()])
        for node in scene.graph.nodes_geometry:
            file_from_part, name = scene.graph[node]
            part = scene.geometry[name]
            if isinstance(part, trimesh.Trimesh):
                vertices = transform_points(file_from_part, np.asarray(part.vertices, np.float64)) * scale
                yield _thinned(
                    transform_points(link_from_visual, vertices), part.faces, told or _color_of(part)
                )
        return
    shape = next(geometry.find(kind) for kind in _PRIMITIVES if geometry.find(kind) is not None)
    if shape.tag == "box":
        solid = trimesh.creation.box([float(x) for x in shape.get("size").split()])
    elif shape.tag == "cylinder":
        solid = trimesh.creation.cylinder(float(shape.get("radius")), float(shape.get("length")))
    else:
        solid = trimesh.creation.icosphere(radius=float(shape.get("radius")), subdivisions=2)
    yield _thinned(transform_points(link_from_visual, solid.vertices), solid.faces, told or _GRAY)


def _collision_parts(body: Any) -> Iterator[LinkPart]:
    """Yield the convex hulls of points on the collision shapes of a link."""
    from scipy.spatial import ConvexHull

    from simrecon_envs.robots import surface_points

    for shape in body.collision_shapes:
        points = surface_points(shape, 0.02)
        if len(points) >= 4:
            points = transform_points(shape.local_pose.to_transformation_matrix(), points)
            hull = ConvexHull(points)
            yield _thinned(points, _outward(points, hull), _GRAY)


def _outward(points: np.ndarray, hull: Any) -> np.ndarray:
    """Return the faces of a hull, counter-clockwise seen from outside."""
    faces = np.array(hull.simplices)
    a, b, c = (points[faces[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return faces


def _thinned(vertices: np.ndarray, faces: Any, color: tuple[float, float, float]) -> LinkPart:
    import fast_simplification
    import trimesh

    mesh = trimesh.Trimesh(np.asarray(vertices), np.asarray(faces), process=True)  # merges equal vertices
    points, triangles = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)
    if len(triangles) > _MOST_FACES:
        simplify: Any = fast_simplification.simplify
        points, triangles = simplify(points, triangles, target_count=_MOST_FACES)
    return LinkPart(np.asarray(points, np.float32), np.asarray(triangles, np.uint32), color)


def _origin(origin: Any) -> np.ndarray:
    from trimesh.transformations import euler_matrix

    if origin is None:
        return np.eye(4)
    roll, pitch, yaw = (float(x) for x in origin.get("rpy", "0 0 0").split())
    translation = np.array([float(x) for x in origin.get("xyz", "0 0 0").split()])
    return rigid(euler_matrix(roll, pitch, yaw, "sxyz")[:3, :3], translation)


def _rgb(material: Any) -> tuple[float, float, float] | None:
    color = material.find("color")
    if color is None:
        return None
    r, g, b = (float(x) for x in color.get("rgba").split()[:3])
    return r, g, b


def _color_of(part: Any) -> tuple[float, float, float]:
    material = getattr(part.visual, "material", None)
    color = getattr(material, "main_color", None) if material is not None else part.visual.main_color
    if color is None:
        return _GRAY
    r, g, b = (float(x) / 255 for x in np.asarray(color)[:3])
    return r, g, b
