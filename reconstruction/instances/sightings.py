"""Keyframes beside the fused surface: what each measured, and what of the surface it shows."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.mesh_graph import lab_from_rgb
from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera, DepthMaps, PosedFrames, Surface
from reconstruction.instances.colors import LIGHTNESS_WEIGHT
from reconstruction.poses.parallel import ordered_map
from registry.geometry import invert_rigid

_MAX_FRAMES = 36
_SLACK = 0.012  # of depth: surface this far behind what is drawn is seen all the same


@dataclass(frozen=True)
class Sighting:
    """A keyframe at depth resolution."""

    camera: Camera
    camera_from_world: np.ndarray  # float64 (4, 4)
    eye: np.ndarray  # float64 (3,)
    lab: np.ndarray  # float32 (h, w, 3) weighted CIELAB
    measured: np.ndarray  # float32 (h, w) depth
    drawn: np.ndarray  # float32 (h, w) depth of the fused surface
    vertex: (
        np.ndarray
    )  # int32 (ceil(h / 2), ceil(w / 2)) vertex nearest to what every second pixel shows, -1 = none
    affinity: np.ndarray | None  # uint8 (6, ceil(h / 2), ceil(w / 2)), of `DepthMaps.affinity`

    def seen_at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the pixel row and column of points (n, 3), clipped, and their z-depth, 0 where they are outside."""
        camera, pose = self.camera, self.camera_from_world
        local = points @ pose[:3, :3].T + pose[:3, 3]
        z = np.maximum(local[:, 2], 1e-6)
        u, v = camera.fx * local[:, 0] / z + camera.cx, camera.fy * local[:, 1] / z + camera.cy
        inside = (local[:, 2] > 0.1) & (u >= 1) & (v >= 1) & (u < camera.width - 1) & (v < camera.height - 1)
        row = np.clip(v, 0, camera.height - 1).astype(int)
        column = np.clip(u, 0, camera.width - 1).astype(int)
        return row, column, np.where(inside, local[:, 2], 0.0)

    def shown(self, row: np.ndarray, column: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return which points, as `seen_at` found them, nothing of the fused surface hides."""
        return (z > 0) & (z < self.drawn[row, column] * (1.0 + _SLACK))


def sightings(surface: Surface, posed: PosedFrames, depth: DepthMaps) -> list[Sighting]:
    """Return keyframes spread over the film, the fused surface drawn into each."""
    count, camera = len(posed.images), depth.camera

    def sighting(row: int) -> Sighting:
        pose = np.asarray(posed.world_from_camera[row], np.float64)
        image = cv2.resize(posed.images[row], (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        raster = rasterize_mesh(surface.vertices, surface.faces, camera, pose)
        face, corner = raster.face[::2, ::2], raster.barycentric[::2, ::2].argmax(axis=2)
        vertex = np.full(face.shape, -1, np.int32)
        vertex[face >= 0] = surface.faces[face[face >= 0], corner[face >= 0]]
        affinity = None if depth.affinity is None else np.asarray(depth.affinity[row])
        lab = lab_from_rgb(image) * LIGHTNESS_WEIGHT
        measured = np.asarray(depth.depth[row])
        return Sighting(
            camera, invert_rigid(pose), pose[:3, 3], lab, measured, raster.depth, vertex, affinity
        )

    rows = np.unique(np.linspace(0, count - 1, min(count, _MAX_FRAMES)).round().astype(int))
    return list(ordered_map(sighting, rows))
