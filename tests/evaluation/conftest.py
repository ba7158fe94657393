"""Fixtures: one generated room for all tests of the metrics."""

from collections.abc import Callable
from pathlib import Path

import pytest
from truth_bundle import Change, Truth, write_bundle, write_truth

from reconstruction.measure import Evaluation, evaluate_scene

POINTS = {"composition_points": 40_000, "object_points": 15_000}


@pytest.fixture(scope="session")
def truth(tmp_path_factory) -> Truth:
    """The room's ground-truth folder."""
    return write_truth(tmp_path_factory.mktemp("truth"))


@pytest.fixture
def evaluate(truth, tmp_path) -> Callable[..., Evaluation]:
    """Return a function that evaluates the truth with a change against the truth."""

    def run(change: Change | None = None, folder: Path | None = None) -> Evaluation:
        bundle = write_bundle(truth, folder or tmp_path / "bundle", change)
        return evaluate_scene(bundle, truth.folder, video=truth.frames, **POINTS)

    return run


@pytest.fixture(scope="session")
def perfect(truth, tmp_path_factory) -> Evaluation:
    """The evaluation of the truth against itself."""
    bundle = write_bundle(truth, tmp_path_factory.mktemp("perfect") / "bundle")
    return evaluate_scene(bundle, truth.folder, video=truth.frames, **POINTS)
