"""Self-calibration of a phone's camera, and things that move before it: synthetic models and generated films."""

from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from notes import Notes

from benchmarks.phone_films import PhoneFilm, Truth, make_film
from benchmarks.phones import judge
from reconstruction.poses import POSES_PRESETS
from reconstruction.poses.bundle import Bundle, Equations
from reconstruction.poses.moving_things import clusters, without_moving_things
from reconstruction.poses.phone_camera import find_phone_camera
from reconstruction.poses.refine import bundle_adjust
from reconstruction.poses.self_calibration import self_calibrate

pytestmark = pytest.mark.stage
_FRAMES = 16
_TIMES = 2.0 * np.arange(_FRAMES)  # too far apart for a motion: the shutter cannot be seen


def synthetic_model() -> pycolmap.Reconstruction:
    """Return a model of 16 frames and 250 points whose pixels have noise."""
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, _FRAMES, 250
    model = pycolmap.synthesize_dataset(options)
    rng = np.random.default_rng(0)
    for image_id in sorted(model.reg_image_ids()):
        for point in model.image(image_id).points2D:
            point.xy = point.xy + rng.normal(0, 0.3, 2)
    return model


def shift_pixels(model: pycolmap.Reconstruction, offsets: np.ndarray) -> None:
    for row, offset in enumerate(offsets):
        for point in model.image(row + 1).points2D:
            point.xy = point.xy + offset


def move_some_points(model: pycolmap.Reconstruction) -> set[int]:
    """Let the fifth of the points that is nearest to one of them drift while the film goes on; return their ids."""
    ids = sorted(model.point3D_ids())
    places = np.array([model.point3D(i).xyz for i in ids])
    near = np.linalg.norm(places - places[7], axis=1).argsort()[: len(ids) // 5]
    moving = {ids[k] for k in near}
    way = 0.008 * float(np.ptp(places)) * np.array([1.0, 0.5, 0.2])
    for row in range(_FRAMES):
        image = model.image(row + 1)
        for point in image.points2D:
            if point.has_point3D() and point.point3D_id in moving:
                seen = image.project_point(model.point3D(point.point3D_id).xyz + row / _FRAMES * way)
                point.xy = seen if seen is not None else point.xy
    bundle_adjust(model)
    return moving


def test_derivatives_are_those_of_the_errors():
    model = synthetic_model()
    bundle = Bundle(model, 0.1 * np.arange(_FRAMES), 0)
    rng = np.random.default_rng(1)
    linear = bundle.linearized(bundle.start)
    cameras = 1e-6 * rng.normal(size=8 * _FRAMES + 3)
    points = 1e-6 * rng.normal(size=(250, 3))
    moved = bundle.stepped(bundle.start, cameras, points)
    expected = (
        np.einsum("kij,kj->ki", linear.by_frame, cameras[: 8 * _FRAMES].reshape(-1, 8)[linear.frame])
        + linear.by_shared @ cameras[8 * _FRAMES :]
        + np.einsum("kij,kj->ki", linear.by_point, points[linear.point])
    )
    assert np.abs(bundle.errors(moved) - linear.error - expected).max() < 1e-3 * np.abs(expected).max()


def test_the_systems_of_parts_of_the_points_add_up():
    bundle = Bundle(synthetic_model(), _TIMES, 0)
    linear = bundle.linearized(bundle.start)
    whole, gradient, _ = Equations.of(linear, _FRAMES, 250).reduced()
    parts = [np.arange(0, 250, 2), np.arange(1, 250, 2)]
    systems = [Equations.of(linear.of(part), _FRAMES, 125).reduced() for part in parts]
    assert np.allclose(whole, systems[0][0] + systems[1][0], atol=1e-9 * np.abs(whole).max())
    assert np.allclose(gradient, systems[0][1] + systems[1][1], atol=1e-9 * np.abs(gradient).max())


def test_a_moving_crop_is_found_and_a_fixed_one_is_not():
    still = synthetic_model()
    assert self_calibrate(Bundle(still, _TIMES, 0)).spread_px == 0.5
    offsets = np.random.default_rng(2).normal(0, 8, (_FRAMES, 2))
    moved = synthetic_model()
    shift_pixels(moved, offsets - offsets.mean(0))
    bundle_adjust(moved)
    found = self_calibrate(Bundle(moved, _TIMES, 0))
    error = found.unknowns.offset - (offsets - offsets.mean(0))
    assert found.spread_px > 4
    assert np.sqrt(((error - error.mean(0)) ** 2).mean()) < 0.25 * 8
    assert found.unknowns.params[0] == pytest.approx(1280, rel=0.01)


def test_a_camera_at_rest_has_no_offsets():
    moved = synthetic_model()
    shift_pixels(moved, np.random.default_rng(2).normal(0, 8, (_FRAMES, 2)))
    found = self_calibrate(Bundle(moved, _TIMES, 0), at_rest=True).unknowns
    assert np.abs(found.offset).max() < 1e-6
    assert abs(found.readout_s) < 1e-6


def test_things_that_move_are_left_out():
    frames = SimpleNamespace(times_s=_TIMES, quarter_turns=0)
    model = synthetic_model()
    bundle_adjust(model)

    def largest_influence_and_bend() -> tuple[float, float]:
        bundle = Bundle(model, _TIMES, 0)
        found = clusters(bundle, self_calibrate(bundle, at_rest=True))
        return max(c.influence for c in found), max(c.bend for c in found)

    influence, bend = largest_influence_and_bend()
    moving = move_some_points(model)
    influence_now, bend_now = largest_influence_and_bend()
    assert influence_now > 4 * influence
    assert bend_now > 4 * bend
    before = model.num_points3D()
    rest = without_moving_things(model, frames, POSES_PRESETS["default"])
    assert rest is not None
    assert model.num_points3D() == before, "the model stays"
    left = set(rest.point3D_ids())
    assert len(left & moving) <= 0.2 * len(moving)
    assert len(left - moving) >= 0.9 * (before - len(moving))


def test_a_film_at_rest_keeps_its_model():
    model, notes = synthetic_model(), Notes()
    bundle_adjust(model)
    poses = [model.image(row + 1).cam_from_world().matrix() for row in range(_FRAMES)]
    camera = model.cameras[1]
    blank = np.zeros((_FRAMES, camera.height, camera.width, 3), np.uint8)  # no patch aligns
    frames = SimpleNamespace(images=blank, times_s=_TIMES, quarter_turns=0)
    phone = find_phone_camera(model, frames, POSES_PRESETS["default"], notes)
    assert phone.offsets is None
    assert phone.shutter is None
    assert not notes.notes
    now = [phone.model.image(row + 1).cam_from_world().matrix() for row in range(_FRAMES)]
    assert np.abs(np.array(now) - poses).max() < 2e-3  # another scale of the loss


@pytest.mark.end_to_end
@pytest.mark.parametrize(
    ("film", "said"),
    [
        (
            PhoneFilm("crop_and_shutter", wander=0.02, readout_s=0.02, size=(320, 240)),
            ("crop", "rolling shutter"),
        ),
        (PhoneFilm("somebody_stays", passers=2, size=(320, 240)), ("moves before the camera",)),
    ],
    ids=lambda value: value.name if isinstance(value, PhoneFilm) else "",
)
def test_films_of_phones_have_the_true_cameras(film, said, tmp_path):
    video = make_film(film, 14 if film.wander else 1, tmp_path / film.name)
    outcome = judge(film, video, Truth.load(video.parent), with_depth=False)
    assert outcome.verdict == "right", outcome
    assert outcome.camera_error < 0.015
    assert all(any(word in note for note in outcome.notes) for word in said), outcome.notes
