"""Collision shape of an open surface: an open mesh in, thin convex plates behind it out.

The mesh is smoothed and split into patches of a cell and a direction each. Patches are merged while their common convex
hull is hardly larger than theirs together (hierarchical approximate convex decomposition, Mamou and Ghorbel 2009).
"""

import heapq

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from reconstruction.assets.collision.build import hull_part
from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.solid import Solid, taubin
from reconstruction.core.types import ConvexPart

PLATE_M = 0.015
"""Thickness of a plate, away from the side that was seen: what moves at 3 m/s passes 12 mm in a step of 1/240 s."""
_SMOOTHING = 10  # rounds of Taubin's smoothing: noise of a few millimetres turns normals
_CELL_M = 0.12  # side of the cells of a patch, two superpoints
_LEAST_AREA_M2 = 1e-3  # smaller patches are noise, or the border of a cell
# Most empty space in a merged hull: share of its patches, and the volume of a plate of 25x25 cm.
_EMPTY_SHARE, _EMPTY_M3 = 0.5, 1e-3


def plate_parts(vertices: np.ndarray, faces: np.ndarray, config: AssetsConfig) -> tuple[ConvexPart, ...]:
    """Return convex plates behind an open mesh, at most `hulls_structure`, largest first.

    Args:
        vertices: float64 (v, 3) metres.
        faces: int (f, 3), counter-clockwise seen from free space.
        config: the number of plates and of their vertices.
    """
    smooth = taubin(Solid(vertices, faces), _SMOOTHING, np.zeros(len(vertices), bool)).vertices
    patches = _Patches(smooth, faces)
    patches.merge()
    order = sorted(patches.hulls, key=lambda k: (-patches.volumes[k], k))[: config.hulls_structure]
    parts = [hull_part(_extreme(patches.hulls[k], config.hull_vertices)) for k in order]
    return tuple(part for part in parts if part is not None)


class _Patches:
    """Patches of a mesh as convex hulls, and which of them touch."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        corners = vertices[faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        label, links = _split(corners.mean(axis=1), cross, faces)
        self.hulls: dict[int, np.ndarray] = {}
        self.volumes: dict[int, float] = {}
        order = np.argsort(label, kind="stable")
        for own in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
            normal = cross[own].sum(axis=0)
            length = float(np.linalg.norm(normal))
            if 0.5 * length < _LEAST_AREA_M2:
                continue
            front = vertices[np.unique(faces[own])]
            hull = _hull(np.concatenate([front, front - PLATE_M * normal / length]))
            if hull is not None:
                key = int(label[own[0]])
                self.hulls[key], self.volumes[key] = hull
        self.solid = dict(self.volumes)  # of the patches that a hull is made of
        self.near: dict[int, set[int]] = {key: set() for key in self.hulls}
        for a, b in links.tolist():
            if a in self.near and b in self.near:
                self.near[a].add(b)
                self.near[b].add(a)

    def merge(self) -> None:
        """Merge touching patches, those first whose hull has the least share of empty space, while it has little."""
        pairs = [(a, b) for a in sorted(self.near) for b in sorted(self.near[a]) if a < b]
        queue = [entry for a, b in pairs if (entry := self._merged(a, b))]
        heapq.heapify(queue)
        last = max(self.hulls, default=0)
        while queue:
            _, a, b, points, volume = heapq.heappop(queue)
            if a not in self.hulls or b not in self.hulls:
                continue
            last += 1
            around = (self.near.pop(a) | self.near.pop(b)) - {a, b}
            self.solid[last] = self.solid.pop(a) + self.solid.pop(b)
            for gone in (a, b):
                del self.hulls[gone], self.volumes[gone]
            self.hulls[last], self.volumes[last], self.near[last] = points, volume, around
            for other in sorted(around):
                self.near[other] -= {a, b}
                self.near[other].add(last)
                entry = self._merged(other, last)
                if entry is not None:
                    heapq.heappush(queue, entry)

    def _merged(self, a: int, b: int) -> tuple | None:
        """Return a queue entry for merging two patches, None if their hull has too much empty space."""
        found = _hull(np.concatenate([self.hulls[a], self.hulls[b]]))
        if found is None:
            return None
        solid = self.solid[a] + self.solid[b]
        empty = found[1] - solid
        return (empty / solid, a, b, *found) if empty <= min(_EMPTY_SHARE * solid, _EMPTY_M3) else None


def _split(centers: np.ndarray, cross: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the patch (f,) of each face, connected faces of a cell and a main axis, and pairs (k, 2) that touch.

    Small patches, at the border of a cell, join the largest that they touch of the same direction.
    """
    from trimesh.graph import connected_component_labels, face_adjacency

    axis = np.abs(cross).argmax(axis=1)
    side = 2 * axis + (np.take_along_axis(cross, axis[:, None], axis=1)[:, 0] > 0)
    key = np.column_stack([np.floor(centers / _CELL_M).astype(np.int64), side])
    key = np.unique(key, axis=0, return_inverse=True)[1].ravel()
    touching = np.asarray(face_adjacency(faces))
    first, second = touching.T
    label = connected_component_labels(touching[key[first] == key[second]], len(faces))
    area = np.bincount(label, weights=0.5 * np.linalg.norm(cross, axis=1))
    own = np.concatenate([first, second])
    other = np.concatenate([second, first])
    joins = (label[own] != label[other]) & (side[own] == side[other]) & (area[label[own]] < _LEAST_AREA_M2)
    small, large = label[own[joins]], label[other[joins]]
    order = np.lexsort((large, -area[large], small))
    small, chosen = np.unique(small[order], return_index=True)
    joined = np.column_stack([small, large[order][chosen]])
    label = connected_component_labels(joined, len(area))[label]
    links = np.sort(label[touching], axis=1)
    return label, np.unique(links[links[:, 0] != links[:, 1]], axis=0)


def _hull(points: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Return the vertices of a convex hull and its volume; None if it has none."""
    try:
        hull = ConvexHull(points)
    except QhullError:
        return None
    return points[hull.vertices], float(hull.volume)


def _extreme(points: np.ndarray, most: int) -> np.ndarray:
    """Return at most `most` of the points (n, 3), by farthest point sampling from the outermost one."""
    if len(points) <= most:
        return points
    chosen = [int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    distance = np.full(len(points), np.inf)
    while len(chosen) < most:
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(distance.argmax()))
    return points[chosen]
