"""The cut does not depend on how finely the mesh samples the surface."""

import numpy as np
import pytest
import surfaces

from reconstruction.core.progress import NO_PROGRESS
from reconstruction.core.types import Instance
from reconstruction.instances import InstancesConfig, find_instances

pytestmark = pytest.mark.stage

WOOD = (120, 80, 50)


def things_of_a_room() -> tuple[Instance, ...]:
    """A table with a box, a book and a low plate; noise of 1 mm."""
    surface = surfaces.surface_from(
        surfaces.merged(
            surfaces.floor_sheet((200, 200, 190), 0.8),
            surfaces.solid_box((-0.5, -0.4, 0.0), (0.5, 0.4, 0.5), WOOD),
            surfaces.solid_box((0.2, 0.1, 0.5), (0.32, 0.2, 0.68), (200, 30, 30)),
            surfaces.solid_box((-0.4, -0.3, 0.5), (-0.15, -0.1, 0.54), (30, 60, 120)),
            surfaces.solid_box((0.1, -0.3, 0.5), (0.3, -0.1, 0.52), (235, 235, 240)),
        )
    )
    jitter = np.random.default_rng(0).normal(0, 0.001, surface.vertices.shape).astype(np.float32)
    surface.vertices[:] += jitter
    posed, depth = surfaces.frames_of(surface, 240, 180)
    return find_instances(
        posed, depth, surface, InstancesConfig(snap_radius_px=0), progress=NO_PROGRESS
    ).objects


@pytest.mark.parametrize("step_m", [0.007, 0.014])
def test_the_same_things_whatever_the_spacing(step_m, monkeypatch):
    expected = things_of_a_room()
    assert len(expected) == 4
    monkeypatch.setattr(surfaces, "STEP_M", step_m)
    found = things_of_a_room()
    assert len(found) == len(expected)
    for thing in expected:
        same = min(found, key=lambda other: np.linalg.norm(other.center - thing.center))
        np.testing.assert_allclose(same.center, thing.center, atol=0.012)
        np.testing.assert_allclose(same.extents_m, thing.extents_m, atol=0.02)
