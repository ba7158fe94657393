"""Convex collision parts: one hull for nearly convex things, else CoACD, brought to the visual bounds."""

import numpy as np

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.solid import Solid, box_solid, from_manifold, hull_solid, lighten
from reconstruction.types import ConvexPart


def collision_parts(
    solid: Solid, config: AssetsConfig, *, levels: tuple[float, ...] = ()
) -> tuple[ConvexPart, ...]:
    """Approximate a closed mesh in object space (bottom at z = 0) by convex parts within its bounds.

    Args:
        solid: the closed mesh.
        config: budgets and limits.
        levels: heights at which other things stand on it. No part passes through them, so that tops come out level.
    """
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    furniture = float((high - low).max()) > config.furniture_m
    budget = config.hulls_furniture if furniture else config.hulls_small
    pieces = _sliced(solid, levels)
    if len(pieces) == 1 and (hull := _nearly_convex(solid, config)) is not None:
        return (_limited(hull.vertices, config, low, high),)
    total = sum(p.volume for p in pieces)
    parts: list[np.ndarray] = []
    for piece in pieces:
        hull = _nearly_convex(piece, config)
        if hull is not None or piece.volume < 0.03 * total:
            hull = hull or hull_solid(piece.vertices)
            parts.append(_limited(hull.vertices, config, *_bounds(piece)).vertices.astype(np.float64))
            continue
        share = max(4, round(budget * piece.volume / total))
        # Thin walls show as a low filled share: the hollower, the finer the cuts.
        filled = piece.volume / max(hull_solid(piece.vertices).volume, 1e-12)
        threshold = config.coacd_threshold * (0.6 if filled < 0.5 and not furniture else 1.0)
        made = _to_bounds(_decompose(piece, threshold, share, config), *_bounds(piece))
        parts += made
    parts = [fixed for part in parts if (fixed := _deflate(part, low, high, config)) is not None]
    return tuple(parts) if parts else (_limited(hull_solid(solid.vertices).vertices, config, low, high),)


def _bounds(solid: Solid) -> tuple[np.ndarray, np.ndarray]:
    return solid.vertices.min(axis=0), solid.vertices.max(axis=0)


def _nearly_convex(solid: Solid, config: AssetsConfig) -> Solid | None:
    """Return the convex hull where the surface nowhere lies deeper inside it than reconstruction noise."""
    hull = hull_solid(solid.vertices)
    if solid.volume > config.convex_enough * hull.volume:
        return hull
    if solid.volume < 0.6 * hull.volume:
        return None
    from scipy.spatial import cKDTree

    # From the hull down to the surface: over an opening that is its half width, over noise it is the noise.
    corner = hull.vertices[hull.faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    rng = np.random.default_rng(config.seed)
    chosen = rng.choice(len(area), 1500, p=area / area.sum())
    weight = rng.dirichlet((1.0, 1.0, 1.0), 1500)
    probes = np.einsum("nk,nkc->nc", weight, corner[chosen])
    gap, _ = cKDTree(np.concatenate([solid.vertices, solid.vertices[solid.faces].mean(axis=1)])).query(probes)
    allowed = np.clip(config.dent_share * float(np.median(solid.extents)), 0.003, config.dent_limit_m)
    return hull if float(np.percentile(gap, 95)) < allowed else None


def _sliced(solid: Solid, levels: tuple[float, ...]) -> list[Solid]:
    """Cut a solid at heights; layers above the lowest fall into their separate bodies, crumbs left out."""
    import manifold3d

    top = float(solid.vertices[:, 2].max())
    heights: list[float] = []
    for level in sorted(levels):
        if level > 0.008 and (not heights or level - heights[-1] > 0.02):
            heights.append(level)
    heights = [h for h in heights if h < top - 0.001][:4]
    if not heights:
        return [solid]
    mesh = manifold3d.Mesh(
        vert_properties=np.ascontiguousarray(solid.vertices, np.float32),
        tri_verts=np.ascontiguousarray(solid.faces, np.uint32),
    )
    mesh.merge()
    body = manifold3d.Manifold(mesh)
    if body.status() != manifold3d.Error.NoError or body.is_empty():
        return [solid]
    out, whole = [], solid.volume
    for height in heights:
        above, below = body.split_by_plane((0.0, 0.0, 1.0), height)
        if not below.is_empty():
            out.append(from_manifold(below))
        body = above
    for piece in body.decompose() if not body.is_empty() else []:
        made = from_manifold(piece)
        # Lower things than this above a plane that carries others are noise of its surface.
        if made.extents[2] > 0.012 and made.volume > 0.002 * whole:
            out.append(made)
    return out or [solid]


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
        resolution=100,
        mcts_nodes=6,
        mcts_iterations=6,
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
