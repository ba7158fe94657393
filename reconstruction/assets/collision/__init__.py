"""Convex collision shapes within the visual bounds; hollow objects stay hollow, carrying surfaces level."""

from reconstruction.assets.collision.build import collision_parts
from reconstruction.assets.collision.decomposition import end_decomposer
from reconstruction.assets.collision.part_cache import kept_parts

__all__ = ("collision_parts", "end_decomposer", "kept_parts")
