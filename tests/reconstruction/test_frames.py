"""Stage 1: decoding, choosing keyframes, and one clear sentence for every input that cannot work."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from notes import Notes
from PIL import Image

from reconstruction.frames import FRAMES_PRESETS, FramesConfig, load_frames
from reconstruction.frames.keyframes import (
    FrameStats,
    MotionMeter,
    Spacing,
    choose_keyframes,
    rotational_flow,
)
from registry.errors import InputError, UsageError
from synthetic.videos import (
    BAD_VIDEOS,
    HARD_VIDEOS,
    short_film,
    standard_film,
    write_4k60,
    write_video,
)

pytestmark = pytest.mark.stage


@pytest.fixture(scope="module")
def film():
    return standard_film()[:48]


def hard(name, tmp_path):
    path = tmp_path / f"{name}.mp4"
    HARD_VIDEOS[name](path)
    notes = Notes()
    return load_frames(path, FramesConfig(), progress=notes), notes.notes


def check_invariants(found, config=FRAMES_PRESETS["default"]):
    n, m = len(found.images), len(found.held_out_images)
    assert found.images.dtype == np.uint8
    assert found.images.shape[1:] == found.held_out_images.shape[1:]
    assert len(found.indices) == len(found.times_s) == len(found.sharpness) == n
    assert len(found.held_out_indices) == len(found.held_out_times_s) == m
    assert np.all(np.diff(found.indices) > 0)
    assert np.all(np.diff(found.times_s) > 0)
    assert not set(found.indices.tolist()) & set(found.held_out_indices.tolist())
    assert n <= config.max_keyframes
    assert m <= config.max_held_out
    assert max(found.images.shape[1:3]) <= config.max_side_px
    assert found.indices.max() < found.source.frame_count


def test_demo_video_gives_keyframes_that_show_their_frames(demo_video):
    found = load_frames(demo_video, FramesConfig())
    check_invariants(found)
    assert (found.source.width, found.source.height, found.source.frame_count) == (640, 480, 120)
    assert found.source.fps == pytest.approx(12)
    assert found.source.duration_s == pytest.approx(10)
    assert len(found.source.sha256) == 64
    assert found.ordered
    assert 60 <= len(found.images) <= 96
    assert np.all(found.indices % 10 != 0)
    assert found.held_out_indices.tolist() == list(range(0, 120, 10))
    assert np.allclose(found.times_s, found.indices / 12, atol=1e-3)


def test_frames_arrive_in_the_right_colors_at_the_right_numbers(tmp_path, film):
    write_video(tmp_path / "v.mp4", film, crf=12)
    found = load_frames(tmp_path / "v.mp4", FramesConfig())
    for image, index in [
        *zip(found.images, found.indices),
        *zip(found.held_out_images, found.held_out_indices),
    ]:
        errors = [
            np.abs(image.astype(int) - film[k]).mean() for k in (index - 1, index, (index + 1) % len(film))
        ]
        assert errors[1] < 6
        assert errors[1] == min(errors)


def test_same_video_gives_the_same_bits(demo_video):
    config = FRAMES_PRESETS["fast"]
    a, b = load_frames(demo_video, config), load_frames(demo_video, config)
    assert np.array_equal(a.indices, b.indices)
    assert np.array_equal(a.images, b.images)
    check_invariants(a, config)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("not_a_video", "not a video"),
        ("empty", "0 bytes"),
        ("cut_before_index", "cut off or damaged"),
        ("one_frame", "single image"),
        ("too_short", "only 5 frames"),
        ("black", "is black"),
        ("still_camera", "stands still"),
        ("blank_wall", "blank surfaces"),
    ],
)
def test_hopeless_inputs_are_refused_with_one_clear_sentence(tmp_path, name, words):
    path = tmp_path / f"{name}.mp4"
    BAD_VIDEOS[name](path)
    with pytest.raises(InputError, match=words) as caught:
        load_frames(path, FramesConfig())
    assert caught.value.exit_code == 3
    assert name in str(caught.value), "the message names the file"
    assert "\n" not in str(caught.value)


def test_pure_rotation_passes_here_because_poses_must_judge_it(tmp_path):
    BAD_VIDEOS["pure_rotation"](tmp_path / "pan.mp4")
    check_invariants(load_frames(tmp_path / "pan.mp4", FramesConfig()))


def test_missing_file_is_wrong_use(tmp_path):
    with pytest.raises(UsageError, match="no file or folder"):
        load_frames(tmp_path / "nothing.mp4", FramesConfig())


def test_text_that_ffmpeg_would_play_as_terminal_art_is_no_video(tmp_path):
    (tmp_path / "list.txt").write_text("milk\nbread\n" * 50)
    with pytest.raises(InputError):
        load_frames(tmp_path / "list.txt", FramesConfig())


def test_blurred_frames_are_avoided(tmp_path):
    found, _ = hard("half_blurred", tmp_path)
    check_invariants(found)
    assert np.mean(found.indices % 2) < 0.05, "odd frames are out of focus"
    assert len(found.images) > 30


def test_duplicated_frames_are_chosen_once_and_never_repeat_held_out_ones(tmp_path):
    found, _ = hard("half_duplicated", tmp_path)
    check_invariants(found)
    pictures = found.indices // 2
    assert len(np.unique(pictures)) == len(pictures)
    assert not set(pictures.tolist()) & set((found.held_out_indices // 2).tolist())


def test_portrait_video_is_turned_upright(tmp_path):
    found, notes = hard("portrait", tmp_path)
    check_invariants(found)
    assert (found.source.width, found.source.height) == (240, 320)
    upright = short_film(48, 240, 320)
    error = np.abs(found.images[5].astype(int) - upright[found.indices[5]]).mean()
    assert error < 6
    assert any("rotated by 90 degrees clockwise" in n for n in notes)


def test_cut_off_file_works_with_what_is_there(tmp_path):
    found, notes = hard("cut_off", tmp_path)
    check_invariants(found)
    assert found.source.frame_count < 96
    assert any("cut off" in n for n in notes)


def test_of_a_file_with_hardly_anything_left_the_cut_is_told_first_to_mend(tmp_path):
    path = tmp_path / "film.mp4"
    HARD_VIDEOS["cut_off"](path)
    path.write_bytes(path.read_bytes()[: int(0.2 * path.stat().st_size)])
    with pytest.raises(InputError, match=r"damaged or cut off: \d+ frames of \d+ announced .* copy it again"):
        load_frames(path, FramesConfig())


def test_frames_after_damage_are_left_out(tmp_path):
    found, notes = hard("damaged", tmp_path)
    check_invariants(found)
    assert any("smeared" in n for n in notes)


def test_variable_rate_keeps_true_times(tmp_path):
    found, _ = hard("variable_rate", tmp_path)
    check_invariants(found)
    steps = np.random.default_rng(3).choice([1 / 30, 2 / 30, 3 / 30], 59)
    times = np.concatenate([[0.0], np.cumsum(steps)])
    assert np.allclose(found.times_s, times[found.indices], atol=1e-3)


@pytest.mark.parametrize("pixel_format", ["yuv420p10le", "gray", "yuv444p"])
def test_other_pixel_formats_decode(tmp_path, film, pixel_format):
    write_video(tmp_path / "v.mkv", film[:24], pixel_format=pixel_format)
    found = load_frames(tmp_path / "v.mkv", FramesConfig())
    check_invariants(found)
    want = film[found.indices[3]].astype(int)
    if pixel_format == "gray":
        assert np.ptp(found.images[3].astype(int), axis=-1).max() <= 2
        want = np.repeat(cv2.cvtColor(film[found.indices[3]], cv2.COLOR_RGB2GRAY)[..., None], 3, 2)
    assert np.abs(found.images[3].astype(int) - want).mean() < 6


def test_odd_sizes_and_scaling_down(tmp_path, film):
    odd = [f[:239, :317] for f in film[:24]]
    write_video(tmp_path / "v.mkv", odd, pixel_format="yuv444p")
    found = load_frames(tmp_path / "v.mkv", FramesConfig())
    assert found.images.shape[1:] == (239, 317, 3)
    small = load_frames(tmp_path / "v.mkv", FramesConfig(max_side_px=160))
    assert small.images.shape[1:3] == (121, 160)


def test_keyframes_follow_motion_not_time(tmp_path):
    """A camera that rests for two thirds of the video gives few keyframes there."""
    film = standard_film()[::3]
    rng = np.random.default_rng(0)
    rest = np.repeat(film[14:15], 60, axis=0) + rng.integers(-2, 3, (60, *film.shape[1:]))
    write_video(
        tmp_path / "v.mp4", np.clip(np.concatenate([film[:15], rest, film[15:]]), 0, 255).astype(np.uint8)
    )
    found = load_frames(tmp_path / "v.mp4", FramesConfig(min_keyframes=24))
    resting = (found.indices > 15) & (found.indices < 74)
    assert resting.sum() <= 3
    assert (~resting).sum() >= 18


def stats_of(position, sharpness, parallax=None):
    n = len(position)
    return FrameStats(
        indices=list(range(n)),
        times_s=[i / 30 for i in range(n)],
        sharpness=list(sharpness),
        brightness=[100.0] * n,
        texture=[1.0] * n,
        position=list(position),
        parallax=list(0.8 * position if parallax is None else parallax),
        similarity=[1.0] * n,
        change=[9.0] * n,
    )


def test_long_video_is_thinned_evenly_along_its_path():
    stats = stats_of(np.linspace(0, 40, 3000), np.ones(3000))
    rows = choose_keyframes(stats, np.ones(3000, bool), Spacing(0.045, 64, 96, 0.4, 0.22))
    assert len(rows) == 96
    gaps = np.diff(np.array(stats.position)[rows])
    assert gaps.max() < 2 * gaps.min()


def test_who_walks_gives_more_keyframes_than_who_turns_on_the_spot():
    position = np.linspace(0, 3, 1200)
    parallax = np.maximum(position - 2.0, 0) * 0.8  # turns for two thirds of the path, then walks
    rows = choose_keyframes(
        stats_of(position, np.ones(1200), parallax), np.ones(1200, bool), Spacing(0.045, 64, 96, 0.4, 0.22)
    )
    walking = rows > 800
    assert len(rows) == pytest.approx(67, abs=3)  # their number is that of the displacement
    assert 0.6 < walking.mean() < 0.8
    assert np.diff(position[rows]).max() < 0.12  # neighbors still overlap


def test_parallax_is_flow_that_no_rotation_explains():
    rng = np.random.default_rng(0)
    at = rng.uniform(-0.5, 0.5, (120, 2))
    rays = np.column_stack([at / 0.9, np.ones(120)])

    def flow_of(rotation, shift, depth):
        there = (depth[:, None] * rays) @ cv2.Rodrigues(np.array(rotation))[0].T + shift
        return 0.9 * there[:, :2] / there[:, 2:] - at

    turned = flow_of([0.02, -0.04, 0.01], np.zeros(3), np.ones(120))
    left = np.linalg.norm(turned - rotational_flow(at, turned), axis=1)
    assert np.percentile(left, 75) < 0.05 * np.median(np.linalg.norm(turned, axis=1))
    depth = rng.uniform(1, 4, 120)
    walked = flow_of([0.0, 0.0, 0.0], np.array([0.0, 0.0, -0.2]), depth)
    left = np.linalg.norm(walked - rotational_flow(at, walked), axis=1)
    assert np.percentile(left, 75) > 0.5 * np.median(np.linalg.norm(walked, axis=1))


def test_blurred_frame_is_kept_where_nothing_else_bridges_the_gap():
    sharpness = np.ones(40)
    sharpness[10:30] = 0.1  # a blurred stretch
    position = np.linspace(0, 4, 40)
    rows = choose_keyframes(stats_of(position, sharpness), np.ones(40, bool), Spacing(0.1, 8, 96, 0.4, 0.3))
    assert np.diff(position[rows]).max() <= 0.31


def test_noise_of_a_resting_camera_is_no_motion(film):
    rng = np.random.default_rng(1)
    meter = MotionMeter()
    gray = cv2.cvtColor(film[10], cv2.COLOR_RGB2GRAY).astype(float)
    for k in range(60):
        meter.add(k, k / 30, np.clip(gray + 3 * rng.standard_normal(gray.shape), 0, 255).astype(np.uint8))
    assert meter.stats.position[-1] < 0.006


def save_folder(folder, images, **options):
    folder.mkdir()
    for number, image in enumerate(images, start=1):
        Image.fromarray(image).save(folder / f"img{number}.jpg", quality=92, **options)


def test_folder_is_read_in_natural_order_and_holds_nothing_out_when_small(tmp_path, film):
    save_folder(tmp_path / "photos", film[:24])
    notes = Notes()
    found = load_frames(tmp_path / "photos", FramesConfig(), progress=notes)
    check_invariants(found)
    assert found.indices.tolist() == list(range(24))
    assert len(found.held_out_images) == 0
    assert found.ordered
    assert np.abs(found.images[11].astype(int) - film[11]).mean() < 6
    assert any("none is held out" in n for n in notes.notes)


def test_large_folder_holds_out_every_tenth(tmp_path):
    save_folder(tmp_path / "photos", [cv2.resize(f, (160, 120)) for f in standard_film()[:64]])
    found = load_frames(tmp_path / "photos", FramesConfig())
    assert found.held_out_indices.tolist() == list(range(0, 64, 10))
    assert np.all(found.indices % 10 != 0)


def test_unrelated_neighbors_are_not_ordered(tmp_path):
    views = standard_film()[np.random.default_rng(2).permutation(96)][:16]
    save_folder(tmp_path / "photos", views)
    assert not load_frames(tmp_path / "photos", FramesConfig()).ordered


def test_exif_orientation_and_focal_length_are_used(tmp_path, film):
    exif = Image.Exif()
    exif[0x0112] = 6  # shown after a quarter turn clockwise
    exif.get_ifd(0x8769)[0xA405] = 26  # 35 mm equivalent
    save_folder(tmp_path / "photos", [np.ascontiguousarray(np.rot90(f, 1)) for f in film[:12]], exif=exif)
    found = load_frames(tmp_path / "photos", FramesConfig())
    assert found.images.shape[1:3] == (240, 320)
    assert np.abs(found.images[4].astype(int) - film[4]).mean() < 6
    assert found.focal_prior_px == pytest.approx(26 / 43.2666 * 400, rel=1e-3)


def test_mixed_and_broken_images_are_dropped_with_a_note(tmp_path, film):
    folder = tmp_path / "photos"
    save_folder(folder, film[:14])
    Image.fromarray(film[14][:, :200]).save(folder / "img15.jpg")  # another shape
    Image.fromarray(cv2.resize(film[15], (640, 480))).save(folder / "img16.png")  # same shape, larger
    (folder / "img17.jpg").write_bytes(b"not a jpeg")
    data = (folder / "img3.jpg").read_bytes()
    (folder / "img3.jpg").write_bytes(data[: len(data) // 3])
    (folder / "notes.txt").write_text("kitchen")
    notes = Notes()
    found = load_frames(folder, FramesConfig(), progress=notes)
    check_invariants(found)
    assert len(found.images) == 14
    text = "\n".join(notes.notes)
    assert all(name in text for name in ("img15.jpg", "img17.jpg", "img3.jpg"))
    assert "1 images of other sizes are resized" in text


def test_folder_without_images_is_refused(tmp_path):
    (tmp_path / "photos").mkdir()
    with pytest.raises(InputError, match="no jpg or png"):
        load_frames(tmp_path / "photos", FramesConfig())


def test_presets_are_configs_and_memory_is_bounded():
    for config in FRAMES_PRESETS.values():
        assert isinstance(config, FramesConfig)
    config = FRAMES_PRESETS["default"]
    bytes_each = config.max_side_px**2 * 3 // 4 * 3
    assert (config.max_keyframes + config.max_held_out) * bytes_each < 300e6


@pytest.mark.end_to_end
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads the peak from Linux' /proc")
def test_4k_at_60_frames_per_second_needs_little_memory(tmp_path):
    """Frames are scaled down one by one; 240 of them at once would be 6 GB."""
    import subprocess
    import sys

    write_4k60(tmp_path / "v.mp4", 4.0)
    code = (
        "import re, sys; from pathlib import Path; from reconstruction.frames import *;"
        "found = load_frames(Path(sys.argv[1]), FramesConfig());"
        "assert found.images.shape[1:3] == (540, 960);"
        "assert found.source.frame_count == 240;"
        # Not `ru_maxrss`: that begins with the peak of the process that started this one.
        "print(re.search(r'VmHWM:\\s+(\\d+) kB', Path('/proc/self/status').read_text())[1])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "v.mp4")], check=True, capture_output=True, text=True
    )
    assert int(done.stdout) * 1024 < 1.5e9
