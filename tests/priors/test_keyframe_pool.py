"""Crops drawn on a device agree with crops drawn by processes, and with the rooms that they are of."""

import numpy as np
import pytest
import torch

from priors import aggregation
from priors.keyframe_pool import KeyframePool, border_of
from priors.samples import CROP, draw_sample, load_sample, open_rooms, stack
from priors.samples import border_of as border_of_samples
from reconstruction.depth.channels import BINS

pytestmark = pytest.mark.stage


@pytest.fixture(scope="module")
def rooms(data):
    return open_rooms(data / "train", aggregation.ARRAYS)


@pytest.fixture(scope="module")
def pool(rooms):
    out = KeyframePool("cpu")
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
