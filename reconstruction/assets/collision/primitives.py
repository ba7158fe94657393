"""Boxes, cylinders, spheres and capsules in place of hulls, where they fit a solid within two millimetres."""

import math
from functools import partial

import numpy as np

from reconstruction.assets.solid import Solid, hull_solid
from reconstruction.core.types import ConvexPart
from registry.primitives import FLAT, Primitive, Shape, corners_of

BOUND_M = 0.002
_HOPELESS = 4.0  # times the bound, of the middle half of the surface at the first guess
_SAMPLES, _CHECKS = 600, 12_000
_FILLED = 0.5  # of the primitive's volume: the solid's surface then goes around all of it
# What is fitted: the shape, and whether its axis lies. Upright ones come first: things stand.
_CANDIDATES: tuple[tuple[Shape, bool], ...] = (
    ("box", False), ("cylinder", False), ("sphere", False), ("cylinder", True), ("capsule", False), ("capsule", True)
)  # fmt: skip


def fitted_primitive(
    solid: Solid, levels: tuple[float, ...] = (), bound_m: float = BOUND_M
) -> Primitive | None:
    """Return the primitive whose surface and that of a closed mesh are nowhere farther apart than a bound.

    All the mesh lies within the bound of the primitive's surface, and encloses its middle: so on every way from within
    the primitive to without, the mesh is crossed within the bound, too.

    Args:
        solid: The mesh, bottom at its lowest point.
        levels: Heights at which other things stand on it: the primitive must end at them.
        bound_m: Metres.
    """
    rng = np.random.default_rng(0)
    few, many = _on_surface(solid, _SAMPLES, rng), _on_surface(solid, _CHECKS, rng)
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
        found = _made(shape, lying, _refined(shape, lying, first, few), low)
        if shape in ("sphere", "capsule") and FLAT * found.size[0] > bound_m:
            continue  # its corners would not fit
        gap = np.abs(_distance_to(found, every)).max()
        if gap <= bound_m and solid.volume > _FILLED * _volume(found):
            return found
    return None


def primitive_part(primitive: Primitive) -> ConvexPart:
    """Return the convex mesh that stands for a primitive."""
    hull = hull_solid(corners_of(primitive))
    return ConvexPart(hull.vertices.astype(np.float32), hull.faces.astype(np.int32))


def _on_surface(solid: Solid, count: int, rng: np.random.Generator) -> np.ndarray:
    corner = solid.vertices[solid.faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    chosen = rng.choice(len(area), count, p=area / area.sum())
    return np.einsum("nk,nkc->nc", rng.dirichlet((1.0, 1.0, 1.0), count), corner[chosen])


def _edge_middles(solid: Solid) -> np.ndarray:
    pairs = np.concatenate([solid.faces[:, [0, 1]], solid.faces[:, [1, 2]], solid.faces[:, [2, 0]]])
    return solid.vertices[pairs].mean(axis=1)


def _first_guess(solid: Solid, shape: Shape, lying: bool) -> np.ndarray:
    """Return center (3), heading, and the size of a primitive around the bounds of a solid."""
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
    """Return center (3), heading and size, from a first guess, that lie nearest to points (n, 3) in least squares."""
    from scipy.optimize import least_squares

    fit = partial(_distance, shape, lying, points=points)
    return least_squares(fit, first, x_scale=np.maximum(np.abs(first), 0.05), max_nfev=40).x


def _made(shape: Shape, lying: bool, values: np.ndarray, low: float) -> Primitive:
    """Return the primitive of fitted values, standing where the solid does."""
    size = np.abs(values[4:])
    center = values[:3].copy()
    if shape == "box" or (shape == "cylinder" and not lying):
        top = center[2] + size[-1]  # stays where it fits, while its foot becomes the solid's
        size[-1] = 0.5 * (top - low)
        center[2] = 0.5 * (top + low)
    else:
        center[2] = low + (size[0] if lying or shape == "sphere" else size.sum())
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = _rotation(lying, values[3]), center
    return Primitive(shape, tuple(float(x) for x in size), pose)


def _rotation(lying: bool, heading: float) -> np.ndarray:
    """Return object_from_primitive (3, 3): the axis upright, or lying along the heading."""
    c, s = math.cos(heading), math.sin(heading)
    turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return turned @ np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]) if lying else turned


def _distance(shape: Shape, lying: bool, values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the signed distance (n,) of points (n, 3) to the primitive of fitted values."""
    return _own_distance(shape, np.abs(values[4:]), (points - values[:3]) @ _rotation(lying, values[3]))


def _distance_to(primitive: Primitive, points: np.ndarray) -> np.ndarray:
    own = (points - primitive.pose[:3, 3]) @ primitive.pose[:3, :3]
    return _own_distance(primitive.shape, np.array(primitive.size), own)


def _own_distance(shape: Shape, size: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the signed distance (n,) of points in the primitive's own space to its surface."""
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
