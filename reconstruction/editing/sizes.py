"""Sizes that the user gives to objects: `size_m` of an overrides file."""

from dataclasses import replace
from typing import Any

import numpy as np

from reconstruction.core.types import ConvexPart, ObjectAsset, PhysicalAttributes, TexturedMesh
from reconstruction.editing.addresses import vector
from registry.errors import UsageError

_LEAST_M, _MOST_M = 0.001, 20.0  # of a side; other lengths are taken for a mistake of units


def parse_size(value: Any, where: str) -> tuple[float, float, float]:
    """Parse the value of `size_m`: the lengths of the sides of a box along an object's own axes, metres.

    Raises:
        UsageError: it is malformed; the message starts with `where`.
    """
    size = vector(value, where)
    if not all(_LEAST_M <= side <= _MOST_M for side in size):
        raise UsageError(f"{where} must be three lengths of {_LEAST_M:g} to {_MOST_M:g} m, got {value!r}")
    return size


def resized(item: ObjectAsset, size_m: tuple[float, float, float]) -> ObjectAsset:
    """Return the object stretched along its own axes so that its box has a size; the box keeps its bottom center.

    Texture, collision parts and center of mass are stretched with the shape. Density stays: mass and its range grow by
    the volume, and the inertia is that of the stretched body.

    Args:
        item: the object.
        size_m: lengths of the sides of its box in object space, metres.
    """
    points = np.asarray(item.visual.vertices, np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    factor = np.asarray(size_m) / np.maximum(high - low, 1e-6)
    fixed = np.array([*(0.5 * (low + high))[:2], low[2]])

    def stretched(vertices: np.ndarray) -> np.ndarray:
        return ((np.asarray(vertices, np.float64) - fixed) * factor + fixed).astype(np.float32)

    visual = item.visual
    return replace(
        item,
        visual=TexturedMesh(stretched(visual.vertices), visual.faces, visual.uvs, visual.texture),
        collision=tuple(ConvexPart(stretched(part.vertices), part.faces) for part in item.collision),
        physics=_stretched_physics(item.physics, factor, fixed),
        provenance=replace(item.provenance, geometry=f"{item.provenance.geometry}, size by the user"),
    )


def _stretched_physics(
    physics: PhysicalAttributes, factor: np.ndarray, fixed: np.ndarray
) -> PhysicalAttributes:
    """Return the physics of a body stretched by `factor` (3,) about a point (3,), at the same density."""
    grown = float(np.prod(factor))
    inertia = np.asarray(physics.inertia, np.float64)
    second = 0.5 * np.trace(inertia) * np.eye(3) - inertia  # integral of x x^T over the mass
    second = grown * factor[:, None] * second * factor[None, :]
    low, high = physics.ranges.mass_kg
    return replace(
        physics,
        mass_kg=physics.mass_kg * grown,
        center_of_mass=(np.asarray(physics.center_of_mass, np.float64) - fixed) * factor + fixed,
        inertia=np.trace(second) * np.eye(3) - second,
        ranges=replace(physics.ranges, mass_kg=(low * grown, high * grown)),
    )
