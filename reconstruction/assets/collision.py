"""Convex collision parts: one hull for nearly convex things, else CoACD, brought to the visual bounds."""

import numpy as np

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.solid import Solid, box_solid, hull_solid, lighten
from reconstruction.types import ConvexPart


def collision_parts(solid: Solid, config: AssetsConfig) -> tuple[ConvexPart, ...]:
    """Approximate a closed mesh in object space (bottom at z = 0) by convex parts within its bounds."""
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    hull = hull_solid(solid.vertices)
    filled = solid.volume / max(hull.volume, 1e-12)
    if filled > config.convex_enough:
        return (_limited(hull.vertices, config, low, high),)
    furniture = float((high - low).max()) > config.furniture_m
    # Thin walls show as a low filled share: the hollower, the finer the cuts.
    threshold = config.coacd_threshold * (0.6 if filled < 0.5 else 1.0)
    parts = _decompose(solid, threshold, config.hulls_furniture if furniture else config.hulls_small, config)
    parts = _to_bounds(parts, low, high)
    parts = [fixed for part in parts if (fixed := _deflate(part, low, high, config)) is not None]
    return tuple(parts) if parts else (_limited(hull.vertices, config, low, high),)


def _decompose(solid: Solid, threshold: float, budget: int, config: AssetsConfig) -> list[np.ndarray]:
    """Run CoACD on the normalised, decimated mesh; return the vertices of each part."""
    import coacd

    light = lighten(solid, config.collision_faces, 0.004 * float(solid.extents.max()))
    center, scale = (
        (light.vertices.max(axis=0) + light.vertices.min(axis=0)) / 2,
        float(light.extents.max()) / 2,
    )
    coacd.set_log_level("error")
    mesh = coacd.Mesh((light.vertices - center) / scale, light.faces)
    pieces = coacd.run_coacd(
        mesh,
        threshold=threshold,
        max_convex_hull=budget,
        preprocess_mode="off",  # the mesh is manifold already; the voxel remesh would inflate it
        resolution=500,
        mcts_nodes=8,
        mcts_iterations=20,
        mcts_max_depth=2,
        max_ch_vertex=config.hull_vertices,
        decimate=True,
        seed=config.seed,
    )
    return [np.asarray(vertices, np.float64) * scale + center for vertices, _ in pieces]


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
