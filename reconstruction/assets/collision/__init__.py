"""Collision shapes: convex parts within the visual bounds, hollow things hollow, what carries level."""

from reconstruction.assets.collision.build import collision_parts

__all__ = ("collision_parts",)
