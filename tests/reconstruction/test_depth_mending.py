"""Mending of depth maps: candidates, the choice among them, and what it does to a filmed table with things."""

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from benchmarks.depth_figures import ring_counts
from reconstruction.core.workers import Workers
from reconstruction.depth import DepthConfig, estimate_depth, mending
from reconstruction.depth.candidates import OFFSETS, candidate_depths, choose_candidates
from reconstruction.depth.channels import OFFSETS_PX
from reconstruction.depth.estimate import gather_evidence
from reconstruction.depth.mending import candidate_shares, mending_features
from reconstruction.depth.weights import load_network
from synthetic.capture import make_test_capture

pytestmark = pytest.mark.stage

CONFIG = DepthConfig(depth_side_px=320, prior="mending")


@pytest.fixture(scope="module")
def capture():
    return make_test_capture(8, 320, 240)


@pytest.fixture(scope="module")
def found(capture):
    """The evidence that the network mends: depth as it is without a prior."""
    return gather_evidence(capture.posed, CONFIG)


@pytest.fixture(scope="module")
def mended(capture):
    """Depth maps of the capture with the network's prior."""
    return estimate_depth(capture.posed, CONFIG)


@pytest.fixture(scope="module")
def step():
    """Inverse depth of a slanted plane, left, and a nearer one, right, 0 at a hole."""
    y, x = np.mgrid[:60, :80].astype(np.float32)
    left, right = 0.5 + 0.0005 * x + 0.001 * y, 0.8 - 0.0007 * x
    rho = np.where(x < 40, left, right).astype(np.float32)
    rho[20:24, 10:14] = 0
    return rho, left, right


def test_candidates_are_the_surfaces_around_extended_as_planes(step):
    rho, left, right = step
    out = candidate_depths(rho)
    assert np.array_equal(out[0], rho)
    for k, (dy, dx) in enumerate(OFFSETS[1:], start=1):
        j, i = 30 + dy, 38 + dx
        expected = (left if i < 40 else right)[30, 38]
        assert out[k, 30, 38] == pytest.approx(expected, rel=2e-3), (j, i)
    assert (out[1:, 21, 11] > 0).any()  # a hole has candidates, none of its own
    assert out[0, 21, 11] == 0
    assert (out[:, 0, 0][OFFSETS.min(1) < 0] == 0).all()  # nothing from outside of the picture


def _choose(candidates, share, least):
    out, trust = (np.full(candidates.shape[1:], -1, np.float32) for _ in range(2))
    choose_candidates(candidates, share, np.float32(least), out, trust)
    return out, trust


def test_a_surface_wins_with_all_that_speak_for_it():
    candidates = np.array([1.0, 2.0, 2.01, 1.99, 0.0], np.float32).reshape(-1, 1, 1)
    share = np.array([0.35, 0.2, 0.2, 0.2, 0.0], np.float32).reshape(-1, 1, 1)
    rho, trust = _choose(candidates, share, 0.5)
    assert rho.item() == pytest.approx(2.0, rel=6e-3)
    assert 0.55 < trust.item() <= 0.6
    assert _choose(candidates, share, 0.62)[0].item() == 0  # unknown, as nothing is that sure
    share[0], share[1:4] = 0.56, 0.2
    assert (
        _choose(candidates, share, 0.5)[0].item() == candidates[0].item()
    )  # nearly the mode: its own, to the last bit
    share[0] = 0.4
    assert _choose(candidates, share, 0.5)[0].item() != candidates[0].item()


def test_features_do_not_know_the_scale():
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 3, (30, 41)).astype(np.float32)
    depth[:5] = 0
    rest = (
        np.where(depth > 0, 2, 0).astype(np.uint8),
        depth / 4,
        depth.astype(np.uint8),
        depth.astype(np.uint8),
        depth,
    )
    picture = rng.uniform(0, 1, (30, 41, 3)).astype(np.float32)
    one, other = (mending_features(picture, s * depth, *rest) for s in (1, 37))
    assert np.abs(one - other).max() < 1e-3
    assert np.isfinite(one).all()


def test_threads_do_not_change_the_result():
    rng = np.random.default_rng(0)
    features = rng.normal(0, 1, (mending.FEATURES, 61, 83)).astype(np.float32)  # odd sizes
    there = rng.random((len(OFFSETS), 61, 83)) < 0.7
    alone, _ = candidate_shares(features, there)
    assert alone.shape == there.shape
    assert (alone[~there] == 0).all()
    assert alone.sum(0).max() <= 1 + 1e-5
    with ThreadPoolExecutor(3) as pool:
        for share, _ in pool.map(lambda _: candidate_shares(features, there), range(4)):
            assert np.array_equal(share, alone)


def test_the_weights_are_small_and_load_quickly():
    assert mending.WEIGHTS.stat().st_size < 3.1e6  # 6 MB together with the aggregation's
    load_network.cache_clear()
    started = time.process_time()
    load_network("mending", mending.WEIGHTS)
    assert time.process_time() - started < 3.0  # .1 s on a machine at rest


def test_things_end_where_they_end(capture, found, mended):
    rings, right = [], []
    things = [i for i in np.unique(capture.id_maps) if i > len(capture.room.base)]
    for maps in (found, mended):
        truth = capture.depth.depth
        counts = sum(ring_counts(d, t, i, things) for d, t, i in zip(maps.depth, truth, capture.id_maps))
        rings.append(counts[1] / counts[0])
        on = np.isin(capture.id_maps, things)
        right.append(float((np.abs(maps.depth[on] / truth[on] - 1) < 0.02).mean()))
    assert rings[1] < 0.7 * rings[0]
    assert right[1] > right[0]


def test_depth_is_believed_only_where_the_network_is_sure_enough(capture, found):
    each = Workers(2).each
    half, careful, never = (
        mending.mend_depth(found, capture.posed, least, each).depth for least in (0.5, 0.8, 1.1)
    )
    assert not never.any()
    hole, truth = found.depth == 0, capture.depth.depth
    amounts = [float((depth[hole] > 0).mean()) for depth in (half, careful)]
    assert amounts[0] > amounts[1] > 0
    for where in (hole, ~hole):
        wrong = [
            float((np.abs(d[there] / np.maximum(truth[there], 1e-6) - 1) > 0.05).mean())
            for d in (half, careful)
            for there in [where & (d > 0)]
        ]
        assert wrong[1] < wrong[0]
    assert half.shape == truth.shape


def test_affinities_of_the_keyframes_go_with_the_maps(capture, mended):
    assert mended.affinity.shape == (8, mending.AFFINITIES, 120, 160)
    ids = capture.id_maps[:, ::2, ::2]
    step = OFFSETS_PX[-1] // 2
    said = mended.affinity[:, 2 * (len(OFFSETS_PX) - 1), :, :-step]
    same = ids[:, :, :-step] == ids[:, :, step:]
    known = (ids[:, :, :-step] > 0) & (ids[:, :, step:] > 0)
    assert said[known & same].mean() > said[known & ~same].mean() + 64
