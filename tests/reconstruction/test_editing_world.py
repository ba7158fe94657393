"""Scale, up direction and floor by the user: clicks on a generated room lead to its true world frame."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from reconstruction.cache import StageStore
from reconstruction.config import PipelineConfig
from reconstruction.core.progress import NO_PROGRESS
from reconstruction.core.types import DistortedCamera, WorldFrame
from reconstruction.editing.film import Film
from reconstruction.editing.overrides import Overrides
from reconstruction.editing.world_frame import corrected_world
from reconstruction.pipeline import STAGES
from reconstruction.poses.lens import Lens
from reconstruction.runner import Run
from reconstruction.world import WorldConfig, find_world
from reconstruction.world.samples import window_normals
from registry.errors import UsageError
from registry.geometry import matrix_from_quat, split_similarity, transform_points

pytestmark = pytest.mark.stage


class Scene:
    """A generated room in an arbitrary `sfm` space, and clicks on true points of it."""

    def __init__(self, capture) -> None:
        quaternion = np.array([0.9, 0.2, -0.3, 0.25])
        self.sfm_from_world = np.eye(4)
        self.sfm_from_world[:3, :3] = 0.37 * matrix_from_quat(quaternion / np.linalg.norm(quaternion))
        self.sfm_from_world[:3, 3] = [1.0, -2.0, 0.5]
        self.capture = capture
        posed, depth = capture.in_sfm_space(self.sfm_from_world)
        self.film = Film(posed, depth, Lens.of(posed))
        self.plain = find_world(posed, depth, WorldConfig())

    def points(self, row: int) -> np.ndarray:
        """Return the true world point (h, w, 3) at each pixel of a keyframe."""
        pose, depth = self.capture.posed.world_from_camera[row], self.capture.depth
        local = depth.camera.pixel_rays() * np.asarray(depth.depth[row], np.float64)[..., None]
        return transform_points(pose, local.reshape(-1, 3)).reshape(local.shape)

    def seen(self, height: float, count: int) -> tuple[list[dict], np.ndarray]:
        """Return clicks on level surface at a height, far from one another and from edges, and their world points."""
        found, where = [], []
        for row in range(len(self.capture.posed.images)):
            points = self.points(row)
            on = (np.abs(points[..., 2] - height) < 0.002) & (self.capture.depth.depth[row] > 0)
            v, u = np.nonzero(cv2.erode(on.astype(np.uint8), np.ones((9, 9), np.uint8)))
            found.append(points[v, u])
            where += [(row, x + 0.5, y + 0.5) for x, y in zip(u.tolist(), v.tolist())]
        candidates = np.concatenate(found)
        chosen = [len(candidates) // 2]
        while len(chosen) < count:
            away = np.linalg.norm(candidates[:, None] - candidates[chosen], axis=2).min(axis=1)
            chosen.append(int(away.argmax()))
        return [self.click(*where[i]) for i in chosen], candidates[chosen]

    def click(self, row: int, x: float, y: float) -> dict:
        camera = self.capture.depth.camera
        size = [camera.width, camera.height]
        frame = int(self.capture.posed.indices[row])
        return {"pixel": {"frame": frame, "x": float(x), "y": float(y), "size": size}}

    def corrected(self, *entries: dict, config: WorldConfig | None = None) -> WorldFrame:
        said = Overrides(list(entries)).scene_entries()
        return corrected_world(self.plain, said, self.film, config or WorldConfig(), NO_PROGRESS)

    def error(self, world: WorldFrame) -> tuple[float, float]:
        """Return scale over the true scale, and the angle of the up direction to the true one, degrees."""
        scale, rotation, _ = split_similarity(world.world_from_sfm @ self.sfm_from_world)
        return scale, float(np.degrees(np.arccos(np.clip(rotation[2, 2], -1, 1))))


@pytest.fixture(scope="module")
def scene(small_capture) -> Scene:
    return Scene(small_capture)


def test_a_length_between_two_frames_sets_the_scale(scene):
    clicks, points = scene.seen(0.0, 2)
    metres = 1.5 * float(np.linalg.norm(points[0] - points[1]))
    world = scene.corrected({"scale": {"from": clicks[0], "to": clicks[1], "metres": metres}})
    assert clicks[0]["pixel"]["frame"] != clicks[1]["pixel"]["frame"]
    assert scene.error(world)[0] == pytest.approx(1.5, rel=0.01)
    assert world.scale.method == "user-distance"
    assert 0.01 < world.scale.uncertainty < 0.05


def test_it_equals_the_option_for_two_pixels_of_one_frame(scene):
    frame = int(scene.film.posed.indices[3])
    width, height = scene.film.posed.source.width, scene.film.posed.source.height
    a, b = (0.3 * width, 0.8 * height), (0.7 * width, 0.85 * height)
    ends = [{"pixel": {"frame": frame, "x": x, "y": y}} for x, y in (a, b)]
    said = scene.corrected({"scale": {"from": ends[0], "to": ends[1], "metres": 1.3}})
    text = f"distance:{frame},{a[0]},{a[1]},{b[0]},{b[1]}=1.3"
    option = find_world(scene.film.posed, scene.film.depth, WorldConfig(scale=text))
    np.testing.assert_allclose(said.world_from_sfm, option.world_from_sfm, rtol=2e-3, atol=2e-3)
    assert said.scale.uncertainty == pytest.approx(option.scale.uncertainty, rel=0.1)


def test_clicks_go_through_the_lens(scene):
    """A click on the filmed, bent frame means the point that the straight frame shows elsewhere."""
    camera = scene.film.posed.camera
    params = np.array([*camera.intrinsics, -0.12, 0.03, 0.0, 0.0])
    distorted = DistortedCamera("OPENCV", camera.width, camera.height, params)
    bent = replace(scene.film, lens=Lens(camera, distorted))
    clicks, points = scene.seen(0.0, 2)
    filmed = []
    for click in clicks:
        x, y = click["pixel"]["x"], click["pixel"]["y"]
        grid = np.array([[x + 0.25 * i, y + 0.25 * j] for i in range(-200, 201) for j in range(-200, 201)])
        nearest = grid[np.argmin(np.linalg.norm(bent.lens.straightened(grid) - [x, y], axis=1))]
        filmed.append({"pixel": {**click["pixel"], "x": float(nearest[0]), "y": float(nearest[1])}})
    metres = float(np.linalg.norm(points[0] - points[1]))
    said = Overrides([{"scale": {"from": filmed[0], "to": filmed[1], "metres": metres}}]).scene_entries()
    world = corrected_world(scene.plain, said, bent, WorldConfig(), NO_PROGRESS)
    assert scene.error(world)[0] == pytest.approx(1, abs=0.015)


@pytest.mark.parametrize("count", [1, 3, 5])
def test_level_clicks_set_the_up_direction(scene, count):
    clicks, _ = scene.seen(0.0, count)
    world = scene.corrected({"up": {"level": clicks if count > 1 else clicks[0]}})
    assert scene.error(world)[1] < (1.0 if count == 1 else 0.3)
    assert world.gravity_method == "user-level"
    assert scene.error(world)[1] < 4 * world.gravity_sigma_deg


def test_a_normal_counts_in_the_uncorrected_world_or_in_a_camera(scene):
    lean = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
    by_world = scene.corrected({"up": {"normal": lean.tolist()}})
    before = split_similarity(scene.plain.world_from_sfm)[1]
    after = split_similarity(by_world.world_from_sfm)[1]
    np.testing.assert_allclose(after @ before.T @ lean, [0, 0, 1], atol=1e-9)
    frame = int(scene.film.posed.indices[2])
    in_camera = scene.film.posed.world_from_camera[2][:3, :3].T @ before.T @ lean
    by_camera = scene.corrected({"up": {"normal": (3 * in_camera).tolist(), "frame": frame}})
    np.testing.assert_allclose(by_camera.world_from_sfm, by_world.world_from_sfm, atol=1e-9)
    assert by_world.gravity_method == "user-direction"


def test_the_floor_passes_through_the_click(scene):
    table = next(e for e in scene.capture.entities if e.label == "table")
    height = max(float(patch.vertices[:, 2].max()) for patch in table.patches)
    clicks, points = scene.seen(height, 1)
    world = scene.corrected({"floor": clicks[0]})
    there = transform_points(world.world_from_sfm @ scene.sfm_from_world, points)
    assert abs(there[0, 2]) < 0.01
    assert world.floor_observed


def test_what_the_clicks_cannot_determine_is_said(scene):
    (a, b, _), _ = scene.seen(0.0, 3)
    middle = {"pixel": {**a["pixel"], "x": a["pixel"]["x"] + 1.0}}
    with pytest.raises(UsageError, match=r"overrides: up: .* lie on a line"):
        scene.corrected({"up": {"level": [a, middle, b]}})
    with pytest.raises(UsageError, match=r"overrides: no camera is known of frame 500"):
        scene.corrected({"floor": {"pixel": {"frame": 500, "x": 3, "y": 3}}})
    with pytest.raises(UsageError, match=r"outside the frame"):
        scene.corrected({"floor": {"pixel": {"frame": 1, "x": 99999, "y": 3}}})
    blind = replace(scene.film, depth=replace(scene.film.depth, depth=0 * scene.film.depth.depth))
    said = Overrides([{"floor": a}]).scene_entries()
    with pytest.raises(UsageError, match=r"there is no depth at pixel .*textured"):
        corrected_world(scene.plain, said, blind, WorldConfig(), NO_PROGRESS)


def test_upright_surface_is_not_level(scene):
    """A click on the side of furniture is refused, with the angle."""
    depth = scene.capture.depth
    best = (0.0, 0, 0, 0)
    for row, pose in enumerate(scene.capture.posed.world_from_camera):
        z = np.asarray(depth.depth[row])
        normals, residual = window_normals(z, z > 0, depth.camera)
        upright = (np.abs(normals @ pose[2, :3]) < 0.05) & (residual < 0.002)
        inner = cv2.distanceTransform(upright.astype(np.uint8), cv2.DIST_L2, 5)
        v, u = np.unravel_index(int(inner.argmax()), inner.shape)
        best = max(best, (float(inner.max()), row, int(u), int(v)))
    _, row, u, v = best
    with pytest.raises(UsageError, match=r"the surface at pixel .* is (8|9)\d degrees off level"):
        scene.corrected({"up": {"level": scene.click(row, u + 0.5, v + 0.5)}})


def test_only_what_depends_on_the_world_frame_runs_again(scene, tmp_path):
    posed, depth = scene.film.posed, scene.film.depth
    done = {"frames": scene.capture.frame_set(), "poses": posed, "depth": depth}
    store, digest, film = StageStore(tmp_path), posed.source.sha256, Path("film.mp4")
    seed = Run(film, PipelineConfig(), store, input_digest=digest)
    for number, stage in enumerate(STAGES[:3], start=1):
        key = seed.keys[stage.name] = seed.key_of(stage, [])
        record = {"usage": {"wall_s": 1.0, "cpu_s": 1.0, "peak_memory_mb": 1.0}, "notes": []}
        store.save(done[stage.name], number, stage.name, key, record)
    (click,), _ = scene.seen(0.0, 1)

    def run_with(*entries: dict) -> Run:
        run = Run(film, PipelineConfig(), store, Overrides(list(entries)), input_digest=digest)
        run.execute(until="world")
        return run

    plain, floor = run_with(), run_with({"floor": click}, {"at": [0, 0, 1], "drop": True})
    assert (plain.computed, floor.computed) == ({"world"}, {"world"})
    assert {name for name in plain.keys if plain.keys[name] != floor.keys[name]} == {"world"}
    gaussians = next(stage for stage in STAGES if stage.name == "gaussians")
    assert plain.key_of(gaussians, []) == floor.key_of(gaussians, [])
    assert not any("entries" in note for note in plain.notes)
    assert any(
        "coordinates in entries 2 of the overrides file count in the world frame" in n for n in floor.notes
    )
    again = run_with({"floor": click}, {"id": 3, "relabel": "mug"})
    assert again.computed == set()  # entries of other stages are no part of it
    assert not any("coordinates" in note for note in again.notes)
