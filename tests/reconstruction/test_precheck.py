"""The check of a film: sharpness, parallax and directions against the truth; verdicts; the command; its hook."""

import json

import cv2
import numpy as np
import pytest

from reconstruction.cli import main
from reconstruction.precheck import judge_film
from reconstruction.precheck.coverage import measure_coverage
from reconstruction.precheck.limits import FAIL_LIMITS
from reconstruction.precheck.sampling import gray_of
from reconstruction.precheck.sharpness import edge_blur_px
from reconstruction.precheck.two_view import match_frames, measure_parallax
from synthetic.camera_paths import pan_path
from synthetic.videos import short_film, write_black, write_still_camera, write_video

pytestmark = pytest.mark.stage


@pytest.fixture(scope="module")
def good():
    return short_film(36)


@pytest.fixture(scope="module")
def turned():
    return short_film(36, path=pan_path(36))


@pytest.mark.parametrize("sigma", [1.5, 2.5, 4.0])
def test_blur_of_step_edges_is_measured(sigma):
    image = np.kron(np.random.default_rng(0).choice([40, 200], (8, 10)), np.ones((36, 36))).astype(np.float32)
    blurred = cv2.GaussianBlur(image, (0, 0), sigma) + np.random.default_rng(1).normal(0, 1.5, image.shape)
    assert edge_blur_px(np.clip(blurred, 0, 255).astype(np.uint8)) == pytest.approx(sigma, rel=0.25)


def test_a_turn_leaves_no_parallax_and_a_walk_does(good, turned):
    size = (320, 240)
    walked, panned = (
        np.median(measure_parallax(match_frames(film[::2], ordered=True), size).degrees)
        for film in (good, turned)
    )
    assert panned < FAIL_LIMITS["parallax_deg"] < walked


def test_directions_follow_a_turn_on_the_spot(turned):
    path = pan_path(36)[::2]
    frames = turned[::2]
    true = np.degrees(np.arccos(np.clip((np.trace(path[0, :3, :3].T @ path[-1, :3, :3]) - 1) / 2, -1, 1)))
    pairs = match_frames(frames, ordered=True)
    found = measure_coverage([gray_of(f) for f in frames], pairs, focal_px=160 / np.tan(np.radians(31)))
    last = found.rotations[-1]
    turn = np.degrees(np.arccos(np.clip((np.trace(found.rotations[0].T @ last) - 1) / 2, -1, 1)))
    assert len(found.rows) == len(frames)
    assert turn == pytest.approx(true, abs=8)


def test_verdicts_name_what_is_wrong(tmp_path, good, turned):
    files = {
        name: tmp_path / f"{name}.mp4" for name in ("good", "turned", "defocused", "black", "still", "short")
    }
    write_video(files["good"], good)
    write_video(files["turned"], turned)
    write_video(files["defocused"], [cv2.GaussianBlur(f, (0, 0), 9.0) for f in good])
    write_black(files["black"])
    write_still_camera(files["still"])
    write_video(files["short"], good[:5])
    failed = {
        name: {line.name for line in judge_film(file).lines if line.status == "fail"}
        for name, file in files.items()
    }
    assert failed["good"] == set()
    assert failed["turned"] == {"parallax"}
    assert "texture" in failed["defocused"]
    assert "texture" in failed["black"]
    assert {"length", "parallax"} <= failed["still"]
    assert "length" in failed["short"]


def test_command_prints_lines_json_and_a_page(tmp_path, capsys, good):
    folder = tmp_path / "images"
    folder.mkdir()
    for number, frame in enumerate(good[::2]):
        cv2.imwrite(str(folder / f"{number}.png"), frame[..., ::-1])
    page = tmp_path / "page.html"
    assert main(["check", str(folder), "--page", str(page)]) == 0
    assert "fine to reconstruct" in capsys.readouterr().out
    text = page.read_text()
    assert "<!doctype html>" in text
    assert "data:image" in text
    assert "parallax" in text
    write_still_camera(tmp_path / "still.mp4")
    assert main(["check", str(tmp_path / "still.mp4"), "--json"]) == 1
    said = json.loads(capsys.readouterr().out)
    assert said["fine"] is False
    assert {line["name"] for line in said["lines"]} >= {
        "sharp",
        "parallax",
        "coverage",
        "exposure",
        "floor",
        "marker",
    }


@pytest.mark.parametrize(
    ("content", "code"), [(None, 2), (b"", 3), (b"This is a shopping list: milk and bread.\n" * 40, 3)]
)
def test_broken_input_is_one_clear_error(tmp_path, capsys, content, code):
    file = tmp_path / "room.mp4"
    if content is not None:
        file.write_bytes(content)
    assert main(["check", str(file)]) == code
    error = capsys.readouterr().err
    assert error.startswith("simrecon check: ")
    assert "Traceback" not in error


def test_a_refused_film_says_in_one_line_what_the_check_finds(tmp_path, capsys, turned):
    file = tmp_path / "turned.mp4"
    write_video(file, turned)
    command = [
        "reconstruct",
        str(file),
        "--registry",
        str(tmp_path / "registry"),
        "--preset",
        "fast",
        "--quiet",
    ]
    assert main(command) == 3
    error = capsys.readouterr().err
    (line,) = [line for line in error.splitlines() if "simrecon check" in line]
    assert "parallax" in line
    assert line.endswith(".")
