"""Input of every step of the depth stage: keyframes, their view plan, settings and progress."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.core.types import Camera, PosedFrames
from reconstruction.core.workers import Workers
from reconstruction.depth.config import DepthConfig
from reconstruction.depth.views import ViewPlan
from registry.geometry import invert_rigid


@dataclass(frozen=True)
class DepthScene:
    """Keyframes whose depth is estimated, in any space and scale."""

    posed: PosedFrames
    camera: Camera  # at depth resolution
    plan: ViewPlan  # sources, neighbors and depth range of each view
    config: DepthConfig
    progress: Progress

    @property
    def count(self) -> int:
        """Return the number of views."""
        return len(self.posed.images)

    @property
    def shape(self) -> tuple[int, int]:
        """Return height and width of the depth maps."""
        return self.camera.height, self.camera.width

    def each(self, work: Callable[[int], None], label: str) -> None:
        """Run a function for every view, several at once; the label names the step to the user."""
        Workers(self.config.threads).each(self.count, work, label, self.progress)

    def neighbors(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the neighbors int (k,) of a view, -1 = none, and neighbor_from_view float64 (k, 4, 4)."""
        rows, poses = self.plan.neighbors[i], self.posed.world_from_camera
        return rows, invert_rigid(poses[np.maximum(rows, 0)]) @ poses[i]


def plane_warps(
    posed: PosedFrames, camera: Camera, i: int, sources: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the homographies of fronto-parallel planes from view i to sources, by inverse depth.

    Returns:
        h_inf float64 (s, 3, 3) and shift float64 (s, 3): pixel p of view i at inverse depth rho is seen at
        h_inf @ p + rho * shift in each source.
    """
    k, k_inv = camera.matrix, np.linalg.inv(camera.matrix)
    relative = invert_rigid(posed.world_from_camera[sources]) @ posed.world_from_camera[i]
    return k @ relative[:, :3, :3] @ k_inv, relative[:, :3, 3] @ k.T
