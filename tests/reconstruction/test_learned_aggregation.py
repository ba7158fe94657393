"""The network that aggregates the sweep's costs: its input, its weights, and the depth that it gives."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch

from reconstruction.core.trunk import load_trunk
from reconstruction.depth import DepthConfig, aggregation
from reconstruction.depth.aggregation import (
    aggregate_costs,
    bin_costs,
    line_of_places,
    place_of_depth,
    smoothed_scores,
)
from reconstruction.depth.channels import BINS, PLANES
from reconstruction.depth.estimate import gather_evidence
from reconstruction.depth.evidence import PREDICTED
from reconstruction.depth.network import Aggregation, place_of
from reconstruction.depth.weights import load_network
from registry.errors import EnvironmentMissing
from synthetic.capture import make_test_capture

pytestmark = pytest.mark.stage


def test_a_bin_has_the_least_cost_of_its_planes():
    cost = np.random.default_rng(0).integers(0, 255, (3, 4, PLANES)).astype(np.uint8)
    assert np.array_equal(bin_costs(cost), cost.reshape(3, 4, BINS, 2).min(-1))
    assert bin_costs(cost[..., :72]).shape == (3, 4, BINS)


def test_places_are_where_the_planes_are():
    far, near = 6.0, 0.5
    rhos = np.linspace(1 / far, 1 / near, PLANES)
    place, (start, step) = place_of_depth(1 / rhos, far, near)
    assert np.allclose(place[1:-1], (np.arange(PLANES) / 2 - 0.25)[1:-1])
    assert np.allclose(start + step * place[1:-1], rhos[1:-1])
    assert place_of_depth(np.array([0.0, 0.4, 60.0]), far, near)[0].tolist() == [-1, -1, -1]
    assert line_of_places(far, near, PLANES) == (start, step)


def test_the_untrained_network_says_what_semi_global_aggregation_says():
    torch.manual_seed(0)
    smoothed = torch.rand(1, BINS, 16, 24) * 0.6
    best = torch.randint(3, BINS - 3, (1, 1, 16, 24))
    smoothed.scatter_(1, best, 1.0)
    correlation, color = torch.rand(1, BINS, 16, 24), torch.rand(1, 3, 16, 24)
    with torch.inference_mode():
        seen = load_trunk()(2 * color - 1)
        logits, offset, affinity = Aggregation().eval()(correlation, smoothed, color, seen)
    assert torch.equal(logits.argmax(1), best[:, 0])
    assert affinity.shape == (1, 6, 16, 24)
    place, total = place_of(logits.softmax(1), offset)
    assert (place - best[:, 0]).abs().max() < 0.6
    assert total.min() > 0
    assert total.max() <= 1 + 1e-6


def test_smoothed_scores_put_the_least_cost_first_and_spread_it_over_blank_pixels():
    cost = np.full((20, 30, BINS), 120, np.uint8)
    cost[:, 8:, 30] = 10  # textured to the right, blank to the left
    scores = smoothed_scores(cost, np.zeros((20, 30), np.float32), 0.06, 0.45)
    assert (scores.argmax(2) == 30).all()
    assert scores.max() == 255
    assert scores[10, 20].astype(int)[[29, 31]].max() < 255


def test_a_second_surface_has_no_say_in_the_place():
    share = torch.full((1, BINS, 1, 1), 1e-4)
    share[0, 10], share[0, 11], share[0, 30] = 0.35, 0.2, 0.4
    place, total = place_of(share, torch.zeros(1, 1, 1))
    assert place.item() == pytest.approx(30, abs=0.01)  # the strongest bin, and nothing from 10 and 11
    assert total.item() == pytest.approx(0.4, abs=0.01)


def test_missing_weights_say_what_to_do(tmp_path):
    with pytest.raises(EnvironmentMissing, match=r"depth\.prior=none"):
        load_network("aggregation", tmp_path / "none.safetensors")
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(b"not weights")
    with pytest.raises(EnvironmentMissing, match=r"depth\.prior=none"):
        load_network("aggregation", broken)


@pytest.fixture(scope="module")
def some_costs():
    rng = np.random.default_rng(1)
    cost = rng.integers(60, 200, (61, 83, 72)).astype(np.uint8)  # odd sizes, the fast preset's planes
    color = rng.uniform(0, 255, (61, 83, 3))
    gray = (color.mean(2) - 128).astype(np.float32)
    return cost, color, gray, np.linspace(0.2, 2.0, 72), (0.06, 0.45)


def test_threads_do_not_change_the_result(some_costs):
    alone = aggregate_costs(*some_costs)
    with ThreadPoolExecutor(3) as pool:
        for rho, sure in pool.map(lambda _: aggregate_costs(*some_costs), range(6)):
            assert np.array_equal(rho, alone[0])
            assert np.array_equal(sure, alone[1])
    assert alone[0].shape == (61, 83)
    assert alone[0].min() > 0
    assert 0 <= alone[1].min() <= alone[1].max() <= 1.0001


def test_the_weights_are_small_and_load_quickly():
    assert aggregation.WEIGHTS.stat().st_size < 6e6
    load_network.cache_clear()
    started = time.process_time()
    load_network("aggregation", aggregation.WEIGHTS)
    assert time.process_time() - started < 3.0  # .1 s on a machine at rest


def test_predictions_fill_what_is_unknown_and_change_nothing_else():
    capture = make_test_capture(10, 160, 120)
    plain = DepthConfig(depth_side_px=160, sweep_side_px=160, complete=False, prior="mending")
    before = gather_evidence(capture.posed, plain)
    after = gather_evidence(capture.posed, replace(plain, prior="both", prior_surety=0.3))
    known = before.depth > 0
    assert np.array_equal(before.depth[known], after.depth[known])
    assert np.array_equal(before.origin[known], after.origin[known])
    new = (after.depth > 0) & ~known
    assert new.mean() > 0.005
    assert (after.origin[new] == PREDICTED).all()
    truth = capture.depth.depth
    off = np.abs(after.depth[new & (truth > 0)] / truth[new & (truth > 0)] - 1)
    assert np.median(off) < 0.05
