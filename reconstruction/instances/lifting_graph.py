"""Clustering of masks by view consensus, after MaskClustering (CVPR 2024).

Two masks are of one object if most frames that observe both contain both in one mask. Masks that other frames split are
under-segmented and are left out. Clusters grow iteratively, from pairs with many observing frames to pairs with few; a
cluster has the observers of all its masks.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix, triu
from scipy.sparse.csgraph import connected_components

from reconstruction.instances.lifting_views import MaskViews

_VISIBLE_SHARE = 0.3  # a frame observes a mask, or a superpoint, if it sees more than this share of its area
_CONTAINED_SHARE = 0.8  # of the visible area of a mask must lie in one mask of the observing frame
_SPLIT_SHARE = 0.3  # at most this share of the observing frames may split a mask
_CONSENSUS = 0.9  # of the observers of two masks must contain both in one mask
_CHUNK = 200_000  # pairs at once, which bounds the memory
_PURE_SHARE = 0.6  # of a superpoint's visible area must lie in one mask


@dataclass(frozen=True)
class Agreement:
    """Relations of m masks and n frames; rows are mask numbers less 1."""

    judged: csr_matrix  # (m, n) 1 where a frame observes a mask and contains it in one mask of its own
    contained: csr_matrix  # (m, m) 1 where a mask lies within another
    whole: np.ndarray  # bool (m,) not under-segmented


def cluster_masks(views: MaskViews, patches: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Cluster the masks of all frames.

    Args:
        views: the mask of each vertex in each frame.
        patches: int (v,) superpoint of each vertex.
        areas: float (v,) area of each vertex.

    Returns:
        Cluster of each mask int32 (m + 1,), from 1 by first mask; 0 for no mask and for under-segmented masks.
    """
    out = np.zeros(views.mask_count + 1, np.int32)
    if views.mask_count == 0:
        return out
    agreement = agree(views, patch_masks(views, patches, areas), np.bincount(patches, weights=areas))
    chosen = np.flatnonzero(agreement.whole)
    if len(chosen) == 0:
        return out
    label = _grown(agreement, chosen)
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int32)
    rank[np.argsort(first)] = np.arange(1, len(first) + 1)
    out[chosen + 1] = rank[inverse.reshape(-1)]
    return out


def patch_masks(views: MaskViews, patches: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Return the mask int32 (n, s) of each superpoint in each frame; 0 = in none or in several, -1 = hardly visible."""
    count = int(patches.max()) + 1
    total = np.bincount(patches, weights=areas, minlength=count)
    out = np.full((len(views.seen), count), -1, np.int32)
    for row, seen in enumerate(views.seen):
        vertices = np.flatnonzero(seen >= 0)
        visible = np.bincount(patches[vertices], weights=areas[vertices], minlength=count)
        enough = visible > _VISIBLE_SHARE * total
        keys = patches[vertices].astype(np.int64) * (views.mask_count + 1) + seen[vertices]
        unique, inverse = np.unique(keys, return_inverse=True)
        share = np.bincount(inverse.reshape(-1), weights=areas[vertices])
        patch, mask = unique // (views.mask_count + 1), unique % (views.mask_count + 1)
        out[row, enough] = 0
        pure = enough[patch] & (share > _PURE_SHARE * visible[patch])
        out[row, patch[pure]] = mask[pure]
    return out


def agree(views: MaskViews, mask_of_patch: np.ndarray, patch_area: np.ndarray) -> Agreement:
    """Return which frames observe which masks, and which masks lie within which.

    Args:
        views: the masks of all frames.
        mask_of_patch: int (n, s) as `patch_masks` returns it.
        patch_area: float (s,) area of each superpoint.
    """
    frames, patch = np.nonzero(mask_of_patch > 0)
    mask = mask_of_patch[frames, patch] - 1
    count, frame_count = views.mask_count, len(views.seen)
    member = csr_matrix((np.ones(len(mask)), (mask, patch)), shape=(count, len(patch_area)))
    masked = csr_matrix((np.ones(len(mask)), (patch, frames)), shape=(len(patch_area), frame_count))
    weighted = member.multiply(patch_area[None, :]).tocsr()
    size = np.asarray(weighted.sum(axis=1)).ravel()
    visible = np.asarray((weighted @ masked).todense())
    sees = (visible > _VISIBLE_SHARE * size[:, None]) & (size[:, None] > 0)
    shared = (weighted @ member.T).tocoo()
    frame_of = views.mask_frame[1:]
    seen = shared.row, frame_of[shared.col]
    within = (shared.data > _CONTAINED_SHARE * visible[seen]) & sees[seen]
    row, column = shared.row[within], shared.col[within]
    kept_whole = np.bincount(row, minlength=count)
    whole = (kept_whole > 0) & (sees.sum(axis=1) - kept_whole <= _SPLIT_SHARE * sees.sum(axis=1))
    # Containment in an under-segmented mask is no evidence.
    told = whole[column]
    row, column = row[told], column[told]
    one = np.ones(len(row))
    return Agreement(
        csr_matrix((one, (row, frame_of[column])), shape=(count, frame_count)),
        csr_matrix((one, (row, column)), shape=(count, count)),
        whole,
    )


def _grown(agreement: Agreement, chosen: np.ndarray) -> np.ndarray:
    """Return a label for each chosen mask: clusters are merged with a falling least number of observers."""
    label = np.arange(len(chosen))
    judged, contained = agreement.judged[chosen], agreement.contained[chosen]
    for least in _schedule(judged, contained):
        while True:
            count = int(label.max()) + 1
            members = (np.ones(len(label)), (label, np.arange(len(label))))
            gather = csr_matrix(members, shape=(count, len(label)))
            pairs, agreed, observers = _witnesses((gather @ judged).sign(), (gather @ contained).sign())
            good = (observers >= least) & (agreed >= _CONSENSUS * observers)
            links = csr_matrix((np.ones(good.sum()), pairs[:, good]), shape=(count, count))
            merged = connected_components(links, directed=False)[1]
            if merged.max() + 1 == count:
                break
            label = merged[label]
    return label


def _witnesses(judged: csr_matrix, contained: csr_matrix) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pairs int (2, p) of rows that share a mask, the number of shared masks, and of frames that observe both.

    Pairs without a shared mask never merge and are left out.
    """
    shared = triu(contained @ contained.T, 1).tocoo()
    pairs = np.stack([shared.row, shared.col])
    dense = judged.toarray().astype(bool)
    observers = np.zeros(len(shared.data), np.int64)
    for start in range(0, len(observers), _CHUNK):
        part = slice(start, start + _CHUNK)
        observers[part] = (dense[pairs[0, part]] & dense[pairs[1, part]]).sum(axis=1)
    return pairs, shared.data, observers


def _schedule(judged: csr_matrix, contained: csr_matrix) -> list[int]:
    """Return falling least numbers of observers: quantiles over pairs of masks, the last one 1."""
    counts = _witnesses(judged, contained)[2]
    if len(counts) == 0:
        return [1]
    levels = {int(np.percentile(counts, q)) for q in range(95, -1, -5)}
    return sorted({max(level, 1) for level in levels} | {1}, reverse=True)
