"""Viewpoints by the truth: how much of a thing's real surface they see, and whether a camera can be there."""

from collections.abc import Mapping, Sequence

import numpy as np

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera
from reconstruction.measure.ground_truth import GroundTruth, TrueEntity
from reconstruction.measure.scene import joined
from reconstruction.measure.surfaces import sample
from reconstruction.measure.visibility import seen_points

_POINTS = 3000
_HIDDEN_SIDE_PX = 320
_INSIDE = 0.5  # winding number


class TrueViews:
    """Measures viewpoints in the true scene; the meshes are joined once."""

    def __init__(self, truth: GroundTruth) -> None:
        self.truth = truth
        self.vertices, self.faces = joined([e.mesh for e in truth.entities])
        counts = [len(e.mesh.faces) for e in truth.entities]
        self._face_entity = np.repeat([e.id for e in truth.entities], counts)

    def points_of(self, entity: TrueEntity) -> np.ndarray:
        """Return points (n, 3), evenly on the whole surface of a thing."""
        return sample(entity.mesh.vertices, entity.mesh.faces, _POINTS).points

    def seen(self, points: np.ndarray, camera: Camera, world_from_camera: np.ndarray) -> np.ndarray:
        """Tell which points on a thing (n, 3) a camera sees, past everything that is there."""
        return seen_points(points, self.vertices, self.faces, camera, [world_from_camera])

    def seen_by_any(
        self, points: Mapping[int, np.ndarray], camera: Camera, world_from_camera: Sequence[np.ndarray]
    ) -> dict[int, np.ndarray]:
        """Tell by id which points (n, 3) of each thing some of the cameras see."""
        if not points:
            return {}
        seen = seen_points(
            np.concatenate(list(points.values())), self.vertices, self.faces, camera, world_from_camera
        )
        ends = np.cumsum([len(p) for p in points.values()])[:-1]
        return dict(zip(points, np.split(seen, ends)))

    def hidden_shares(self, world_from_camera: Sequence[np.ndarray]) -> dict[int, float]:
        """Return by id how much of each thing's outline other things hide, over these poses of the input camera.

        Both outlines end where the picture ends. Things that no pose has in its picture are left out.
        """
        scale = _HIDDEN_SIDE_PX / max(self.truth.camera.width, self.truth.camera.height)
        camera = self.truth.camera.resized(
            round(self.truth.camera.width * scale), round(self.truth.camera.height * scale)
        )
        things = [e for e in self.truth.entities if not e.base]
        visible, whole = np.zeros(len(things)), np.zeros(len(things))
        for pose in world_from_camera:
            face = rasterize_mesh(self.vertices, self.faces, camera, pose).face
            shown = self._face_entity[face[face >= 0]]
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
        """Return the name of what a camera at `eye` (3,) is inside of, or of the wall or floor that it is behind."""
        for entity in self.truth.entities:
            vertices, faces = np.asarray(entity.mesh.vertices), np.asarray(entity.mesh.faces)
            if abs(winding_number(eye, vertices, faces)) > _INSIDE:
                return entity.name
            if entity.base and self._behind(eye, vertices):
                return f"behind {entity.name}"
        return None

    def _behind(self, eye: np.ndarray, vertices: np.ndarray) -> bool:
        """Tell whether a flat piece of the base lies between the eye and the cameras that filmed."""
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        axis = int(np.argmin(high - low))
        filmed = float(np.mean([pose[axis, 3] for pose in self.truth.world_from_camera.values()]))
        return bool(eye[axis] > high[axis]) if filmed < low[axis] else bool(eye[axis] < low[axis])


def winding_number(point: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return how often a mesh winds around a point (3,): 1 inside of a closed one, 0 outside."""
    a, b, c = (vertices[faces[:, k]] - point for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    ab, bc, ca = (np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a)))
    return float(2.0 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum() / (4.0 * np.pi))
