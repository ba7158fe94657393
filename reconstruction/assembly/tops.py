"""Bring the collision shape of what carries things down to its visible surface.

Convex pieces span the bumps, the raised edge and the tilt of a reconstructed table top, so that things would
float above it by as much. Under each child the pieces that stick out are cut off at the plane of the visible
surface, or hollowed out where it stands, if they belong to what rises around it.
"""

import numpy as np
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree

from reconstruction.assembly.base import convex_part
from reconstruction.assembly.collision import cut
from reconstruction.core.types import ConvexPart
from reconstruction.scene_graph.surfaces import SampledObject

_REACH_M = 0.04  # how far a child's underside may be from the surface that carries it
_MIN_OVERSHOOT_M = 0.002
_MIN_HOLLOW_M = 0.004
_HOLLOW_MARGIN_M = 0.008  # an underside is known as the centers of its cells
_MAX_CUT_M = 0.04
_MAX_SHARE_LOST = 0.15  # of the visible surface; more means that the piece is a wall, not a bump
_FIT_BAND_M = 0.015
_PAD_M, _LEAST_PAD_M2 = 0.006, 1e-4
_MAX_SLOPE = 0.1


def level_tops(
    parts: tuple[ConvexPart, ...],
    surface: SampledObject,
    world_from_object: np.ndarray,
    children: list[SampledObject],
) -> tuple[tuple[ConvexPart, ...], float]:
    """Cut off what the pieces have above the visible surface under the children.

    Args:
        parts: the parent's convex pieces, object space.
        surface: the parent's visible surface, sampled at `world_from_object`.
        world_from_object: (4, 4) the parent's reconstructed pose.
        children: what it carries, sampled at their reconstructed poses.

    Returns:
        The pieces, and the deepest cut in metres (0: nothing was cut).
    """
    if len(surface.up) == 0:
        return parts, 0.0
    rotation, origin = world_from_object[:3, :3], world_from_object[:3, 3]
    tree = cKDTree(surface.up[:, :2])
    resting = [under for child in children if len(under := _surface_under(child, surface, tree)) >= 5]
    pieces, deepest = list(parts), 0.0
    for under in resting:
        made: list[ConvexPart] = []
        for piece in pieces:
            lowered, depth = _lowered(piece, under, surface.up, rotation, origin)
            made += lowered
            deepest = max(deepest, depth)
        pieces = made
    return (tuple(pieces), deepest) if deepest > 0 else (parts, 0.0)


def seat(
    parts: tuple[ConvexPart, ...], pose: np.ndarray, place: np.ndarray, level: float, most_m: float
) -> tuple[ConvexPart, ...]:
    """Make a carrier level under a thing: what rises within its place goes, and a pad fills what is missing.

    The top under a thing is hidden by it, so that bumps and hollows there are guesses; that the thing stood is not.

    Args:
        parts: the carrier's convex pieces, object space.
        pose: (4, 4) where it stands.
        place: (n, 2) where the foot of the thing is, world.
        level: of the foot, world, metres.
        most_m: pieces that rise higher within the place stay (walls, other boards); deeper tops are not padded.

    Returns:
        The pieces; the same ones where nothing was done.
    """
    rotation, origin = pose[:3, :3], pose[:3, 3]
    under = np.column_stack([place, np.full(len(place), level)])
    pieces: list[ConvexPart] = []
    below, highest = [], -np.inf
    for piece in parts:
        world = np.asarray(piece.vertices, np.float64) @ rotation.T + origin
        rise = _rise(world, under)
        made = _hollowed(piece, place, level, rotation, origin) if 0 < rise <= most_m else ()
        pieces += made or (piece,)
        if np.isfinite(rise) and rise <= most_m:
            below.append(world[:, :2])
            highest = max(highest, rise)
    if not below or highest < -most_m:
        return parts
    pad = _common(place, np.concatenate(below))
    if pad is not None:
        corners = [np.column_stack([pad, np.full(len(pad), level - depth)]) for depth in (0.0, _PAD_M)]
        pieces.append(convex_part((np.concatenate(corners) - origin) @ rotation))
    return tuple(pieces)


def _common(one: np.ndarray, other: np.ndarray) -> np.ndarray | None:
    """Return points (n, 2) that span what the hulls of two sets of points (n, 2) have in common; None: too little."""
    try:
        inside = [Delaunay(a).find_simplex(b) >= 0 for a, b in ((other, one), (one, other))]
        points = np.concatenate([one[inside[0]], other[inside[1]]])
        if not len(points):  # they cross, and no corner of either is in the other
            return None
        hull = ConvexHull(points)
    except QhullError:
        return None
    return points[hull.vertices] if hull.volume > _LEAST_PAD_M2 else None


def _rise(vertices: np.ndarray, under: np.ndarray) -> float:
    """Return how high a piece ends above a level place (n, 3); -inf: it is beside or above the place."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    place_low, place_high = under.min(axis=0), under.max(axis=0)
    if np.any(low[:2] > place_high[:2]) or np.any(high[:2] < place_low[:2]) or low[2] > place_low[2]:
        return -np.inf
    return float(high[2] - place_low[2])


def _lowered(
    piece: ConvexPart, under: np.ndarray, up: np.ndarray, rotation: np.ndarray, origin: np.ndarray
) -> tuple[tuple[ConvexPart, ...], float]:
    """Bring a piece down to the visible surface under one child: what is left of it, and the depth of the cut."""
    world = np.asarray(piece.vertices, np.float64) @ rotation.T + origin
    rise = _overshoot(world, under)
    if rise < _MIN_OVERSHOOT_M:
        return (piece,), 0.0
    level = float(np.median(under[:, 2]))
    plane = _visible_plane(world, up, level)
    if plane is not None:
        normal, offset = plane
        depth = float((world @ normal + offset).max())
        made = cut((piece,), -normal @ rotation, -(normal @ origin + offset))
        if 0 < depth <= _MAX_CUT_M and made:
            return made, depth
    # What rises around the child is there (a plate's rim): only the place where it stands is cut free.
    made = _hollowed(piece, under[:, :2], level, rotation, origin) if rise >= _MIN_HOLLOW_M else ()
    return (made, rise) if made else ((piece,), 0.0)


def _hollowed(
    piece: ConvexPart, place: np.ndarray, level: float, rotation: np.ndarray, origin: np.ndarray
) -> tuple[ConvexPart, ...]:
    """Split a piece around the octagon about a place (n, 2), world, and cut it at a level within."""
    out: tuple[ConvexPart, ...] = ()
    rest: tuple[ConvexPart, ...] = (piece,)
    for angle in np.arange(8) * np.pi / 4:
        outward = np.array([np.cos(angle), np.sin(angle), 0.0])
        offset = float(outward @ origin - (place @ outward[:2]).max()) - _HOLLOW_MARGIN_M
        out += cut(rest, outward @ rotation, offset)
        rest = cut(rest, -outward @ rotation, -offset)
    return out + cut(rest, -rotation[2], level - float(origin[2]))


def _surface_under(child: SampledObject, surface: SampledObject, tree: cKDTree) -> np.ndarray:
    """Return the highest visible point within reach under each cell of a child's underside, (n, 3)."""
    radius = max(1.2 * surface.spacing_m, 0.008)
    out = []
    for cell, near in zip(child.underside, tree.query_ball_point(child.underside[:, :2], radius)):
        height = surface.up[near, 2]
        height = height[np.abs(height - cell[2]) < _REACH_M]
        if len(height):
            out.append((cell[0], cell[1], height.max()))
    return np.array(out).reshape(-1, 3)


def _overshoot(vertices: np.ndarray, under: np.ndarray) -> float:
    """Return by how much (median, m) a piece rises above the points that it covers; 0: covers none."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    if np.any(low[:2] > under[:, :2].max(axis=0)) or np.any(high[:2] < under[:, :2].min(axis=0)):
        return 0.0
    try:
        equations = ConvexHull(vertices).equations  # normal . x + offset <= 0 inside
    except QhullError:
        return 0.0
    normals, offsets = equations[:, :3], equations[:, 3]
    up, down, side = normals[:, 2] > 1e-6, normals[:, 2] < -1e-6, np.abs(normals[:, 2]) <= 1e-6
    level = under[:, :2] @ normals[:, :2].T + offsets
    top = (-level[:, up] / normals[up, 2]).min(axis=1)
    bottom = (-level[:, down] / normals[down, 2]).max(axis=1)
    inside = (level[:, side] <= 1e-6).all(axis=1) & (top > bottom)
    # A piece that only starts above the surface is something else: the next board of a shelf.
    inside &= bottom < under[:, 2] + _MIN_OVERSHOOT_M
    rise = (top - under[:, 2])[inside & (top < under[:, 2] + _MAX_CUT_M)]
    return float(np.median(rise)) if len(rise) >= max(3, 0.05 * len(under)) else 0.0


def _visible_plane(vertices: np.ndarray, up: np.ndarray, level: float) -> tuple[np.ndarray, float] | None:
    """Fit the visible surface near a height: (normal (3,), offset), or None if it is no plane."""
    low, high = vertices[:, :2].min(axis=0), vertices[:, :2].max(axis=0)
    covered = up[np.all((up[:, :2] >= low) & (up[:, :2] <= high), axis=1)]
    near = covered[np.abs(covered[:, 2] - level) < _MAX_CUT_M]
    if len(near) < 10:
        return None
    center = near[:, :2].mean(axis=0)
    design = np.column_stack([near[:, :2] - center, np.ones(len(near))])
    keep = np.abs(near[:, 2] - level) < _FIT_BAND_M
    fit = np.array([0.0, 0.0, level])
    for _ in range(4):
        if keep.sum() < 10:
            return None
        fit = np.linalg.lstsq(design[keep], near[keep, 2], rcond=None)[0]
        keep = np.abs(design @ fit - near[:, 2]) < _FIT_BAND_M
    above = design @ fit < near[:, 2] - 0.5 * _FIT_BAND_M
    if np.hypot(fit[0], fit[1]) > _MAX_SLOPE or above.mean() > _MAX_SHARE_LOST:
        return None
    normal = np.array([-fit[0], -fit[1], 1.0])
    scale = np.linalg.norm(normal)
    return normal / scale, float(-(fit[2] - fit[:2] @ center) / scale)
