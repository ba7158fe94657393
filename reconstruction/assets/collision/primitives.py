"""Boxes, cylinders, spheres and capsules that fit a solid within two millimetres."""

import math
from functools import partial

import numpy as np

from reconstruction.assets.collision.convexity import part_of
from reconstruction.assets.solid import Solid, hull_solid, surface_samples
from reconstruction.core.types import ConvexPart
from registry.primitives import FLAT, Primitive, Shape, corners_of

BOUND_M = 0.002  # greatest distance between the surfaces
_HOPELESS = 4.0  # median distance at the first guess, in bounds, above which a candidate is dropped
_SAMPLES, _CHECKS = 600, 12_000  # surface points of the fit and of the check
_FILLED = 0.5  # least volume of the solid, relative to the primitive's: it encloses the primitive's middle
# Shape, and whether its axis is horizontal; upright ones are tried first.
_CANDIDATES: tuple[tuple[Shape, bool], ...] = (
    ("box", False), ("cylinder", False), ("sphere", False), ("cylinder", True), ("capsule", False), ("capsule", True)
)  # fmt: skip


def fitted_primitive(
    solid: Solid, levels: tuple[float, ...] = (), bound_m: float = BOUND_M
) -> Primitive | None:
    """Return the first primitive whose surface lies within a bound of a closed mesh's everywhere; None if none does.

    All the mesh lies within the bound of the primitive's surface, and encloses its middle. So any path from inside the
    primitive to outside crosses the mesh within the bound, too.

    Args:
        solid: the mesh.
        levels: heights of children's contacts; the primitive must end at them.
        bound_m: metres.
    """
    rng = np.random.default_rng(0)
    few, many = surface_samples(solid, _SAMPLES, rng), surface_samples(solid, _CHECKS, rng)
    every = np.concatenate(
        [solid.vertices, solid.vertices[solid.faces].mean(axis=1), _edge_middles(solid), many]
    )
    low, high = float(solid.vertices[:, 2].min()), float(solid.vertices[:, 2].max())
    if any(low + bound_m < level < high - bound_m for level in levels):
        return None
    for shape, lying in _CANDIDATES:
        first = _first_guess(solid, shape, lying)
        away = np.abs(_distance(shape, lying, first, few))
        if min(first[4:]) <= bound_m or np.median(away) > _HOPELESS * bound_m:
            continue
        found = _standing(shape, lying, _refined(shape, lying, first, few), low)
        if shape in ("sphere", "capsule") and FLAT * found.size[0] > bound_m:
            continue  # the mesh that stands for it in files would not fit
        gap = np.abs(_distance_to(found, every)).max()
        if gap <= bound_m and solid.volume > _FILLED * _volume(found):
            return found
    return None


def primitive_part(primitive: Primitive) -> ConvexPart:
    """Return the convex mesh of a primitive."""
    return part_of(hull_solid(corners_of(primitive)))


def _edge_middles(solid: Solid) -> np.ndarray:
    pairs = np.concatenate([solid.faces[:, [0, 1]], solid.faces[:, [1, 2]], solid.faces[:, [2, 0]]])
    return solid.vertices[pairs].mean(axis=1)


def _first_guess(solid: Solid, shape: Shape, lying: bool) -> np.ndarray:
    """Return center (3), heading and size of a primitive from the minimum-area rectangle and height of a solid."""
    import cv2

    outline = solid.vertices[:, :2].astype(np.float32)
    (x, y), (along, across), degrees = cv2.minAreaRect(outline)
    heading = math.radians(degrees)
    if across > along:
        along, across, heading = across, along, heading + 0.5 * math.pi
    low, high = float(solid.vertices[:, 2].min()), float(solid.vertices[:, 2].max())
    height, center = high - low, [x, y, 0.5 * (low + high)]
    if shape == "box":
        size = [0.5 * along, 0.5 * across, 0.5 * height]
    elif shape == "sphere":
        size = [0.25 * (0.5 * (along + across) + height)]
    else:
        radius = 0.25 * (across + height) if lying else 0.25 * (along + across)
        reach = 0.5 * (along if lying else height)
        size = [radius, reach if shape == "cylinder" else reach - radius]
    return np.array([*center, heading, *size])


def _refined(shape: Shape, lying: bool, first: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return center (3), heading and size fitted to points (n, 3) by least squares from a first guess."""
    from scipy.optimize import least_squares

    fit = partial(_distance, shape, lying, points=points)
    return least_squares(fit, first, x_scale=np.maximum(np.abs(first), 0.05), max_nfev=40).x


def _standing(shape: Shape, lying: bool, values: np.ndarray, low: float) -> Primitive:
    """Return the primitive of fitted values, its bottom moved to the solid's."""
    size = np.abs(values[4:])
    center = values[:3].copy()
    if shape == "box" or (shape == "cylinder" and not lying):
        top = center[2] + size[-1]  # keeps its fitted height
        size[-1] = 0.5 * (top - low)
        center[2] = 0.5 * (top + low)
    else:
        center[2] = low + (size[0] if lying or shape == "sphere" else size.sum())
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = _rotation(lying, values[3]), center
    return Primitive(shape, tuple(float(x) for x in size), pose)


def _rotation(lying: bool, heading: float) -> np.ndarray:
    """Return object_from_primitive (3, 3): the axis upright, or horizontal along the heading."""
    c, s = math.cos(heading), math.sin(heading)
    turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return turned @ np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]) if lying else turned


def _distance(shape: Shape, lying: bool, values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the signed distance (n,) of points (n, 3) to the primitive of fitted values."""
    return _own_distance(shape, np.abs(values[4:]), (points - values[:3]) @ _rotation(lying, values[3]))


def _distance_to(primitive: Primitive, points: np.ndarray) -> np.ndarray:
    """Return the signed distance (n,) of points (n, 3) to a primitive."""
    own = (points - primitive.pose[:3, 3]) @ primitive.pose[:3, :3]
    return _own_distance(primitive.shape, np.array(primitive.size), own)


def _own_distance(shape: Shape, size: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the signed distance (n,) of points (n, 3) in the primitive's own frame."""
    if shape == "sphere":
        return np.linalg.norm(points, axis=1) - size[0]
    if shape == "capsule":
        beyond = points.copy()
        beyond[:, 2] -= np.clip(points[:, 2], -size[1], size[1])
        return np.linalg.norm(beyond, axis=1) - size[0]
    if shape == "box":
        off = np.abs(points) - size
    else:
        off = np.stack([np.linalg.norm(points[:, :2], axis=1), np.abs(points[:, 2])], axis=1) - size
    return np.linalg.norm(np.maximum(off, 0.0), axis=1) + np.minimum(off.max(axis=1), 0.0)


def _volume(primitive: Primitive) -> float:
    size = primitive.size
    if primitive.shape == "box":
        return 8.0 * size[0] * size[1] * size[2]
    ball = 4.0 / 3.0 * math.pi * size[0] ** 3
    return {
        "sphere": ball,
        "cylinder": 2.0 * math.pi * size[0] ** 2 * size[-1],
        "capsule": ball + 2.0 * math.pi * size[0] ** 2 * size[-1],
    }[primitive.shape]
