"""The separate things that stand on a support plane, cut off at the contact."""

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.supports import (
    SupportRegion,
    contact_height,
    median_color,
    span_ratio,
    stands_on,
)
from reconstruction.surface.mesh_graph import MeshGraph, pieces


def candidates_on(
    graph: MeshGraph, body: np.ndarray, support: SupportRegion, config: InstancesConfig
) -> list[np.ndarray]:
    """Return the separate things that stand on a support plane of `body`, each cut off at the contact.

    Noise of the support and the feet of neighbors join things just above the plane, so pieces that are refused at one
    level are looked at again a little higher; what is found there gets back the foot that lies right below it.
    """
    out: list[np.ndarray] = []
    base = contact_height(support, config)
    above = body[graph.points[body, 2] > support.height_m + base]
    above = np.setdiff1d(above, support.vertices, assume_unique=True)
    pool = [above]
    levels = (base, 1.8 * base, 3.0 * base, 4.5 * base)
    large = bool(np.ptp(graph.points[support.vertices, :2], axis=0).max() > 0.5)
    for level in levels:
        refused = []
        for part in pool:
            high = part[graph.points[part, 2] > support.height_m + level]
            for candidate in pieces(graph, high):
                if len(candidate) < config.min_object_vertices:
                    continue
                candidate = _without_stain(graph, candidate, support)
                # What covers most of a large support may be several things joined by noise: look higher first.
                wide = large and span_ratio(graph, support, candidate) > 0.55 and level < levels[-1]
                if not wide and stands_on(graph, body, support, candidate, level, config):
                    out.append(
                        _with_foot(graph, candidate, above, level + support.height_m)
                        if level > base
                        else candidate
                    )
                else:
                    refused.append(candidate)
        pool = refused
    out = _merge_alike(graph, _disjoint(out))
    return [part for one in out for part in _fall_apart(graph, body, one, support, base, config)]


def _fall_apart(
    graph: MeshGraph,
    body: np.ndarray,
    whole: np.ndarray,
    support: SupportRegion,
    base: float,
    config: InstancesConfig,
) -> list[np.ndarray]:
    """Cut neighbors that only touch at their feet: higher up they are separate and of different colors."""
    height = float(np.ptp(graph.points[whole, 2]))
    for level in (1.8 * base, 3.0 * base, 4.5 * base, base + 0.3 * height, base + 0.5 * height):
        high = whole[graph.points[whole, 2] > support.height_m + level]
        parts = [p for p in pieces(graph, high) if graph.areas[p].sum() > 0.12 * graph.areas[whole].sum()]
        if len(parts) < 2 or not all(stands_on(graph, body, support, p, level, config) for p in parts):
            continue
        colors = [median_color(graph, p) for p in parts]
        gaps = [np.linalg.norm(a - b) for i, a in enumerate(colors) for b in colors[:i]]
        if min(gaps) < 5.0:
            continue
        owner = np.concatenate([np.full(len(p), i) for i, p in enumerate(parts)])
        nearest = cKDTree(graph.points[np.concatenate(parts)]).query(graph.points[whole])[1]
        out = [whole[owner[nearest] == i] for i in range(len(parts))]
        if max(graph.points[part, 2].min() for part in out) < support.height_m + base + 0.02:
            return out  # each reaches down to the support: none is a handle
    return [whole]


def _merge_alike(graph: MeshGraph, parts: list[np.ndarray]) -> list[np.ndarray]:
    """Join pieces of one color with a narrow gap between them: one thing torn by holes in the surface."""
    parts = sorted(parts, key=lambda p: (-graph.areas[p].sum(), p[0]))
    i = 0
    while i < len(parts):
        tree = cKDTree(graph.points[parts[i]])
        for j in range(i + 1, len(parts)):
            gap = tree.query(graph.points[parts[j]], distance_upper_bound=0.03)[0].min()
            if (
                gap < 0.025
                and np.linalg.norm(median_color(graph, parts[i]) - median_color(graph, parts[j])) < 9.0
            ):
                parts[i] = np.union1d(parts[i], parts[j])
                del parts[j]
                break
        else:
            i += 1
    return parts


def _without_stain(graph: MeshGraph, candidate: np.ndarray, support: SupportRegion) -> np.ndarray:
    """Leave out what clings to the foot of a thing but has the support's color: noise around the contact."""
    z = graph.points[candidate, 2] - support.height_m
    body = candidate[z > min(0.03, float(np.percentile(z, 60)))]
    if len(body) < 5:
        return candidate
    own = np.median(graph.lab[body], axis=0)
    if np.linalg.norm(own - support.lab) < 18.0:
        return candidate
    to_support = np.linalg.norm(graph.lab[candidate] - support.lab, axis=1)
    to_own = np.linalg.norm(graph.lab[candidate] - own, axis=1)
    stained = candidate[(to_support < 9.0) & (to_own > 1.5 * to_support)]
    # Fattened depth drapes a skirt of the support's color around a thing; letters on a label do not reach the foot.
    skirt = [p for p in pieces(graph, stained) if graph.points[p, 2].min() < support.height_m + 0.025]
    if not skirt:
        return candidate
    clean = np.setdiff1d(candidate, np.concatenate(skirt), assume_unique=True)
    if len(clean) < 0.4 * len(candidate):
        return candidate
    parts = pieces(graph, clean, 1.6 * graph.spacing_m)
    return np.sort(
        np.concatenate([p for p in parts if graph.areas[p].sum() > 0.1 * graph.areas[parts[0]].sum()])
    )


def _with_foot(graph: MeshGraph, candidate: np.ndarray, above: np.ndarray, level: float) -> np.ndarray:
    """Add what lies below the level at which a candidate came free, right under it."""
    low = above[graph.points[above, 2] <= level]
    foot = candidate[graph.points[candidate, 2] < level + 0.015]
    if len(low) == 0 or len(foot) == 0:
        return candidate
    distance, _ = cKDTree(graph.points[foot, :2]).query(graph.points[low, :2])
    return np.union1d(candidate, low[distance < max(0.01, 1.2 * graph.spacing_m)])


def _disjoint(parts: list[np.ndarray]) -> list[np.ndarray]:
    out: list[np.ndarray] = []
    for part in parts:
        for other in out:
            part = np.setdiff1d(part, other, assume_unique=True)
        out.append(part)
    return out
