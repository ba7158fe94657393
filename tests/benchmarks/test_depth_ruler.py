"""The depth ruler measures what it says, on scenes whose depth is written down here."""

import numpy as np
import pytest

from benchmarks.depth import main, report_lines
from benchmarks.depth_figures import TrueView, depth_figures, laid_onto, ring_counts
from reconstruction.core.types import Camera, DepthMaps
from reconstruction.depth.perturb import perturbed
from registry.geometry import rigid, transform_points

CAMERA = Camera(320, 240, 300.0, 300.0, 160.0, 120.0)
NAMES = {2: "box"}


def scene() -> TrueView:
    """Return a wall at 2 m (entity 1) before which a box (entity 2) stands at 1 m."""
    depth, ids = np.full((240, 320), 2.0, np.float32), np.ones((240, 320), np.int32)
    depth[100:140, 100:160], ids[100:140, 100:160] = 1.0, 2
    return TrueView(0, depth, ids)


def maps(depth: np.ndarray, confidence: np.ndarray | None = None) -> DepthMaps:
    """Return one depth map, all of it measured unless said otherwise."""
    level = np.where(depth > 0, 2, 0) if confidence is None else confidence
    return DepthMaps(CAMERA, depth[None].astype(np.float32), level[None].astype(np.uint8))


def test_the_truth_is_right_everywhere():
    view = scene()
    found = depth_figures(maps(view.depth / 0.2), 0.2, [view], NAMES)
    assert found["known"] == found["measured"] == found["on_things"] == 1.0
    assert found["off"] == found["ring"] == 0.0
    assert found["median_rel"] < 1e-6
    assert found["things"]["box"]["pixels"] == 2400


def test_unknown_wrong_and_completed_pixels_are_counted():
    view = scene()
    depth = view.depth.copy()
    depth[100:140, 100:115] = 0  # a quarter of the box unknown, a quarter 3 % off
    depth[100:140, 115:130] *= 1.03
    depth[:24] *= 1.1  # a tenth of the picture, completed, 10 % off
    level = np.where(depth > 0, 2, 0)
    level[:24] = 1
    found = depth_figures(maps(depth, level), 1.0, [view], NAMES)
    pixels = 240 * 320
    assert found["known"] == pytest.approx(1 - 600 / pixels)
    assert found["completed"] == pytest.approx(0.1)
    assert (found["completed_off"], found["measured_off"]) == (1.0, 0.0)
    assert found["on_things"] == pytest.approx(0.5)


def test_what_a_reference_did_not_know_is_new():
    view = scene()
    before = view.depth.copy()
    before[200:] = 0
    after = view.depth.copy()
    after[220:] *= 1.2
    found = depth_figures(maps(after), 1.0, [view], NAMES, reference=maps(before))
    assert found["new"] == pytest.approx(40 / 240)
    assert found["new_off"] == pytest.approx(0.5)


def test_background_that_sticks_to_a_thing_is_glued():
    view = scene()
    depth = view.depth.copy()
    depth[98:142, 98:162] = 1.0  # the box is two pixels too wide on all sides
    counted, glued = ring_counts(depth, view.depth, view.ids, [2])
    yy, xx = np.mgrid[:240, :320]
    dx, dy = np.maximum(np.maximum(100 - xx, xx - 159), 0), np.maximum(np.maximum(100 - yy, yy - 139), 0)
    far = np.hypot(dx, dy)
    assert counted == ((far > 0) & (far <= 4)).sum()
    assert glued == ((far > 0) & (np.maximum(dx, dy) <= 2)).sum()
    assert ring_counts(np.zeros_like(depth), view.depth, view.ids, [2]).tolist() == [
        0,
        0,
    ]  # unknown is not glued


def test_what_stands_before_a_thing_or_on_its_level_is_no_background():
    view = scene()
    near = np.where(view.ids == 2, 1.0, 0.98).astype(np.float32)
    assert ring_counts(near, near, view.ids, [2]).tolist() == [0, 0]


def test_points_are_laid_onto_a_surface():
    generator = np.random.default_rng(0)
    points = generator.uniform(0, 2, (20_000, 3))  # on the six walls of a room, and on a post in it
    points[np.arange(len(points)), generator.integers(0, 3, len(points))] = generator.choice(
        [0, 2], len(points)
    )
    points[:1_500, :2] = 0.8 + 0.1 * generator.choice([0, 1], (1_500, 2))
    surface = points
    chosen = surface[::20]
    true = rigid(None, np.array([0.03, -0.02, 0.04])) @ np.diag([1.04, 1.04, 1.04, 1.0])
    points = transform_points(np.linalg.inv(true), chosen)
    found = laid_onto(points, surface, np.eye(4))
    assert np.abs(transform_points(found, points) - chosen).max() < 0.02


def test_only_the_last_bits_change_and_the_seed_says_how():
    depth = np.random.default_rng(0).uniform(0.5, 5, (2, 40, 60)).astype(np.float32)
    depth[0, :10] = 0
    changed = perturbed(depth, 1)
    assert changed.dtype == np.float32
    assert np.array_equal(changed == 0, depth == 0)
    known = depth > 0
    ratio = np.abs(changed[known].astype(np.float64) / depth[known] - 1)
    assert 0 < ratio.max() < 1.2e-6
    assert (changed[known] != depth[known]).mean() > 0.8
    assert np.array_equal(changed, perturbed(depth, 1))
    assert not np.array_equal(changed, perturbed(depth, 2))
    assert not np.array_equal(
        changed[0][known[0]] / depth[0][known[0]], changed[1][known[0]] / depth[1][known[0]]
    )


def test_the_mean_of_rings_is_weighted_by_their_pixels():
    rows = [
        {"capture": "a", "known": 0.9, "ring": 0.1, "ring_px": 300, "pixels": 1},
        {"capture": "b", "known": 0.7, "ring": 0.5, "ring_px": 100, "pixels": 1},
        {"capture": "dorm", "known": 0.1},
    ]
    assert report_lines(rows)[-1] == "| mean of those with truth | 80.0 | 20.0 |"
    assert report_lines(rows)[-2] == "| dorm | 10.0 | – |"


@pytest.mark.stage  # runs a command
def test_a_capture_that_is_not_there_is_named(capsys):
    assert main(["cellar"]) == 2
    assert "cellar: no such folder" in capsys.readouterr().err
