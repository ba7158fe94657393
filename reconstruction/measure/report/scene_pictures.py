"""Render the whole scene from distant cameras: the fused surface, the assembled scene, and their error maps."""

from dataclasses import replace

import numpy as np

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera, Surface, TexturedMesh
from reconstruction.measure.report import drawing
from reconstruction.measure.report.blocks import Picture
from reconstruction.measure.report.collect import Gathered, present
from reconstruction.measure.report.pictures import VIEW_PX, picture
from reconstruction.measure.report.truth import NearSurface
from reconstruction.measure.scene import PlacedMesh, joined
from reconstruction.measure.surfaces import sample

SURFACE_ERROR_M = 0.05  # upper end of the color scale


def side_views(g: Gathered, width: int = VIEW_PX) -> list[tuple[str, Camera, np.ndarray]]:
    """Return three distant cameras (name, camera, pose): on the side of the video's cameras, and 55° to both sides."""
    centers = g.bundle.cameras.world_from_camera[:, :3, 3]
    things = [m.vertices for m in g.object_meshes] or [m.vertices for m in g.meshes] or [centers]
    points = np.concatenate([_box(v) for v in things])
    floor = [m for m in g.meshes if m.label == "floor"]
    for mesh in floor:  # the floor around the objects
        low, high = points.min(axis=0) - 0.4, points.max(axis=0) + 0.4
        inside = np.clip(_box(mesh.vertices), low, high)
        points = np.concatenate([points, inside])
    center = points.mean(axis=0)
    toward = centers.mean(axis=0) - center
    azimuth = float(np.degrees(np.arctan2(toward[1], toward[0])))
    out = []
    for name, turn in (("from the left", -55.0), ("from the video's side", 0.0), ("from the right", 55.0)):
        out.append((name, *drawing.framing_camera(points, azimuth + turn, 32.0, width, round(0.8 * width))))
    return out


def _box(vertices: np.ndarray) -> np.ndarray:
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )


def surface_faces(g: Gathered, surface: Surface, pose: np.ndarray) -> np.ndarray:
    """Return the surface's faces without back-facing faces of floor and walls."""
    faces = np.asarray(surface.faces)
    front = drawing.facing(surface.vertices, faces, pose)
    if g.instances is None:
        return faces[front]
    base = np.isin(g.instances.vertex_instance, [item.id for item in g.instances.base])
    return faces[front | ~base[faces].any(axis=1)]


def surface_views(g: Gathered) -> tuple[list[Picture], list[str]]:
    """Render the fused surface from three sides: in color, in gray, and as an error map; also return their names."""
    surface, views = present(g.surface), side_views(g)
    vertices = np.asarray(surface.vertices)
    clay = np.full((len(vertices), 3), 196, np.float32)
    out = []
    for what, colors in (("in color", np.asarray(surface.colors)), ("shape only", clay)):
        for name, camera, pose in views:
            faces = surface_faces(g, surface, pose)
            image = drawing.render_colored(vertices, faces, colors, camera, pose)
            out.append(picture(image, f"the surface {name}, {what}", what))
    if g.truth is not None and g.truth.has_meshes:
        for name, camera, pose in views:
            faces = surface_faces(g, surface, pose)
            out.append(error_view(g, vertices, faces, camera, pose, f"error of the surface {name}"))
    return out, [name for name, _, _ in views]


def error_view(
    g: Gathered, vertices: np.ndarray, faces: np.ndarray, camera: Camera, pose: np.ndarray, what: str
) -> Picture:
    """Render a mesh (v, 3), (f, 3) colored by its distance to the true surface."""
    raster = rasterize_mesh(vertices, faces, camera, pose)
    hit = raster.face >= 0
    distance = np.zeros(hit.shape)
    distance[hit] = present(g.truth).distance(raster.interpolate(faces, vertices)[hit])
    return _error_picture(distance, hit, raster.depth, camera, what)


def missing_view(g: Gathered, near: NearSurface, camera: Camera, pose: np.ndarray, what: str) -> Picture:
    """Render the true surface colored by its distance to the scene (`near`), where it is visible in the video."""
    truth = present(g.truth)
    vertices, faces = truth.mesh_in_scene
    base = np.isin(truth.known.face_ids, [e.id for e in truth.known.base])
    faces = faces[~base | drawing.facing(vertices, faces, pose)]
    raster = rasterize_mesh(vertices, faces, camera, pose)
    hit = raster.face >= 0
    points = truth.alignment.to_true(raster.interpolate(faces, vertices)[hit])
    distance, filmed = np.zeros(hit.shape), np.zeros(hit.shape, bool)
    filmed[hit] = truth.seen(points)
    distance[filmed] = near.distance(points[filmed[hit]])
    return _error_picture(distance, filmed, raster.depth, camera, what)


def _error_picture(
    distance: np.ndarray, known: np.ndarray, depth: np.ndarray, camera: Camera, what: str
) -> Picture:
    image = drawing.colorize(distance, 0, SURFACE_ERROR_M, drawing.ERROR_MAP, known)
    image[depth <= 0] = drawing.BACKGROUND
    text = "nothing to compare"
    if known.any():
        far = (distance[known] > SURFACE_ERROR_M).mean()
        text = f"mean {100 * distance[known].mean():.1f} cm, {far:.0%} over {100 * SURFACE_ERROR_M:.0f} cm"
    return picture(drawing.shaded(image, depth, camera), what, text)


def scene_views(g: Gathered) -> list[Picture]:
    """Render the assembled scene from three sides; with true meshes also error maps in both directions."""
    views = side_views(g)
    out = []
    for name, camera, pose in views:
        meshes = [(_open_room(m, pose), m.world_from_mesh) for m in g.meshes]
        out.append(picture(drawing.render_lit(meshes, camera, pose), f"the scene {name}", name))
    if g.truth is None or not g.truth.has_meshes:
        return out
    for name, camera, pose in views:
        shown = [replace(m, faces=_open_room(m, pose).faces) for m in g.meshes]
        out.append(error_view(g, *joined(shown), camera, pose, f"error of the scene {name}"))
    vertices, faces = joined(g.meshes)
    near = NearSurface(sample(g.truth.alignment.to_true(vertices), faces, 400_000))
    for name, camera, pose in views:
        out.append(missing_view(g, near, camera, pose, f"distance from the truth to the scene, {name}"))
    return out


def _open_room(mesh: PlacedMesh, pose: np.ndarray) -> TexturedMesh:
    """Return a mesh without back-facing faces if it is a base surface, to look into the room."""
    if not mesh.base:
        return mesh.visual
    return replace(mesh.visual, faces=mesh.faces[drawing.facing(mesh.vertices, mesh.faces, pose)])
