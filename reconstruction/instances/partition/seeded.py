"""Regions joined to given seeds by learned affinities: what remains of an object when parts of it were pointed at.

Average-linkage agglomeration in which clusters of different seeds are never joined (Bailoni et al., GASP, a generalized
framework for agglomerative clustering of signed graphs, CVPR 2022).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from heapq import heapify, heappop, heappush

import numpy as np

from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.core.types import DepthMaps, PosedFrames, Surface
from reconstruction.instances.partition.cut import features
from reconstruction.instances.partition.features import View
from reconstruction.instances.partition.graph import RegionGraph, region_graph
from reconstruction.instances.partition.model import load_models
from reconstruction.instances.sightings import sightings


@dataclass(frozen=True)
class Affinities:
    """Superpoints of a surface, and the learned affinity of their borders."""

    graph: RegionGraph
    log_odds: np.ndarray  # float32 (e,) that both sides of a border are one object

    @classmethod
    def of(cls, surface: Surface, posed: PosedFrames, depth: DepthMaps) -> "Affinities":
        """Score the borders of a surface; takes seconds.

        Args:
            surface: the surface in world space.
            posed: keyframes with cameras in world space.
            depth: their depth in metres.

        Raises:
            EnvironmentMissing: the weights cannot be read.
        """
        mesh = MeshGraph.from_surface(surface)
        graph = region_graph(mesh)
        if not len(graph.pairs):
            return cls(graph, np.zeros(0, np.float32))
        view = View.of(mesh, surface, sightings(surface, posed, depth))
        scores = load_models().superpoints.scores(*features(view, graph), graph.pairs)
        return cls(graph, scores.affinity)

    def seeded(self, vertices: np.ndarray, region: np.ndarray, seeds: Sequence[Sequence[int]]) -> np.ndarray:
        """Assign vertices to seeds.

        Args:
            vertices: int (k,) to assign, ascending.
            region: int (v,) superpoint of each vertex; may be finer than that of the graph.
            seeds: for each part, vertices that belong to it; no region has seeds of two parts.

        Returns:
            Part of each vertex int (k,), from 0; -1 where no borders lead to a seed.
        """
        inside = np.zeros(len(region), bool)
        inside[vertices] = True
        links, pair = self.graph.links, self.graph.link_pair
        kept = inside[links[:, 0]] & inside[links[:, 1]]
        first, second = region[links[kept, 0]], region[links[kept, 1]]
        numbers, node = np.unique(np.concatenate([region[vertices], first, second]), return_inverse=True)
        # Regions with seeds of one part are one node, whose number is that of the part.
        node_of = np.arange(len(numbers)) + len(seeds)
        for part, points in enumerate(seeds):
            node_of[np.searchsorted(numbers, region[np.asarray(points)])] = part
        node = node_of[node]
        mine, ends = node[: len(vertices)], np.sort(node[len(vertices) :].reshape(2, -1), axis=0)
        count = len(numbers) + len(seeds)
        keys, row = np.unique(ends[0] * count + ends[1], return_inverse=True)
        total = np.bincount(row, weights=self.log_odds[pair[kept]], minlength=len(keys))
        weights = total / np.maximum(np.bincount(row, minlength=len(keys)), 1)
        pairs = np.stack([keys // count, keys % count], axis=1)
        across = pairs[:, 0] != pairs[:, 1]
        return joined_to_seeds(count, pairs[across], weights[across], len(seeds))[mine]


def joined_to_seeds(count: int, pairs: np.ndarray, weights: np.ndarray, seeds: int) -> np.ndarray:
    """Join the nodes of a graph, those with the highest mean weight between them first, but never two seeds.

    Args:
        count: number of nodes; the first ones are the seeds.
        pairs: int (e, 2) edges, each once.
        weights: float (e,) log-odds that both ends are one object.
        seeds: number of seeds.

    Returns:
        Seed of each node int (count,); -1 where no path leads to one.
    """
    borders: list[dict[int, tuple[float, int]]] = [
        {} for _ in range(count)
    ]  # sum and number of weights, by neighbor
    for (a, b), weight in zip(pairs.tolist(), weights.tolist()):
        borders[a][b] = borders[b][a] = (weight, 1)
    parent = list(range(count))
    heap = [(-weight, a, b) for (a, b), weight in zip(pairs.tolist(), weights.tolist())]
    heapify(heap)
    while heap:
        negative, a, b = heappop(heap)
        known = borders[a].get(b)
        if parent[a] != a or parent[b] != b or known is None or known[0] / known[1] != -negative:
            continue  # outdated
        a, b = min(a, b), max(a, b)
        if b < seeds:
            continue
        parent[b] = a
        del borders[a][b]
        for other, (total, number) in borders[b].items():
            if other != a:
                before = borders[a].get(other, (0.0, 0))
                both = (before[0] + total, before[1] + number)
                borders[a][other] = borders[other][a] = both
                del borders[other][b]
                heappush(heap, (-both[0] / both[1], a, other))
        borders[b] = {}
    out = np.full(count, -1, np.int64)
    for node in range(count):
        root = node
        while parent[root] != root:
            root = parent[root]
        out[node] = root if root < seeds else -1
    return out
