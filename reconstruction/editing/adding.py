"""Add an object that the segmentation missed, from outlines that the user drew: `add` of an overrides file."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera, Instance, InstanceSet, Surface
from reconstruction.editing.anchors import Footage, box_axes
from reconstruction.editing.outlined_hull import Cone, box_between
from reconstruction.editing.outlined_wall import hung_on, wall_around
from reconstruction.editing.outlines import Added, Outline
from reconstruction.instances.contacts import carriers
from reconstruction.instances.cut import Thing
from reconstruction.instances.describe import describe
from registry.errors import UsageError
from registry.geometry import invert_rigid, transform_points

_FINE = 4  # outlines are filled at this multiple of depth resolution
_COVERED = 0.25  # least share of an outline that its own surface fills; with less, its size says little of the thing's
_RING = 0.25  # width of the ring around an outline, relative to the root of its area
_RING_PLANE = 0.1  # least share of the ring of a plane that goes on beyond the outline
_UNDER = 0.5  # a level plane with more than this share of a ring carries the outlined thing
_PLANES, _TRIES = 4, 200  # most planes of a ring, and the vertices that propose them
_FACES_ALIKE = 0.9  # least cosine between the normals of a plane and of vertices on it
_LEAST_BAND_M = 0.008  # half thickness of a plane, unless the surface is sampled more coarsely
_DEEPER = 1.5  # largest depth behind the front, relative to the size across
_SAME_THING = 0.5  # an existing object with more than this share of its surface inside is the outlined thing
_SAME_BOX = 0.5  # one without surface, whose box and the new one overlap by more than this share of the smaller, is it
_GRID = 12  # points along each side of a box, to measure an overlap
_PIECE = 0.1  # least size of a connected piece, relative to the largest
_HUNG_M, _FOOT_M = (
    0.05,
    0.05,
)  # to a wall: largest distance of what hangs on it; above the floor: of what stands on it


@dataclass(frozen=True)
class _RingPlane:
    """A plane that goes on beyond an outline."""

    plane: np.ndarray  # (4,), its normal into free space
    share: float  # of the ring


@dataclass(frozen=True)
class _View:
    """One outline in its frame, and where the surface appears there."""

    outline: Outline
    world_from_camera: np.ndarray  # (4, 4)
    polygon: np.ndarray  # (k, 2) pixels at depth resolution
    area_px: float
    inside: np.ndarray  # bool (v,) vertices that project into the outline
    ring: np.ndarray  # bool (v,) vertices that are seen around the outline
    planes: list[_RingPlane]
    visible: np.ndarray  # bool (v,) vertices in front of the camera, in its image, and not hidden
    depth: np.ndarray  # (v,) z-depth


def add_thing(found: InstanceSet, surface: Surface, footage: Footage, added: Added) -> InstanceSet:
    """Return the instances with one more object, which has the next free id.

    Its surface is what lies inside the outlines. Without any, it is flat on the wall around the outlines; elsewhere two
    outlines give it a box and no surface.

    Args:
        found: the instances.
        surface: the surface that was segmented.
        footage: frames and cameras.
        added: label and outlines.

    Raises:
        UsageError: the outlines show no surface of their own and give no box, or an object that exists.
    """
    graph = MeshGraph.from_surface(surface)
    views = [_view(outline, surface, footage, graph) for outline in added.outlines]
    chosen = _own_surface(graph, views)
    number = found.last_id + 1
    shown = _share_shown(chosen, views, surface, footage)
    if shown < _COVERED:
        wall = wall_around(found, [view.ring for view in views])
        drawn = [(view.polygon, view.world_from_camera) for view in views]
        hung = wall and hung_on(found, wall, drawn, number, added.label, footage.posed, footage.depth)
        if hung is not None:
            _refuse_known_box(found, hung.objects[-1], added)
            return hung
        cones = [Cone(view.world_from_camera, view.polygon, view.outline) for view in views]
        under = [
            p.plane for view in views for p in view.planes if p.share > _UNDER and p.plane[2] > _FACES_ALIKE
        ]
        box = box_between(cones, footage.depth.camera, surface, found, under, added.label, shown)
        item = Instance(number, added.label, 1.0, box.center, box.yaw_rad, box.extents_m, 0, False)
        _refuse_known_box(found, item, added)
        return replace(found, objects=(*found.objects, item))
    _refuse_known(found, chosen, added)
    item = _described(found, graph, chosen, number, added.label)
    labels = np.array(found.vertex_instance)
    labels[chosen] = number
    maps = _drawn_into(found.id_maps, chosen, np.asarray(found.vertex_instance), number, footage)
    return replace(found, vertex_instance=labels, id_maps=maps, objects=(*found.objects, item))


def _view(outline: Outline, surface: Surface, footage: Footage, graph: MeshGraph) -> _View:
    """Project the surface into the frame of an outline."""
    pose = footage.camera_of(outline.frame)[1]
    polygon = np.array([footage.depth_pixel(corner) for corner in outline.corners])
    camera = footage.depth.camera
    mask = _filled(polygon, camera)
    local = transform_points(invert_rigid(pose), graph.points)
    z = local[:, 2]
    u, v = camera.project(np.column_stack([local[:, :2], np.maximum(z, 1e-6)]))
    seen = (z > 1e-3) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    column, row = np.where(seen, u, 0).astype(int), np.where(seen, v, 0).astype(int)
    drawn = rasterize_mesh(surface.vertices, surface.faces, camera, pose).depth
    # The farthest of the neighboring pixels: vertices on silhouettes fall beside the pixels of their triangles.
    far = cv2.dilate(drawn.astype(np.float32), np.ones((3, 3), np.uint8))[row, column]
    visible = seen & ((far <= 0) | (z < far + 2 * graph.spacing_m))
    width = 2 * round(_RING * float(np.sqrt(mask.sum()))) + 1
    around = cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width)))
    fine = (np.where(seen, v, 0) * _FINE).astype(int), (np.where(seen, u, 0) * _FINE).astype(int)
    inside = seen & (mask[fine] > 0)
    ring = visible & (around[fine] > 0) & ~inside
    return _View(
        outline,
        pose,
        polygon,
        float(mask.sum()) / _FINE**2,
        inside,
        ring,
        _planes_of(graph, ring),
        visible,
        z,
    )


def _filled(polygon: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the mask uint8 (h * _FINE, w * _FINE) of a polygon."""
    mask = np.zeros((camera.height * _FINE, camera.width * _FINE), np.uint8)
    cv2.fillPoly(mask, [np.round(polygon * _FINE).astype(np.int32)], 1)
    return mask


def _own_surface(graph: MeshGraph, views: list[_View]) -> np.ndarray:
    """Return the vertices int (k,) inside all outlines, without planes that go on beyond one and what is far behind."""
    inside = np.all([view.inside for view in views], axis=0)
    front = inside & np.any([view.visible for view in views], axis=0)
    background = np.zeros(len(inside), bool)
    for view in views:
        for found in view.planes:
            background |= _on(graph, found.plane)
    front &= ~background
    allowed = inside & ~background
    for view in views:
        if front.any():
            across = np.ptp(graph.points[front], axis=0).max()
            allowed &= view.depth < np.quantile(view.depth[front], 0.1) + _DEEPER * across
    front &= allowed
    edges = graph.edges_within(allowed)
    count = len(inside)
    links = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    piece = connected_components(links, directed=False)[1]
    sizes = np.bincount(piece[front], minlength=count)
    large = sizes >= max(_PIECE * sizes.max(initial=0), 1)
    return np.flatnonzero(allowed & large[piece])


def _planes_of(graph: MeshGraph, ring: np.ndarray) -> list[_RingPlane]:
    """Return the planes of the ring around an outline.

    Each is the best of those through single vertices of the ring along their normals; its vertices are removed before
    the next is sought.
    """
    band = _band_of(graph)
    rest = np.flatnonzero(ring)
    count = max(len(rest), 1)
    out = []
    for _ in range(_PLANES):
        if len(rest) < max(_RING_PLANE * count, 3):
            break
        points, normals = graph.points[rest], graph.normals[rest]
        tried = np.unique(np.linspace(0, len(rest) - 1, _TRIES).astype(int))
        off = np.abs(points @ normals[tried].T - (points[tried] * normals[tried]).sum(axis=1))
        on = (off < band) & (normals @ normals[tried].T > _FACES_ALIKE)
        best = int(on.sum(axis=0).argmax())
        members = on[:, best]
        if members.sum() < _RING_PLANE * count:
            break
        middle = points[members].mean(axis=0)
        normal = np.linalg.svd(points[members] - middle, full_matrices=False)[2][2]
        normal = normal * np.sign(normal @ normals[tried[best]] or 1.0)
        out.append(_RingPlane(np.append(normal, -normal @ middle), float(members.sum() / count)))
        rest = rest[~members]
    return out


def _on(graph: MeshGraph, plane: np.ndarray) -> np.ndarray:
    """Return the mask (v,) of the vertices that lie on a plane (4,)."""
    away = np.abs(graph.points @ plane[:3] + plane[3])
    alike = np.abs(graph.normals @ plane[:3]) > _FACES_ALIKE
    band = _band_of(graph)
    return (away < 0.5 * band) | ((away < band) & alike)


def _band_of(graph: MeshGraph) -> float:
    return max(graph.spacing_m, _LEAST_BAND_M)


def _share_shown(chosen: np.ndarray, views: list[_View], surface: Surface, footage: Footage) -> float:
    """Return the share of the outlines' area in which the chosen surface is seen."""
    mine = np.zeros(len(surface.vertices), bool)
    mine[chosen] = True
    shown = 0.0
    for view in views:
        seen = footage.seen_vertices(view.world_from_camera)
        shown += float(((seen >= 0) & mine[seen]).sum())
    return shown / max(sum(view.area_px for view in views), 1.0)


def _refuse_known_box(found: InstanceSet, item: Instance, added: Added) -> None:
    """Raise UsageError if the box of outlines without surface is that of an object without surface."""
    with_surface = set(np.unique(found.vertex_instance).tolist())
    for other in found.objects:
        if other.id in with_surface:
            continue
        small, large = sorted((item, other), key=lambda o: float(np.prod(o.extents_m)))
        if _share_inside(small, large) > _SAME_BOX:
            where = " and ".join(map(str, added.outlines))
            raise UsageError(
                f"overrides: add {added.label}: {where} shows {other.label} {other.id}, "
                "which is a thing already; relabel that one, or drop it first"
            )


def _share_inside(small: Instance, large: Instance) -> float:
    """Return the share of one object's box that lies in another's."""
    steps = (np.arange(_GRID) + 0.5) / _GRID - 0.5
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    points = (grid * small.extents_m) @ box_axes(small) + small.center
    away = np.abs((points - large.center) @ box_axes(large).T)
    return float((away <= 0.5 * np.asarray(large.extents_m)).all(axis=1).mean())


def _refuse_known(found: InstanceSet, chosen: np.ndarray, added: Added) -> None:
    """Raise UsageError if the outlines show an object that exists."""
    owner = np.asarray(found.vertex_instance)
    for item in found.objects:
        whole = int((owner == item.id).sum())
        if whole and (owner[chosen] == item.id).sum() > _SAME_THING * whole:
            where = " and ".join(map(str, added.outlines))
            raise UsageError(
                f"overrides: add {added.label}: {where} shows {item.label} {item.id}, which is a thing already; "
                "relabel that one, or split it"
            )


def _described(found: InstanceSet, graph: MeshGraph, chosen: np.ndarray, number: int, label: str) -> Instance:
    """Return the object of these vertices with its box and its support."""
    owner = np.asarray(found.vertex_instance).copy()
    owner[chosen] = number
    ids = [i for i in (*(o.id for o in found.objects), found.structure) if i and (owner == i).any()]
    surfaces = [np.flatnonzero(owner == i) for i in ids]
    row = carriers(graph, [*surfaces, chosen])[-1]
    under = Thing(surfaces[row], is_object=ids[row] != found.structure) if row >= 0 else None
    thing = Thing(np.sort(chosen), under, attached=under is None and _hangs(found, graph, chosen))
    numbers = np.zeros(len(owner), np.int32)
    items = describe(graph, [thing] if under is None else [under, thing], found.base, numbers)
    made = next(item for item in items if item.id == numbers[chosen[0]])
    hint = ids[row] if row >= 0 else made.support_hint
    return replace(made, id=number, label=label, label_confidence=1.0, support_hint=hint)


def _hangs(found: InstanceSet, graph: MeshGraph, chosen: np.ndarray) -> bool:
    """Return whether an object that nothing carries touches a wall and is above the floor."""
    points = graph.points[chosen]
    gaps = [points @ b.surface.plane[:3] + b.surface.plane[3] for b in found.base if b.label == "wall"]
    return bool(points[:, 2].min() > _FOOT_M and any(np.percentile(gap, 5) < _HUNG_M for gap in gaps))


def _drawn_into(
    id_maps: np.ndarray, chosen: np.ndarray, before: np.ndarray, number: int, footage: Footage
) -> np.ndarray:
    """Return the id maps (n, h, w) with the pixels of the chosen surface set to `number`."""
    maps = np.array(id_maps)
    mine = np.zeros(len(before), bool)
    mine[chosen] = True
    replaced = {0, *np.unique(before[chosen]).tolist()}
    for row, ids in enumerate(maps):
        seen = footage.seen_in_keyframe(row)
        ids[(seen >= 0) & mine[seen] & np.isin(ids, list(replaced))] = number
    return maps
