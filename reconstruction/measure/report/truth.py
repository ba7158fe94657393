"""Compare with ground truth: true depth and ids of a frame, distances to the true surface."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.spatial import KDTree

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera
from reconstruction.measure.alignment import Alignment, align
from reconstruction.measure.ground_truth import GroundTruth
from reconstruction.measure.scene import bundle_poses
from reconstruction.measure.surfaces import Samples, sample
from reconstruction.measure.visibility import seen_points
from registry import SceneBundle
from registry.geometry import transform_points

_SAMPLES = 400_000  # of the true surface
_SEEN_FROM = 24  # number of true cameras for visibility


@dataclass(frozen=True)
class Truth:
    """The ground truth of a scene, and the similarity from the scene's world to the true one."""

    known: GroundTruth
    alignment: Alignment

    @classmethod
    def of(cls, bundle: SceneBundle, ground_truth: GroundTruth) -> "Truth":
        """Align a bundle with its ground truth.

        Raises:
            UsageError: the truth is not of the same video.
        """
        return cls(ground_truth, align(bundle_poses(bundle), ground_truth.world_from_camera, ground_truth.up))

    @property
    def has_meshes(self) -> bool:
        """Whether the truth has meshes, not just cameras and depth images."""
        return bool(self.known.entities)

    @property
    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """All true surfaces as one mesh: vertices (v, 3), true world; faces (f, 3)."""
        return self.known.mesh

    @cached_property
    def mesh_in_scene(self) -> tuple[np.ndarray, np.ndarray]:
        """The same mesh in the scene's world."""
        vertices, faces = self.mesh
        return transform_points(np.linalg.inv(self.alignment.true_from_estimated), vertices), faces

    def frame(
        self, index: int, pose: np.ndarray, camera: Camera
    ) -> tuple[np.ndarray, np.ndarray | None] | None:
        """Return true depth (metres) and entity ids of a video frame, at the size of `camera`; None if unknown.

        They come from the truth's images, or else from its meshes, rendered at the aligned `pose`.
        """
        depth, ids = self.known.depth(index), self.known.instances(index)
        if depth is not None and (ids is not None or not self.has_meshes):
            size = (camera.width, camera.height)
            depth = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST)
            return depth, None if ids is None else cv2.resize(ids, size, interpolation=cv2.INTER_NEAREST)
        if not self.has_meshes:
            return None
        raster = rasterize_mesh(*self.mesh, camera, self.alignment.pose_to_true(pose))
        ids = np.where(raster.face >= 0, self.known.face_ids[np.maximum(raster.face, 0)], 0)
        return raster.depth, ids.astype(np.uint16)

    def seen(self, points: np.ndarray) -> np.ndarray:
        """Return which points (n, 3) of the true surface, true world, are visible in the video within 5 m."""
        poses = self.known.poses
        return seen_points(points, *self.mesh, self.known.camera, poses[:: max(1, len(poses) // _SEEN_FROM)])

    @cached_property
    def _surface(self) -> "NearSurface":
        return NearSurface(sample(*self.mesh, _SAMPLES))

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distances (n,), in true metres, of points (n, 3) of the scene's world to the true surface."""
        return self._surface.distance(self.alignment.to_true(points))


class NearSurface:
    """Distances to a sampled surface: point-to-plane at the nearest sample, to reduce the effect of their spacing."""

    def __init__(self, samples: Samples) -> None:
        self._samples, self._tree = samples, KDTree(samples.points)
        pairs, _ = self._tree.query(samples.points[:: max(1, len(samples.points) // 2000)], k=2)
        self._spacing_m = 3 * float(np.median(pairs[:, 1]))

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distances (n,) of points (n, 3) to the surface."""
        distance, nearest = self._tree.query(points, workers=-1)
        offset = np.asarray(points) - self._samples.points[nearest]
        height = np.abs(np.einsum("nc,nc->n", offset, self._samples.normals[nearest]))
        sideways = np.sqrt(np.maximum(distance**2 - height**2, 0))
        return np.where(sideways < self._spacing_m, height, distance)
