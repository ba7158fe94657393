"""Lifting of 2D masks: merge masks across views, then assign each surface vertex to a cluster of masks by vote."""

from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.core.progress import Progress
from reconstruction.core.types import DepthMaps, PosedFrames, Surface
from reconstruction.instances.lifting_graph import cluster_masks
from reconstruction.instances.lifting_views import MaskViews, view_masks
from reconstruction.instances.masks.base import FrameMasks
from reconstruction.instances.superpoints import superpoints

_MIN_VOTES_SHARE = 0.34  # of the frames that see a vertex must vote for its cluster


@dataclass(frozen=True)
class Lifted:
    """Clusters of masks, and the cluster of each vertex."""

    cluster: np.ndarray  # int32 (v,) from 1 on, 0 = in no mask
    share: np.ndarray  # float32 (v,) share of the frames with the vertex in a mask that vote for its cluster
    views: MaskViews
    mask_cluster: np.ndarray  # int32 (m + 1,) cluster of each mask, 0 = none

    @property
    def count(self) -> int:
        """Return the number of clusters."""
        return int(self.mask_cluster.max(initial=0))


def lift_masks(
    graph: MeshGraph,
    surface: Surface,
    posed: PosedFrames,
    depth: DepthMaps,
    masks: FrameMasks,
    progress: Progress,
) -> Lifted:
    """Cluster masks across views; each frame votes for the cluster of every vertex of `graph` that it sees."""
    patches = superpoints(graph)
    views = view_masks(graph, surface, posed, depth, masks, progress)
    mask_cluster = cluster_masks(views, patches, graph.areas)
    cluster, votes, seen = vote(np.ascontiguousarray(views.seen.T), mask_cluster)
    share = (votes / np.maximum(seen, 1)).astype(np.float32)
    cluster = np.where(share >= _MIN_VOTES_SHARE, cluster, 0).astype(np.int32)
    return Lifted(_fill_unseen(cluster, seen, patches, graph.areas), share, views, mask_cluster)


@njit(cache=True, parallel=True)
def vote(seen, mask_cluster):  # pragma: no cover - compiled
    """Count the votes of frames at each vertex; masks without a cluster (under-segmented ones) do not vote.

    Args:
        seen: int32 (v, n) mask in each frame, 0 = none, -1 = not visible.
        mask_cluster: int32 (m + 1,) cluster of each mask, 0 = none.

    Returns:
        Winning cluster (the lower number on a tie), its votes, and all votes, int32 (v,) each.
    """
    count, frames = seen.shape
    winner, votes, total = np.zeros(count, np.int32), np.zeros(count, np.int32), np.zeros(count, np.int32)
    for i in prange(count):
        names = np.zeros(frames, np.int32)
        tally = np.zeros(frames, np.int32)
        used = 0
        for f in range(frames):
            if seen[i, f] <= 0:
                continue
            name = mask_cluster[seen[i, f]]
            if name == 0:
                continue
            total[i] += 1
            slot = 0
            while slot < used and names[slot] != name:
                slot += 1
            if slot == used:
                names[slot] = name
                used += 1
            tally[slot] += 1
        for slot in range(used):
            if tally[slot] > votes[i] or (tally[slot] == votes[i] and names[slot] < winner[i]):
                votes[i] = tally[slot]
                winner[i] = names[slot]
    return winner, votes, total


def _fill_unseen(cluster: np.ndarray, seen: np.ndarray, patches: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Assign vertices without votes to the cluster with the most area in their superpoint."""
    known, count = cluster > 0, int(cluster.max(initial=0)) + 1
    keys, inverse = np.unique(patches[known].astype(np.int64) * count + cluster[known], return_inverse=True)
    weight = np.bincount(inverse.reshape(-1), weights=areas[known], minlength=len(keys))
    owner = np.zeros(int(patches.max(initial=-1)) + 1, np.int32)
    keys = keys[np.argsort(weight, kind="stable")]  # ascending: the cluster with the most area wins
    owner[keys // count] = keys % count
    return np.where((seen == 0) & ~known, owner[patches], cluster).astype(np.int32)
