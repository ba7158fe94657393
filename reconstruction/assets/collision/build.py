"""Convex collision parts: a primitive that fits; else layers between level faces, hulls of what is nearly convex, cut
rings, CoACD.
"""

import numpy as np

from reconstruction.assets.collision.convexity import nearly_convex, waste
from reconstruction.assets.collision.decomposition import decompose
from reconstruction.assets.collision.primitives import fitted_primitive, primitive_part
from reconstruction.assets.collision.rings import find_hole, ring_pieces
from reconstruction.assets.collision.slicing import sliced
from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.solid import Solid, box_solid, hull_solid
from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.core.types import ConvexPart

_WASTE_SHARE = 0.01  # of the whole's hull: a hull that takes so little empty space is good enough
_ODD_SECTORS = 2  # of a ring
_LEAST_PARTS = 3
_REACH_M = 0.002
_GRID_DIGITS = 6  # metres


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
        levels: heights at which other things stand on it. No part passes through them, so that tops come out level.
        progress: told of parts that could not be decomposed and collide as their hulls.
        name: of the object, for that.
    """
    primitive = fitted_primitive(solid, levels)
    if primitive is not None:
        return (primitive_part(primitive),)
    low, high = _bounds(solid)
    whole = hull_solid(solid.vertices)
    pieces, crumbs = sliced(solid, levels)
    if len(pieces) == 1 and (hull := nearly_convex(solid, config)) is not None:
        return (_limited(hull.vertices, config, low, high),)
    furniture = float((high - low).max()) > config.furniture_m
    convex, hollow = _sorted_out(pieces, _WASTE_SHARE * whole.volume, config)
    # Thin walls show as a low filled share: the hollower, the finer the cuts.
    fine = solid.volume < 0.5 * whole.volume and not furniture
    threshold = config.coacd_threshold * (0.6 if fine else 1.0)
    budget = (config.hulls_furniture if furniture else config.hulls_small) - len(convex)
    total = sum(waste(piece) for piece in hollow)
    parts = [
        _limited(piece.vertices, config, *_bounds(piece)).vertices.astype(np.float64) for piece in convex
    ]
    for piece in hollow:
        share = max(_LEAST_PARTS, round(budget * waste(piece) / total))
        found = decompose(piece, threshold, share, config)
        if found is None:
            progress.note(f"{name}: CoACD failed on a part of it, which collides as its convex hull")
            found = [piece.vertices]
        parts += _to_bounds(found, *_bounds(piece))
    parts += _reaching(crumbs, parts)
    parts = [fixed for part in parts if (fixed := _deflate(part, low, high, config)) is not None]
    return tuple(parts) if parts else (_limited(whole.vertices, config, low, high),)


def _sorted_out(
    pieces: list[Solid], allowed_m3: float, config: AssetsConfig
) -> tuple[list[Solid], list[Solid]]:
    """Return what may collide as its hull, rings cut into such pieces, and what must be decomposed."""
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
    """Return the crumbs that reach beyond all parts: the shape must end where it is seen to."""
    every = np.concatenate(parts) if parts else np.zeros((1, 3))
    low, high = every.min(axis=0) - _REACH_M, every.max(axis=0) + _REACH_M
    return [c.vertices for c in crumbs if (c.vertices < low).any() or (c.vertices > high).any()]


def _bounds(solid: Solid) -> tuple[np.ndarray, np.ndarray]:
    return solid.vertices.min(axis=0), solid.vertices.max(axis=0)


def _to_bounds(parts: list[np.ndarray], low: np.ndarray, high: np.ndarray) -> list[np.ndarray]:
    """Stretch all parts together, axis by axis, so that they span the visual bounds; decimation eats edges."""
    if not parts:
        return parts
    every = np.concatenate(parts)
    own_low, own_high = every.min(axis=0), every.max(axis=0)
    scale = (high - low) / np.maximum(own_high - own_low, 1e-9)
    scale = np.where((scale > 0.85) & (scale < 1.18), scale, 1.0)
    shift = np.where(scale == 1.0, 0.0, low - own_low * scale)
    return [part * scale + shift for part in parts]


def _deflate(
    vertices: np.ndarray, low: np.ndarray, high: np.ndarray, config: AssetsConfig
) -> ConvexPart | None:
    """Clip a part to the visual bounds; parts that end within a few millimetres of them end exactly there."""
    clipped = np.clip(vertices, low, high)
    snap = np.minimum(0.003, 0.02 * (high - low))
    for axis in range(3):
        for bound, nearest in ((low, clipped[:, axis].min()), (high, clipped[:, axis].max())):
            if abs(nearest - bound[axis]) < snap[axis]:
                at = np.abs(clipped[:, axis] - nearest) < 0.5 * snap[axis]
                clipped[at, axis] = bound[axis]
    return _part(clipped)


def _part(vertices: np.ndarray) -> ConvexPart | None:
    from scipy.spatial import QhullError

    # Corners that files cannot tell apart would leave triangles without area.
    vertices = np.unique(np.round(vertices, _GRID_DIGITS), axis=0)
    if np.ptp(vertices, axis=0).min() < 5e-4:
        return None
    try:
        hull = hull_solid(vertices)
    except QhullError:
        return None
    return ConvexPart(hull.vertices.astype(np.float32), hull.faces.astype(np.int32))


def _limited(vertices: np.ndarray, config: AssetsConfig, low: np.ndarray, high: np.ndarray) -> ConvexPart:
    """One convex part of at most `hull_vertices` vertices: the extreme points of evenly spread directions."""
    if len(vertices) > config.hull_vertices:
        number = np.arange(4 * config.hull_vertices) + 0.5
        polar, turn = np.arccos(1 - 2 * number / len(number)), np.pi * (1 + 5**0.5) * number
        spread = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], -1)
        axes = np.concatenate([np.eye(3), -np.eye(3)])
        # What stands must keep its whole outline on the ground, or it would rock.
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
    part = _deflate(vertices, low, high, config)
    if part is None:
        box = box_solid(low, np.maximum(high, low + 1e-3))
        part = ConvexPart(box.vertices.astype(np.float32), box.faces.astype(np.int32))
    return part
