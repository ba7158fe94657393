"""Contact shadows of robots, added and moved things: the ambient light that they keep from what is right below.

A shadow map looks from straight above: for each cell of the ground the share that casters cover, blurred, and the
height of their lowest points. A pixel is darkened by that share, less so the farther below the casters it is. What
stands as it was filmed casts none: its shadow is in the Gaussians.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import sapien

from simrecon_envs.robots import surface_points
from simrecon_envs.splats.kernels import compiled

_CELL_M = 0.015
_BLUR_M = 0.03  # standard deviation of the shadow's outline; chosen by eye, as are the next two
_REACH_M = 0.12  # height above a surface at which a caster's shadow ends
_DARKEST = 0.6  # share of the light that a large caster keeps away where it touches
_INSIDE_M = 0.01  # above a caster's lowest points its shadow fades over this height: accuracy of depth
_AROUND_M = 2.5  # what is farther from the first caster casts none: bounds the map


@dataclass(frozen=True)
class ShadowMap:
    """Coverage and lowest height of casters, seen from above. Rows run along world y, columns along world x."""

    origin: np.ndarray  # float64 (2,) world x and y of the first cell's corner, metres
    cover: np.ndarray  # float32 (ny, nx) covered share, 0 to 1
    lowest: (
        np.ndarray
    )  # float32 (ny, nx) world height of the casters' lowest points, metres; 0 where `cover` is


class Caster:
    """An actor or link with collision shapes."""

    def __init__(self, entity: sapien.Entity) -> None:
        """Sample points on the entity's collision shapes."""
        self._entity = entity
        body: Any = entity.find_component_by_type(sapien.physx.PhysxRigidBaseComponent)
        clouds = [np.zeros((0, 3))]
        for shape in body.collision_shapes if body is not None else ():
            pose = shape.local_pose.to_transformation_matrix()
            clouds.append(surface_points(shape, _CELL_M) @ pose[:3, :3].T + pose[:3, 3])
        points = np.concatenate(clouds)
        _, kept = np.unique(np.floor(points / _CELL_M), axis=0, return_index=True)
        self.points = points[np.sort(kept)]
        """Points (n, 3) in the entity's frame, metres."""

    def in_world(self) -> np.ndarray:
        """Return the points (n, 3) in world space, metres."""
        pose = self._entity.pose.to_transformation_matrix()
        return self.points @ pose[:3, :3].T + pose[:3, 3]


def shadow_map(points: np.ndarray) -> ShadowMap | None:
    """Return the shadow map of points (n, 3) on casters, world space, metres; None if there are none."""
    if len(points) == 0:
        return None
    points = points[(np.abs(points[:, :2] - points[0, :2]) < _AROUND_M).all(axis=1)]
    margin = 3 * _BLUR_M
    origin = points[:, :2].min(axis=0) - margin
    nx, ny = np.ceil((points[:, :2].max(axis=0) + margin - origin) / _CELL_M).astype(int) + 1
    lowest = np.full((ny, nx), np.inf, np.float32)
    _lower(points, origin, lowest)
    covered = np.isfinite(lowest).astype(np.float32)
    lowest[covered == 0] = 0
    cover = cv2.GaussianBlur(covered, (0, 0), _BLUR_M / _CELL_M)
    height = cv2.GaussianBlur(lowest, (0, 0), _BLUR_M / _CELL_M)
    return ShadowMap(origin, cover, np.divide(height, cover, out=np.zeros_like(height), where=cover > 1e-4))


@compiled()
def _lower(points, origin, lowest):
    """Lower each cell of `lowest` to the lowest of the points above it."""
    rows, columns = lowest.shape
    for p in range(len(points)):
        i, j = int((points[p, 1] - origin[1]) / _CELL_M), int((points[p, 0] - origin[0]) / _CELL_M)
        if 0 <= i < rows and 0 <= j < columns:
            lowest[i, j] = min(lowest[i, j], points[p, 2])


@compiled(nogil=True)
def darken(colors, depth_mm, receives, world_from_camera, intrinsics, origin, cover, lowest):
    """Darken the pixels below casters, in place.

    Args:
        colors: float32 (h, w, 3).
        depth_mm: int16 (h, w), 0 is nothing.
        receives: bool (h, w), the pixels that may be darkened.
        world_from_camera: float64 (4, 4), OpenCV camera axes.
        intrinsics: float64 (4,) fx, fy, cx, cy in pixels.
        origin: Of `ShadowMap`.
        cover: Of `ShadowMap`.
        lowest: Of `ShadowMap`.
    """
    m, rows, columns = world_from_camera, cover.shape[0], cover.shape[1]
    for v in range(len(colors)):
        for u in range(colors.shape[1]):
            z = 1e-3 * depth_mm[v, u]
            if z <= 0 or not receives[v, u]:
                continue
            x = (u + 0.5 - intrinsics[2]) / intrinsics[0] * z
            y = (v + 0.5 - intrinsics[3]) / intrinsics[1] * z
            across = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3] - origin[0]) / _CELL_M - 0.5
            along = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3] - origin[1]) / _CELL_M - 0.5
            if not (0 <= across < columns - 1 and 0 <= along < rows - 1):
                continue
            j, i = int(across), int(along)
            fx, fy = across - j, along - i
            share = (1 - fy) * ((1 - fx) * cover[i, j] + fx * cover[i, j + 1]) + fy * (
                (1 - fx) * cover[i + 1, j] + fx * cover[i + 1, j + 1]
            )
            above = lowest[i, j] - (m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3])
            if above < -_INSIDE_M or above > _REACH_M:
                continue
            near = 1 + above / _INSIDE_M if above < 0 else (1 - above / _REACH_M) ** 2
            light = np.float32(1 - _DARKEST * share * near)
            for c in range(3):
                colors[v, u, c] *= light
