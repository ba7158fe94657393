"""Which part of every surface was seen: measured in a frame, completed by a plane, or guessed.

A vertex is *seen* where a keyframe that faces it measured a depth that is the vertex's; *completed* where only depth
that a plane completed agrees with it; *guessed* where no frame has it: symmetry, support or carving made it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from registry import SceneBundle
from registry.geometry import invert_rigid, transform_points
from studio.picking import Geometry, read_geometry

if TYPE_CHECKING:
    from reconstruction.core.types import AssetSet, Camera, DepthMaps
    from reconstruction.measure.stage_results import StageResults

CLASSES = ("guessed", "completed", "seen")
COLORS = np.array([[214, 104, 83], [233, 190, 96], [62, 150, 136]], np.uint8)  # a row a class
# A depth agrees with a vertex within two voxels of the fusion (8 mm by default, `surface.voxel_size_m`) and the
# tolerance at which views confirm a depth (`depth.agree_depth`).
_AGREE_M, _AGREE_SHARE = 0.016, 0.01
_FACING = 0.15  # cosine; at flatter angles a pixel is longer than the tolerance
_OBJECT_EDGE_M, _ROOM_EDGE_M = 0.02, 0.08  # longest edges of the colored meshes


@dataclass(frozen=True)
class CoveredSurface:
    """A mesh in its owner's space, with a class per vertex (rows of `CLASSES`)."""

    mesh: Geometry
    classes: np.ndarray  # int (v,)
    shares: np.ndarray  # float (3,) of the surface's area, by class

    def colored(self) -> Any:
        """Return a trimesh whose vertices have the colors of their classes."""
        import trimesh

        colors = np.column_stack([COLORS[self.classes], np.full(len(self.classes), 255, np.uint8)])
        return trimesh.Trimesh(self.mesh.vertices, self.mesh.faces, vertex_colors=colors, process=False)


@dataclass(frozen=True)
class Coverage:
    """Classes of all surfaces of a scene; `measured` is false where only the bundle's shares are known."""

    surfaces: dict[int, CoveredSurface]
    measured: bool

    def legend(self) -> str:
        """Return HTML: the colors, and the share of each class over all surfaces."""
        dots = "".join(
            f'<span style="color:rgb({r},{g},{b})">&#9679;</span> {name}&emsp;'
            for (r, g, b), name in zip(COLORS[::-1].tolist(), CLASSES[::-1], strict=True)
        )
        if self.measured:
            return (
                dots + "<br>A frame measured it; a plane completed it; symmetry, support or carving made it."
            )
        return dots + (
            "<br>The stage cache of this scene is gone, so whole objects are colored by the share that was seen "
            "(half or more: seen; some: completed; none: guessed)."
        )


def measure_coverage(bundle: SceneBundle, stages: "StageResults") -> Coverage:
    """Class all surfaces of a bundle by the depth maps of its run, or by its own shares where those are gone."""
    posed, depth = stages.in_world()[0], stages.refined_in_world()[1]
    if posed is None or depth is None:
        return Coverage({key: _by_share(mesh, share) for key, mesh, _, share in _meshes(bundle, None)}, False)
    assets = stages.get("assets")
    surfaces = {}
    for key, mesh, world_from_owner, _ in _meshes(bundle, assets):
        normals = vertex_normals(mesh) @ world_from_owner[:3, :3].T
        points = transform_points(world_from_owner, mesh.vertices)
        classes = classify(points, normals, depth, posed.world_from_camera)
        surfaces[key] = CoveredSurface(mesh, classes, _shares(mesh, classes))
    return Coverage(surfaces, True)


def classify(
    points: np.ndarray, normals: np.ndarray, depth: "DepthMaps", world_from_camera: np.ndarray
) -> np.ndarray:
    """Return the class (v,) of vertices, rows of `CLASSES`.

    Args:
        points: (v, 3) world space.
        normals: (v, 3) unit, outward.
        depth: depth maps in metres; their confidence says measured (2) or completed (1).
        world_from_camera: (n, 4, 4) poses of the maps.
    """
    best = np.zeros(len(points), np.int64)
    for row, pose in enumerate(world_from_camera):
        open_ = np.flatnonzero(best < 2)
        if not len(open_):
            break
        towards = pose[:3, 3] - points[open_]
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9)
        open_ = open_[np.einsum("ij,ij->i", towards, normals[open_]) > _FACING]
        local = transform_points(invert_rigid(pose), points[open_])
        x, y, inside = _pixels(depth.camera, local)
        open_, z = open_[inside], local[inside, 2]
        found, confidence = depth.depth[row, y, x], depth.confidence[row, y, x]
        agrees = (found > 0) & (np.abs(found - z) < _AGREE_M + _AGREE_SHARE * z)
        best[open_] = np.maximum(best[open_], np.where(agrees, np.minimum(confidence, 2), 0))
    return best


def vertex_normals(mesh: Geometry) -> np.ndarray:
    """Return the area-weighted unit normals (v, 3) of a mesh; vertices at one place are separate."""
    corners = mesh.vertices[mesh.faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    out = np.zeros_like(mesh.vertices)
    for k in range(3):
        np.add.at(out, mesh.faces[:, k], area)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-30)


def _pixels(camera: "Camera", local: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    z = np.maximum(local[:, 2], 1e-6)
    columns, rows = camera.project(np.column_stack([local[:, :2], z]))
    inside = (
        (local[:, 2] > 0) & (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    )
    return columns[inside].astype(np.int64), rows[inside].astype(np.int64), inside


def _meshes(
    bundle: SceneBundle, assets: "AssetSet | None"
) -> Iterator[tuple[int, Geometry, np.ndarray, float]]:
    """Yield id, mesh, pose as reconstructed (before assembly, where known) and the bundle's share seen."""
    before = {} if assets is None else {a.id: a.world_from_object for a in assets.objects}
    for base, entry in zip(bundle.base, bundle.scene["base"], strict=True):
        mesh = _fine(read_geometry(bundle.resolve(base.mesh)), _ROOM_EDGE_M)
        yield base.id, mesh, np.eye(4), float(entry.get("observed_fraction", base.observed))
    for item in bundle.objects:
        mesh = _fine(read_geometry(bundle.resolve(item.visual)), _OBJECT_EDGE_M)
        pose = before.get(item.id, item.world_from_object)
        yield item.id, mesh, pose, float(item.provenance["observed_fraction"])


def _fine(mesh: Geometry, edge_m: float) -> Geometry:
    import trimesh

    fine = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, edge_m, max_iter=12)
    return Geometry(np.asarray(fine[0]), np.asarray(fine[1]))


def _by_share(mesh: Geometry, share: float) -> CoveredSurface:
    row = 2 if share >= 0.5 else 1 if share > 0 else 0
    classes = np.full(len(mesh.vertices), row)
    return CoveredSurface(mesh, classes, _shares(mesh, classes))


def _shares(mesh: Geometry, classes: np.ndarray) -> np.ndarray:
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    total = np.array([(area[:, None] * (classes[mesh.faces] == row)).sum() for row in range(3)])
    return total / max(total.sum(), 1e-12)
