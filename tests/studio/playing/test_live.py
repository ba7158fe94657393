"""The page of a reconstruction in progress: what it shows of each stage, its advice, its end."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from viewer import Viewer

from reconstruction.cache import StageStore
from reconstruction.config import PipelineConfig
from reconstruction.core.progress import NoProgress
from reconstruction.core.types import ScaleEstimate, WorldFrame
from reconstruction.runner import Run
from registry.geometry import invert_rigid, transform_points
from studio.live import LivePage
from studio.live_layers import depth_points, moved_by, upright_from_cameras
from studio.refilm import advice_on_poses, unvisited_side

SCALE = 0.31  # of sfm space, metres an unit


@pytest.fixture(scope="module")
def sfm(small_capture):
    """Frames and depth in sfm space, and the world frame that undoes it."""
    angle = 0.7
    turned = np.eye(4)
    turned[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    turned[:3, 3] = [3.0, -1.0, 0.5]
    sfm_from_world = turned.copy()
    sfm_from_world[:3, :3] /= SCALE
    posed, depth = small_capture.in_sfm_space(sfm_from_world)
    world = WorldFrame(
        np.linalg.inv(sfm_from_world), ScaleEstimate("marker", 0.01, "a marker"), "planes", 0.3, True, True
    )
    return posed, depth, world


def test_depth_is_shown_as_points_on_the_true_surface(small_capture):
    points, colors = depth_points(small_capture.posed, small_capture.depth, 4000)
    assert 2000 < len(points) <= 4000
    assert len(colors) == len(points)
    # Each point projects to a pixel of its own frame with its own depth and color.
    pose, camera = small_capture.posed.world_from_camera[0], small_capture.posed.camera
    first = points[: len(points) // len(small_capture.posed.images) // 2]
    local = transform_points(invert_rigid(pose), first)
    columns, rows = camera.project(local)
    at = rows.astype(int), columns.astype(int)
    assert small_capture.depth.depth[0][at] == pytest.approx(local[:, 2], abs=1e-4)
    assert np.array_equal(small_capture.posed.images[0][at], colors[: len(first)])


def test_before_the_world_frame_the_cameras_put_the_scene_upright(sfm):
    posed, _, world = sfm
    poses, points = moved_by(upright_from_cameras(posed), posed)
    assert (-poses[:, :3, 1]).mean(axis=0)[2] > 0.8
    assert np.median(points, axis=0) == pytest.approx(
        [0, 0, 0], abs=0.15
    )  # a median of coordinates turns a little
    distance = np.linalg.norm(poses[:, :3, 3], axis=1)
    assert np.median(distance) == pytest.approx(1.5)  # from where the median of the points went
    assert np.linalg.det(poses[:, :3, :3]) == pytest.approx(np.ones(len(poses)))
    truth = world.apply_to(posed)
    moved = moved_by(world.world_from_sfm, posed)
    assert moved[0] == pytest.approx(truth.world_from_camera, abs=1e-9)
    assert moved[1] == pytest.approx(truth.points, abs=1e-9)


def test_the_unvisited_side_is_where_no_camera_was():
    yaws = np.radians(np.arange(-60, 61, 10))  # all on the side of +x, looking at the origin
    centers = np.stack([np.cos(yaws), np.sin(yaws), np.full(len(yaws), 0.5)], axis=1)
    forward = -centers / np.linalg.norm(centers, axis=1, keepdims=True)
    at = np.zeros(3)
    assert unvisited_side(at, centers, forward, 0.5) == "-x"
    # A camera behind the object that looks away from it does not count, one that looks at it does.
    behind = np.array([[-1.0, 0.0, 0.5]])
    away = np.append(forward, [[-1.0, 0.0, 0.0]], axis=0)
    assert unvisited_side(at, np.append(centers, behind, axis=0), away, 0.5) == "-x"
    looking = np.append(forward, -behind / np.linalg.norm(behind), axis=0)
    assert unvisited_side(at, np.append(centers, behind, axis=0), looking, 0.5) != "-x"


def test_lost_keyframes_are_told_with_their_time(small_capture):
    posed = small_capture.posed
    complete = replace(posed, chosen_frames=len(posed.images))
    assert advice_on_poses(complete) == []
    keep = [0, 1, 2, *range(7, len(posed.images))]
    lost = replace(
        posed,
        images=posed.images[keep],
        indices=posed.indices[keep],
        times_s=posed.times_s[keep],
        world_from_camera=posed.world_from_camera[keep],
        sharpness=posed.sharpness[keep],
        observations=posed.observations[:0],
        chosen_frames=len(posed.images),
    )
    (line,) = advice_on_poses(lost)
    assert f"4 of {len(posed.images)} keyframes" in line
    assert f"from {posed.times_s[2]:.1f} s to {posed.times_s[7]:.1f} s" in line


class Kept(NoProgress):
    """Keeps what a listener receives."""

    def __init__(self):
        self.notes, self.done = [], 0

    def note(self, message):
        self.notes.append(message)

    def advance(self, n=1):
        self.done += n


def test_the_page_fills_as_stages_finish_and_passes_everything_on(small_capture, sfm, tmp_path):
    posed, depth, world = sfm
    video = tmp_path / "<b>room.mp4"
    video.write_bytes(b"")
    page = LivePage(video)
    viewer = Viewer(page.port)
    try:
        run = Run(video, PipelineConfig(), StageStore(tmp_path / "work"), input_digest="0" * 64)
        kept = Kept()
        listener = page.watch(kept)
        frames = small_capture.frame_set()
        results = {"frames": frames, "poses": posed, "depth": depth, "world": world}
        for number, (stage, result) in enumerate(results.items(), start=1):
            listener.begin_stage(stage, number, 4, False)
            listener.start(5, "working")
            listener.advance(5)
            listener.note(f"a note of {stage} <script>alert(1)</script>")
            run.results[stage] = result
            page.show(run, stage)
        page._drain()
        assert kept.done == 20
        assert len(kept.notes) == 4
        until(
            lambda: created(viewer) >= {"/live/points", "/live/depth", "/live/floor"},
            "points and depth are shown",
        )
        cameras = [name for name in created(viewer) if name.startswith("/live/cameras/")]
        assert len(cameras) == len(posed.images)
        camera = int(posed.indices[0])
        true = world.apply_to(posed).world_from_camera[0]
        place = [
            m["position"]
            for m in viewer.messages
            if m.get("name") == f"/live/cameras/{camera}" and "position" in m
        ]
        assert place[-1] == pytest.approx(true[:3, 3], abs=1e-5)
        assert "script" in page._said.content
        assert "<script" not in page._said.content
        assert "12 cameras" in page._done.content
    finally:
        viewer.close()
        page.__exit__(None, None, None)


def test_the_page_ends_at_once_if_nobody_looks(play_registry, tmp_path):
    video = tmp_path / "room.mp4"
    video.write_bytes(b"")
    with LivePage(video) as page:
        began = time.monotonic()
        page.keep(play_registry.root, "room")
        assert time.monotonic() - began < 5
    assert all(thread.name != "studio-live" or not thread.is_alive() for thread in threading.enumerate())


def created(viewer):
    return {
        m["name"]
        for m in viewer.messages
        if "name" in m and m["type"].endswith(("Message",)) and "props" in m
    }


def until(true, what, seconds=15.0):
    limit = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < limit, f"not within {seconds:.0f} s: {what}"
        time.sleep(0.02)
