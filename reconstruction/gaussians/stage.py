"""Stage 5: fit 2D Gaussians to posed frames and depth maps, and refine the depth maps with them."""

from dataclasses import dataclass, replace

import numpy as np

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.core.types import DepthMaps, PosedFrames, WorldFrame
from reconstruction.gaussians.backends import load_backend
from reconstruction.gaussians.config import GaussiansConfig
from reconstruction.gaussians.depth_maps import rendered_depth_maps
from reconstruction.gaussians.fit import fit_gaussians, median_depth_of, settings_of
from reconstruction.gaussians.model import Gaussians, moved


@dataclass(frozen=True)
class GaussianScene:
    """Gaussians and refined depth in `sfm` space, so that a change of scale or floor needs no new fit."""

    gaussians: Gaussians
    depth: DepthMaps  # of the keyframes, for later stages

    def in_world(self, world: WorldFrame) -> Gaussians:
        """Return the Gaussians in world space, in metres."""
        return moved(self.gaussians, world.world_from_sfm)

    def posed(self, posed: PosedFrames) -> PosedFrames:
        """Return the keyframes with the Gaussians' cameras (optimized, if `optimize_poses`)."""
        return replace(posed, world_from_camera=np.asarray(self.gaussians.world_from_camera, np.float64))


def make_gaussians(
    posed: PosedFrames, depth: DepthMaps, config: GaussiansConfig, *, progress: Progress = NO_PROGRESS
) -> GaussianScene:
    """Fit Gaussians and refine the depth maps by rendering them.

    Args:
        posed: keyframes with cameras, in any space; held-out frames are not used.
        depth: one depth map per keyframe, in the same units.
        config: settings; with `refine_depth=False` depth maps stay unchanged.
        progress: receives steps and notes.

    Raises:
        InputError: there is no usable depth.
        EnvironmentMissing: the backend's requirements are not met.
    """
    gaussians = fit_gaussians(posed, depth, config, progress=progress)
    if not config.refine_depth:
        return GaussianScene(gaussians, depth)
    settings = settings_of(config, median_depth_of(depth))
    backend = load_backend(config.backend)
    refined = rendered_depth_maps(gaussians, posed, depth, config, settings, backend, progress)
    return GaussianScene(gaussians, refined)
