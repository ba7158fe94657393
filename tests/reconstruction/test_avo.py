"""Active viewpoint optimization: the objective, its gradient, where cameras may be, decay, and what views show."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
import avo_room as room

from reconstruction.core.types import SpaceGrid
from reconstruction.gaussians.fit import exponential
from reconstruction.gaussians.model import SH_C0
from reconstruction.gaussians.rasterizer import RasterSettings, rasterize
from reconstruction.views import AvoConfig, find_views, load_inpainter, load_strategy, make_target
from reconstruction.views.cameras import look_at, moved, square_camera, step_gradient, upright
from reconstruction.views.clearance import measure_clearance
from reconstruction.views.coverage import Coverage
from reconstruction.views.initial_views import starts_below
from reconstruction.views.objective import Objective
from reconstruction.views.scene import reach_of, thinned
from reconstruction.views.search import Search
from reconstruction.views.strategies import STRATEGIES
from registry.errors import UsageError

pytestmark = pytest.mark.stage

QUICK = AvoConfig(
    side_px=64, scan_side_px=48, steps=12, restarts=1, picture_side_px=96, remaining_share=0.0, min_gain=1e-4
)


@pytest.fixture(scope="module")
def scene():
    return room.room()


@pytest.fixture(scope="module")
def open_scene():
    return room.room(with_panel=False)


@pytest.fixture(scope="module")
def found(scene):
    (views,) = find_views(scene, [room.BOX], QUICK)
    return views


def objective(scene, number, config, side=48, dtype=np.float32):
    target = make_target(scene, number, config)
    packed = scene.packed.astype(dtype)
    reach = reach_of(packed, config.sigma_cutoff)
    return Objective(packed, reach, target.rows, square_camera(side, config.fov_deg), config), target


UNCUT = replace(QUICK, sigma_cutoff=6.0, alpha_min=1e-8, transmittance_stop=0.0)


def differences(value, pose, worth, steps):
    """The derivative by central differences, the median over several sizes of steps."""

    def loss(xi):
        return value.evaluate(pose @ exponential(xi), worth, 0.7, 2.0, gradient=False).loss

    return np.array(
        [np.median([(loss(h * axis) - loss(-h * axis)) / (2 * h) for h in steps]) for axis in np.eye(6)]
    )


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_gradient_of_a_cloud_agrees_with_finite_differences(seed):
    rng = np.random.default_rng(seed)
    p = np.zeros((60, 13))
    p[:, :3], p[:, 3:7] = rng.uniform(-0.4, 0.4, (60, 3)), rng.normal(size=(60, 4))
    p[:, 7:9], p[:, 9] = rng.uniform(np.log(0.02), np.log(0.15), (60, 2)), rng.normal(size=60) + 0.5
    own = np.sort(rng.choice(60, 25, replace=False))
    value = Objective(p, reach_of(p, 6.0), own, square_camera(48, 50.0), UNCUT)
    value.reference_px = 200.0
    pose, worth = (
        look_at(np.array([0.7, -0.9, 0.5]), np.array([0.05, 0.0, -0.03]), 80.0),
        rng.uniform(0, 1, 25),
    )
    found, expected = value.evaluate(pose, worth, 0.7, 2.0).gradient, differences(value, pose, worth, [1e-5])
    assert np.linalg.norm(found - expected) <= 0.005 * np.linalg.norm(expected)


@pytest.mark.parametrize("eye", [(0.9, -0.6, 0.8), (-0.2, -1.2, 0.45), (0.5, 1.2, 0.3)])
def test_gradient_in_a_room_agrees_with_finite_differences(scene, eye):
    value, target = objective(scene, room.BOX, UNCUT, dtype=np.float64)
    value.reference_px = 300.0
    pose = look_at(np.array(eye), room.BOX_CENTER + np.array([0.05, 0.02, 0.04]), 80.0)
    worth = np.ones((2, len(target.rows)))
    # Steps are not tiny: where two Gaussians change their order, the depth at a pixel jumps by a hair.
    found, expected = (
        value.evaluate(pose, worth, 0.7, 2.0).gradient,
        differences(value, pose, worth, [3e-4, 6e-4, 1e-3]),
    )
    assert np.linalg.norm(found - expected) <= 0.03 * np.linalg.norm(expected)


def test_cropping_changes_nothing(scene):
    """Against the plain rasterizer on the whole scene: what it says of the target's Gaussians is what counts here."""
    from reconstruction.gaussians.rasterizer import rasterize

    value, target = objective(scene, room.BOX, QUICK)
    pose = look_at(np.array([0.8, -0.8, 0.7]), room.BOX_CENTER, 80.0)
    shown, _ = value.scan(pose)
    image = rasterize(scene.packed, value.camera, pose, value.settings, np.ones((48, 48)))
    expected = image.contributions[target.rows]
    shown = shown.sum(axis=0)
    assert shown.sum() > 50
    # They differ in the order of splats that are within a centimetre of each other only.
    assert shown.sum() == pytest.approx(expected.sum(), rel=0.03)
    assert np.corrcoef(shown, expected)[0, 1] > 0.99


def test_an_occluder_lowers_the_objective(scene, open_scene):
    pose = look_at(np.array([0.0, -1.0, 0.3]), room.BOX_CENTER, 80.0)
    values = []
    for place in (open_scene, scene):
        value, target = objective(place, room.BOX, QUICK)
        values.append(
            value.evaluate(pose, np.ones((2, len(target.rows))), 0.7, 0.0, gradient=False).information
        )
    assert values[1] < 0.4 * values[0]


def test_what_is_seen_from_behind_is_no_information(open_scene):
    value, target = objective(open_scene, room.BOX, QUICK)
    pose = look_at(np.array([0.0, -1.0, 0.3]), room.BOX_CENTER, 80.0)
    worth = np.array([[1.0], [0.0]]) * np.ones(len(target.rows))
    outward = open_scene.packed[target.rows, :3].astype(np.float64) - room.BOX_CENTER
    value.fronts = outward
    before = value.evaluate(pose, worth, 0.7, 0.0, gradient=False)
    value.fronts = -outward
    behind = value.evaluate(pose, worth, 0.7, 0.0, gradient=False)
    assert before.information > 100
    assert behind.information < 0.05 * before.information
    assert behind.seen == before.seen  # it hides, and has a depth, from both sides


def test_the_search_brings_the_camera_to_the_target_distance(open_scene):
    value, target = objective(open_scene, room.BOX, QUICK)
    value.reference_px = 500.0
    worth = np.ones((2, len(target.rows)))
    start = look_at(np.array([0.2, -1.25, 0.5]), room.BOX_CENTER, 80.0)
    depths = {}
    for weight in (0.0, QUICK.depth_weight):
        search = Search(value, open_scene.clearance, 0.8, weight, replace(QUICK, steps=40))
        result = search.descend(start, worth)
        first = value.evaluate(start, worth, 0.8, weight).loss
        assert result.value.loss < first
        depths[weight] = result.value.depth_m
    assert depths[QUICK.depth_weight] == pytest.approx(0.8, rel=0.15)
    assert depths[0.0] < 0.75 * depths[QUICK.depth_weight]  # without the term it collapses onto the surface


def test_a_start_in_a_wall_leaves_it(open_scene):
    value, target = objective(open_scene, room.BOX, QUICK)
    search = Search(value, open_scene.clearance, 0.8, QUICK.depth_weight, QUICK)
    start = look_at(np.array([0.0, -1.62, 0.5]), room.BOX_CENTER, 80.0)  # 12 cm beyond where the room ends
    assert open_scene.clearance.at(start[:3, 3]) < 0
    result = search.descend(start, np.ones((2, len(target.rows))))
    assert open_scene.clearance.at(result.pose[:3, 3]) >= QUICK.min_clearance_m


def test_views_are_free_upright_and_see_what_the_input_frames_do_not(scene, found):
    frames = find_views(scene, [room.BOX], replace(QUICK, strategy="max-visibility"))[0].views
    assert len(found.views) == QUICK.views
    for view in found.views:
        assert scene.clearance.at(view.world_from_camera[:3, 3]) >= QUICK.min_clearance_m
        assert view.world_from_camera[2, 3] > 0
        assert abs(view.world_from_camera[2, 0]) < 1e-9  # the camera's right is level
        assert np.allclose(view.world_from_camera[:3, :3].T @ view.world_from_camera[:3, :3], np.eye(3))
    assert found.views[0].visibility > frames[0].visibility + 0.2
    assert found.views[0].visibility > 0.9


def test_what_a_view_shows(scene):
    """From an input camera: the panel hides the lower part of the box; taking it away shows all that is known."""
    (whole,) = find_views(scene, [room.BOX], replace(QUICK, strategy="max-visibility", views=1))
    view = whole.views[0]
    size = (view.camera.height, view.camera.width)
    assert view.color.shape == (*size, 3)
    assert view.depth.shape == view.alpha.shape == size
    assert 0.05 < view.visibility < 0.8
    seen = view.depth[view.mask]
    eye = view.world_from_camera[:3, 3]
    away = np.linalg.norm(room.BOX_CENTER - eye)
    assert np.all(np.abs(seen - away) < 0.5 * np.sqrt(3) * room.BOX_SIDE)
    red = (view.clean[..., 0] > 150) & (view.clean[..., 1] < 90)
    assert red.sum() > 1.5 * view.mask.sum()
    green = (view.clean[..., 1] > 150) & (view.clean[..., 0] < 90)
    assert green.sum() < 0.1 * view.mask.sum()


def test_only_what_matters_is_drawn(scene, found):
    """The opacity behind what hides the target is that of a picture of the whole scene."""
    own = np.isin(np.arange(len(scene.packed)), make_target(scene, room.BOX, QUICK).rows)
    marked = scene.packed.copy()
    marked[:, 10:13] = np.where(own[:, None], 0.5, -0.5) / SH_C0
    frames = find_views(scene, [room.BOX], replace(QUICK, strategy="max-visibility"))[0].views
    assert min(view.visibility for view in frames) < 0.8  # something is in the way
    for view in (*frames, *found.views):
        drawn = rasterize(marked, view.camera, view.world_from_camera, RasterSettings(near=0.02)).features
        np.testing.assert_allclose(view.alpha, drawn[..., 0], atol=1e-3)


def test_large_targets_are_optimized_coarser_and_seen_as_well(scene, found):
    count = len(make_target(scene, room.BOX, QUICK).rows)
    (same,) = find_views(scene, [room.BOX], replace(QUICK, large_gaussians=count))
    (never,) = find_views(scene, [room.BOX], replace(QUICK, large_gaussians=0))
    for other in (same, never):
        for a, b in zip(other.views, found.views, strict=True):
            np.testing.assert_array_equal(a.world_from_camera, b.world_from_camera)
    large = replace(QUICK, large_gaussians=count - 1)
    points = STRATEGIES["avo"].choose(scene, make_target(scene, room.BOX, large), large)
    assert {point.camera.width for point in points} == {QUICK.scan_side_px}
    (coarse,) = find_views(scene, [room.BOX], large)
    assert coarse.views[0].visibility > 0.9
    assert coarse.views[0].color.shape == found.views[0].color.shape


def test_thinned_gaussians_cover_what_all_of_them_covered(scene):
    target = make_target(scene, room.BOX, QUICK)
    most = len(target.rows) // 2
    few, same = thinned(scene, target, most)
    assert len(same.rows) == most
    assert len(few.packed) == pytest.approx(0.5 * len(scene.packed), abs=2)
    np.testing.assert_array_equal(np.flatnonzero(few.instance == room.BOX), same.rows)
    assert thinned(scene, target, len(target.rows)) == (scene, target)
    camera = square_camera(64, 50.0)
    for eye in ([0.9, -0.9, 0.8], [-0.9, 1.1, 0.5]):
        pose = look_at(np.array(eye), target.center, 80.0)
        all_of_it, left = (
            rasterize(packed, camera, pose, RasterSettings()).features[..., 7] > 0.5
            for packed in (scene.packed[target.rows], few.packed[same.rows])
        )
        assert (all_of_it & left).sum() > 0.85 * (all_of_it | left).sum()


def test_low_starts_look_up_from_beside_the_target_and_never_from_below_it(scene):
    target = make_target(scene, room.BOX, QUICK)
    assert not len(
        starts_below(scene, target, QUICK)
    )  # a low thing: cameras beside its foot are too near the floor
    target = replace(target, center=target.center + np.array([0.0, 0.0, 0.25]))
    low = starts_below(scene, target, QUICK)
    assert len(low)
    assert (low[:, 2, 3] >= scene.packed[target.rows, 2].min()).all()
    assert (low[:, 2, 3] < target.center[2]).all()
    assert all(scene.clearance.at(pose[:3, 3]) >= QUICK.clearance_m for pose in low)


def test_views_stop_at_k_and_at_the_remaining_share(scene, found):
    two = find_views(scene, [room.BOX], replace(QUICK, views=2))[0].views
    assert len(two) == 2
    for a, b in zip(two, found.views):
        np.testing.assert_array_equal(a.world_from_camera, b.world_from_camera)
    gains = np.cumsum([view.gain for view in found.views])
    enough = 1.0 - 0.5 * (gains[0] + gains[1])  # reached by the second view, not by the first
    few = find_views(scene, [room.BOX], replace(QUICK, remaining_share=float(enough)))[0].views
    assert len(few) == 2


def test_coverage_decays_by_what_was_shown():
    most = np.array([[10.0, 4.0, 2.0], [0.0, 0.0, 1.0]])
    start = Coverage(np.array([0.8, 0.8, 0.2]), most, back_weight=0.5)
    assert start.remaining == pytest.approx(1.0)
    np.testing.assert_allclose(start.worth, [[1, 1, 1], [0, 0, 0.5]])  # what cannot be seen does not count
    view = np.array([[10.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    after = start.after(view)
    np.testing.assert_allclose(after.worth, [[0, 1, 1], [0, 0, 0.5]])
    assert after.remaining == pytest.approx(1.1 / 1.9)
    assert start.remaining == pytest.approx(1.0)  # the one before is as it was
    assert after.after(view).remaining == after.remaining
    partly = start.after(np.array([[2.0, 0.0, 40.0], [0.0, 0.0, 0.0]])).worth
    assert 0 < partly[0, 0] < 1
    assert partly[0, 2] == 0.0
    assert partly[1, 2] == 0.5  # the other side of it was not seen


def test_a_batch_gives_what_each_target_gives_alone(scene, found):
    regions = [room.BALL, room.BOX, (room.BOX, room.BALL), 77]
    batch = find_views(scene, regions, replace(QUICK, views=2))
    assert [entry.ids for entry in batch] == [(4,), (2,), (2, 4), (77,)]
    assert batch[3].views == ()
    for a, b in zip(batch[1].views, found.views):
        np.testing.assert_array_equal(a.world_from_camera, b.world_from_camera)
        np.testing.assert_array_equal(a.color, b.color)
    region = batch[2].views[0]
    assert batch[2].distance_m > batch[1].distance_m  # it looks at both from farther away
    local = np.array([room.BOX_CENTER, [0.7, 0.5, 0.06]]) - region.world_from_camera[:3, 3]
    local = local @ region.world_from_camera[:3, :3]
    pixels = local[:, :2] / local[:, 2:] * region.camera.fx + region.camera.cx
    assert ((pixels > 0) & (pixels < region.camera.width)).all()


def test_canonical_views_are_an_orbit_that_ignores_the_room(scene):
    views = find_views(scene, [room.BOX], replace(QUICK, strategy="canonical"))[0].views
    target = make_target(scene, room.BOX, QUICK)
    away = np.array([view.world_from_camera[:3, 3] for view in views]) - target.center
    assert np.ptp(np.linalg.norm(away, axis=1)) < 1e-9
    angles = np.sort(np.degrees(np.arctan2(away[:, 1], away[:, 0])))
    np.testing.assert_allclose(np.diff(angles), 90.0, atol=1e-6)


def test_steps_keep_the_camera_upright_and_the_point_ahead_ahead():
    pose = look_at(np.array([1.0, -2.0, 1.0]), np.zeros(3), 80.0)
    distance = float(np.linalg.norm(pose[:3, 3]))
    after = moved(pose, np.array([0.02, -0.01, 0.0, 0.0, 0.0]), distance, 80.0)
    ahead = -after[:3, 3] @ after[:3, :3]
    assert np.hypot(*(ahead[:2] / ahead[2])) < 2e-3
    assert abs(after[2, 0]) < 1e-12
    # The derivative in these coordinates is that of the way the camera moves, where no roll is taken out.
    for k in range(5):
        step = np.zeros(5)
        step[k] = 1e-6
        change = np.linalg.inv(pose) @ moved(pose, step, distance, 80.0)
        xi = np.array([*change[:3, 3], change[2, 1], change[0, 2], change[1, 0]]) / 1e-6
        for axis in (0, 1, 2, 3, 4):
            unit = np.eye(6)[axis]
            assert step_gradient(unit, distance)[k] == pytest.approx(xi @ unit, abs=1e-4)


def test_pitch_is_limited():
    down = upright(np.array([0.0, 0.0, -1.0]), 80.0)
    assert down[2, 2] == pytest.approx(-np.sin(np.radians(80.0)))
    assert np.linalg.det(down) == pytest.approx(1.0)


def test_clearance_is_signed_and_knows_what_lies_behind_a_surface():
    state = np.ones((40, 20, 20), np.uint8)
    state[20:22] = 2  # a wall through all of it: nobody was behind
    space = SpaceGrid(np.zeros(3), 0.1, state)
    clearance = measure_clearance(space, np.array([[0.5, 1.0, 1.0], [0.8, 1.0, 1.0]]))
    assert clearance.at(np.array([1.5, 1.0, 1.0])) == pytest.approx(0.5, abs=0.051)
    assert clearance.at(np.array([2.3, 1.0, 1.0])) < -0.2  # free, but no way leads there
    assert clearance.at(np.array([-0.5, 1.0, 1.0])) < -0.3  # outside of what was seen
    place = np.array([1.83, 1.02, 1.01])
    _, slope = clearance.with_gradient(place)
    for k in range(3):
        step = np.eye(3)[k] * 1e-4
        difference = (clearance.at(place + step) - clearance.at(place - step)) / 2e-4
        assert slope[k] == pytest.approx(difference, abs=1e-3)


def test_inpainting_fills_holes_and_nothing_else():
    picture = np.full((40, 40, 3), 120, np.uint8)
    holes = np.zeros((40, 40), bool)
    holes[10:14, 5:30] = True
    picture[holes] = 0
    for name in ("telea", "navier-stokes"):
        filled = load_inpainter(name).inpaint(picture, holes)
        assert np.abs(filled[holes].astype(int) - 120).max() < 10
        np.testing.assert_array_equal(filled[~holes], picture[~holes])


def test_wrong_names_and_values_are_said():
    with pytest.raises(UsageError, match=r"avo\.strategy=best: there is no such backend"):
        load_strategy("best")
    with pytest.raises(UsageError, match=r"avo\.inpainting=magic: there is no such backend"):
        load_inpainter("magic")
    with pytest.raises(ValueError, match=r"avo\.views"):
        AvoConfig(views=0)
    assert set(STRATEGIES) == {"avo", "avo-no-depth", "max-visibility", "canonical"}
