"""From 2D masks of any origin to things on the surface: which cluster of masks each vertex belongs to."""

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

_MIN_VOTES_SHARE = 0.34  # of the frames that see a vertex must put it into the cluster that it goes to


@dataclass(frozen=True)
class Lifted:
    """Masks merged across views, and the surface divided among them."""

    cluster: np.ndarray  # int32 (v,) from 1 on; 0 = in no mask, or never seen in one
    share: np.ndarray  # float32 (v,) of the frames that see the vertex in some mask and agree with that
    views: MaskViews
    mask_cluster: np.ndarray  # int32 (m + 1,) cluster of each mask
    patches: np.ndarray  # int32 (v,) superpoints

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
    """Merge masks across views and let every frame vote for every vertex that it sees.

    Args:
        graph: the surface in world space, in metres.
        surface: what the graph is of.
        posed: keyframes.
        depth: their depth.
        masks: id images of posed frames; ids of two frames are unrelated.
        progress: told of every frame.
    """
    patches = superpoints(graph)
    views = view_masks(graph, surface, posed, depth, masks, progress)
    mask_cluster = cluster_masks(views, patches, graph.areas)
    cluster, votes, seen = vote(np.ascontiguousarray(views.seen.T), mask_cluster)
    share = (votes / np.maximum(seen, 1)).astype(np.float32)
    cluster = np.where(share >= _MIN_VOTES_SHARE, cluster, 0).astype(np.int32)
    cluster = _fill_unseen(cluster, seen, patches, graph.areas)
    return Lifted(cluster, share, views, mask_cluster, patches)


@njit(cache=True, parallel=True)
def vote(seen, mask_cluster):  # pragma: no cover - compiled
    """Count votes: the cluster that most frames see at each vertex, how many do, and how many see any.

    Frames whose mask is under-segmented there say nothing.

    Args:
        seen: int32 (v, n) mask in each frame, 0 = none, -1 = not seen.
        mask_cluster: int32 (m + 1,) cluster of each mask, 0 = none.

    Returns:
        int32 (v,) each; of two clusters with equal votes the first one.
    """
    count, frames = seen.shape
    winner, votes, total = (
        np.zeros(count, np.int32),
        np.zeros(count, np.int32),
        np.zeros(count, np.int32),
    )
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
    """Give vertices that no frame shows in a mask to the cluster that most of their superpoint belongs to."""
    patch_count = int(patches.max(initial=-1)) + 1
    known = cluster > 0
    keys = patches[known].astype(np.int64) * (int(cluster.max(initial=0)) + 1) + cluster[known]
    unique, inverse = np.unique(keys, return_inverse=True)
    weight = np.bincount(inverse.reshape(-1), weights=areas[known], minlength=len(unique))
    owner = np.zeros(patch_count, np.int32)
    order = np.argsort(weight, kind="stable")  # the heaviest is written last
    owner[unique[order] // (int(cluster.max(initial=0)) + 1)] = unique[order] % (
        int(cluster.max(initial=0)) + 1
    )
    return np.where((seen == 0) & ~known, owner[patches], cluster).astype(np.int32)
