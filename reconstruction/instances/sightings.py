"""Keyframes as the partition reads them: image, measured depth, and the rendered depth and vertices of the surface."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.mesh_graph import lab_from_rgb
from reconstruction.core.types import Camera, DepthMaps, PosedFrames, Surface
from reconstruction.instances.colors import LIGHTNESS_WEIGHT
from reconstruction.instances.id_maps import seen_vertices
from reconstruction.poses.parallel import ordered_map
from registry.geometry import invert_rigid

_MAX_FRAMES = 36
_SLACK = 0.012  # of the depth: a point this far behind the rendered surface counts as visible


@dataclass(frozen=True)
class Sighting:
    """A keyframe at depth resolution."""

    camera: Camera
    camera_from_world: np.ndarray  # float64 (4, 4)
    eye: np.ndarray  # float64 (3,) camera center, world space
    picture: np.ndarray  # uint8 (h, w, 3) RGB
    lab: np.ndarray  # float32 (h, w, 3) weighted CIELAB
    measured: np.ndarray  # float32 (h, w) depth map
    drawn: np.ndarray  # float32 (h, w) rendered depth of the fused surface
    vertex: np.ndarray  # int32 (ceil(h / 2), ceil(w / 2)) surface vertex at every second pixel, -1 = none
    affinity: np.ndarray | None  # uint8 (6, ceil(h / 2), ceil(w / 2)), of `DepthMaps.affinity`

    def seen_at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Project world points (n, 3); return pixel rows and columns, clipped, and z-depth, 0 outside of the image."""
        camera, pose = self.camera, self.camera_from_world
        local = points @ pose[:3, :3].T + pose[:3, 3]
        z = np.maximum(local[:, 2], 1e-6)
        u, v = camera.project(np.column_stack([local[:, :2], z]))
        inside = (local[:, 2] > 0.1) & (u >= 1) & (v >= 1) & (u < camera.width - 1) & (v < camera.height - 1)
        row = np.clip(v, 0, camera.height - 1).astype(int)
        column = np.clip(u, 0, camera.width - 1).astype(int)
        return row, column, np.where(inside, local[:, 2], 0.0)

    def shown(self, row: np.ndarray, column: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return which points, projected by `seen_at`, the fused surface does not occlude."""
        return (z > 0) & (z < self.drawn[row, column] * (1.0 + _SLACK))


def sightings(surface: Surface, posed: PosedFrames, depth: DepthMaps) -> list[Sighting]:
    """Return up to 36 keyframes spread evenly over the film, with the fused surface rendered into each."""
    count, camera = len(posed.images), depth.camera

    def sighting(row: int) -> Sighting:
        pose = np.asarray(posed.world_from_camera[row], np.float64)
        image = cv2.resize(posed.images[row], (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        vertex, drawn = seen_vertices(surface, camera, pose)
        affinity = None if depth.affinity is None else np.asarray(depth.affinity[row])
        lab = lab_from_rgb(image) * LIGHTNESS_WEIGHT
        measured = np.asarray(depth.depth[row])
        every_second = np.ascontiguousarray(vertex[::2, ::2])
        return Sighting(
            camera, invert_rigid(pose), pose[:3, 3], image, lab, measured, drawn, every_second, affinity
        )  # fmt: skip

    rows = np.unique(np.linspace(0, count - 1, min(count, _MAX_FRAMES)).round().astype(int))
    return list(ordered_map(sighting, rows.tolist()))
