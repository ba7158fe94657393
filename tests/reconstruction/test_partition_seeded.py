"""Nodes joined to seeds by mean weights: never two seeds, always along the strongest borders."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from reconstruction.instances.partition.seeded import joined_to_seeds


@st.composite
def graphs(draw):
    count = draw(st.integers(2, 14))
    every = [(a, b) for a in range(count) for b in range(a + 1, count)]
    pairs = draw(st.lists(st.sampled_from(every), unique=True))
    weights = draw(st.lists(st.floats(-5, 5), min_size=len(pairs), max_size=len(pairs)))
    return count, np.array(pairs, int).reshape(-1, 2), np.array(weights), draw(st.integers(1, count))


def components(count: int, pairs: np.ndarray) -> np.ndarray:
    ones = np.ones(len(pairs))
    return connected_components(coo_matrix((ones, pairs.T), shape=(count, count)), directed=False)[1]


@given(graphs())
def test_every_node_with_a_path_gets_a_seed_and_each_part_hangs_together(graph):
    count, pairs, weights, seeds = graph
    part = joined_to_seeds(count, pairs, weights, seeds)
    assert part[:seeds].tolist() == list(range(seeds))
    piece = components(count, pairs)
    reached = np.isin(piece, piece[:seeds])
    assert ((part >= 0) == reached).all()
    within = components(count, pairs[part[pairs[:, 0]] == part[pairs[:, 1]]])
    for seed in range(seeds):
        assert len(set(within[part == seed])) == 1


@given(graphs())
def test_the_order_of_edges_and_their_direction_do_not_matter(graph):
    count, pairs, weights, seeds = graph
    weights = weights + 1e-3 * np.arange(len(weights))  # no ties
    order = np.random.default_rng(0).permutation(len(pairs))
    once = joined_to_seeds(count, pairs, weights, seeds)
    again = joined_to_seeds(count, pairs[order][:, ::-1], weights[order], seeds)
    assert np.array_equal(once, again)


def test_a_chain_is_cut_at_its_weakest_border():
    pairs = np.array([[0, 2], [2, 3], [3, 4], [4, 1]])
    assert joined_to_seeds(5, pairs, np.array([2.0, 3.0, -1.0, 0.5]), 2).tolist() == [0, 1, 0, 0, 1]
    assert joined_to_seeds(5, pairs, np.array([0.1, 3.0, 2.0, 0.5]), 2).tolist() == [0, 1, 1, 1, 1]


def test_a_long_weak_border_counts_by_its_mean():
    # Node 2 touches three nodes of seed 1 weakly, and seed 0 at one border that is stronger than each of them.
    pairs = np.array([[0, 2], [1, 3], [1, 4], [2, 3], [2, 4], [1, 2]])
    weights = np.array([1.0, 5.0, 5.0, 0.6, 0.6, 0.6])
    assert joined_to_seeds(5, pairs, weights, 2).tolist() == [0, 1, 0, 1, 1]
