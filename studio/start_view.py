"""The camera that a page opens with: where the person who filmed saw most of the scene."""

from dataclasses import dataclass

import numpy as np

from registry import SceneBundle
from registry.geometry import invert_rigid

_FOV_RAD = 1.1  # vertical; wider than most phones, so that the room is seen around the objects
_FAR_M = 2.0  # of a scene without cameras
_BACK_M, _UP_M = 0.45, 0.15  # behind the recorded camera, so that the other cameras are in view


@dataclass(frozen=True)
class StartView:
    """A camera, world space."""

    position: np.ndarray  # float64 (3,)
    look_at: np.ndarray  # float64 (3,)
    fov: float  # vertical, radians


def start_view(bundle: SceneBundle) -> StartView:
    """Choose the recorded camera that has most objects in view, of several the one farthest from their middle."""
    centers = np.array([o.world_from_object[:3, 3] for o in bundle.objects]).reshape(-1, 3)
    middle = np.median(centers, axis=0) if len(centers) else np.array([0.0, 0.0, 0.5])
    cameras = bundle.cameras
    if not len(cameras.world_from_camera):
        return StartView(middle + _FAR_M * np.array([1.0, -1.0, 0.8]), middle, _FOV_RAD)
    fx, fy, cx, cy = cameras.params[:4]
    scores = []
    for world_from_camera in cameras.world_from_camera:
        camera_from_world = invert_rigid(world_from_camera)
        points = centers @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        z = np.maximum(points[:, 2], 1e-6)
        columns, rows = fx * points[:, 0] / z + cx, fy * points[:, 1] / z + cy
        inside = (
            (points[:, 2] > 0)
            & (columns > 0)
            & (columns < cameras.width)
            & (rows > 0)
            & (rows < cameras.height)
        )
        scores.append((int(inside.sum()), float(np.linalg.norm(world_from_camera[:3, 3] - middle))))
    best = cameras.world_from_camera[max(range(len(scores)), key=scores.__getitem__)]
    away = best[:3, 3] - middle
    away[2] = 0.0
    back = away / max(float(np.linalg.norm(away)), 1e-6) * _BACK_M
    return StartView(best[:3, 3] + back + np.array([0.0, 0.0, _UP_M]), middle, _FOV_RAD)
