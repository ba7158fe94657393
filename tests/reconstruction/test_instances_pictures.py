"""Pictures on walls, by what was seen of the wall."""

import numpy as np
import pytest

from reconstruction.instances.pictures import _to_the_edge


@pytest.mark.parametrize("turned", [False, True])
def test_a_picture_cut_by_the_images_edge_goes_on_to_the_last_that_was_seen(turned):
    """Its outline fades in the last cells; beyond them nothing was seen."""
    seen = np.zeros((60, 80), bool)
    seen[:45] = True
    region, whole = np.zeros_like(seen), np.zeros_like(seen)
    region[25:40, 20:50] = whole[25:45, 20:50] = True
    if turned:
        seen, region, whole = seen.T[::-1], region.T[::-1], whole.T[::-1]
    np.testing.assert_array_equal(_to_the_edge(region, seen), whole)


def test_a_picture_with_wall_around_it_stays_as_it_is():
    seen = np.ones((60, 80), bool)
    region = np.zeros_like(seen)
    region[15:40, 20:50] = True
    np.testing.assert_array_equal(_to_the_edge(region, seen), region)
