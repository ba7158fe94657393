"""Generated short films for `benchmarks.check`: rooms filmed well, and the same rooms filmed badly.

Each room gives one film as it is and one or two spoiled ones. A film is bad by construction (camera on a tripod, at
rest, blank wall, a few frames) or by the poses stage: frames without a pose, or cameras off the truth.
"""

import json
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from reconstruction.frames import FRAMES_PRESETS, load_frames
from reconstruction.poses import POSES_PRESETS, estimate_poses
from registry.errors import InputError
from registry.geometry import transform_points, umeyama
from synthetic.benchmark_capture import CaptureSpec, Scene, stage
from synthetic.camera_paths import look_at
from synthetic.film import iterate_film, prepare
from synthetic.procedural import RoomSpec, furnish, plan_room
from synthetic.random_rooms import draw_room
from synthetic.sensor import draw_sensor
from synthetic.shape_families import SHAPE_FAMILIES
from synthetic.videos import write_video
from synthetic.walks import draw_walk

SPLITS: dict[str, range] = {"fit": range(100, 112), "choose": range(200, 208), "report": range(300, 322)}
"""Seeds of the rooms. Thresholds are fitted on the first, the rule is chosen on the second, the last is kept out."""
_FRAMES, _SIZE, _FPS = 64, (320, 240), 10.0
_GOOD_REGISTERED, _BAD_REGISTERED = 0.9, 0.6  # shares of the keyframes
_GOOD_ERROR, _BAD_ERROR = 0.03, 0.10  # camera error, as a share of the extent of the camera's path

Frames = np.ndarray  # uint8 (n, h, w, 3)


@dataclass(frozen=True)
class Outcome:
    """The label of a film: "good", "bad", or "between" where the poses stage did neither well nor badly."""

    label: str
    by: str  # "construction" or "poses"
    registered: float = 0.0  # share of the keyframes
    error: float = 0.0  # RMSE of the camera centers after alignment, as a share of their spread
    message: str = ""


def _directional(frames: Frames, rng: np.random.Generator) -> Frames:
    """Blur each frame along a line, its angle changing slowly: the shutter of a shaken camera."""
    length, angle = rng.uniform(5, 22), rng.uniform(0, np.pi)
    out = []
    for frame in frames:
        angle += rng.normal(0, 0.3)
        kernel = np.zeros((31, 31), np.float32)
        reach = 0.5 * length * np.array([np.cos(angle), np.sin(angle)])
        a, b = ([round(float(15 + s * x)) for x in reach] for s in (-1, 1))
        cv2.line(kernel, a, b, 1.0)
        out.append(cv2.filter2D(frame, -1, kernel / kernel.sum()))
    return np.stack(out)


def _defocus(frames: Frames, rng: np.random.Generator) -> Frames:
    sigma = float(np.exp(rng.uniform(np.log(1.5), np.log(7))))
    return np.stack([cv2.GaussianBlur(f, (0, 0), sigma) for f in frames])


def gained(frames: Frames, gain: float, noise: float, rng: np.random.Generator) -> Frames:
    """Multiply linear light, then add noise."""
    linear = (frames.astype(np.float32) / 255) ** 2.2 * gain
    out = 255 * np.clip(linear, 0, 1) ** (1 / 2.2) + noise * rng.standard_normal(frames.shape, np.float32)
    return np.clip(out + 0.5, 0, 255).astype(np.uint8)


def _dark(frames: Frames, rng: np.random.Generator) -> Frames:
    return gained(frames, float(np.exp(rng.uniform(np.log(5e-4), np.log(2e-2)))), 3.0, rng)


def _overexposed(frames: Frames, rng: np.random.Generator) -> Frames:
    return gained(frames, float(np.exp(rng.uniform(np.log(4), np.log(60)))), 1.0, rng)


def _noisy(frames: Frames, rng: np.random.Generator) -> Frames:
    return gained(frames, 1.0, float(rng.uniform(25, 110)), rng)


def _frozen(frames: Frames, rng: np.random.Generator) -> Frames:
    """One frame, again and again, with sensor noise."""
    one = frames[int(rng.integers(len(frames)))]
    return gained(np.repeat(one[None], 40, axis=0), 1.0, 2.0, rng)


def _short(frames: Frames, rng: np.random.Generator) -> Frames:
    return frames[: int(rng.integers(3, 8))]


def _joined(frames: Frames, other: Frames) -> Frames:
    """Four pieces of two films in turn: cuts."""
    k = len(frames) // 4
    return np.concatenate([frames[:k], other[:k], frames[2 * k : 3 * k], other[2 * k : 3 * k]])


SPOILERS: dict[str, Callable[[Frames, np.random.Generator], Frames]] = {
    "shaken": _directional, "defocus": _defocus, "dark": _dark, "overexposed": _overexposed, "noisy": _noisy,
    "frozen": _frozen, "short": _short,
}  # fmt: skip
"""Spoiled by image operations."""
FILMED = ("rotation", "blank", "fast")
"""Filmed again: turning on a tripod; along a blank wall; all around the room in a second."""
KINDS = ("rotation", "shaken", "blank", "dark", "fast", "defocus", "frozen", "noisy", "short", "overexposed")
_BY_CONSTRUCTION = ("rotation", "blank", "frozen", "short")


def kinds_of(split: str, seed: int) -> tuple[str, ...]:
    """Return the ways in which a room's film is spoiled, in turn."""
    row = SPLITS[split].index(seed)
    return KINDS[2 * row % len(KINDS)], KINDS[(2 * row + 1) % len(KINDS)]


def make_films(split: str, seed: int, folder: Path) -> list[Path]:
    """Film a room well and badly: folders with `video.mp4` and `label.json`; finished ones are left as they are.

    Args:
        split: of `SPLITS`.
        seed: of the room, the walk, the phone and the spoiling.
        folder: to create.
    """
    names = ("plain", *kinds_of(split, seed))
    films = [folder / f"{seed}_{name}" for name in names]
    if all((film / "label.json").exists() for film in films):
        return films
    rng = np.random.default_rng([seed, 2525])
    scene = _draw_scene(seed, rng)
    sensor = replace(draw_sensor(rng), blur_shutter=0.0, rolling_shutter=0.0)

    def shoot(at: Scene) -> Frames:
        film = iterate_film(
            at.film_set, at.camera, at.world_from_camera, sensor, seed=seed, supersample=1, quick=True
        )
        return np.stack(list(film))

    plain = shoot(scene)
    for film, kind in zip(films, names):
        if kind in FILMED:
            again = _filmed_again(scene, kind, rng)
            frames, path = shoot(again), again.world_from_camera
        else:
            frames = plain if kind == "plain" else SPOILERS[kind](plain, rng)
            path = scene.world_from_camera
        film.mkdir(parents=True, exist_ok=True)
        write_video(film / "video.mp4", frames, _FPS, crf=23, preset="veryfast")
        outcome = Outcome("bad", "construction")
        if kind not in _BY_CONSTRUCTION:
            outcome = judge_by_poses(film / "video.mp4", path)
        said = {"split": split, "seed": seed, "kind": kind, **asdict(outcome)}
        (film / "label.json").write_text(json.dumps(said, indent=1) + "\n")
    return films


def _draw_scene(seed: int, rng: np.random.Generator) -> Scene:
    room = draw_room(seed, shapes=tuple(SHAPE_FAMILIES), step_m=0.08, density=0.6)
    scene = stage(CaptureSpec(room, frames=_FRAMES, width=_SIZE[0], height=_SIZE[1]))
    return replace(scene, world_from_camera=draw_walk(rng, plan_room(room).shape, _FRAMES))


def _filmed_again(scene: Scene, kind: str, rng: np.random.Generator) -> Scene:
    """Return the same room, filmed in one of the ways of `FILMED`."""
    path = scene.world_from_camera.copy()
    middle = path[len(path) // 2]
    if kind == "rotation":
        angles = np.radians(np.linspace(0, rng.uniform(50, 120), _FRAMES))
        pitch = -0.35 + 0.08 * np.sin(3 * angles)
        start = np.arctan2(middle[1, 2], middle[0, 2]) - angles.mean()
        views = np.column_stack([np.cos(start + angles), np.sin(start + angles), pitch])
        path = np.stack([look_at(middle[:3, 3], middle[:3, 3] + v) for v in views])
    elif kind == "fast":
        count = int(rng.integers(9, 13))
        angles = np.radians(np.linspace(0, rng.uniform(330, 700), count))
        views = np.column_stack([np.cos(angles), np.sin(angles), np.full(count, -0.4)])
        steps = 0.25 * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(count)])
        path = np.stack([look_at(middle[:3, 3] + s, middle[:3, 3] + s + v) for s, v in zip(steps, views)])
    else:
        return _blank_wall(scene, rng)
    return replace(scene, world_from_camera=path)


def _blank_wall(scene: Scene, rng: np.random.Generator) -> Scene:
    """Return a walk along a wall of another room, with nothing but paint in view."""
    plan = plan_room(RoomSpec(seed=int(rng.integers(10**6)), objects=3, wall_things=0.0, side_furniture=0.0,
                              blank_walls=True, step_m=0.08, density=0.6))  # fmt: skip
    middle, length = plan.shape.wall("wall_north")
    x = middle[0] + np.linspace(-0.25, 0.25, 40) * length
    eyes = np.column_stack([x, np.full(40, middle[1] - 0.7), np.full(40, rng.uniform(1.4, 1.7))])
    path = np.stack([look_at(eye, [*eye, 0.1, 1.0, 0.1]) for eye in eyes])
    return replace(scene, film_set=prepare(furnish(plan)), world_from_camera=path)


def judge_by_poses(video: Path, path: np.ndarray) -> Outcome:
    """Run frames and poses (preset fast) on a film; compare its cameras with the true path (n, 4, 4)."""
    options = replace(FRAMES_PRESETS["fast"], max_held_out=1)
    with tempfile.TemporaryDirectory() as scratch:
        try:
            frames = load_frames(video, options)
            posed = estimate_poses(frames, POSES_PRESETS["fast"], work_dir=Path(scratch))
        except InputError as error:
            return Outcome("bad", "poses", message=str(error))
    registered = len(posed.images) / posed.chosen_frames
    true, found = path[posed.indices, :3, 3], posed.world_from_camera[:, :3, 3]
    moved = transform_points(umeyama(found, true), found)
    spread = ((true - true.mean(0)) ** 2).sum(1).mean()
    error = float(np.sqrt(((moved - true) ** 2).sum(1).mean() / spread))
    label = "between"
    if registered < _BAD_REGISTERED or error > _BAD_ERROR:
        label = "bad"
    elif registered >= _GOOD_REGISTERED and error < _GOOD_ERROR:
        label = "good"
    return Outcome(label, "poses", round(registered, 3), round(error, 4))
