"""Stage 5: posed frames and depth maps -> 2D Gaussians, and the depth that they show."""

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
    """What the stage makes, in `sfm` space, so that another scale or floor does not ask for another fit."""

    gaussians: Gaussians
    depth: DepthMaps  # of the keyframes, corrected by the Gaussians; later stages use it

    def in_world(self, world: WorldFrame) -> Gaussians:
        """Return the Gaussians in world space, in metres."""
        return moved(self.gaussians, world.world_from_sfm)

    def posed(self, posed: PosedFrames) -> PosedFrames:
        """Return the keyframes with the cameras that the Gaussians were fitted with (refined where asked for)."""
        return replace(posed, world_from_camera=np.asarray(self.gaussians.world_from_camera, np.float64))


def make_gaussians(
    posed: PosedFrames,
    depth: DepthMaps,
    config: GaussiansConfig,
    *,
    progress: Progress = NO_PROGRESS,
) -> GaussianScene:
    """Fit Gaussians and render the depth maps anew from them.

    Args:
        posed: keyframes with cameras, in any space; kept-out frames are not looked at.
        depth: one depth map per keyframe, in the same units.
        config: settings; `refine_depth=False` hands the depth maps on as they are.
        progress: told of steps and decisions.

    Raises:
        InputError: there is no usable depth.
        EnvironmentMissing: the backend's needs are not met.
    """
    gaussians = fit_gaussians(posed, depth, config, progress=progress)
    if not config.refine_depth:
        return GaussianScene(gaussians, depth)
    settings = settings_of(config, median_depth_of(depth))
    backend = load_backend(config.backend)
    return GaussianScene(
        gaussians, rendered_depth_maps(gaussians, posed, depth, config, settings, backend, progress)
    )
