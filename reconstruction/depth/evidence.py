"""What is known of every keyframe's depth before the mending network judges it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from reconstruction.progress import NO_PROGRESS, Progress
from reconstruction.types import Camera, PosedFrames
from registry.geometry import invert_rigid

COMPLETED, MEASURED, PREDICTED = 1, 2, 3
"""Origins of a pixel's depth; 0 = unknown."""
_SAME, _BEYOND = (
    0.015,
    1.025,
)  # relative difference up to which a view sees the same; ratio from which it looks through


@dataclass(frozen=True)
class Evidence:
    """Depth maps with the origin of every pixel's depth."""

    camera: Camera
    neighbors: np.ndarray  # int32 (n, k) views that see the same, best first, -1 = none
    agreed: np.ndarray  # float32 (n, h, w) what was measured and confirmed by other views, 0 = unknown
    depth: np.ndarray  # float32 (n, h, w) the same after completion, 0 = unknown
    origin: np.ndarray  # uint8 (n, h, w) of `depth`
    correlation: np.ndarray  # float32 (n, h, w) of the windows' refinement, -1 = none
    surety: np.ndarray  # float32 (n, h, w) of the learned aggregation, empty without it


def count_views(
    depth: np.ndarray,
    posed: PosedFrames,
    camera: Camera,
    neighbors: np.ndarray,
    each: Callable,
    progress: Progress = NO_PROGRESS,
) -> tuple[np.ndarray, np.ndarray]:
    """Count for every pixel the views that see the same point, and those that look through it; uint8 (n, h, w) both.

    Args:
        depth: (n, h, w), 0 = unknown.
        posed: Their frames.
        camera: At the depth maps' resolution.
        neighbors: (n, k) views to ask, -1 = none.
        each: Runs a function for every frame: each(n, work, label, progress).
        progress: Where the steps are reported.
    """
    from reconstruction.depth.consistency import count_witnesses

    k = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    agree, through = np.zeros(depth.shape, np.uint8), np.zeros(depth.shape, np.uint8)

    def work(i: int) -> None:
        rows = neighbors[i]
        relative = invert_rigid(posed.world_from_camera[np.maximum(rows, 0)]) @ posed.world_from_camera[i]
        count_witnesses(i, rows, depth, depth[i] > 0, relative, k, _BEYOND, _SAME, agree[i], through[i])

    each(len(depth), work, "counting views", progress)
    return agree, through
