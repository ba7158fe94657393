"""Cut touching things apart where a concave crease and a change of color agree; prefer to leave them whole.

A label on a can has another color but no crease; the inside of a bowl has creases but one color: neither is cut.
"""

import numpy as np
from scipy.sparse import coo_matrix

from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.mesh_graph import MeshGraph

_MAX_VERTICES = 40_000


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
    patch = _color_patches(graph.lab[body], links, graph.areas[body], config)
    if patch.max() == 0:
        return [body]
    label = _merge_patches(graph, body, links, patch, config)
    parts = [body[label == i] for i in np.unique(label)]
    return sorted(parts, key=lambda part: (-graph.areas[part].sum(), part[0]))


def _color_patches(
    lab: np.ndarray, links: np.ndarray, areas: np.ndarray, config: InstancesConfig
) -> np.ndarray:
    """Grow patches of similar color over mesh edges (Felzenszwalb's criterion); return a patch per vertex."""
    weight = np.linalg.norm(lab[links[:, 0]] - lab[links[:, 1]], axis=1)
    order = np.argsort(weight, kind="stable")
    from reconstruction.instances._kernels import grow_patches

    scale = 12.0 * config.min_object_vertices
    roots = grow_patches(links[order].astype(np.int64), weight[order].astype(np.float64), len(lab), scale, 20)
    return np.unique(roots, return_inverse=True)[1]


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
    first, second = body[links[crossing, 0]], body[links[crossing, 1]]
    angle = crease_angles(graph, body, links, first, second)
    concave = np.bincount(inverse, weights=np.clip(angle, -60, 90)) / length
    median_lab = np.stack([np.median(graph.lab[body[label == i]], axis=0) for i in range(count)])
    color = np.linalg.norm(median_lab[pairs[:, 0]] - median_lab[pairs[:, 1]], axis=1)
    strength = np.minimum(concave / config.split_angle_deg, color / config.split_color_contrast)
    return pairs, strength, length


def crease_angles(
    graph: MeshGraph, body: np.ndarray, links: np.ndarray, first: np.ndarray, second: np.ndarray
) -> np.ndarray:
    """Return the crease at edges in degrees, positive where concave, from normals two steps to either side."""
    local = np.full(len(graph.points), -1, np.int64)
    local[body] = np.arange(len(body))
    count = len(body)
    rows = np.concatenate([links[:, 0], links[:, 1]])
    columns = np.concatenate([links[:, 1], links[:, 0]])
    adjacency = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count)).tocsr()
    a, b = local[first], local[second]
    side = graph.points[second] - graph.points[first]
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    # The vertex two steps away that lies farthest along the edge's own direction, on either side.
    normals, points = graph.normals[body], graph.points[body]
    far_a, far_b = a, b
    for _ in range(2):
        far_a = _step(adjacency, points, far_a, -side)
        far_b = _step(adjacency, points, far_b, side)
    across = points[far_b] - points[far_a]
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    bend = np.degrees(np.arccos(np.clip((normals[far_a] * normals[far_b]).sum(axis=1), -1, 1)))
    sign = ((normals[far_a] - normals[far_b]) * across).sum(axis=1)
    return np.where(sign > 0, bend, -bend)


def _step(adjacency, points: np.ndarray, at: np.ndarray, direction: np.ndarray) -> np.ndarray:
    from reconstruction.instances._kernels import step_along

    return step_along(adjacency.indptr, adjacency.indices, points, at, direction)


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
