"""Cut touching things apart where a concave crease and a change of color agree; prefer to leave them whole.

A label on a can has another color but no crease; the inside of a bowl has creases but one color: neither is cut.
"""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from reconstruction.instances.config import InstancesConfig
from reconstruction.surface.mesh_graph import MeshGraph

_MAX_VERTICES = 40_000
# Shading changes lightness within one thing; two things mostly differ in hue or strongly in lightness.
LIGHTNESS_WEIGHT = np.array([0.5, 1.0, 1.0], np.float32)


def split_touching(graph: MeshGraph, body: np.ndarray, config: InstancesConfig) -> list[np.ndarray]:
    """Split vertices `body` (sorted indices) into one or more parts, the largest first."""
    if len(body) < 4 * config.min_object_vertices or len(body) > _MAX_VERTICES:
        return [body]
    local = np.full(len(graph.points), -1, np.int64)
    local[body] = np.arange(len(body))
    links = local[graph.edges]
    links = links[(links >= 0).all(axis=1)]
    if len(links) == 0:
        return [body]
    patch = _color_patches(graph.lab[body] * LIGHTNESS_WEIGHT, links, config)
    if patch.max() == 0:
        return [body]
    label = _merge_patches(graph, body, links, patch, config)
    parts = [body[label == i] for i in np.unique(label)]
    return sorted(parts, key=lambda part: (-graph.areas[part].sum(), part[0]))


def _color_patches(lab: np.ndarray, links: np.ndarray, config: InstancesConfig) -> np.ndarray:
    """Return a patch per vertex: connected pieces of one color out of the few that the thing has."""
    centers = [np.median(lab, axis=0)]
    for _ in range(7):  # farthest color first, ignoring a few percent of strays
        distance = np.min([np.linalg.norm(lab - c, axis=1) for c in centers], axis=0)
        limit = np.percentile(distance, 96)
        if limit < config.split_color_contrast:
            break
        far = distance >= limit
        seed = lab[int(np.argmin(np.abs(distance - limit)))]
        near = far | (np.linalg.norm(lab - seed, axis=1) < 0.5 * config.split_color_contrast)
        centers.append(np.median(lab[near & (np.linalg.norm(lab - seed, axis=1) < 20)], axis=0))
    means = np.array(centers)
    for _ in range(6):
        nearest = np.argmin(np.linalg.norm(lab[:, None] - means[None], axis=2), axis=1)
        means = np.array(
            [lab[nearest == k].mean(axis=0) if (nearest == k).any() else m for k, m in enumerate(means)]
        )
    same = nearest[links[:, 0]] == nearest[links[:, 1]]
    adjacency = coo_matrix(
        (np.ones(same.sum(), np.int8), (links[same, 0], links[same, 1])), shape=(len(lab),) * 2
    )
    return connected_components(adjacency, directed=False)[1]


def _merge_patches(
    graph: MeshGraph, body: np.ndarray, links: np.ndarray, patch: np.ndarray, config: InstancesConfig
) -> np.ndarray:
    """Merge patches greedily, the least separate pair first, until every contact left is crease and color."""
    label = patch.copy()
    minimum = max(config.min_object_vertices, 12)
    while True:
        count = int(label.max()) + 1
        if count == 1:
            return label
        sizes = np.bincount(label, minlength=count)
        contact, strength, length = _contacts(graph, body, links, label, count, config)
        if len(contact) == 0:
            return label
        small = sizes[contact].min(axis=1) < minimum
        # Small patches merge first, into the neighbor with the longest contact.
        cost = np.where(small, -length.astype(float) / length.max() - 1.0, strength)
        weakest = int(np.argmin(cost))
        if cost[weakest] >= 1.0:
            return _only_compact(graph, body, label, contact, config)
        a, b = sorted(contact[weakest])
        label[label == b] = a
        label = np.unique(label, return_inverse=True)[1]


def _contacts(
    graph: MeshGraph,
    body: np.ndarray,
    links: np.ndarray,
    label: np.ndarray,
    count: int,
    config: InstancesConfig,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return touching pairs (n, 2), how separate each is (1 = cut), and contact lengths in edges."""
    ends = label[links]
    crossing = ends[:, 0] != ends[:, 1]
    ends = np.sort(ends[crossing], axis=1)
    if len(ends) == 0:
        return np.zeros((0, 2), np.int64), np.zeros(0), np.zeros(0, np.int64)
    keys = ends[:, 0] * count + ends[:, 1]
    unique, inverse = np.unique(keys, return_inverse=True)
    pairs = np.stack([unique // count, unique % count], axis=1)
    length = np.bincount(inverse)
    middle = 0.5 * (graph.points[body[links[crossing, 0]]] + graph.points[body[links[crossing, 1]]])
    concave = crease_angles(graph, body, label, pairs, middle, inverse)
    median_lab = np.stack([np.median(graph.lab[body[label == i]], axis=0) for i in range(count)])
    color = np.linalg.norm((median_lab[pairs[:, 0]] - median_lab[pairs[:, 1]]) * LIGHTNESS_WEIGHT, axis=1)
    strength = np.minimum(concave / config.split_angle_deg, color / config.split_color_contrast)
    return pairs, strength, length


def crease_angles(
    graph: MeshGraph,
    body: np.ndarray,
    label: np.ndarray,
    pairs: np.ndarray,
    middle: np.ndarray,
    which: np.ndarray,
) -> np.ndarray:
    """Return the mean crease along each contact in degrees, positive where concave.

    Both sides are described by the mean position and normal of their vertices within a few spacings of the contact,
    because the edge of a color rarely lies exactly in the crease.

    Args:
        graph: the surface.
        body: vertices of the thing.
        label: patch of each of them.
        pairs: int (n, 2) touching patches.
        middle: float (m, 3) middles of the mesh edges that cross from patch to patch.
        which: int (m,) row of `pairs` that each belongs to.
    """
    points, normals = graph.points[body], graph.normals[body]
    radius = max(0.02, 2.5 * graph.spacing_m)
    trees = {int(k): np.flatnonzero(label == k) for k in np.unique(pairs)}
    search = {k: cKDTree(points[index]) for k, index in trees.items()}
    out = np.zeros(len(pairs))
    for row, (a, b) in enumerate(pairs):
        samples = middle[which == row]
        samples = samples[:: max(1, len(samples) // 40)]
        angles = []
        sides = [search[int(k)].query_ball_point(samples, radius) for k in (a, b)]
        for in_a, in_b in zip(*sides):
            if len(in_a) < 3 or len(in_b) < 3:
                continue
            one, two = trees[int(a)][in_a], trees[int(b)][in_b]
            normal_a, normal_b = normals[one].mean(axis=0), normals[two].mean(axis=0)
            normal_a = normal_a / max(np.linalg.norm(normal_a), 1e-9)
            normal_b = normal_b / max(np.linalg.norm(normal_b), 1e-9)
            bend = np.degrees(np.arccos(np.clip(normal_a @ normal_b, -1, 1)))
            across = points[two].mean(axis=0) - points[one].mean(axis=0)
            angles.append(bend if (normal_a - normal_b) @ across > 0 else -bend)
        out[row] = np.mean(np.clip(angles, -60, 90)) if angles else 0.0
    return out


def _only_compact(
    graph: MeshGraph, body: np.ndarray, label: np.ndarray, contact: np.ndarray, config: InstancesConfig
) -> np.ndarray:
    """Give parts that are too small to be things back to a neighbor."""
    for i in np.unique(label):
        part = body[label == i]
        extents = np.sort(np.ptp(graph.points[part], axis=0))
        if extents[1] < config.min_object_m or len(part) < 2 * config.min_object_vertices:
            neighbors = contact[(contact == i).any(axis=1)].ravel()
            neighbors = neighbors[neighbors != i]
            if len(neighbors):
                sizes = [(label == n).sum() for n in neighbors]
                label[label == i] = label[label == neighbors[int(np.argmax(sizes))]][0] if max(sizes) else i
    return np.unique(label, return_inverse=True)[1]
