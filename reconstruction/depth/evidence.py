"""Depth maps with the origin of each pixel's depth (the mending network's input), and counts of agreeing views."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.core.types import Camera, DepthMaps, PosedFrames
from registry.geometry import invert_rigid

COMPLETED, MEASURED, PREDICTED = 1, 2, 3
"""Origins of a pixel's depth; 0 = unknown."""
_SAME = 0.015  # relative difference of depths up to which a view sees the same point
_BEYOND = 1.025  # ratio of depths from which it looks through the point


@dataclass(frozen=True)
class Evidence:
    """Depth maps with the origin of every pixel's depth."""

    camera: Camera
    neighbors: np.ndarray  # int32 (n, k) views that see the same, best first, -1 = none
    depth: np.ndarray  # float32 (n, h, w), 0 = unknown
    origin: np.ndarray  # uint8 (n, h, w) of `depth`
    correlation: np.ndarray  # float32 (n, h, w) of the windows' refinement, -1 = none
    surety: np.ndarray  # float32 (n, h, w) of the learned aggregation, empty without it
    agreed: np.ndarray  # float32 (n, h, w) depth before completion, 0 = unknown; empty unless asked for
    affinity: np.ndarray | None = None  # as `DepthMaps.affinity`, once mended

    def maps(self) -> DepthMaps:
        """Return the maps; predicted depth counts as completed."""
        confidence = np.where(self.origin == PREDICTED, COMPLETED, self.origin).astype(np.uint8)
        return DepthMaps(self.camera, self.depth, confidence, self.affinity)


def inverse(values: np.ndarray) -> np.ndarray:
    """Return 1 / values as float32, 0 where there is none: depth to inverse depth, and back."""
    return np.where(values > 0, 1.0 / np.maximum(values, 1e-12), 0).astype(np.float32)


def count_views(
    depth: np.ndarray,
    posed: PosedFrames,
    camera: Camera,
    neighbors: np.ndarray,
    each: Callable,
    progress: Progress = NO_PROGRESS,
    mask: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Count for every pixel the views that see the same point, and those that look through it; uint8 (n, h, w) both.

    Args:
        depth: (n, h, w), 0 = unknown.
        posed: Their frames.
        camera: At the depth maps' resolution.
        neighbors: (n, k) views to ask, -1 = none.
        each: Runs a function for every frame: each(n, work, label, progress).
        progress: Where the steps are reported.
        mask: bool (n, h, w) pixels to ask about; None: all with depth.
    """
    from reconstruction.depth.consistency import count_witnesses

    agree, through = np.zeros(depth.shape, np.uint8), np.zeros(depth.shape, np.uint8)

    def work(i: int) -> None:
        rows = neighbors[i]
        relative = invert_rigid(posed.world_from_camera[np.maximum(rows, 0)]) @ posed.world_from_camera[i]
        asked = depth[i] > 0 if mask is None else mask[i]
        count_witnesses(
            i, rows, depth, asked, relative, camera.intrinsics, _BEYOND, _SAME, agree[i], through[i]
        )

    each(len(depth), work, "counting views", progress)
    return agree, through
