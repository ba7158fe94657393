"""Mask propagation: ids of keyframes by reprojecting their pixels into nearby frames that have masks.

Masks follow image edges more closely than the rendered surface does. Between nearby frames the reprojection tolerates
inexact depth.
"""

import numpy as np
from numba import njit, prange

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import DepthMaps, PosedFrames, Surface
from reconstruction.instances.lifting_views import nearest_views, project
from reconstruction.instances.masks.base import FrameMasks
from registry.geometry import invert_rigid

_SOURCES = 4  # nearest frames with masks that vote for a pixel
_SAME_M = 0.02  # added to the distance of a source, so that close ones have similar weights
_HIDDEN = 0.015  # of the depth: a point this far behind the rendered surface is occluded


class MaskPropagation:
    """Propagates masks of some frames to keyframes, by reprojection."""

    def __init__(self, labeled: FrameMasks, surface: Surface) -> None:
        """Render the surface into the frames of the masks (ids of instances, 0 = unknown), for occlusion tests."""
        self._labeled = labeled
        poses = labeled.world_from_camera
        self._camera_from_world = np.stack([invert_rigid(pose) for pose in poses])
        vertices, faces = surface.vertices, surface.faces
        depths = [rasterize_mesh(vertices, faces, labeled.camera, pose).depth for pose in poses]
        self._drawn = np.stack(depths).astype(np.float32)

    def ids(self, drawn: np.ndarray, posed: PosedFrames, depth: DepthMaps, row: int) -> np.ndarray:
        """Return ids uint16 (h, w) of a keyframe from the masks, and from `drawn` (h, w) where no mask votes."""
        pose = np.asarray(posed.world_from_camera[row], np.float64)
        near, away = nearest_views(pose, self._labeled.world_from_camera, _SOURCES)
        return _vote(
            drawn, np.ascontiguousarray(depth.depth[row], np.float32), pose, depth.camera.intrinsics,
            self._camera_from_world[near], self._labeled.camera.intrinsics, self._labeled.ids[near], self._drawn[near],
            1.0 / (away + _SAME_M), _HIDDEN,
        )  # fmt: skip


@njit(cache=True, parallel=True)
def _vote(
    ids, depth, world_from_camera, own, others, their, told, drawn, weights, hidden
):  # pragma: no cover - compiled
    """Return the id of each pixel with the largest sum of votes in the other frames, or its own id without votes."""
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
