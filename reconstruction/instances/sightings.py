"""Keyframes beside the fused surface: what each measured, and what of the surface it shows."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.instances.colors import LIGHTNESS_WEIGHT
from reconstruction.rasterize import rasterize_mesh
from reconstruction.surface.mesh_graph import lab_from_rgb
from reconstruction.types import Camera, DepthMaps, PosedFrames, Surface
from registry.geometry import invert_rigid

_MAX_FRAMES = 36
_SLACK = 0.012  # of depth: surface this far behind what is drawn is seen all the same
_AGREES = 0.015  # of depth: measured depth this near to a vertex confirms it
_LEAST_CONFIRMED = 0.3  # of the frames that see a vertex
_LEAST_COSINE = 0.2  # between its normal and the line of sight of the frame that faces it best


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
    out = []
    for row in np.unique(np.linspace(0, count - 1, min(count, _MAX_FRAMES)).round().astype(int)):
        pose = np.asarray(posed.world_from_camera[row], np.float64)
        image = cv2.resize(posed.images[row], (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        raster = rasterize_mesh(surface.vertices, surface.faces, camera, pose)
        face, corner = raster.face[::2, ::2], raster.barycentric[::2, ::2].argmax(axis=2)
        vertex = np.full(face.shape, -1, np.int32)
        vertex[face >= 0] = surface.faces[face[face >= 0], corner[face >= 0]]
        affinity = None if depth.affinity is None else np.asarray(depth.affinity[row])
        lab = lab_from_rgb(image) * LIGHTNESS_WEIGHT
        measured = np.asarray(depth.depth[row])
        out.append(
            Sighting(camera, invert_rigid(pose), pose[:3, 3], lab, measured, raster.depth, vertex, affinity)
        )
    return out


def unconfirmed(points: np.ndarray, normals: np.ndarray, frames: list[Sighting]) -> np.ndarray:
    """Return which vertices of the fused surface the frames speak against.

    Between the outline of a thing and what is behind it depth fills in sheets. They run along the lines of sight, so
    that every frame sees them at a slant, most frames measure another depth where they show, and those behind the
    thing show in no frame at all. A surface that is there has been seen, and is measured again and again.

    Args:
        points: float64 (n, 3) vertices.
        normals: float64 (n, 3) theirs.
        frames: keyframes, the surface drawn into them.

    Returns:
        bool (n,).
    """
    shown, agreed, facing = np.zeros(len(points)), np.zeros(len(points)), np.full(len(points), -1.0)
    for frame in frames:
        row, column, z = frame.seen_at(points)
        there = np.flatnonzero(frame.shown(row, column, z))
        measured, z = frame.measured[row[there], column[there]], z[there]
        rays = frame.eye - points[there]
        cosine = (rays * normals[there]).sum(axis=1) / np.maximum(np.linalg.norm(rays, axis=1), 1e-9)
        shown[there] += 1
        agreed[there] += (measured > 0) & (np.abs(measured - z) < _AGREES * z)
        facing[there] = np.maximum(facing[there], cosine)
    return (shown == 0) | (agreed < _LEAST_CONFIRMED * shown) | (facing < _LEAST_COSINE)
