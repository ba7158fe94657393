"""Over-segmentation of a surface into patches without creases, and what their contacts look like.

Things that touch meet in a concave crease, mostly with a change of color across it. Patches are grown from what is free
of both; each contact of two patches then says, averaged along its length, how concave it is and how the colors beside
it differ. All scales are metres, whatever the spacing of the mesh.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree

from reconstruction.instances.colors import LIGHTNESS_WEIGHT
from reconstruction.surface.mesh_graph import MeshGraph

_MAX_BEND_PER_M = 12.0  # a fillet of 8 cm radius: no crease
_COLOR_STEP_PER_M = 600.0  # CIELAB units a metre of surface that hold the water as a crease of that bend does
_MAX_PAINTS, _PAINT_GAP = (
    10,
    12.0,
)  # how many colors a body is painted with, and how far apart they are at least
_MIN_SEED_M2 = 3e-4
_SIDE_M = 0.03  # how far beside a contact its two sides are looked at
_BEND_M = 0.022  # and how far for the crease
_BLUR_M = 0.010  # color this close to a contact is mixed with the other side's
_LEVEL = 0.6  # of a mean normal's z: a side that something can lie on


@dataclass(frozen=True)
class Contacts:
    """Touching pairs of patches, and sums along their common borders."""

    pairs: np.ndarray  # int (n, 2) smaller patch first
    length_m: np.ndarray  # float (n,)
    bend_deg: np.ndarray  # float (n,) mean, positive where concave
    color: np.ndarray  # float (n,) mean CIELAB distance of the two sides, lightness at half weight
    level: np.ndarray  # float (n, 2) share of the border along which the first, the second patch faces up


def crease_patches(graph: MeshGraph, body: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a patch number for each vertex of `body` (sorted indices), and the mesh edges within it as rows of it."""
    local = np.full(len(graph.points), -1, np.int64)
    local[body] = np.arange(len(body))
    links = local[graph.edges_within(body)]
    count = len(body)
    if len(links) == 0:
        return np.zeros(count, np.int64), links
    points, normals, lab = graph.points[body], graph.normals[body], graph.lab[body] * LIGHTNESS_WEIGHT
    across = points[links[:, 1]] - points[links[:, 0]]
    length = np.maximum(np.linalg.norm(across, axis=1), 2e-3)
    bend = -((normals[links[:, 1]] - normals[links[:, 0]]) * across).sum(axis=1) / length**2
    step = np.linalg.norm(lab[links[:, 1]] - lab[links[:, 0]], axis=1) / np.maximum(length, 6e-3)
    crease = np.maximum(bend, 0) / _MAX_BEND_PER_M
    wall = np.zeros(count)
    np.maximum.at(wall, links[:, 0], crease)
    np.maximum.at(wall, links[:, 1], crease)
    paint = palette(lab, _MAX_PAINTS, _PAINT_GAP)[0]
    same = paint[links[:, 0]] == paint[links[:, 1]]
    seed = _seeds(wall < 1.0, links, links[same], graph.areas[body])
    barrier = crease + step / _COLOR_STEP_PER_M
    if seed.max() < 2:
        return np.zeros(count, np.int64), links
    patch = _flooded(barrier + 1e-3 * length / graph.spacing_m, links, seed)
    lost = patch == 0  # islands without a seed
    if lost.any():
        nearest = cKDTree(points[~lost]).query(points[lost])[1]
        patch[lost] = patch[~lost][nearest]
    return np.unique(patch, return_inverse=True)[1], links


def _seeds(free: np.ndarray, links: np.ndarray, same: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Return the number (from 1) of the connected free region of one color of each vertex, drawn in by one; else 0."""
    core = free.copy()
    core[links[~free[links[:, 1]], 0]] = False
    core[links[~free[links[:, 0]], 1]] = False
    for chosen in (core, free):  # what is too slim to be drawn in is its own seed
        inner = same[chosen[same].all(axis=1)]
        graph = coo_matrix((np.ones(len(inner), np.int8), (inner[:, 0], inner[:, 1])), shape=(len(free),) * 2)
        label = connected_components(graph, directed=False)[1]
        size = np.bincount(label, weights=np.where(chosen, areas, 0.0))
        if chosen is core:
            kept = core & (size[label] > _MIN_SEED_M2)
            seed = np.where(kept, 1 + label, 0)
        else:
            taken = np.unique(label[seed > 0])
            slim = free & (size[label] > _MIN_SEED_M2) & ~np.isin(label, taken)
            seed = np.where(slim, 1 + len(free) + label, seed)
    values, number = np.unique(seed, return_inverse=True)
    return number if values[0] == 0 else number + 1


def _flooded(height: np.ndarray, links: np.ndarray, seed: np.ndarray) -> np.ndarray:
    """Return for each vertex the seed that floods it first as the water rises; 0 where none can (a watershed)."""
    count = len(seed)
    starts = np.flatnonzero(seed)
    rows = np.concatenate([links[:, 0], np.full(len(starts), count)])
    columns = np.concatenate([links[:, 1], starts])
    values = np.concatenate([1.0 + height, np.full(len(starts), 0.5)])  # zeros would be no edges
    tree = minimum_spanning_tree(csr_matrix((values, (rows, columns)), shape=(count + 1, count + 1))).tocoo()
    kept = (tree.row < count) & (tree.col < count)
    inner = coo_matrix((tree.data[kept], (tree.row[kept], tree.col[kept])), shape=(count, count))
    label = connected_components(inner, directed=False)[1]
    of_label = np.zeros(label.max() + 1, np.int64)
    of_label[label[starts]] = seed[starts]
    return of_label[label]


def contacts_of(graph: MeshGraph, body: np.ndarray, links: np.ndarray, patch: np.ndarray) -> Contacts:
    """Measure the contact of each pair of touching patches."""
    ends = patch[links]
    crossing = ends[:, 0] != ends[:, 1]
    links, ends = links[crossing], ends[crossing]
    points, normals, lab = graph.points[body], graph.normals[body], graph.lab[body] * LIGHTNESS_WEIGHT
    swap = ends[:, 0] > ends[:, 1]
    ends[swap] = ends[swap][:, ::-1]
    pairs, which = np.unique(ends, axis=0, return_inverse=True)
    which = which.ravel()
    if len(pairs) == 0:
        return Contacts(pairs.reshape(0, 2), np.zeros(0), np.zeros(0), np.zeros(0), np.zeros((0, 2)))
    middle = 0.5 * (points[links[:, 0]] + points[links[:, 1]])
    bend, color, good = np.zeros(len(middle)), np.zeros(len(middle)), np.zeros(len(middle))
    level = np.zeros((len(middle), 2))
    around = cKDTree(points).query_ball_point(middle, _SIDE_M, return_sorted=True)
    for row, near in enumerate(around):
        near = np.asarray(near, np.int64)  # of a coarse mesh there may be none
        owner = patch[near]
        one, two = near[owner == ends[row, 0]], near[owner == ends[row, 1]]
        if len(one) < 3 or len(two) < 3:
            continue
        close = np.linalg.norm(points[near] - middle[row], axis=1) < _BEND_M
        within = [near[close & (owner == end)] for end in ends[row]]
        if min(len(side) for side in within) >= 3:
            bend[row] = _bend(points, normals, *within)
        color[row] = _color_gap(points, lab, middle[row], one, two)
        level[row] = normals[one, 2].mean() > _LEVEL, normals[two, 2].mean() > _LEVEL
        good[row] = 1.0
    total = np.bincount(which, weights=good)
    share = np.maximum(total, 1e-9)
    # Each crossing edge of a mesh stands for about half a spacing of border.
    return Contacts(
        pairs,
        np.bincount(which) * 0.5 * graph.spacing_m,
        np.bincount(which, weights=good * np.clip(bend, -60, 90)) / share,
        np.bincount(which, weights=good * np.minimum(color, 50.0)) / share,
        np.stack([np.bincount(which, weights=level[:, k]) / share for k in range(2)], axis=1),
    )


def _bend(points: np.ndarray, normals: np.ndarray, one: np.ndarray, two: np.ndarray) -> float:
    """Return the angle between the mean normals of two sides in degrees, positive where the surface is concave."""
    a, b = normals[one].mean(axis=0), normals[two].mean(axis=0)
    a, b = a / max(np.linalg.norm(a), 1e-9), b / max(np.linalg.norm(b), 1e-9)
    angle = float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))
    across = points[two].mean(axis=0) - points[one].mean(axis=0)
    return angle if (a - b) @ across > 0 else -angle


def _color_gap(
    points: np.ndarray, lab: np.ndarray, middle: np.ndarray, one: np.ndarray, two: np.ndarray
) -> float:
    sides = []
    for side in (one, two):
        clear = side[np.linalg.norm(points[side] - middle, axis=1) > _BLUR_M]
        sides.append(lab[clear if len(clear) >= 3 else side].mean(axis=0))
    return float(np.linalg.norm(sides[0] - sides[1]))


def palette(lab: np.ndarray, most: int, gap: float) -> tuple[np.ndarray, np.ndarray]:
    """Return for each color (n, 3) its row among at most `most` typical ones (k, 3), `gap` apart but for few strays."""
    centers = [np.median(lab, axis=0)]
    distance = np.linalg.norm(lab - centers[0], axis=1)
    while len(centers) < most:
        limit = np.percentile(distance, 99)
        if limit < gap:
            break
        seed = lab[int(np.argmin(np.abs(distance - limit)))]
        centers.append(lab[np.linalg.norm(lab - seed, axis=1) < 0.5 * gap].mean(axis=0))
        distance = np.minimum(distance, np.linalg.norm(lab - centers[-1], axis=1))
    means = np.array(centers)
    return np.argmin(((lab[:, None] - means[None]) ** 2).sum(axis=2), axis=1), means
