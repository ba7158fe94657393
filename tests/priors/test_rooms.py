"""Films of generated rooms look at things, as people film."""

from dataclasses import replace

import numpy as np
import pytest

from priors.partition_ruler import LEAST_SHARE
from priors.rooms import draw_film
from registry.errors import InputError
from synthetic.film import render_truth

pytestmark = pytest.mark.stage


def things_in_view(film, pose) -> int:
    _, ids = render_truth(film.film_set, film.camera(160, 120), pose)
    pixels = np.bincount(ids[ids > film.base_entities].astype(np.int64))
    return int((pixels >= LEAST_SHARE * ids.size).sum())


@pytest.fixture(scope="module")
def film():
    return draw_film("train", 20001)


def test_keyframes_have_things_in_view(film):
    poses = film.keyframes(10)
    assert 8 <= len(poses) <= 10
    assert np.mean([things_in_view(film, pose) for pose in poses]) > 2


def test_the_same_number_is_the_same_film(film):
    again = draw_film("train", 20001)
    np.testing.assert_array_equal(again.walk, film.walk)
    assert again.describe() == film.describe()


def test_a_walk_that_sees_nothing_is_refused(film):
    up = film.walk.copy()
    up[:, :3, :3] = np.diag([1.0, -1.0, -1.0]) @ np.diag([1.0, -1.0, -1.0])  # OpenCV axes: straight up
    with pytest.raises(InputError, match="sees enough"):
        replace(film, walk=up).keyframes(10)
