"""Collision shapes as convex parts.

A primitive that fits; else the solid is cut at its level faces, nearly convex pieces become hulls, rings are cut into
sectors, and CoACD decomposes the rest.
"""

import numpy as np

from reconstruction.assets.collision.convexity import nearly_convex, part_of, waste
from reconstruction.assets.collision.decomposition import decompose
from reconstruction.assets.collision.primitives import fitted_primitive, primitive_part
from reconstruction.assets.collision.rings import find_hole, ring_pieces
from reconstruction.assets.collision.slicing import sliced
from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.solid import Solid, box_solid, hull_solid
from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.core.types import ConvexPart

_WASTE_SHARE = 0.01  # of the whole hull's volume: a piece whose hull adds less empty space becomes that hull
_ODD_SECTORS = 2  # most sectors of a ring that are decomposed
_LEAST_PARTS = 3  # of a decomposed piece
_REACH_M = 0.002  # crumbs that reach this far beyond the parts are kept
_GRID_DIGITS = 6  # decimals of metres in files


def collision_parts(
    solid: Solid,
    config: AssetsConfig,
    *,
    levels: tuple[float, ...] = (),
    progress: Progress = NO_PROGRESS,
    name: str = "object",
) -> tuple[ConvexPart, ...]:
    """Approximate a closed mesh in object space (bottom at z = 0) by convex parts within its bounds.

    Args:
        solid: the closed mesh.
        config: budgets and limits.
        levels: heights of children's contacts; no part crosses them, so that carrying surfaces are level.
        progress: notes pieces that CoACD failed on and that became their hulls.
        name: the object's name in these notes.
    """
    primitive = fitted_primitive(solid, levels)
    if primitive is not None:
        return (primitive_part(primitive),)
    low, high = solid.bounds
    whole = hull_solid(solid.vertices)
    pieces, crumbs = sliced(solid, levels)
    if len(pieces) == 1 and (hull := nearly_convex(solid, config)) is not None:
        return (_limited(hull.vertices, config, low, high),)
    furniture = float((high - low).max()) > config.furniture_m
    convex, hollow = _sorted_out(pieces, _WASTE_SHARE * whole.volume, config)
    # A low filled share means thin walls, which need finer cuts.
    fine = solid.volume < 0.5 * whole.volume and not furniture
    threshold = config.coacd_threshold * (0.6 if fine else 1.0)
    budget = (config.hulls_furniture if furniture else config.hulls_small) - len(convex)
    total = sum(waste(piece) for piece in hollow)
    parts = [_limited(piece.vertices, config, *piece.bounds).vertices.astype(np.float64) for piece in convex]
    for piece in hollow:
        share = max(_LEAST_PARTS, round(budget * waste(piece) / total))
        found = decompose(piece, threshold, share, config)
        if found is None:
            progress.note(f"{name}: CoACD failed on a part of it, which collides as its convex hull")
            found = [piece.vertices]
        parts += _to_bounds(found, *piece.bounds)
    parts += _reaching(crumbs, parts)
    parts = [fixed for part in parts if (fixed := _clipped(part, low, high)) is not None]
    return tuple(parts) if parts else (_limited(whole.vertices, config, low, high),)


def _sorted_out(
    pieces: list[Solid], allowed_m3: float, config: AssetsConfig
) -> tuple[list[Solid], list[Solid]]:
    """Return the pieces that collide as their hulls, among them sectors of rings, and those to decompose."""
    convex, hollow = [], []
    for piece in pieces:
        if waste(piece) < allowed_m3 or nearly_convex(piece, config) is not None:
            convex.append(piece)
        elif (hole := find_hole(piece)) is not None:
            cut = ring_pieces(piece, hole, config.hulls_ring, allowed_m3)
            cut.sort(key=waste, reverse=True)
            odd = [part for part in cut[:_ODD_SECTORS] if waste(part) > allowed_m3]  # a handle, another hole
            hollow += odd
            convex += cut[len(odd) :]
        else:
            hollow.append(piece)
    return convex, hollow


def _reaching(crumbs: list[Solid], parts: list[np.ndarray]) -> list[np.ndarray]:
    """Return the crumbs that reach beyond all parts, so that the shape is as large as the solid."""
    every = np.concatenate(parts) if parts else np.zeros((1, 3))
    low, high = every.min(axis=0) - _REACH_M, every.max(axis=0) + _REACH_M
    return [c.vertices for c in crumbs if (c.vertices < low).any() or (c.vertices > high).any()]


def _to_bounds(parts: list[np.ndarray], low: np.ndarray, high: np.ndarray) -> list[np.ndarray]:
    """Scale all parts together, axis by axis, to the visual bounds, as decimation shrinks them."""
    if not parts:
        return parts
    every = np.concatenate(parts)
    own_low, own_high = every.min(axis=0), every.max(axis=0)
    scale = (high - low) / np.maximum(own_high - own_low, 1e-9)
    scale = np.where((scale > 0.85) & (scale < 1.18), scale, 1.0)
    shift = np.where(scale == 1.0, 0.0, low - own_low * scale)
    return [part * scale + shift for part in parts]


def _clipped(vertices: np.ndarray, low: np.ndarray, high: np.ndarray) -> ConvexPart | None:
    """Clip a part to the visual bounds, and snap it to bounds within a few millimetres; None if too thin."""
    clipped = np.clip(vertices, low, high)
    snap = np.minimum(0.003, 0.02 * (high - low))
    for axis in range(3):
        for bound, nearest in ((low, clipped[:, axis].min()), (high, clipped[:, axis].max())):
            if abs(nearest - bound[axis]) < snap[axis]:
                at = np.abs(clipped[:, axis] - nearest) < 0.5 * snap[axis]
                clipped[at, axis] = bound[axis]
    return hull_part(clipped)


def hull_part(vertices: np.ndarray) -> ConvexPart | None:
    """Return the hull of vertices as a part; None if it is too thin."""
    from scipy.spatial import QhullError

    # Corners that files merge would leave triangles without area.
    vertices = np.unique(np.round(vertices, _GRID_DIGITS), axis=0)
    if np.ptp(vertices, axis=0).min() < 5e-4:
        return None
    try:
        hull = hull_solid(vertices)
    except QhullError:
        return None
    return part_of(hull)


def _limited(vertices: np.ndarray, config: AssetsConfig, low: np.ndarray, high: np.ndarray) -> ConvexPart:
    """Return one part of at most `hull_vertices` vertices: the extreme ones in evenly spread directions."""
    if len(vertices) > config.hull_vertices:
        number = np.arange(4 * config.hull_vertices) + 0.5
        polar, turn = np.arccos(1 - 2 * number / len(number)), np.pi * (1 + 5**0.5) * number
        spread = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], -1)
        axes = np.concatenate([np.eye(3), -np.eye(3)])
        # The bottom keeps its whole outline, as the object would rock otherwise.
        bottom = vertices[:, 2] < low[2] + 0.002 + 0.01 * (high[2] - low[2])
        around = np.arange(12) * np.pi / 6
        feet = np.flatnonzero(bottom)
        chosen = list(np.argmax(vertices @ axes.T, axis=0))
        if len(feet):
            ring = np.stack([np.cos(around), np.sin(around)])
            chosen += list(feet[np.argmax(vertices[feet][:, :2] @ ring, axis=0)])
        for index in np.argmax((vertices / (high - low)) @ spread.T, axis=0):
            if len(set(chosen)) >= config.hull_vertices:
                break
            chosen.append(index)
        vertices = vertices[np.unique(chosen)]
    part = _clipped(vertices, low, high)
    return part_of(box_solid(low, np.maximum(high, low + 1e-3))) if part is None else part
