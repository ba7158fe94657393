"""Lower the collision shape of support surfaces to the visible surface under the objects that they carry.

Convex parts span the bumps, the raised edge and the tilt of a reconstructed table top, so that objects would float
above it. Under each child, protruding parts are cut at the plane fitted to the visible surface, or hollowed out in the
child's footprint if they belong to something around it, such as a rim.
"""

import numpy as np
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from reconstruction.assembly.base import convex_part
from reconstruction.assembly.collision import cut
from reconstruction.core.types import ConvexPart
from reconstruction.scene_graph.surfaces import SampledObject

_REACH_M = 0.04  # largest distance of a child's underside to the surface that carries it
_MIN_OVERSHOOT_M = 0.002  # of parts that are cut
_MIN_HOLLOW_M = 0.004  # overshoot of parts that are hollowed out
_HOLLOW_MARGIN_M = 0.008  # around a footprint, which is given by the centers of its cells
_MAX_CUT_M = 0.04
_MAX_SHARE_LOST = 0.15  # of the visible surface above the plane; with more, it is no plane with bumps
_FIT_BAND_M = 0.015  # inlier band of the plane fit
_PAD_M, _LEAST_PAD_M2 = 0.006, 1e-4  # thickness and least area of a pad
_MAX_SLOPE = 0.1  # of the fitted plane


def level_tops(
    parts: tuple[ConvexPart, ...],
    surface: SampledObject,
    world_from_object: np.ndarray,
    children: list[SampledObject],
) -> tuple[tuple[ConvexPart, ...], float]:
    """Cut the parts of a support down to its visible surface under its children.

    Args:
        parts: convex parts of the support, object space.
        surface: its visible surface, sampled at `world_from_object`.
        world_from_object: its reconstructed pose (4, 4).
        children: the objects that it carries, sampled at their reconstructed poses.

    Returns:
        The parts, and the deepest cut in metres (0: nothing was cut).
    """
    if len(surface.up) == 0:
        return parts, 0.0
    rotation, origin = world_from_object[:3, :3], world_from_object[:3, 3]
    tree = cKDTree(surface.up[:, :2])
    resting = [under for child in children if len(under := _surface_under(child, surface, tree)) >= 5]
    left, deepest = list(parts), 0.0
    for under in resting:
        lowered = [_lowered(part, under, surface.up, rotation, origin) for part in left]
        left = [part for made, _ in lowered for part in made]
        deepest = max([deepest, *(depth for _, depth in lowered)])
    return (tuple(left), deepest) if deepest > 0 else (parts, 0.0)


def seat(
    parts: tuple[ConvexPart, ...], pose: np.ndarray, place: np.ndarray, level: float, most_m: float
) -> tuple[ConvexPart, ...]:
    """Level a support under an object: cut parts that rise within its footprint, fill up with a pad.

    The object hides the top there, whose shape is therefore guessed.

    Args:
        parts: convex parts of the support, object space.
        pose: its pose (4, 4).
        place: footprint of the object, (n, 2), world.
        level: height of the footprint, world, metres.
        most_m: parts that rise higher stay (walls, other boards); deeper tops are not padded.

    Returns:
        The parts; `parts` itself if nothing was done.
    """
    rotation, origin = pose[:3, :3], pose[:3, 3]
    under = np.column_stack([place, np.full(len(place), level)])
    out: list[ConvexPart] = []
    below, highest = [], -np.inf
    for part in parts:
        world = np.asarray(part.vertices, np.float64) @ rotation.T + origin
        rise = _rise(world, under)
        made = _hollowed(part, place, level, rotation, origin) if 0 < rise <= most_m else ()
        out += made or (part,)
        if np.isfinite(rise) and rise <= most_m:
            below.append(world[:, :2])
            highest = max(highest, rise)
    if not below or highest < -most_m:
        return parts
    pad = _common(place, np.concatenate(below))
    if pad is not None:
        corners = [np.column_stack([pad, np.full(len(pad), level - depth)]) for depth in (0.0, _PAD_M)]
        out.append(convex_part((np.concatenate(corners) - origin) @ rotation))
    return tuple(out)


def _common(one: np.ndarray, other: np.ndarray) -> np.ndarray | None:
    """Intersect the hulls of two sets of points (n, 2), approximately: vertices (k, 2); None if too small."""
    try:
        inside = [Delaunay(a).find_simplex(b) >= 0 for a, b in ((other, one), (one, other))]
        points = np.concatenate([one[inside[0]], other[inside[1]]])
        if not len(points):  # the hulls may cross, with no vertex of one in the other
            return None
        hull = ConvexHull(points)
    except QhullError:
        return None
    return points[hull.vertices] if hull.volume > _LEAST_PAD_M2 else None


def _rise(vertices: np.ndarray, under: np.ndarray) -> float:
    """Return the height of the top of a part above a level footprint (n, 3); -inf if beside or above it."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    place_low, place_high = under.min(axis=0), under.max(axis=0)
    if np.any(low[:2] > place_high[:2]) or np.any(high[:2] < place_low[:2]) or low[2] > place_low[2]:
        return -np.inf
    return float(high[2] - place_low[2])


def _lowered(
    part: ConvexPart, under: np.ndarray, up: np.ndarray, rotation: np.ndarray, origin: np.ndarray
) -> tuple[tuple[ConvexPart, ...], float]:
    """Cut a part down to the visible surface (n, 3) under one child: the parts left, and the depth of the cut."""
    world = np.asarray(part.vertices, np.float64) @ rotation.T + origin
    rise = _overshoot(world, under)
    if rise < _MIN_OVERSHOOT_M:
        return (part,), 0.0
    level = float(np.median(under[:, 2]))
    plane = _visible_plane(world, up, level)
    if plane is not None:
        normal, offset = plane
        depth = float((world @ normal + offset).max())
        made = cut((part,), -normal @ rotation, -float(normal @ origin + offset))
        if 0 < depth <= _MAX_CUT_M and made:
            return made, depth
    # The part rises around the child, e.g. as a rim: only the footprint is cut free.
    made = _hollowed(part, under[:, :2], level, rotation, origin) if rise >= _MIN_HOLLOW_M else ()
    return (made, rise) if made else ((part,), 0.0)


def _hollowed(
    part: ConvexPart, place: np.ndarray, level: float, rotation: np.ndarray, origin: np.ndarray
) -> tuple[ConvexPart, ...]:
    """Split a part around the octagon about a footprint (n, 2), world, and cut it at a level inside."""
    out: tuple[ConvexPart, ...] = ()
    rest: tuple[ConvexPart, ...] = (part,)
    for angle in np.arange(8) * np.pi / 4:
        outward = np.array([np.cos(angle), np.sin(angle), 0.0])
        offset = float(outward @ origin - (place @ outward[:2]).max()) - _HOLLOW_MARGIN_M
        out += cut(rest, outward @ rotation, offset)
        rest = cut(rest, -outward @ rotation, -offset)
    return out + cut(rest, -rotation[2], level - float(origin[2]))


def _surface_under(child: SampledObject, surface: SampledObject, tree: cKDTree) -> np.ndarray:
    """Return the highest visible point (n, 3) within reach of each cell of a child's underside that has one."""
    radius = max(1.2 * surface.spacing_m, 0.008)
    out = []
    for cell, near in zip(child.underside, tree.query_ball_point(child.underside[:, :2], radius)):
        height = surface.up[near, 2]
        height = height[np.abs(height - cell[2]) < _REACH_M]
        if len(height):
            out.append((cell[0], cell[1], height.max()))
    return np.array(out).reshape(-1, 3)


def _overshoot(vertices: np.ndarray, under: np.ndarray) -> float:
    """Return the median height (m) of a part above the points (n, 3) that it covers; 0 if it covers few."""
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
    # A part that starts above the surface is something else, e.g. the next board of a shelf.
    inside &= bottom < under[:, 2] + _MIN_OVERSHOOT_M
    rise = (top - under[:, 2])[inside & (top < under[:, 2] + _MAX_CUT_M)]
    return float(np.median(rise)) if len(rise) >= max(3, 0.05 * len(under)) else 0.0


def _visible_plane(vertices: np.ndarray, up: np.ndarray, level: float) -> tuple[np.ndarray, float] | None:
    """Fit a plane (normal (3,), offset) to the visible surface near a height by trimmed least squares; None if poor."""
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
