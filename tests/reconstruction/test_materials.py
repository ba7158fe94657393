"""Drawn materials, light, sensors and walks for training films; without them films stay as they were."""

import hashlib
from dataclasses import replace

import cv2
import numpy as np
import pytest

from reconstruction.core.rasterize import rasterize_mesh
from synthetic.camera_paths import phone_camera
from synthetic.film import iterate_film, prepare, render_color
from synthetic.lighting import Light, draw_light
from synthetic.materials import FAMILIES, Finish, MaterialMix, repaint
from synthetic.photographs import load_photographs
from synthetic.procedural import RoomSpec, furnish, plan_room
from synthetic.sensor import Sensor, draw_sensor
from synthetic.walks import WALKS, draw_walk, walk_path

pytestmark = pytest.mark.stage

_BEFORE = "5c9b9e668df2deaf15d1832482c30f157a71b0c2062229699a36d56389d985bb"
_BEFORE_BLURRED = "c23ff82ecb2ad7d751715bce70f56f432ea2849adbe054aedb65c0fdadb2d8d5"
_DRAWN = ("near", "strafe", "pan", "sit", "handheld_wander")


@pytest.fixture(scope="module")
def plan():
    return plan_room(RoomSpec(seed=3, objects=8, step_m=0.08, density=0.4))


@pytest.fixture(scope="module")
def room(plan):
    return furnish(plan)


@pytest.fixture(scope="module")
def film_set(room):
    return prepare(room, shadow_px=256)


@pytest.fixture(scope="module")
def camera():
    return phone_camera(160, 120)


@pytest.fixture(scope="module")
def poses(plan):
    return walk_path(plan.shape, "arc", 12, 3)


def _hash(image):
    return hashlib.sha256(image.tobytes()).hexdigest()


def _one(film_set, camera, poses, sensor, **more):
    """Return the last of a few frames."""
    return list(iterate_film(film_set, camera, poses[:3], sensor, seed=1, quick=True, **more))[-1].astype(
        float
    )


def test_films_are_what_they_were(film_set, camera, poses):
    assert _hash(list(iterate_film(film_set, camera, poses[:2], Sensor(), seed=1))[1]) == _BEFORE
    blurred = Sensor(blur_shutter=0.5, blur_jitter=True)
    assert _hash(next(iter(iterate_film(film_set, camera, poses[:2], blurred, seed=1)))) == _BEFORE_BLURRED


def test_a_blurred_frame_is_centered_on_its_pose(film_set, camera, poses):
    path = np.stack([poses[0]] * 3)
    path[:, :3, 3] += np.linspace(-0.05, 0.05, 3)[:, None] * poses[0][:3, 0]  # to the right
    clean = Sensor(noise=0.0, exposure_drift=0.0)

    def grays(sensor):
        film = iterate_film(film_set, camera, path, sensor, seed=1)
        return [np.float32(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)) for image in film]

    first, middle, _ = grays(clean)
    blurred = grays(replace(clean, blur_shutter=0.6, blur_samples=5))[1]
    window = cv2.createHanningWindow(middle.shape[::-1], cv2.CV_32F)
    step = abs(cv2.phaseCorrelate(middle, first, window)[0][0])
    assert step > 3.0
    assert abs(cv2.phaseCorrelate(middle, blurred, window)[0][0]) < 0.05 * step


def test_quick_pictures_are_nearly_the_same(film_set, camera, poses):
    for pose in poses[::5]:
        slow, quick = render_color(film_set, camera, pose), render_color(film_set, camera, pose, quick=True)
        assert abs(float((slow - quick).mean())) < 0.3
        # Fine textures are filtered otherwise; what is a few pixels large is the same.
        assert np.abs(cv2.GaussianBlur(slow - quick, (0, 0), 2.0)).mean() < 1.0


def test_quick_pictures_are_right_where_triangles_cross_the_camera(room, camera, poses):
    plain = replace(room, textures={n: replace(t, pixels=t.pixels[:1, :1]) for n, t in room.textures.items()})
    film_set = prepare(plain, shadow_px=64)
    low = poses[0].copy()
    low[2, 3] = 0.05
    slow, quick = render_color(film_set, camera, low, 1), render_color(film_set, camera, low, 1, quick=True)
    seen = rasterize_mesh(film_set.vertices, film_set.faces, camera, low).face >= 0
    assert (np.abs(slow - quick).max(2)[seen] < 2.0).mean() > 0.99


def test_repainting_is_repeatable_and_changes_textures_only(room):
    photographs = [np.random.default_rng(0).integers(0, 255, (200, 300, 3), np.uint8)]
    first, shining = repaint(room, np.random.default_rng(5), MaterialMix(), photographs)
    again, shining_again = repaint(room, np.random.default_rng(5), MaterialMix(), photographs)
    other, _ = repaint(room, np.random.default_rng(6), MaterialMix(), photographs)
    assert first.entities is room.entities
    assert set(first.textures) == set(room.textures)
    assert shining == shining_again
    assert set(shining) <= set(room.textures)
    assert all(np.array_equal(first.textures[n].pixels, again.textures[n].pixels) for n in room.textures)
    assert any(not np.array_equal(first.textures[n].pixels, other.textures[n].pixels) for n in room.textures)
    assert any(first.textures[n] is not room.textures[n] for n in room.textures)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_family_alone_paints_everything(room, family):
    others = [name for name in FAMILIES if name != family]
    photographs = [np.full((150, 150, 3), 90, np.uint8)]
    mix = MaterialMix().without(*others)
    painted, shining = repaint(room, np.random.default_rng(1), mix, photographs)
    density = {n: t.texels_per_m for n, t in painted.textures.items() if t is not room.textures[n]}
    if family == "print":
        assert not density
    elif family != "text":  # never on floors
        assert set(density) == set(room.textures) - {"edge"}
    assert bool(shining) == (family == "gloss")
    for name, texels in density.items():
        if min(painted.textures[name].pixels.shape[:2]) > 9:
            assert texels <= (400 if "/" not in name else 1500)


def test_a_highlight_moves_with_the_camera(room, camera, poses):
    plain = {n: replace(t, pixels=np.full((8, 8, 3), 40, np.uint8)) for n, t in room.textures.items()}
    plain_room = replace(room, textures=plain)
    matt = prepare(plain_room, shadow_px=64)
    glossy = prepare(plain_room, shadow_px=64, finishes={"floor": Finish(1.0, 200.0)})
    spots = []
    for pose in (poses[1], poses[6]):
        added = (render_color(glossy, camera, pose, 1) - render_color(matt, camera, pose, 1)).sum(2)
        assert added.min() > -1e-3
        assert added.max() > 40
        row, column = np.unravel_index(added.argmax(), added.shape)
        depth = rasterize_mesh(matt.vertices, matt.faces, camera, pose).depth[row, column]
        ray = np.array([(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, 1.0])
        spots.append(pose[:3, :3] @ (ray * depth) + pose[:3, 3])
        quick = render_color(glossy, camera, pose, 1, quick=True)
        assert np.abs(quick - render_color(glossy, camera, pose, 1)).mean() < 1.0
    assert np.linalg.norm(spots[0] - spots[1]) > 0.2


def test_light_changes_the_picture(room, film_set):
    assert np.array_equal(prepare(room, shadow_px=256, light=Light()).light, film_set.light)
    rng = np.random.default_rng(4)
    drawn = [prepare(room, shadow_px=64, light=draw_light(rng, room.extent)).light for _ in range(4)]
    assert all(np.isfinite(light).all() and 0.2 < light.mean() < 1.5 for light in drawn)
    assert np.abs(drawn[0] - drawn[1]).mean() > 0.02


@pytest.mark.parametrize(
    "change",
    [
        {"rolling_shutter": 0.5}, {"exposure": 1.3}, {"exposure_mean": 60.0}, {"exposure_steps": 0.2},
        {"clip_level": 120.0}, {"vignetting": 0.4}, {"white_balance": (1.1, 1.0, 0.9)}, {"white_drift": 0.1},
        {"gamma": 0.7}, {"contrast": 0.5}, {"saturation": 0.3}, {"defocus_px": 1.5}, {"sharpening": 0.8},
        {"shot_noise": 8.0}, {"chroma_noise": 4.0}, {"jpeg_quality": 30},
    ],
    ids=lambda change: next(iter(change)),
)  # fmt: skip
def test_every_part_of_a_sensor_has_an_effect(film_set, camera, poses, change):
    still = Sensor(noise=0.0, exposure_drift=0.0)
    difference = np.abs(
        _one(film_set, camera, poses, replace(still, **change)) - _one(film_set, camera, poses, still)
    )
    assert difference.mean() > 0.3


def test_smeared_noise_is_as_strong(film_set, camera, poses):
    still = _one(film_set, camera, poses, Sensor(noise=0.0, exposure_drift=0.0))
    noise = [
        _one(film_set, camera, poses, Sensor(noise=5.0, exposure_drift=0.0, noise_grain_px=g)) - still
        for g in (0.0, 1.0)
    ]
    assert noise[1].std() == pytest.approx(noise[0].std(), rel=0.15)
    assert np.abs(np.diff(noise[1], axis=1)).mean() < 0.7 * np.abs(np.diff(noise[0], axis=1)).mean()


def test_drawn_sensors_make_pictures(film_set, camera, poses):
    rng = np.random.default_rng(2)
    for _ in range(5):
        frame = _one(film_set, camera, poses, draw_sensor(rng))
        assert frame.shape == (120, 160, 3)
        assert 20 < frame.mean() < 235


@pytest.mark.parametrize("walls", [3, 4])
@pytest.mark.parametrize("kind", _DRAWN)
def test_drawn_walks_stay_upright_on_the_free_band(kind, walls):
    shape = plan_room(RoomSpec(seed=5, objects=8, walls=walls)).shape
    assert kind in WALKS
    for seed in range(8):
        path = walk_path(shape, kind, 40, seed)
        assert np.array_equal(path, walk_path(shape, kind, 40, seed))
        assert np.isfinite(path).all()
        assert np.allclose(path[:, :3, :3] @ path[:, :3, :3].transpose(0, 2, 1), np.eye(3), atol=1e-9)
        assert (path[:, 2, 1] < -0.3).all()  # the image's down is the world's
        at = path[:, :3, 3]
        angle = np.arctan2(at[:, 1], at[:, 0])
        out = np.linalg.norm(at[:, :2], axis=1) - np.linalg.norm(shape.walk(angle), axis=1)
        if kind == "near":
            assert (np.abs(out + 0.49) < 0.24).all()
            assert ((at[:, 2] >= 0.56 + 0.24) & (at[:, 2] <= 0.56 + 0.71)).all()
        else:
            assert (np.abs(out) < 0.161).all()
            assert ((at[:, 2] > 0.75) & (at[:, 2] < 1.85)).all()


def test_draw_walk_depends_on_the_seed(plan):
    first, again, other = (draw_walk(np.random.default_rng(s), plan.shape, 20) for s in (1, 1, 2))
    assert first.shape == (20, 4, 4)
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_photographs_are_read_and_shrunk(tmp_path):
    (tmp_path / "deep").mkdir()
    cv2.imwrite(str(tmp_path / "deep" / "large.png"), np.full((300, 2000, 3), (10, 20, 200), np.uint8))
    cv2.imwrite(str(tmp_path / "tiny.png"), np.zeros((20, 20, 3), np.uint8))
    (tmp_path / "broken.jpg").write_bytes(b"no picture")
    found = load_photographs(tmp_path, 5, np.random.default_rng(0))
    assert [f.shape for f in found] == [(154, 1024, 3)]
    assert found[0][0, 0].tolist() == [200, 20, 10]
    assert load_photographs(tmp_path, 0, np.random.default_rng(0)) == []
