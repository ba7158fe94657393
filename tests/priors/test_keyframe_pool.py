"""Crops drawn on a device agree with crops drawn by processes, and with the rooms that they are of."""

import numpy as np
import pytest
import torch

from priors import aggregation, mending, mending_pool
from priors.aggregation_pool import AggregationPool, border_of
from priors.mending_pool import MendingPool
from priors.samples import CROP, draw_sample, load_sample, open_rooms, stack
from priors.samples import border_of as border_of_samples
from reconstruction.depth.channels import BINS

pytestmark = pytest.mark.stage


@pytest.fixture(scope="module")
def rooms(data):
    return open_rooms(data / "train", aggregation.ARRAYS)


@pytest.fixture(scope="module")
def pool(rooms):
    out = AggregationPool("cpu")
    out.add(rooms)
    out.add(rooms)  # a room is copied once
    return out


def test_it_holds_every_keyframe_once(rooms, pool):
    assert len(pool) == sum(len(room) for room in rooms)


def test_batches_have_the_form_of_those_that_processes_draw(rooms, pool):
    rng = np.random.default_rng(0)
    drawn = stack([draw_sample(rooms[0], rng) for _ in range(3)])
    batch = pool.draw(3, torch.Generator().manual_seed(0))
    assert [(t.shape, t.dtype) for t in batch] == [(t.shape, t.dtype) for t in drawn]
    again = pool.draw(3, torch.Generator().manual_seed(0))
    assert all(torch.equal(a, b) for a, b in zip(batch[3:], again[3:], strict=True))


def test_costs_and_truth_stay_together(rooms, pool):
    depths = rooms[0].arrays["true_depth"]
    low, high = float(depths[depths > 0].min()), float(depths.max())
    correlation, smoothed, color, place, _, border, rho = pool.draw(12, torch.Generator().manual_seed(1))
    known = place >= 0
    line = rho[:, :, None, None].expand(-1, -1, *place.shape[1:])
    depth = 1 / (line[:, 0] + line[:, 1] * place)[known]
    assert low * 0.999 <= depth.min()
    assert depth.max() <= high * 1.001
    assert place.max() <= BINS - 1
    assert 0 <= color.min() <= color.max() <= 1
    assert 0 <= smoothed.min() <= smoothed.max() <= 1
    contrast = torch.stack(torch.gradient(color.mean(1), dim=(1, 2))).abs().sum(0)
    clear = known & (contrast > 0.06) & ~border
    assert (correlation.argmax(1) - place)[clear].abs().median() < 1.0  # bins


def test_border_is_that_of_the_samples(rooms):
    sample = load_sample(rooms[0], 0)
    place = torch.from_numpy(sample.place)[None]
    rho = torch.tensor([sample.rho])
    assert np.array_equal(border_of(place, rho)[0].numpy(), border_of_samples(sample.place, sample.rho))


def test_nothing_inside_of_the_sweep_asks_for_no_bin(pool):
    """The loss is least where all bins are equally probable."""
    from types import SimpleNamespace

    config = SimpleNamespace(border_weight=3.0, affinity_weight=0.2, widths=(16, 16, 16))
    batch = pool.draw(1, torch.Generator().manual_seed(2))
    batch[3] = torch.full((1, *CROP), -1.0)
    net = aggregation.make_network(config)
    with torch.no_grad():
        net.sharpness.fill_(0.0)  # the untrained network then prefers no bin
        assert aggregation.losses(net, batch, config)["nowhere"] == pytest.approx(0, abs=1e-5)
        net.sharpness.fill_(8.0)
        assert aggregation.losses(net, batch, config)["nowhere"] > 0.1


@pytest.fixture(scope="module")
def maps(data):
    return open_rooms(data / "train", mending.ARRAYS)


@pytest.fixture(scope="module")
def mending_crops(maps):
    out = MendingPool("cpu")
    out.add(maps)
    return out


def test_mending_batches_have_the_form_of_those_that_processes_draw(maps, mending_crops):
    rng = np.random.default_rng(0)
    drawn = mending.stack([mending.draw_sample(maps[0], rng) for _ in range(3)])
    batch = mending_crops.draw(3, torch.Generator().manual_seed(0))
    assert [(t.shape, t.dtype) for t in batch] == [(t.shape, t.dtype) for t in drawn]


@pytest.mark.parametrize("agreed", [False, True])
def test_features_and_likelihoods_are_those_of_the_samples(maps, agreed):
    """Of a whole keyframe that nothing disturbs."""
    sample = mending.load_sample(maps[0], 2, agreed=agreed)
    a = {name: torch.from_numpy(np.array(values[2:3])) for name, values in maps[0].arrays.items()}
    depth = (a["agreed"] if agreed else a["depth"]).float()
    known = depth > 0
    origin = known.to(torch.uint8) * 2 if agreed else a["origin"]
    agree, through = (a["agreed_" + n if agreed else n] * known for n in ("agree", "through"))
    features = mending_pool.mending_features(
        a["picture"].permute(0, 3, 1, 2).float() / 255, depth, origin, a["correlation"].float() / 100,
        agree, through, a["surety"].float() / 100,
    )  # fmt: skip
    assert np.abs(features[0].numpy() - sample.features).max() < 2e-3
    candidates = mending_pool.candidate_depths(torch.where(known, 1 / depth.clamp_min(1e-12), 0.0))
    there = sample.candidates > 0
    assert ((candidates[0].numpy() > 0) == there).mean() > 0.9999
    both = there & (candidates[0].numpy() > 0)
    ratio = candidates[0].numpy()[both] / sample.candidates[both]
    assert np.quantile(np.abs(ratio - 1), 0.999) < 1e-3
    truth = a["exact_depth"].float()
    exact = torch.from_numpy(sample.candidates)[None]
    assert (
        np.abs(mending_pool.likelihoods(exact, truth)[0].numpy() - mending.likelihoods(sample)).max() < 1e-3
    )
    _, _, weights, _ = mending.stack([sample])
    assert torch.equal(mending_pool.weights(exact, truth), weights)


def test_windows_show_what_lies_there(maps, mending_crops):
    """Magnified, mirrored and exchanged crops of coordinates are straight, and smooth reads agree with nearest ones."""
    h, w = maps[0].arrays["depth"].shape[1:3]
    y, x = torch.meshgrid(torch.arange(float(h)), torch.arange(float(w)), indexing="ij")
    plane = torch.stack([y, x], -1)[None].expand(len(maps[0]), -1, -1, -1)
    _, at = mending_crops.choose(24, torch.Generator().manual_seed(3))
    near, smooth = mending_crops.nearest(plane, at), mending_crops.smooth(plane, at)
    inner = (slice(None), slice(2, -2), slice(2, -2))
    assert (near - smooth)[inner].abs().max() <= 0.51
    steps = at.step.flip(1) * at.exchanged[:, None] + at.step * ~at.exchanged[:, None]
    for axis in (1, 2):
        change = smooth.diff(dim=axis)[:, 3:-3, 3:-3]
        assert torch.allclose(change, change.mean((1, 2), keepdim=True).expand_as(change), atol=1e-3)
        assert torch.allclose(change.abs().sum(-1).mean((1, 2)), steps[:, axis - 1], atol=1e-3)
    assert near.min() >= 0
    assert near[..., 0].max() <= h - 1
    assert near[..., 1].max() <= w - 1
    assert len({bool(e) for e in at.exchanged}) == 2
