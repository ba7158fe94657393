"""One small room of two splits, as `python -m priors.dataset` makes them."""

import shutil
from pathlib import Path

import pytest
from kept import kept_folder

from priors import dataset
from priors.samples import open_rooms

FRAMES = 6


def make_rooms(folder: Path) -> None:
    """Make one room each of the splits "train" and "shapes"."""
    options = ["--rooms", "1", "--frames", str(FRAMES), "--processes", "1"]
    for split in ("train", "shapes"):
        # Of some rooms six keyframes measure too little; those are left out.
        for seed in range(4):
            arguments = [str(folder), "--split", split, "--seed", str(seed), *options]
            assert dataset.main([*arguments, "--keep", "costs", "winner", "depth"]) == 0
            if open_rooms(folder / split):
                break


@pytest.fixture(scope="session")
def data(tmp_path_factory) -> Path:
    """Return a folder with the rooms; tests may write to it."""
    return shutil.copytree(kept_folder(make_rooms), tmp_path_factory.mktemp("rooms") / "data")
