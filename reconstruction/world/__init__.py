"""Stage 4: estimate the world frame (gravity, yaw, floor, metric scale) from posed frames and depth maps."""

from reconstruction.world.config import WORLD_PRESETS, WorldConfig
from reconstruction.world.frame import find_world, rescale_for_object
from reconstruction.world.object_scale import settle_object_height
from reconstruction.world.request import ScaleRequest, parse_scale

__all__ = [
    "WORLD_PRESETS",
    "ScaleRequest",
    "WorldConfig",
    "find_world",
    "parse_scale",
    "rescale_for_object",
    "settle_object_height",
]
