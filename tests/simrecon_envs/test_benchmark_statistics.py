"""Intervals and tests agree with published values and simulation; splits and seeds are hashes of names."""

import numpy as np
import pytest

from simrecon_envs.benchmark.splits import episode_seed, side_of
from simrecon_envs.benchmark.statistics import bootstrap_mean, mcnemar, wilson
from simrecon_envs.multi import split_of


@pytest.mark.parametrize(
    ("successes", "count", "low", "high"),
    [(8, 10, 0.4902, 0.9433), (0, 10, 0.0, 0.2775), (10, 10, 0.7225, 1.0), (50, 100, 0.4038, 0.5962)],
)
def test_wilson_has_the_values_of_textbooks(successes, count, low, high):
    assert wilson(successes, count) == pytest.approx((low, high), abs=2e-4)


def test_wilson_covers_the_true_rate_as_often_as_it_says():
    rng = np.random.default_rng(0)
    covered = [wilson(int(rng.binomial(30, 0.9)), 30) for _ in range(2000)]
    share = np.mean([low <= 0.9 <= high for low, high in covered])
    assert 0.92 <= share <= 0.98


def test_wilson_refuses_nothing_and_too_many():
    for wrong in ((0, 0), (3, 2), (-1, 2)):
        with pytest.raises(ValueError, match="successes"):
            wilson(*wrong)


def test_mean_of_like_episodes_is_as_uncertain_as_its_tasks():
    rng = np.random.default_rng(1)
    tasks = rng.normal(size=20)
    values, groups = np.repeat(tasks, 10), np.repeat(np.arange(20), 10)
    low, high = bootstrap_mean(values, list(groups))
    alone = bootstrap_mean(values, list(range(200)))  # as if episodes were independent
    assert low < values.mean() < high
    assert high - low == pytest.approx(2 * 1.96 * tasks.std() / np.sqrt(20), rel=0.15)
    assert high - low > 2.5 * (alone[1] - alone[0])
    assert bootstrap_mean(values, list(groups)) == (low, high)
    assert bootstrap_mean([1.0, 2.0], ["one", "one"]) is None


def test_mcnemar_is_exact():
    assert mcnemar(0, 0) == 1.0
    assert mcnemar(1, 8) == pytest.approx(0.0390625)
    assert mcnemar(8, 1) == mcnemar(1, 8)
    assert mcnemar(5, 5) == 1.0


def test_splits_are_those_of_the_multi_scene_environment_and_stay():
    names = [f"scene{number:04d}" for number in range(2000)]
    assert [side_of(name, 0.2) for name in names] == [split_of(name) for name in names]
    assert np.mean([side_of(name, 0.2) == "test" for name in names]) == pytest.approx(0.2, abs=0.03)
    assert {side_of(name, 0.0) for name in names} == {"train"}
    assert {side_of(name, 1.0) for name in names} == {"test"}


def test_seeds_differ_by_everything_and_fit_a_generator():
    seeds = {episode_seed(s, task, n) for s in (0, 1) for task in ("a", "b") for n in range(50)}
    assert len(seeds) == 200
    assert all(0 <= seed < 2**31 for seed in seeds)
