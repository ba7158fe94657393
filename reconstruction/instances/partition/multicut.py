"""Multicut of a weighted graph: greedy additive edge contraction (GAEC), then local search by node moves and joins.

It maximizes the sum of the weights of edges within clusters (Keuper et al., Efficient decomposition of image and mesh
graphs by lifted multicuts, ICCV 2015). Moves are of the Kernighan-Lin type, one node at a time. Labels of nodes are
terminal nodes (Levinkov et al., Joint graph decomposition and node labeling, CVPR 2017).
"""

from heapq import heapify, heappop, heappush

import numpy as np
from numba import njit

_ROUNDS = 30  # at most, of the local search and of the moves within it


def multicut(count: int, pairs: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the cluster int32 (count,) of each node, numbered from 0 by its first node.

    Args:
        count: number of nodes.
        pairs: int (e, 2) edges, each once, no loops.
        weights: float (e,) log-odds that both ends are one object; -inf for ends that must be separate.
    """
    if count == 0:
        return np.zeros(0, np.int32)
    pairs = np.ascontiguousarray(pairs, np.int64).reshape(-1, 2)
    weights = np.maximum(np.asarray(weights, np.float64), -1e9)
    label = contract_edges(count, pairs, weights)
    for _ in range(_ROUNDS):
        before = label
        label = _joined(_moved(count, pairs, weights, label), pairs, weights)
        if np.array_equal(label, before):
            break
    return _numbered(label)


def partition_with_labels(
    pairs: np.ndarray, weights: np.ndarray, unary: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Partition a graph and label its nodes jointly. Only label 0 has several clusters.

    Every other label is a terminal node, which shares one cluster with its nodes.

    Args:
        pairs: int (e, 2) edges.
        weights: float (e,) log-odds that both ends are one object.
        unary: float (n, k) log-probabilities of the labels.

    Returns:
        Label of each node int32 (n,), and cluster of each node int32 (n,) from 0.
    """
    count, labels = unary.shape
    nodes = np.arange(count)
    ends, terms = [np.asarray(pairs, np.int64)], [np.asarray(weights, np.float64)]
    for k in range(1, labels):
        ends.append(np.stack([nodes, np.full(count, count + k - 1)], axis=1))
        terms.append(unary[:, k] - unary[:, 0])
        for other in range(k + 1, labels):
            ends.append(np.array([[count + k - 1, count + other - 1]]))
            terms.append(np.array([-np.inf]))
    cluster = multicut(count + labels - 1, np.concatenate(ends), np.concatenate(terms))
    label = np.zeros(count, np.int32)
    for k in range(1, labels):
        label[cluster[:count] == cluster[count + k - 1]] = k
    return label, _numbered(cluster[:count])


def energy(pairs: np.ndarray, weights: np.ndarray, label: np.ndarray) -> float:
    """Return the sum of the weights of edges within clusters."""
    return float(np.asarray(weights)[label[pairs[:, 0]] == label[pairs[:, 1]]].sum())


def _numbered(label: np.ndarray) -> np.ndarray:
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int32)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse.reshape(-1)]


def contract_edges(count: int, pairs: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Contract the heaviest edge, parallel edges summed, while its weight is positive; return roots int (count,)."""
    if len(pairs) == 0:
        return np.arange(count)
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    low, high = pairs.min(axis=1)[order], pairs.max(axis=1)[order]
    return _gaec(count, low, high, weights[order])


def _joined(label: np.ndarray, pairs: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Join whole clusters while that increases the objective."""
    label = _numbered(label)
    ends = np.sort(label[pairs], axis=1)
    across = ends[:, 0] != ends[:, 1]
    count = int(label.max()) + 1
    keys, inverse = np.unique(ends[across, 0].astype(np.int64) * count + ends[across, 1], return_inverse=True)
    summed = np.bincount(inverse, weights=weights[across], minlength=len(keys))
    return contract_edges(count, np.stack([keys // count, keys % count], axis=1), summed)[label]


def _moved(count: int, pairs: np.ndarray, weights: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Move single nodes to the best neighboring cluster, or to a new one, until no move increases the objective."""
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    start = np.searchsorted(ends[order, 0], np.arange(count + 1))
    both = np.concatenate([weights, weights])
    return _move(label.astype(np.int64), start, ends[order, 1], both[order], _ROUNDS)


@njit(cache=True, nogil=True)
def _move(label, start, neighbor, weight, rounds):  # pragma: no cover - compiled
    count = label.shape[0]
    out = label.copy()
    size = np.zeros(2 * count + 1, np.int64)
    for i in range(count):
        size[out[i]] += 1
    gain = np.zeros(2 * count + 1)
    free = count  # an unused label
    for _ in range(rounds):
        changed = False
        for i in range(count):
            own = out[i]
            for k in range(start[i], start[i + 1]):
                gain[out[neighbor[k]]] += weight[k]
            best, most = own, gain[own]
            for k in range(start[i], start[i + 1]):
                other = out[neighbor[k]]
                if gain[other] > most + 1e-9:
                    best, most = other, gain[other]
            if most < -1e-9 and size[own] > 1:
                while size[free] > 0:
                    free = free + 1 if free < 2 * count else 0
                best = free
            gain[own] = 0.0
            for k in range(start[i], start[i + 1]):
                gain[out[neighbor[k]]] = 0.0
            if best != own:
                size[own] -= 1
                size[best] += 1
                out[i] = best
                changed = True
        if not changed:
            break
    return out


@njit(cache=True, nogil=True)
def _find(parent, i):  # pragma: no cover - compiled
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True, nogil=True)
def _slot(keys, key):  # pragma: no cover - compiled
    """Return the slot of a key in an open-addressing hash table of 2^k slots, or the free slot where it belongs."""
    mask = keys.shape[0] - 1
    place = (key * 0x9E3779B97F4A7C1 >> 7) & mask
    while keys[place] != -1 and keys[place] != key:
        place = (place + 1) & mask
    return place


@njit(cache=True, nogil=True)
def _gaec(count, low, high, weight):  # pragma: no cover - compiled
    """Return the root of each node after greedy additive edge contraction.

    Edge weights between roots are in a hash table, the neighbors of a root in linked lists that are concatenated on
    contraction. Heap entries may be outdated: an entry is valid only if the table has its weight. One loop, since the
    table, the lists and the heap change together.
    """
    edges = low.shape[0]
    room = 1
    while room < 4 * edges + 16:
        room *= 2
    keys, values = np.full(room, -1, np.int64), np.zeros(room)
    used = 0
    parent = np.arange(count)
    head, tail, degree = np.full(count, -1, np.int64), np.full(count, -1, np.int64), np.zeros(count, np.int64)
    follow, node = np.empty(2 * edges, np.int64), np.empty(2 * edges, np.int64)
    heap = [(0.0, np.int64(0), np.int64(0)) for _ in range(0)]  # empty; gives Numba the type
    for e in range(edges):
        a, b = low[e], high[e]
        place = _slot(keys, a * count + b)
        used += keys[place] == -1
        keys[place] = a * count + b
        values[place] += weight[e]
        for side in range(2):
            at, other, entry = (a, b, 2 * e) if side == 0 else (b, a, 2 * e + 1)
            node[entry], follow[entry] = other, head[at]
            if head[at] < 0:
                tail[at] = entry
            head[at] = entry
            degree[at] += 1
        if values[place] > 0:
            heap.append((-values[place], a, b))  # pyright: ignore[reportArgumentType]
    heapify(heap)
    while len(heap) > 0:
        negative, a, b = heappop(heap)
        if parent[a] != a or parent[b] != b or values[_slot(keys, a * count + b)] != -negative:
            continue
        kept, gone = (a, b) if degree[a] >= degree[b] else (b, a)
        parent[gone] = kept
        if 4 * (used + degree[gone]) > 3 * room:
            keys, values, used, room = _rebuilt(keys, values, parent, count)
        entry = head[gone]
        while entry >= 0:
            other = _find(parent, node[entry])
            if other != kept:
                old = _slot(keys, min(gone, other) * count + max(gone, other))
                if keys[old] != -1 and values[old] != 0.0:
                    moved = values[old]
                    values[old] = 0.0
                    x, y = min(kept, other), max(kept, other)
                    place = _slot(keys, x * count + y)
                    used += keys[place] == -1
                    keys[place] = x * count + y
                    values[place] += moved
                    if values[place] > 0:
                        heappush(heap, (-values[place], x, y))  # pyright: ignore[reportArgumentType]
            entry = follow[entry]
        if head[gone] >= 0:
            if head[kept] < 0:
                head[kept], tail[kept] = head[gone], tail[gone]
            else:
                follow[tail[kept]] = head[gone]
                tail[kept] = tail[gone]
            degree[kept] += degree[gone]
    for i in range(count):
        parent[i] = _find(parent, i)
    return parent


@njit(cache=True, nogil=True)
def _rebuilt(keys, values, parent, count):  # pragma: no cover - compiled
    """Return the hash table without zero weights, of the same size or larger."""
    live = 0
    for i in range(keys.shape[0]):
        if keys[i] != -1 and values[i] != 0.0:
            live += 1
    room = keys.shape[0]
    while room < 4 * live + 16:
        room *= 2
    new_keys, new_values = np.full(room, -1, np.int64), np.zeros(room)
    for i in range(keys.shape[0]):
        if keys[i] != -1 and values[i] != 0.0:
            place = _slot(new_keys, keys[i])
            new_keys[place], new_values[place] = keys[i], values[i]
    return new_keys, new_values, live, room
