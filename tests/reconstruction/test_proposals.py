"""Proposals of whole things: merge trees, their features, and the best choice of disjoint regions."""

import itertools
import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import coo_array, csr_array
from test_partition_clusters import BASE, LEFT, RIGHT, THING, boards, pieces_of  # noqa: F401

from reconstruction.instances.partition import proposals as trees
from reconstruction.instances.partition.choice import (
    best_choice,
    best_disjoint,
    disjoint_by_gain,
    likeliest_things,
)
from reconstruction.instances.partition.cut import UNCLAIMED, labels_of, things_of
from reconstruction.instances.partition.duplicates import DUPLICATE_FEATURES, proposal_pairs
from reconstruction.instances.partition.graph import LABELS, Scores
from reconstruction.instances.partition.model import load_models
from reconstruction.instances.partition.proposal_features import PROPOSAL_FEATURES, proposal_features
from reconstruction.instances.partition.proposals import members_of, propose

pytestmark = pytest.mark.stage


def test_the_choice_is_as_good_as_trying_all():
    rng = np.random.default_rng(0)
    for _ in range(20):
        regions = [sorted(rng.choice(6, rng.integers(1, 4), replace=False).tolist()) for _ in range(9)]
        gain = rng.normal(0.1, 0.5, 9)
        chosen = best_disjoint(members_of(regions, 6), gain)
        taken = [k for row in chosen for k in regions[row]]
        assert len(taken) == len(set(taken))
        best = 0.0
        for size in range(7):
            for rows in itertools.combinations(range(9), size):
                used = [k for row in rows for k in regions[row]]
                if len(used) == len(set(used)):
                    best = max(best, gain[list(rows)].sum())
        assert gain[chosen].sum() == pytest.approx(best)


def test_without_time_the_best_are_taken_one_by_one():
    regions = [[0], [1], [0, 1], [2]]
    gain = np.array([0.5, 0.1, 0.4, 0.2])
    chosen = disjoint_by_gain(members_of(regions, 3), gain, np.arange(4))
    np.testing.assert_array_equal(chosen, [0, 1, 3])
    assert len(best_disjoint(members_of(regions, 3), -gain)) == 0


def test_what_is_estimated_at_less_than_half_of_the_others_is_no_thing():
    members = members_of([[0], [1], [2], [3], [2, 3]], 4)
    iou = np.array([0.8, 0.7, 0.36, 0.3, 0.5])
    np.testing.assert_array_equal(likeliest_things(members, iou), [0, 1, 4])
    np.testing.assert_array_equal(likeliest_things(members, 0.4 * iou), [0, 1, 4])  # all lower alike
    np.testing.assert_array_equal(likeliest_things(members, np.array([0.8, 0.7, 0.3, 0.25, 0.1])), [0, 1])
    assert len(likeliest_things(members, 0.1 * iou)) == 0


def test_the_choice_of_things_agrees_with_its_own_mean():
    rng = np.random.default_rng(5)
    for _ in range(20):
        regions = [sorted(rng.choice(12, rng.integers(1, 4), replace=False).tolist()) for _ in range(40)]
        members, iou = members_of(regions, 12), rng.beta(1, 2, 40)
        chosen = likeliest_things(members, iou)
        half = 0.5 * iou[chosen].mean()
        assert (iou[chosen] > half - 1e-9).all()
        again = best_disjoint(members, iou - half)
        assert (iou[again] - half).sum() == pytest.approx((iou[chosen] - half).sum())


def test_pieces_of_one_thing_do_not_outvote_it():
    members, iou = members_of([[0], [1], [0, 1], [2]], 3), np.array([0.55, 0.45, 0.7, 0.8])
    np.testing.assert_array_equal(likeliest_things(members, iou), [0, 1, 3])
    twice = coo_array(([0.4, 0.4], ([0, 1], [1, 0])), (4, 4)).tocsr()
    np.testing.assert_array_equal(likeliest_things(members, iou, twice), [2, 3])
    np.testing.assert_array_equal(
        likeliest_things(members[[0, 1, 3]], iou[[0, 1, 3]], twice[:3][:, :3]), [0, 2]
    )


def total(rows, gain, twice):
    rows = list(rows)
    return gain[rows].sum() - 0.5 * twice[np.ix_(rows, rows)].sum()


def test_no_exchange_betters_the_choice_and_few_choices_do():
    rng, shortfall = np.random.default_rng(2), []
    for _ in range(40):
        regions = [sorted(rng.choice(8, rng.integers(1, 4), replace=False).tolist()) for _ in range(11)]
        gain, twice = rng.beta(1, 2, 11) - 0.1, np.triu(rng.beta(0.3, 2, (11, 11)), 1)
        twice = twice + twice.T
        members = members_of(regions, 8)
        chosen = set(best_choice(members, gain, csr_array(twice)).tolist())
        overlap = (members @ members.T).toarray() > 0
        every = [
            rows for size in range(9) for rows in itertools.combinations(range(11), size)
            if not np.triu(overlap[np.ix_(rows, rows)], 1).any()
        ]  # fmt: skip
        assert tuple(sorted(chosen)) in every
        found = total(chosen, gain, twice)
        for new in range(11):
            kept = {k for k in chosen if not overlap[new, k]}
            assert total(kept | {new}, gain, twice) < found + 1e-9
            assert total(chosen - {new}, gain, twice) < found + 1e-9
        shortfall.append(max(total(rows, gain, twice) for rows in every) - found)
    assert np.mean(np.array(shortfall) < 1e-9) > 0.8
    assert max(shortfall) < 0.2


def test_pairs_of_proposals_are_disjoint_and_linked_and_the_larger_one_comes_first():
    low = np.array([[0, 0, 0], [0, 0, 1], [5, 0, 0], [0, 0, 0], [0, 0, 0]], float)
    high = np.array([[1, 1, 0.9], [1, 1, 1.1], [6, 1, 1], [1, 1, 1.1], [1, 1, 1]], float)
    members = members_of([[0], [1], [2], [0, 1], [3]], 4)
    iou, area = np.array([0.5, 0.4, 0.6, 0.7, 0.05]), np.array([2.0, 3.0, 1.0, 4.0])
    links, odds = np.array([[0, 1], [0, 3]]), np.array([1.5, 4.0])
    pairs = proposal_pairs(trees.Proposals(members, low, high), iou, area, links, odds)
    # not those that share a cluster, have no link, or are nothing by themselves
    assert list(zip(pairs.first, pairs.second)) == [(1, 0)]
    said = dict(zip(DUPLICATE_FEATURES, pairs.rows[0].tolist()))
    wanted = {
        "iou": 0.4,
        "other_iou": 0.5,
        "area_ratio": 2 / 3,
        "links": 1,
        "odds_mean": 1.5,
        "odds_by_area": 1.5,
    }
    wanted |= {
        "gap": 0.1,
        "gap_up": 0.1,
        "plan_overlap": 1,
        "height_overlap": 0,
        "foot_step": -1,
        "top_step": -0.2,
    }
    assert {name: said[name] for name in wanted} == pytest.approx(wanted, abs=1e-6)
    twice = pairs.counted_twice(load_models().duplicates).toarray()
    assert twice.shape == (5, 5)
    assert (twice == twice.T).all()
    assert 0 < twice[0, 1] < 1
    assert (twice > 0).sum() == 2
    alone = proposal_pairs(trees.Proposals(members, low, high), iou, area, links[:0], odds[:0])
    assert alone.counted_twice(load_models().duplicates).nnz == 0
    none = proposal_pairs(trees.Proposals(members[:0], low[:0], high[:0]), iou[:0], area, links, odds)
    assert len(likeliest_things(members[:0], iou[:0], none.counted_twice(load_models().duplicates))) == 0


def test_a_merge_tree_joins_what_belongs_together_first():
    pairs, odds = np.array([[0, 1], [1, 2], [2, 3]]), np.array([3.0, -1.0, 2.0])
    for linkage in (trees.total_odds, trees._mean):
        merged = trees.regions_of_tree(np.ones(4), pairs, odds, linkage)
        assert merged == [frozenset({0, 1}), frozenset({2, 3}), frozenset({0, 1, 2, 3})]


def _merged_one_by_one(pairs, odds, linkage):
    """Merge the two regions with the greatest linkage, all links added up anew each time, until none are joined."""
    regions, out = [frozenset([k]) for k in range(int(pairs.max()) + 1)], []
    while True:
        links: dict = {}
        for (a, b), value in zip(pairs.tolist(), odds.tolist()):
            x, y = (next(k for k, r in enumerate(regions) if c in r) for c in (a, b))
            if x != y:
                total, number = links.get((min(x, y), max(x, y)), (0.0, 0))
                links[min(x, y), max(x, y)] = total + value, number + 1
        if not links:
            return out
        x, y = max(links, key=lambda pair: linkage(links[pair]))
        out.append(regions[x] | regions[y])
        regions = [r for k, r in enumerate(regions) if k not in (x, y)] + [out[-1]]


@pytest.mark.parametrize("seed", range(4))
def test_a_merge_tree_is_that_of_links_added_up_anew(seed):
    rng = np.random.default_rng(seed)
    every = np.array(list(itertools.combinations(range(18), 2)))
    pairs = every[rng.random(len(every)) < 0.3]
    odds = rng.normal(0, 2, len(pairs))
    area = 10.0 ** np.arange(18.0)[rng.permutation(18)]  # no region is almost as large as its parent
    for linkage in (trees.total_odds, trees._mean):
        wanted = _merged_one_by_one(pairs, odds, linkage)
        found = trees.regions_of_tree(area, pairs, odds, linkage)
        assert set(found) <= set(wanted)
        size = {r: area[list(r)].sum() for r in wanted}
        left_out = set(wanted) - set(found)
        assert all(any(r < o and size[r] > size[o] / trees.ALIKE for o in wanted) for r in left_out)


def test_a_merge_tree_around_one_large_region_takes_no_time():
    count = 8000
    pairs = np.stack([np.zeros(count - 1, int), np.arange(1, count)], axis=1)
    started = time.process_time()
    merged = trees.regions_of_tree(np.ones(count), pairs, -np.arange(1.0, count), trees.total_odds)
    assert time.process_time() - started < 10  # .1 s; minutes where every merge copies all links
    assert len(merged[-1]) == count


def test_a_region_is_proposed_with_all_that_is_below_it():
    """A top, a pedestal below it, a box on it, and a chair beside it."""
    low = np.array([[0, 0, 0.7], [0.4, 0.4, 0], [0.2, 0.2, 0.75], [1.5, 0, 0]])
    high = np.array([[1, 1, 0.75], [0.6, 0.6, 0.7], [0.3, 0.3, 0.9], [2.0, 0.5, 0.9]])
    assert trees.with_all_below(frozenset({0}), low, high, 0.5 * (low + high)) == {0, 1}
    assert trees.with_all_below(frozenset({0, 2}), low, high, 0.5 * (low + high)) == {0, 1, 2}
    assert trees.with_all_below(frozenset({3}), low, high, 0.5 * (low + high)) == {3}


def test_regions_that_hardly_grow_are_left_out():
    count = 30
    area = np.r_[1.0, np.full(count - 1, 0.01)]
    pairs = np.stack([np.zeros(count - 1, int), np.arange(1, count)], axis=1)
    merged = trees.regions_of_tree(area, pairs, -np.arange(1.0, count), trees.total_odds)
    sizes = np.array([area[list(m)].sum() for m in merged])
    assert len(merged) < count / 2
    assert sizes[-1] == pytest.approx(area.sum())
    assert (np.diff(np.log(sizes)) < 2 * np.log(trees.ALIKE)).all()


def rows_of(boards, odds):  # noqa: F811
    view, graph, label, _ = boards
    pieces = pieces_of(boards)
    said = np.zeros((graph.count, len(LABELS)), np.float32)
    scores = Scores(np.zeros(len(graph.pairs), np.float32), said)
    found = propose(view, pieces, odds)
    return found, pieces, proposal_features(view, graph, scores, label, pieces, odds, found)


def test_both_boards_and_their_union_are_proposed_and_described(boards):  # noqa: F811
    view = boards[0]
    found, pieces, rows = rows_of(boards, np.array([2.0]))
    sets = {tuple(found.members[k].indices) for k in range(found.members.shape[0])}
    union = next(s for s in sets if len(s) == 2)
    assert sets == {(0,), (1,), (2,), union}
    assert rows.shape == (4, len(PROPOSAL_FEATURES))
    assert np.isfinite(rows).all()
    area = np.bincount(pieces.graph.region, weights=view.mesh.areas)
    for k in range(4):
        said = dict(zip(PROPOSAL_FEATURES, rows[k].tolist()))
        members = found.members[k].indices
        assert said["log_area"] == pytest.approx(np.log(area[members].sum()), abs=1e-4)
        points = view.mesh.points[np.isin(pieces.graph.region, members)]
        assert said["tall"] == pytest.approx(np.ptp(points[:, 2]), abs=1e-5)
        assert said["diagonal"] == pytest.approx(np.linalg.norm(np.ptp(points, axis=0)), abs=1e-5)
        assert said["pixels_most"] > 0
        shares = [said[f"contour_share_{kind}"] for kind in ("thing", "base", "artifact", "nothing")]
        assert sum(shares) == pytest.approx(1.0, abs=1e-5)
        assert said["contour_behind"] + said["contour_before"] + said["contour_level"] == pytest.approx(
            1.0, abs=1e-5
        )
        assert said["contour_behind"] > 0.3  # the wall and the floor behind a board in the air
        if members.tolist() == list(union):
            assert said["in_mean"] == 2.0
            assert said["out_mean"] == 0.0
            assert said["hull_box"] > 0.5
        elif members[0] in union:
            assert said["out_mean"] == said["best_other"] == 2.0


def test_features_follow_the_proposals_order(boards):  # noqa: F811
    view, graph, label, _ = boards
    found, pieces, rows = rows_of(boards, np.array([2.0]))
    turn = np.array([2, 0, 3, 1])
    turned = replace(found, members=found.members[turn], low=found.low[turn], high=found.high[turn])
    scores = Scores(np.zeros(len(graph.pairs), np.float32), np.zeros((graph.count, len(LABELS)), np.float32))
    again = proposal_features(view, graph, scores, label, pieces, np.array([2.0]), turned)
    np.testing.assert_allclose(again, rows[turn], atol=1e-5)


def test_things_are_the_chosen_and_what_is_left_of_clusters_is_unclaimed(boards):  # noqa: F811
    _, graph, label, cluster = boards
    found, pieces, _ = rows_of(boards, np.array([2.0]))
    union = [k for k in range(4) if len(found.members[k].indices) == 2]
    thing = things_of(found.members[union], pieces)
    assert set(np.unique(thing)) == {0, 1}
    own, number = labels_of(thing, label[graph.region], cluster[graph.region])
    assert len(np.unique(number[thing == 1])) == 1
    assert (own[thing == 1] == THING).all()
    assert (own[label[graph.region] == BASE] == BASE).all()
    far = (thing == 0) & (label[graph.region] == THING)
    assert far.any()
    assert (own[far] == UNCLAIMED).all()
