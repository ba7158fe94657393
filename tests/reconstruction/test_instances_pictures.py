"""Pictures on walls, by what was seen of the wall."""

import numpy as np
import pytest
from surfaces import filmed, looking_at, merged, sheet, surface_from

from reconstruction.instances import InstancesConfig
from reconstruction.instances.cut import Shell
from reconstruction.instances.pictures import _to_the_edge, find_pictures
from reconstruction.progress import NO_PROGRESS
from reconstruction.types import Camera


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


WALL, LIGHT = np.array((160.0, 165.0, 150.0)), np.array((225.0, 230.0, 205.0))


def pictures_in(share):
    """Return the corners of what is found on a wall, painted lighter by a share of places (x, z)."""
    floor = sheet((-1.5, -2.0, 0.0), (3.0, 0, 0), (0, 2.0, 0), (90, 80, 70), 0.03)
    wall = sheet((-1.5, 0.0, 0.0), (3.0, 0, 0), (0, 0, 2.0), tuple(WALL.astype(int)), 0.012)
    truth = merged(floor, wall)
    painted = truth.vertices[:, 1] > -1e-3
    paint = truth.colors.astype(float)
    paint[painted] += share(truth.vertices[painted][:, [0, 2]])[:, None] * (LIGHT - WALL)
    surface = surface_from(truth)
    target = np.array([0.0, 0.0, 1.1])
    poses = np.stack([looking_at((x, -1.8, z), target) for z in (1.0, 1.4) for x in (-0.6, -0.2, 0.2, 0.6)])
    camera = Camera(320, 240, 230.0, 230.0, 160.0, 120.0)
    posed, depth = filmed(truth, paint.round().astype(np.uint8), surface, poses, camera)
    shell = Shell.of(surface, NO_PROGRESS)
    plane = next(plane for plane in shell.planes if plane.label == "wall")
    others = (shell.owner > 0) & ~plane.members
    found = find_pictures(shell.graph, plane, others, shell.owner == 0, posed, depth, InstancesConfig())
    points = shell.graph.points[:, [0, 2]]
    return [(points[vertices].min(axis=0), points[vertices].max(axis=0)) for vertices in found]


def test_a_light_picture_is_found():
    ((low, high),) = pictures_in(lambda at: (np.abs(at - [0.2, 1.2]) < [0.2, 0.15]).all(axis=1).astype(float))
    np.testing.assert_allclose([low, high], [(0.0, 1.05), (0.4, 1.35)], atol=0.03)


@pytest.mark.parametrize("spread_m", [0.12, 0.2])
def test_a_stain_that_fades_is_no_picture(spread_m):
    """It is as much lighter in the middle as the picture is."""
    assert pictures_in(lambda at: np.exp(-((at - [0.2, 1.2]) ** 2).sum(axis=1) / (2 * spread_m**2))) == []
