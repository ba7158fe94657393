"""What depth smeared behind a thing is taken from it; what was measured, and what nothing better is known of, stays."""

from dataclasses import replace

import numpy as np
from surfaces import floor_sheet, frames_of, looking_at, merged, sheet, solid_box, surface_from

from reconstruction.instances.cut import Shell
from reconstruction.instances.doubts import Taken, as_drawn, without_doubts
from reconstruction.instances.segmentation import Thing
from reconstruction.instances.sightings import sightings
from reconstruction.progress import NO_PROGRESS
from reconstruction.rasterize import rasterize_mesh
from reconstruction.types import Camera, DepthMaps

LOW, HIGH = np.array([-0.08, -0.06, 0.0]), np.array([0.08, 0.06, 0.25])
FAR_Y = HIGH[1] + 0.15


def cleaned(smeared=True, measured=True, attached=False):
    """Return the points of a carton filmed from its front, and those left of them.

    Behind it its surface goes on in two sheets to a scrap.
    """
    room, carton = floor_sheet((120, 100, 80), 0.6, 0.03), solid_box(tuple(LOW), tuple(HIGH), (180, 40, 40))
    smears = (
        sheet((LOW[0], HIGH[1], 0.02), (0.0, 0.15, 0), (0, 0, 0.2), (120, 100, 80)),
        sheet((HIGH[0], HIGH[1], 0.02), (0.0, 0.15, 0), (0, 0, 0.2), (120, 100, 80)),
        sheet((LOW[0] - 0.03, FAR_Y, 0.05), (0.05, 0.0, 0), (0, 0, 0.05), (120, 100, 80)),
    )
    surface = surface_from(merged(room, carton, *(smears if smeared else ())))
    truth = merged(room, carton)
    poses = np.stack([looking_at((x, -1.2, 0.7), (0.0, 0.1, 0.12)) for x in np.linspace(-1.2, 1.2, 7)])
    camera = Camera(160, 120, 150.0, 150.0, 80.0, 60.0)
    depth = np.stack(
        [
            rasterize_mesh(
                truth.vertices.astype(np.float32), truth.faces.astype(np.int32), camera, pose
            ).depth
            for pose in poses
        ]
    )
    posed = replace(
        frames_of(surface)[0], camera=camera, images=np.full((len(poses), 120, 160, 3), 128, np.uint8),
        indices=np.arange(len(poses), dtype=np.int32), times_s=np.arange(len(poses)) / 10, world_from_camera=poses,
        sharpness=np.ones(len(poses), np.float32),
    )  # fmt: skip
    maps = DepthMaps(camera, depth * measured, np.full(depth.shape, 2 * measured, np.uint8))
    shell = Shell.of(surface, NO_PROGRESS)
    points = shell.graph.points
    thing = Thing(np.flatnonzero((shell.owner == 0) & (points[:, 2] > 0.015)), attached=attached)
    before = thing.vertices
    without_doubts(shell, [thing], sightings(surface, posed, maps), NO_PROGRESS)
    return points[before], points[thing.vertices]


def test_what_is_smeared_behind_a_thing_is_taken_from_it():
    before, after = cleaned()
    assert (before[:, 1] > HIGH[1] + 0.03).sum() > 300
    assert after[:, 1].max() < HIGH[1] + 0.03
    front = before[:, 1] < LOW[1] + 0.005
    assert (after[:, 1] < LOW[1] + 0.005).sum() > 0.9 * front.sum()


def test_what_is_seen_and_measured_stays():
    before, after = cleaned(smeared=False)
    seen = (before[:, 1] < LOW[1] + 0.005) | (before[:, 2] > HIGH[2] - 0.005)
    kept = (after[:, 1] < LOW[1] + 0.005) | (after[:, 2] > HIGH[2] - 0.005)
    assert kept.sum() > 0.9 * seen.sum()


def test_a_thing_that_hardly_anything_is_measured_of_stays_whole():
    before, after = cleaned(measured=False)
    np.testing.assert_array_equal(before, after)


def test_what_hangs_on_a_wall_stays_whole():
    before, after = cleaned(attached=True)
    np.testing.assert_array_equal(before, after)


def test_what_was_taken_is_drawn_all_the_same():
    ids = np.array([1, 5, 5, 0, 6, 0], np.int32)
    shell = Shell.of(surface_from(floor_sheet((120, 100, 80), 0.6, 0.3)), NO_PROGRESS)
    drawn = as_drawn(
        shell.graph, ids, [Taken(np.array([1, 2]), np.array([3])), Taken(np.array([4]), np.array([5]))]
    )
    np.testing.assert_array_equal(drawn, [1, 5, 5, 5, 6, 6])
    np.testing.assert_array_equal(ids, [1, 5, 5, 0, 6, 0])
