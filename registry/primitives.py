# pyright: strict, reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
"""Recognize boxes, cylinders, spheres and capsules among convex collision parts, by their vertices.

A part of a bundle is a vertex cloud. If it equals `corners_of` some primitive, a simulator may use that primitive: it
is round and has exact contacts. A part that was cut or stretched afterwards matches only if it still is a primitive: a
box cut level is a box, a sphere cut level is only a mesh.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from registry.geometry import transform_points

Shape = Literal["box", "cylinder", "sphere", "capsule"]
SIZES: dict[str, int] = {"box": 3, "cylinder": 2, "sphere": 1, "capsule": 2}  # numbers in `Primitive.size`
SIDES = 20  # vertices per ring; every primitive stays below PhysX's 255 vertices
_LATITUDES_DEG = (0.0, 20.0, 40.0, 60.0, 78.0)  # of rings; no vertex at a pole: round parts rest on flats
FLAT = 1.0 - math.sin(math.radians(_LATITUDES_DEG[-1]))  # depth of these flats below the pole, of the radius
_UPRIGHT = 0.9999  # minimum z component of the axis of an upright cylinder
# Vertex tolerance: metres + share of the extent. Files have 7 digits, arrays are float32.
_EXACT_M, _EXACT_SHARE = 2e-5, 2e-5


@dataclass(frozen=True)
class Primitive:
    """A box, cylinder, sphere or capsule; the axis is the z axis of primitive space.

    `size` in metres: half extents (3) of a box; radius and half length of a cylinder; radius of a sphere; radius and
    half length without the caps of a capsule.
    """

    shape: Shape
    size: tuple[float, ...]
    pose: np.ndarray  # float64 (4, 4) object_from_primitive, rigid

    @property
    def stands(self) -> bool:
        """Return whether it cannot roll: a box, or a cylinder on its end.

        Without rolling resistance, spheres and lying cylinders roll forever. Their vertex hulls do not.
        """
        return self.shape == "box" or (self.shape == "cylinder" and bool(self.pose[2, 2] > _UPRIGHT))

    def as_json(self) -> dict[str, Any]:
        """Return the entry of `collision_primitives` in scene.json."""
        return {
            "shape": self.shape,
            "size": [round(float(x), 7) for x in self.size],
            "object_from_primitive": np.asarray(self.pose, np.float64).tolist(),
        }


def corners_of(primitive: Primitive) -> np.ndarray:
    """Return the vertices (n, 3) of the convex mesh of a primitive, in object space (m)."""
    return transform_points(primitive.pose, _corners(primitive.shape, primitive.size))


def primitive_of(points: np.ndarray) -> Primitive | None:
    """Return the primitive with exactly these vertices (n, 3) (m), in any order; None if there is none."""
    points = np.unique(np.asarray(points, np.float64).round(7), axis=0)
    if not np.isfinite(points).all():
        return None
    exact = _EXACT_M + _EXACT_SHARE * float(np.abs(points).max(initial=0.0))
    if len(points) == 8:
        return _box(points, exact)
    for shape in ("cylinder", "sphere", "capsule"):
        if len(points) == _count(shape):
            return _round(shape, points, exact)
    return None


@lru_cache(maxsize=64)
def _corners(shape: Shape, size: tuple[float, ...]) -> np.ndarray:
    """Return the vertices in primitive space; they lie on the surface of round primitives."""
    if shape == "box":
        return np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size
    radius, half = (size[0], 0.0) if shape == "sphere" else size
    angle = 2.0 * math.pi * (np.arange(SIDES) + 0.5) / SIDES  # a lying cylinder rests on a face, not an edge
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(SIDES)], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    if shape == "cylinder":
        return np.concatenate([radius * ring + side * half * up for side in (-1, 1)])
    latitudes = np.radians(_LATITUDES_DEG)
    upper = np.concatenate([radius * (math.cos(a) * ring + math.sin(a) * up) + half * up for a in latitudes])
    lower = upper * [1, 1, -1]
    return np.concatenate([upper, lower[SIDES:] if shape == "sphere" else lower])


@lru_cache(maxsize=8)
def _count(shape: Shape) -> int:
    return len(_corners(shape, (1.0,) * SIZES[shape]))


def _box(points: np.ndarray, exact: float) -> Primitive | None:
    center = points.mean(axis=0)
    away = points[1:] - points[0]
    near = np.argsort(np.linalg.norm(away, axis=1), kind="stable")
    # The two nearest vertices lie along edges; the third edge is perpendicular to both.
    first, second = away[near[0]], away[near[1]]
    third = np.cross(first, second)
    if np.linalg.norm(third) < exact**2:
        return None
    axes = np.stack([v / np.linalg.norm(v) for v in (first, second, third)])
    axes = axes[np.argsort(np.abs(axes[:, 2]), kind="stable")]  # the most upright axis last
    axes[2] *= 1.0 if axes[2, 2] >= 0 else -1.0
    axes[1] = np.cross(axes[2], axes[0])
    return _checked("box", np.abs((points - center) @ axes.T).max(axis=0), axes.T, center, points, exact)


def _round(shape: Shape, points: np.ndarray, exact: float) -> Primitive | None:
    center = points.mean(axis=0)
    axis = _axis(shape, points - center, exact)
    if axis is None:
        return None
    along = (points - center) @ axis
    flat = points - center - along[:, None] * axis
    radius, reach = float(np.linalg.norm(flat, axis=1).max()), float(along.max())
    if radius <= exact or reach <= exact:
        return None
    outermost = flat[np.argmax(np.linalg.norm(flat, axis=1).round(6))]
    side = outermost / np.linalg.norm(outermost)
    side = math.cos(math.pi / SIDES) * side - math.sin(math.pi / SIDES) * np.cross(axis, side)
    rotation = np.stack([side, np.cross(axis, side), axis], axis=1)
    half = reach - radius * (1.0 - FLAT)
    size = {"cylinder": (radius, reach), "sphere": (radius,), "capsule": (radius, half)}[shape]
    return _checked(shape, np.array(size), rotation, center, points, exact)


def _axis(shape: Shape, points: np.ndarray, exact: float) -> np.ndarray | None:
    """Return the upward axis (3,) of vertices (n, 3) about the origin, or None."""
    if shape == "cylinder":  # between opposite vertices; all vertices project to the same distance
        ways = points[1:] - points[0]
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        off = np.abs(np.abs(points @ ways.T) - np.abs(ways @ points[0])).max(axis=0)
        axis = ways[np.argmin(off)]
        if off.min() > exact:
            return None
    else:  # the principal axis whose variance differs from the two others; holds for a sphere made of rings, too
        values, vectors = np.linalg.eigh(np.cov(points.T))
        axis = vectors[:, 2 if values[2] - values[1] > values[1] - values[0] else 0]
    return axis if axis[2] >= 0 else -axis


def _checked(
    shape: Shape, size: np.ndarray, rotation: np.ndarray, center: np.ndarray, points: np.ndarray, exact: float
) -> Primitive | None:
    """Return the primitive if its vertices and the points match one to one, else None."""
    if (size <= 0).any():
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, center
    found = Primitive(shape, tuple(float(x) for x in size), pose)
    gaps = np.linalg.norm(corners_of(found)[:, None] - points[None], axis=2)
    same = gaps.min(axis=0).max() <= exact and gaps.min(axis=1).max() <= exact
    return found if same else None
