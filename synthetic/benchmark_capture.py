"""Benchmark captures: a procedural room, filmed, with the ground truth that `simrecon evaluate` reads.

`write_capture(CaptureSpec(...), folder)` writes `video.mp4`, `ground_truth/` (contract, section 3) and
`capture.json`, which holds the spec and what is known about the film. The same spec gives the same files.
"""

import json
import shutil
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from reconstruction.core.types import Camera
from registry.errors import UsageError
from synthetic.camera_paths import phone_camera
from synthetic.capture import write_ground_truth
from synthetic.film import FilmSet, iterate_film, prepare
from synthetic.procedural import RoomSpec, furnish, plan_room
from synthetic.room import Room
from synthetic.sensor import Sensor
from synthetic.videos import write_video
from synthetic.walks import walk_path

SCHEMA = "simrecon.capture/1"
_EVALUATED_PIXELS, _EVALUATED_AT = 2000, 640 * 480  # contract, section 4: in proportion to the pixel count


@dataclass(frozen=True)
class CaptureSpec:
    """How a procedural room is filmed; the same spec gives the same files."""

    room: RoomSpec = field(default_factory=RoomSpec)
    """The room."""
    frames: int = 140
    """Length of the film."""
    width: int = 640
    """Of the frames, pixels."""
    height: int = 480
    """Of the frames, pixels."""
    fps: float = 12.0
    """Frames per second."""
    path: str = "arc"
    """The camera's way: one of `synthetic.walks.WALKS`; "loop" and "visit" need walls=4."""
    fov_deg: float = 62.0
    """Field of view along the longer side."""
    shake: float = 1.0
    """Factor on the sway and tremor of the hand."""
    exposure_drift: float = 0.05
    """Amplitude of the slow change of exposure, relative."""
    motion_blur_s: float = 0.0
    """Time that the shutter is open, seconds; a fifth of 1/fps already blurs visibly."""
    noise: float = 1.5
    """Standard deviation of the sensor noise, in 8-bit steps."""
    seed: int = 0
    """Of the hand and the noise; the room has its own."""
    crf: int = 20
    """Quality of the video, lower is better and larger."""

    def __post_init__(self) -> None:
        """Refuse what cannot be filmed."""
        if self.frames < 2 or min(self.width, self.height) < 32 or self.width % 2 or self.height % 2:
            raise UsageError(
                f"CaptureSpec: {self.frames} frames of {self.width}x{self.height}; expected at least 2 frames of an "
                "even width and height, 32 pixels or more"
            )
        if not 0 <= self.motion_blur_s <= 1 / self.fps:
            raise UsageError(
                f"CaptureSpec: motion_blur_s={self.motion_blur_s} s, expected at most 1/fps = {1 / self.fps:.3f} s"
            )

    def sensor(self) -> Sensor:
        """Return what the phone does to light."""
        shutter = self.motion_blur_s * self.fps
        return Sensor(self.noise, self.exposure_drift, shutter, 4 if shutter <= 0.15 else 6, blur_jitter=True)


@dataclass(frozen=True)
class CaptureReport:
    """What is known about a written capture."""

    folder: Path
    objects: int
    evaluated_objects: int
    """Objects with enough visible pixels to be evaluated."""
    hidden: tuple[str, ...]
    """Names of the others."""

    @property
    def evaluated_share(self) -> float:
        """Return the share of the objects that the camera sees well enough."""
        return self.evaluated_objects / self.objects


@dataclass(frozen=True)
class Scene:
    """A room ready to be filmed."""

    room: Room
    film_set: FilmSet
    camera: Camera
    world_from_camera: np.ndarray  # float64 (n, 4, 4)


def stage(spec: CaptureSpec) -> Scene:
    """Build the room, bake its light and plan the camera's way."""
    plan = plan_room(spec.room)
    room = furnish(plan)
    camera = phone_camera(spec.width, spec.height, spec.fov_deg)
    path = walk_path(plan.shape, spec.path, spec.frames, spec.seed, spec.shake)
    return Scene(room, prepare(room), camera, path)


def write_capture(spec: CaptureSpec, folder: Path) -> CaptureReport:
    """Write `video.mp4`, `ground_truth/` and, last, `capture.json` into a folder.

    A folder whose `capture.json` already names the same spec is left as it is.

    Args:
        spec: The room and how it is filmed.
        folder: To create; what another spec left there is replaced.

    Returns:
        How many of the objects the camera sees well enough to be evaluated.
    """
    done = folder / "capture.json"
    if done.is_file() and json.loads(done.read_text()).get("spec") == _as_json(spec):
        return _report(spec, folder)
    done.unlink(missing_ok=True)
    if (folder / "ground_truth").is_dir():
        shutil.rmtree(folder / "ground_truth")
    folder.mkdir(parents=True, exist_ok=True)
    scene = stage(spec)
    film = iterate_film(scene.film_set, scene.camera, scene.world_from_camera, spec.sensor(), seed=spec.seed)
    write_video(folder / "video.mp4", film, spec.fps, crf=spec.crf)
    write_ground_truth(
        folder / "ground_truth", scene.room, scene.film_set, scene.camera, scene.world_from_camera, spec.fps
    )
    report = _report(spec, folder)
    content = {
        "schema": SCHEMA,
        "spec": _as_json(spec),
        "objects": report.objects,
        "evaluated_objects": report.evaluated_objects,
        "hidden": list(report.hidden),
    }
    done.write_text(json.dumps(content, indent=1) + "\n")
    return report


_LATER_FIELDS = (
    "families",
    "furniture",
    "household",
    "layout",
    "uneven",
)  # of RoomSpec, after the first captures


def _as_json(spec: CaptureSpec) -> dict:
    """Return the spec for `capture.json`; later fields only where they are set, so that old captures stay valid."""
    out, usual = json.loads(json.dumps(asdict(spec))), RoomSpec()
    for name in _LATER_FIELDS:
        if getattr(spec.room, name) == getattr(usual, name):
            del out["room"][name]
    return out


def _report(spec: CaptureSpec, folder: Path) -> CaptureReport:
    truth = json.loads((folder / "ground_truth" / "scene.json").read_text())
    needed = _EVALUATED_PIXELS * spec.width * spec.height / _EVALUATED_AT
    objects = [e for e in truth["entities"] if not e["base"]]
    hidden = tuple(e["name"] for e in objects if e["visible_pixels"] < needed)
    return CaptureReport(folder, len(objects), len(objects) - len(hidden), hidden)


def load_spec(file: Path) -> CaptureSpec:
    """Read the spec of a written capture (`capture.json`)."""
    data = json.loads(Path(file).read_text())
    if data.get("schema") != SCHEMA:
        raise UsageError(f"{file}: schema {data.get('schema')!r}, expected {SCHEMA!r}")
    spec = data["spec"]
    return CaptureSpec(**{**spec, "room": RoomSpec(**spec["room"])})
