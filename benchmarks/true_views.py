"""Evaluate viewpoints in the true scene: visible surface, occlusion, and whether the position is free."""

from collections.abc import Mapping, Sequence

import numpy as np

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera
from reconstruction.measure.ground_truth import GroundTruth, TrueEntity
from reconstruction.measure.surfaces import sample
from reconstruction.measure.visibility import seen_points

_POINTS = 3000  # samples per object
_HIDDEN_SIDE_PX = 320  # longer side of the images in which occlusion is counted
_INSIDE = 0.5  # winding number, above which a point is inside of a mesh


class TrueViews:
    """Evaluates viewpoints in the true scene."""

    def __init__(self, truth: GroundTruth) -> None:
        self.truth = truth
        self.vertices, self.faces = truth.mesh

    def points_of(self, entity: TrueEntity) -> np.ndarray:
        """Sample the complete surface of an entity: points (n, 3)."""
        return sample(entity.mesh.vertices, entity.mesh.faces, _POINTS).points

    def seen(self, points: np.ndarray, camera: Camera, world_from_camera: np.ndarray) -> np.ndarray:
        """Return which points (n, 3) on an entity are visible to a camera, with occlusion by the whole scene."""
        return seen_points(points, self.vertices, self.faces, camera, [world_from_camera])

    def seen_by_any(
        self, points: Mapping[int, np.ndarray], camera: Camera, world_from_camera: Sequence[np.ndarray]
    ) -> dict[int, np.ndarray]:
        """Return per id which points (n, 3) of an entity are visible to at least one camera."""
        if not points:
            return {}
        seen = seen_points(
            np.concatenate(list(points.values())), self.vertices, self.faces, camera, world_from_camera
        )
        ends = np.cumsum([len(p) for p in points.values()])[:-1]
        return dict(zip(points, np.split(seen, ends)))

    def hidden_shares(self, world_from_camera: Sequence[np.ndarray]) -> dict[int, float]:
        """Return per id the share of an object's silhouette that other entities occlude, over poses of the true camera.

        Silhouettes are clipped to the image. Objects outside of all images are left out.
        """
        scale = _HIDDEN_SIDE_PX / max(self.truth.camera.width, self.truth.camera.height)
        camera = self.truth.camera.resized(
            round(self.truth.camera.width * scale), round(self.truth.camera.height * scale)
        )
        things = [e for e in self.truth.entities if not e.base]
        visible, whole = np.zeros(len(things)), np.zeros(len(things))
        for pose in world_from_camera:
            face = rasterize_mesh(self.vertices, self.faces, camera, pose).face
            shown = self.truth.face_ids[face[face >= 0]]
            for row, entity in enumerate(things):
                visible[row] += (shown == entity.id).sum()
                alone = rasterize_mesh(entity.mesh.vertices, entity.mesh.faces, camera, pose).face
                whole[row] += (alone >= 0).sum()
        return {
            entity.id: float(1.0 - min(visible[row] / whole[row], 1.0))
            for row, entity in enumerate(things)
            if whole[row] > 0
        }

    def inside(self, eye: np.ndarray) -> str | None:
        """Return the entity that contains `eye` (3,), "behind NAME" for a base surface before it, or None if free."""
        for entity in self.truth.entities:
            vertices, faces = np.asarray(entity.mesh.vertices), np.asarray(entity.mesh.faces)
            if abs(winding_number(eye, vertices, faces)) > _INSIDE:
                return entity.name
            if entity.base and self._behind(eye, vertices):
                return f"behind {entity.name}"
        return None

    def _behind(self, eye: np.ndarray, vertices: np.ndarray) -> bool:
        """Return whether a base surface, thin along one axis, lies between the eye and the true cameras."""
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        axis = int(np.argmin(high - low))
        filmed = float(np.mean([pose[axis, 3] for pose in self.truth.world_from_camera.values()]))
        return bool(eye[axis] > high[axis]) if filmed < low[axis] else bool(eye[axis] < low[axis])


def winding_number(point: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> float:
    """Compute the winding number of a mesh around a point (3,): 1 inside of a closed mesh, 0 outside.

    Sums the solid angles of the triangles (Van Oosterom and Strackee 1983).
    """
    a, b, c = (vertices[faces[:, k]] - point for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    ab, bc, ca = (np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a)))
    return float(2.0 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum() / (4.0 * np.pi))
