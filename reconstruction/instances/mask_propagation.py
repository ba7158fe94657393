"""Mask propagation: masks of some frames in, ids of keyframes without masks out, by reprojection of their pixels.

The id of a pixel drawn from the surface is as good as the surface; a mask follows the picture. Between frames that are
near each other depth need not be exact to say which pixel of the one is which of the other.
"""

import numpy as np
from numba import njit, prange

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera, DepthMaps, PosedFrames, Surface
from reconstruction.instances.lifting_views import nearest_views, project
from reconstruction.instances.masks.base import FrameMasks
from registry.geometry import invert_rigid

_ASKED = 4  # frames with masks
_SAME_M = 0.02  # frames that are nearer than this count alike
_HIDDEN = 0.015  # of depth: what lies so far behind the surface drawn there is hidden


class MaskPropagation:
    """Propagates masks of some frames to keyframes, by reprojection."""

    def __init__(self, told: FrameMasks, surface: Surface) -> None:
        """Draw the surface into the frames of the masks.

        Args:
            told: what each pixel shows; 0 = nothing is said.
            surface: what hides what.
        """
        self._told = told
        self._camera_from_world = np.stack([invert_rigid(p) for p in told.world_from_camera])
        self._drawn = np.stack(
            [
                rasterize_mesh(surface.vertices, surface.faces, told.camera, pose).depth
                for pose in told.world_from_camera
            ]
        ).astype(np.float32)

    def ids(self, drawn: np.ndarray, posed: PosedFrames, depth: DepthMaps, row: int) -> np.ndarray:
        """Return uint16 (h, w) ids of a keyframe: as the masks say, as `drawn` (h, w) where they say nothing."""
        pose = np.asarray(posed.world_from_camera[row], np.float64)
        near, away = nearest_views(pose, self._told.world_from_camera, _ASKED)
        return _ask(
            drawn, np.ascontiguousarray(depth.depth[row], np.float32), pose, _intrinsics(depth.camera),
            self._camera_from_world[near], _intrinsics(self._told.camera), self._told.ids[near], self._drawn[near],
            1.0 / (away + _SAME_M), _HIDDEN,
        )  # fmt: skip


def _intrinsics(camera: Camera) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])


@njit(cache=True, parallel=True)
def _ask(
    ids, depth, world_from_camera, own, others, their, told, drawn, weights, hidden
):  # pragma: no cover - compiled
    """Return the id of each pixel that the frames asked give most weight to; the one drawn where none has a say."""
    height, width = depth.shape
    count = others.shape[0]
    out = ids.copy()
    for y in prange(height):
        names, sums = np.zeros(count, np.int64), np.zeros(count)
        for x in range(width):
            z = depth[y, x]
            if z <= 0:
                continue
            a, b = (x + 0.5 - own[2]) / own[0] * z, (y + 0.5 - own[3]) / own[1] * z
            m = world_from_camera
            point = (
                m[0, 0] * a + m[0, 1] * b + m[0, 2] * z + m[0, 3],
                m[1, 0] * a + m[1, 1] * b + m[1, 2] * z + m[1, 3],
                m[2, 0] * a + m[2, 1] * b + m[2, 2] * z + m[2, 3],
            )
            used = 0
            for f in range(count):
                u, v, there = project(point, others[f], their[0], their[1], their[2], their[3])
                if not (there > 0.0 and 0.0 <= u < told.shape[2] and 0.0 <= v < told.shape[1]):
                    continue
                column, row = int(u), int(v)
                surface = drawn[f, row, column]
                name = told[f, row, column]
                if name == 0 or (surface > 0.0 and there > surface * (1.0 + hidden)):
                    continue
                slot = 0
                while slot < used and names[slot] != name:
                    slot += 1
                if slot == used:
                    names[slot], sums[slot] = name, 0.0
                    used += 1
                sums[slot] += weights[f]
            best = 0
            for slot in range(1, used):
                if sums[slot] > sums[best]:
                    best = slot
            if used > 0:
                out[y, x] = names[best]
    return out
