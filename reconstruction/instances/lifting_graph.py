"""Masks of one thing found by their agreement across views, whatever their ids.

After view-consensus clustering (MaskClustering, CVPR 2024). Two masks show one thing if the other frames that see
both of them put both into one mask. A mask that other frames split is under-segmented and has no say. Clusters grow
from pairs that many frames witness to pairs that few do; a cluster is witnessed by whatever witnesses its masks.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix, triu
from scipy.sparse.csgraph import connected_components

from reconstruction.instances.lifting_views import MaskViews

_VISIBLE_SHARE = 0.3  # of a mask's surface must be seen in a frame for the frame to judge it
_CONTAINED_SHARE = 0.8  # of what is seen of it must lie in one mask there
_SPLIT_SHARE = 0.3  # of the frames that judge a mask may split it
_CONSENSUS = 0.9
_CHUNK = 200_000  # pairs at once
_PURE_SHARE = 0.6  # of a superpoint's seen surface must lie in one mask


@dataclass(frozen=True)
class Agreement:
    """What the frames say of each mask (rows: masks, without the entry for no mask)."""

    judged: csr_matrix  # (m, n) 1 where a frame sees a mask and puts it into one mask of its own
    contained: csr_matrix  # (m, m) 1 where a mask lies within another
    whole: np.ndarray  # bool (m,) not under-segmented


def cluster_masks(views: MaskViews, patches: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Group the masks.

    Args:
        views: which mask shows each vertex in each frame.
        patches: int (v,) superpoint of each vertex.
        areas: float (v,) surface of each vertex.

    Returns:
        int32 (m + 1,) cluster of each mask from 1 on, by its first mask; 0 for none and for under-segmented masks.
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
    """Return the mask int32 (n, s) of each superpoint in each frame; 0 = in none or torn, -1 = hardly seen."""
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
    """Find which frames judge which masks, and which masks lie within which."""
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
    within = (shared.data > _CONTAINED_SHARE * visible[shared.row, frame_of[shared.col]]) & sees[
        shared.row, frame_of[shared.col]
    ]
    row, column = shared.row[within], shared.col[within]
    kept_whole = np.bincount(row, minlength=count)
    whole = (kept_whole > 0) & (sees.sum(axis=1) - kept_whole <= _SPLIT_SHARE * sees.sum(axis=1))
    # A frame whose mask is under-segmented there says nothing of what lies within that mask.
    told = whole[column]
    row, column = row[told], column[told]
    one = np.ones(len(row))
    return Agreement(
        csr_matrix((one, (row, frame_of[column])), shape=(count, frame_count)),
        csr_matrix((one, (row, column)), shape=(count, count)),
        whole,
    )


def _grown(agreement: Agreement, chosen: np.ndarray) -> np.ndarray:
    """Return a label for each chosen mask: merged round by round, with ever fewer witnesses asked for."""
    label = np.arange(len(chosen))
    judged, contained = agreement.judged[chosen], agreement.contained[chosen]
    for least in _schedule(judged, contained):
        while True:
            count = int(label.max()) + 1
            gather = csr_matrix(
                (np.ones(len(label)), (label, np.arange(len(label)))), shape=(count, len(label))
            )
            pairs, agreed, observers = _witnesses((gather @ judged).sign(), (gather @ contained).sign())
            good = (observers >= least) & (agreed >= _CONSENSUS * observers)
            links = csr_matrix((np.ones(good.sum()), pairs[:, good]), shape=(count, count))
            merged = connected_components(links, directed=False)[1]
            if merged.max() + 1 == count:
                break
            label = merged[label]
    return label


def _witnesses(judged: csr_matrix, contained: csr_matrix) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pairs int (2, p) of rows that lie in one mask anywhere, in how many, and how many frames judge both.

    All other pairs have nothing in common, and there are far too many of them.
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
    """Return falling numbers of witnesses: quantiles of what pairs of masks have, the last one 1."""
    counts = _witnesses(judged, contained)[2]
    if len(counts) == 0:
        return [1]
    levels = {int(np.percentile(counts, q)) for q in range(95, -1, -5)}
    return sorted({max(level, 1) for level in levels} | {1}, reverse=True)
