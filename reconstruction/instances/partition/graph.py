"""Region adjacency graph of superpoints, with edges across mesh borders and across small gaps."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.instances.superpoints import superpoints

GAP_M = 0.03  # largest gap that an edge may bridge
LABELS = ("thing", "base", "artifact")


@dataclass(frozen=True)
class Scores:
    """Scores of the network for a graph."""

    affinity: np.ndarray  # float32 (e,) log-odds that both sides are one object
    label: np.ndarray  # float32 (n, 3) log-probabilities of LABELS


@dataclass(frozen=True)
class RegionGraph:
    """Graph with regions of a mesh (superpoints, or clusters of them) as nodes.

    A link is a pair of vertices of two regions: a mesh edge across their border, or two vertices across a gap.
    """

    region: np.ndarray  # int32 (v,) region of each vertex, from 0
    count: int  # number of regions
    pairs: np.ndarray  # int32 (e, 2) edges: neighboring regions, the smaller number first, sorted
    touching: np.ndarray  # bool (e,) linked by mesh edges, else across a gap
    links: np.ndarray  # int32 (l, 2) vertices; the first one belongs to the pair's first region
    link_pair: np.ndarray  # int32 (l,) row in `pairs` of each link


def region_graph(mesh: MeshGraph, gap_m: float = GAP_M) -> RegionGraph:
    """Return the graph of a mesh's superpoints.

    Superpoints with vertices within `gap_m` of each other are joined, too, unless they have a common neighbor.
    """
    region = superpoints(mesh)
    a, b = region[mesh.edges[:, 0]], region[mesh.edges[:, 1]]
    links = mesh.edges[a != b]
    across = _gap_links(mesh, region, links, gap_m)
    touching = np.r_[np.ones(len(links), bool), np.zeros(len(across), bool)]
    return graph_of_links(region, np.concatenate([links, across]), touching)


def _gap_links(mesh: MeshGraph, region: np.ndarray, links: np.ndarray, gap_m: float) -> np.ndarray:
    """Return pairs of vertices (k, 2) within `gap_m`, of regions that are neither neighbors nor have a common one."""
    if len(region) == 0:
        return np.zeros((0, 2), np.int32)
    near = cKDTree(mesh.points).query_pairs(gap_m, output_type="ndarray")
    near = near[region[near[:, 0]] != region[near[:, 1]]]
    count = int(region.max()) + 1
    ends = region[links]
    ones = np.ones(2 * len(ends) + count, np.int32)
    rows, columns = np.r_[ends[:, 0], ends[:, 1], :count], np.r_[ends[:, 1], ends[:, 0], :count]
    step = csr_matrix((ones, (rows, columns)), shape=(count, count))
    step.data[:] = 1
    reached = (step @ step).tocoo()  # pyright: ignore[reportAttributeAccessIssue]
    known = np.sort(reached.row.astype(np.int64) * count + reached.col)
    keys = region[near[:, 0]].astype(np.int64) * count + region[near[:, 1]]
    place = np.minimum(np.searchsorted(known, keys), len(known) - 1)
    near = near[known[place] != keys]
    return near[np.lexsort((near[:, 1], near[:, 0]))].astype(np.int32)


def graph_of_links(
    region: np.ndarray, links: np.ndarray, touching: np.ndarray, count: int | None = None
) -> RegionGraph:
    """Return the graph of regions int32 (v,) with links int32 (l, 2), `touching` (l,) where they are mesh edges."""
    if count is None:
        count = int(region.max()) + 1 if len(region) else 0
    ends = region[links].astype(np.int64)
    swap = ends[:, 0] > ends[:, 1]
    links = np.where(swap[:, None], links[:, ::-1], links)
    low, high = ends.min(axis=1), ends.max(axis=1)
    keys, link_pair = np.unique(low * count + high, return_inverse=True)
    pairs = np.stack([keys // max(count, 1), keys % max(count, 1)], axis=1).astype(np.int32)
    joined = np.zeros(len(pairs), bool)
    joined[link_pair[touching]] = True
    kept = touching | ~joined[link_pair]  # links across a gap are dropped where mesh edges join the regions
    return RegionGraph(
        region, count, pairs, joined, links[kept].astype(np.int32), link_pair[kept].astype(np.int32)
    )
