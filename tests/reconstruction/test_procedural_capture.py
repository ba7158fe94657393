"""Filmed procedural rooms: what is written is what the contract says, the same for the same spec, and in sight."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from benchmarks.generate import build_parser, chosen_captures, main
from registry.errors import UsageError
from synthetic import footprints
from synthetic.benchmark_capture import CaptureSpec, load_spec, stage, write_capture
from synthetic.film import iterate_film, render_truth
from synthetic.procedural import RoomSpec, plan_room
from synthetic.suites import CI_CAPTURES, PRESETS, SUITE, drawn_captures
from synthetic.walks import walk_path

pytestmark = pytest.mark.stage

SMALL = CaptureSpec(
    RoomSpec(seed=3, objects=6, step_m=0.15, density=0.2),
    frames=12,
    width=160,
    height=120,
    motion_blur_s=0.02,
)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "room"
    return folder, write_capture(SMALL, folder)


def files_of(folder):
    return {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()
    }


def test_a_capture_has_what_the_contract_asks_for(written):
    folder, report = written
    truth = json.loads((folder / "ground_truth" / "scene.json").read_text())
    assert len(truth["frames"]) == SMALL.frames
    assert (truth["width"], truth["height"], truth["fps"]) == (160, 120, 12.0)
    assert report.objects == 6 == sum(not e["base"] for e in truth["entities"])
    names = {e["name"] for e in truth["entities"]}
    counted = np.zeros(max(e["id"] for e in truth["entities"]) + 1, int)
    for number in (0, 10):
        ids = cv2.imread(str(folder / f"ground_truth/instances/{number:05d}.png"), cv2.IMREAD_UNCHANGED)
        depth = cv2.imread(str(folder / f"ground_truth/depth/{number:05d}.png"), cv2.IMREAD_UNCHANGED)
        assert ids.shape == depth.shape == (120, 160)
        assert np.array_equal(ids > 0, depth > 0)
        counted += np.bincount(ids.ravel(), minlength=len(counted))
    for entity in truth["entities"]:
        mesh = trimesh.load(folder / "ground_truth" / entity["mesh"])
        assert mesh.is_volume, entity["name"]
        assert counted[entity["id"]] <= entity["visible_pixels"] <= 12 * 160 * 120
        if not entity["base"]:
            assert entity["parent"] in names
            assert entity["relation"] in ("supported_by", "attached_to")


def test_the_video_holds_the_frames(written):
    folder, _ = written
    frames = [image for _, _, image in _decoded(folder / "video.mp4")]
    assert len(frames) == SMALL.frames
    scene = stage(SMALL)
    drawn = list(
        iterate_film(scene.film_set, scene.camera, scene.world_from_camera, SMALL.sensor(), seed=SMALL.seed)
    )
    difference = np.abs(np.stack(frames).astype(float) - np.stack(drawn))
    assert difference.mean() < 6  # the codec


def _decoded(path):
    import av

    with av.open(str(path)) as container:
        for number, frame in enumerate(container.decode(video=0)):
            yield number, frame.time, frame.to_ndarray(format="rgb24")


def _dirty_memory():
    """Leave junk in freed memory: whatever reads what it never wrote then gives another result."""
    rng = np.random.default_rng(0)
    junk = [rng.integers(0, 255, int(size), np.uint8) for size in rng.integers(1000, 400000, 60)]
    del junk


def test_the_same_spec_gives_the_same_files(written, tmp_path):
    folder, _ = written
    _dirty_memory()
    write_capture(SMALL, tmp_path / "again")
    first, second = files_of(folder), files_of(tmp_path / "again")
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []


def test_capture_json_makes_the_capture_again_and_saves_doing_so(written, tmp_path):
    folder, report = written
    assert load_spec(folder / "capture.json") == SMALL
    before = (folder / "video.mp4").stat().st_mtime_ns
    assert write_capture(SMALL, folder) == report
    assert (folder / "video.mp4").stat().st_mtime_ns == before
    (tmp_path / "other.json").write_text('{"schema": "else"}')
    with pytest.raises(UsageError, match=r"expected 'simrecon\.capture/1'"):
        load_spec(tmp_path / "other.json")


def test_another_spec_replaces_what_was_there(tmp_path):
    tiny = replace(SMALL, frames=11, motion_blur_s=0.0)
    write_capture(tiny, tmp_path)
    (tmp_path / "ground_truth" / "meshes" / "ghost.ply").write_text("left behind")
    write_capture(replace(tiny, frames=2), tmp_path)
    assert not (tmp_path / "ground_truth" / "meshes" / "ghost.ply").exists()
    assert not (tmp_path / "ground_truth" / "depth" / "00010.png").exists()


@pytest.mark.parametrize(
    ("kind", "objects", "seed", "walls"),
    [("arc", 6, 0, 3), ("two_heights", 12, 1, 3), ("loop", 16, 2, 4), ("arc", 34, 3, 3), ("loop", 34, 4, 4)],
)
def test_the_camera_walks_freely_at_a_persons_height(kind, objects, seed, walls):
    plan = plan_room(RoomSpec(seed=seed, objects=objects, walls=walls))
    path = walk_path(plan.shape, kind, 120, seed)
    at, forward = path[:, :3, 3], path[:, :3, 2]
    assert at[:, 2].min() > 1.05
    assert at[:, 2].max() < 1.75
    for item in plan.items:
        nearest = min(footprints.point_distance(p[None, :2], item.silhouette) for p in at)
        inside = any(footprints.depth_inside(p[None, :2], item.silhouette) > 0 for p in at)
        assert not inside, item.name
        assert nearest > 0.15, (item.name, nearest)
    room = plan.shape
    if kind == "loop":
        assert np.all(
            (at[:, :2] > (room.west + 0.2, room.south + 0.2))
            & (at[:, :2] < (room.east - 0.2, room.north - 0.2))
        )
    assert np.linalg.norm(np.diff(at, axis=0), axis=1).max() < 0.2  # a person, not a drone
    turn = np.degrees(np.arccos(np.clip(np.sum(forward[1:] * forward[:-1], axis=1), -1, 1)))
    assert turn.max() < 10


def test_a_loop_needs_four_walls_and_unknown_paths_are_named():
    shape = plan_room(RoomSpec(objects=5)).shape
    with pytest.raises(UsageError, match="walls=4"):
        walk_path(shape, "loop", 10, 0)
    with pytest.raises(UsageError, match="two_heights"):
        walk_path(shape, "spiral", 10, 0)


@pytest.mark.parametrize("name", [*CI_CAPTURES, "stacked12", "cluttered16"])
def test_things_are_in_sight(name):
    spec = {**CI_CAPTURES, **SUITE}[name]
    small = replace(spec, frames=24, width=320, height=240, room=replace(spec.room, density=0.02, step_m=0.3))
    scene = stage(small)
    seen = np.zeros(len(scene.room.entities) + 1, int)
    for pose in scene.world_from_camera:
        seen += np.bincount(render_truth(scene.film_set, scene.camera, pose)[1].ravel(), minlength=len(seen))
    # As many pixels as in the whole film at its own size.
    pixels = seen * (spec.frames / 24) * (spec.width * spec.height) / (320 * 240)
    enough = 2000 * spec.width * spec.height / (640 * 480)
    share = np.mean([pixels[e.id] >= enough for e in scene.room.objects])
    assert share > 0.9


def test_drift_blur_and_noise_do_what_they_say():
    base = replace(SMALL, frames=30, noise=0.0, exposure_drift=0.0, motion_blur_s=0.0)
    scene = stage(base)
    still = np.repeat(scene.world_from_camera[:1], 30, axis=0)

    def film(path, **fields):
        spec = replace(base, **fields)
        return np.stack(list(iterate_film(scene.film_set, scene.camera, path, spec.sensor(), seed=0))).astype(
            float
        )

    calm = film(still)
    assert np.ptp(calm, axis=0).max() == 0
    noisy = film(still, noise=3.0)
    middle = (calm[0] > 20) & (calm[0] < 235)
    assert noisy.std(axis=0)[middle].mean() == pytest.approx(3.0, rel=0.1)
    means = film(still, exposure_drift=0.1).mean(axis=(1, 2, 3))
    assert 0.1 < np.ptp(means) / means.mean() < 0.22

    def sharpness(frames):
        return np.mean([cv2.Laplacian(f.mean(-1), cv2.CV_64F).var() for f in frames[:8]])

    moving = scene.world_from_camera[::3]  # three times as fast
    assert sharpness(film(moving, motion_blur_s=0.08)) < 0.7 * sharpness(film(moving))
    # A blurred frame of a still camera is the frame, not a shifted one.
    assert np.abs(film(still[:2], motion_blur_s=0.04)[0] - calm[0]).mean() < 6


@pytest.mark.parametrize(
    ("fields", "said"),
    [({"frames": 1}, "1 frames"), ({"width": 101}, "101x480"), ({"motion_blur_s": 0.2}, "at most 1/fps")],
)
def test_impossible_films_are_refused(fields, said):
    with pytest.raises(UsageError, match=said):
        CaptureSpec(**fields)


def test_drawn_captures_spread_over_the_sizes():
    specs = drawn_captures("cluttered", 8, (5, 40), seed=2, frames=50, room={"walls": 4})
    assert sorted(s.room.objects for s in specs.values()) == [5, 10, 15, 20, 25, 30, 35, 40]
    assert len({s.room.seed for s in specs.values()}) == 8
    assert all(s.frames == 50 and s.room.walls == 4 for s in specs.values())
    assert all(s.room.clutter_gap_m == PRESETS["cluttered"].room.clutter_gap_m for s in specs.values())


def test_the_command_chooses_and_writes(tmp_path, capsys):
    parse = build_parser().parse_args
    assert chosen_captures(parse(["--out", "x", "--ci"])) == CI_CAPTURES
    assert chosen_captures(parse(["--out", "x", "--suite"])) == SUITE
    assert list(chosen_captures(parse(["--out", "x", "--name", "room40"]))) == ["room40"]
    (loop,) = chosen_captures(parse(["--out", "x", "--objects", "7", "--path", "loop"])).values()
    assert (loop.room.walls, loop.room.objects) == (4, 7)
    flags = "--objects 5 --frames 3 --size 64x48 --seed 3 --preset easy"
    assert main(["--out", str(tmp_path), *flags.split()]) == 0
    (capture,) = tmp_path.iterdir()
    assert f"{capture}: 3 frames of 64x48" in capsys.readouterr().out
    assert load_spec(capture / "capture.json").room.objects == 5


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("--name nowhere", "there are ci_stack"),
        ("--objects many", "5-40"),
        ("--objects 40-5", "40-5"),
        ("--size 640", "640x480"),
        ("--motion-blur 3", "at most 1/fps"),
    ],
)
def test_the_command_refuses_with_one_line(tmp_path, capsys, flags, said):
    assert main(["--out", str(tmp_path), *flags.split()]) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert said in err
    assert err.count("\n") == 1
