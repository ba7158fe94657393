"""Generated films as phones take them: codec, rate, rotation, shutter, exposure, zoom, stabilization, passers-by.

A film shows a room while somebody walks around its middle once, in `_SECONDS`. Its truth is kept beside it: times,
poses, focal lengths, the frames before they were encoded, and where passers-by stand.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera
from synthetic.benchmark_capture import CaptureSpec, Scene, stage
from synthetic.film import render_color, render_truth
from synthetic.phone_encoding import ENCODINGS, write_phone_video
from synthetic.random_rooms import draw_room
from synthetic.sensor import Electronics, Sensor, expose
from synthetic.shape_families import SHAPE_FAMILIES

_SECONDS, _PATH_FPS = 5.4, 12.0


@dataclass(frozen=True)
class PhoneFilm:
    """How a film is taken and stored."""

    name: str
    codec: str = "h264"
    """Of `ENCODINGS`."""
    fps: float = 12.0
    """Nominal rate; the walk takes the same time at every rate."""
    times: str = "constant"
    """"constant"; "dropped": a third of the frames is missing; "slow_motion": four times the rate in the middle third;
    "pause": the camera rests for as long as it walks."""
    rotation: int = 0
    """Display matrix, degrees counter-clockwise; 90 and -90: a portrait film."""
    readout_s: float = 0.0
    """Time from the first row of a rolling shutter to the last."""
    shutter_s: float = 0.0
    """Time that the shutter is open."""
    exposure: str = "steady"
    """"steady"; "auto": exposure follows the picture, white balance drifts by 5 %; "strong": with steps of a third."""
    passers: int = 0
    """1: somebody crosses the view in 1.6 s; 2: somebody else stays in view, walking slowly, too."""
    zoom: str = ""
    """"in": twice the focal length from 60 % of the film on; "out": half of it from 45 % on; "pinch": the focal length
    doubles within a second in the middle."""
    wander: float = 0.0
    """Way of the crop of a stabilized film, as a share of the longer side."""
    size: tuple[int, int] = (480, 360)
    """Width and height as stored, pixels; swapped when a portrait film is watched."""


FILMS: tuple[PhoneFilm, ...] = (
    PhoneFilm("h264"),
    PhoneFilm("h264_full_range", "h264_full_range"),
    PhoneFilm("hevc", "hevc"),
    PhoneFilm("hevc_10", "hevc_10"),
    PhoneFilm("hevc_10_hlg", "hevc_10_hlg"),
    PhoneFilm("hevc_10_pq", "hevc_10_pq"),
    PhoneFilm("prores", "prores"),
    PhoneFilm("prores_hlg", "prores_hlg"),
    PhoneFilm("vp9", "vp9"),
    PhoneFilm("av1_10", "av1_10"),
    PhoneFilm("mjpeg", "mjpeg"),
    PhoneFilm("portrait", rotation=-90),
    PhoneFilm("portrait_other_way_hlg", "hevc_10_hlg", rotation=90),
    PhoneFilm("upside_down", "hevc", rotation=180),
    PhoneFilm("dropped_frames", fps=18.0, times="dropped"),
    PhoneFilm("pause", "hevc", times="pause"),
    PhoneFilm("120_fps", fps=120.0, size=(320, 240)),
    PhoneFilm("slow_motion_hevc", "hevc", fps=30.0, times="slow_motion", size=(320, 240)),
    PhoneFilm("readout_15_ms", readout_s=0.015),
    PhoneFilm("readout_30_ms", readout_s=0.030),
    PhoneFilm("readout_30_ms_blur", "hevc", readout_s=0.030, shutter_s=0.012),
    PhoneFilm("exposure_auto", exposure="auto"),
    PhoneFilm("exposure_strong", exposure="strong"),
    PhoneFilm("passer_crosses", passers=1),
    PhoneFilm("passers_stay", passers=2),
    PhoneFilm("zoom_in", zoom="in"),
    PhoneFilm("lens_wide", "hevc", zoom="out"),
    PhoneFilm("zoom_pinch", zoom="pinch"),
    PhoneFilm("stabilized", wander=0.03),
    PhoneFilm("all_at_once", "hevc_10_hlg", 18.0, "dropped", -90, 0.02, 0.006, "auto", 1, "", 0.01),
)
"""The matrix: one property at a time, and one film with most of them."""


@dataclass(frozen=True)
class Truth:
    """Ground truth of a film, in upright frames."""

    times_s: np.ndarray  # float64 (n,)
    world_from_camera: np.ndarray  # float64 (n, 4, 4) of the middle row
    focal_px: np.ndarray  # float64 (n,)
    frames: np.ndarray  # uint8 (n, h, w, 3) before encoding
    passers: np.ndarray  # bool (n, h, w) pixels that show somebody
    depth: np.ndarray  # float32 (n, h, w) of the room without passers-by, metres; empty without them

    def save(self, folder: Path) -> None:
        """Write the arrays into a folder."""
        np.savez_compressed(folder / "truth.npz", **{**vars(self), "passers": np.packbits(self.passers, -1)})

    @classmethod
    def load(cls, folder: Path) -> "Truth":
        """Read what `save` wrote."""
        with np.load(folder / "truth.npz") as stored:
            fields = {name: stored[name] for name in stored.files}
        width = fields["frames"].shape[2]
        fields["passers"] = np.unpackbits(fields["passers"], -1, count=width).astype(bool)
        return cls(**fields)


def make_film(film: PhoneFilm, seed: int, folder: Path) -> Path:
    """Shoot and encode a film; return the video. Finished ones are left as they are.

    Args:
        film: how it is taken.
        seed: of room, hand and noise.
        folder: to create, for this film alone.
    """
    encoding = ENCODINGS[film.codec]
    video, done = folder / f"video{encoding.suffix}", folder / "film.json"
    asked = {**asdict(film), "seed": seed, "size": list(film.size)}
    if done.exists() and json.loads(done.read_text()) == asked:
        return video
    folder.mkdir(parents=True, exist_ok=True)
    truth = shoot(film, seed)
    truth.save(folder)
    stored = np.rot90(truth.frames, -film.rotation // 90, axes=(1, 2))
    write_phone_video(video, stored, list(truth.times_s), encoding, rotation_deg=film.rotation)
    done.write_text(json.dumps(asked, indent=1) + "\n")
    return video


def shoot(film: PhoneFilm, seed: int) -> Truth:
    """Draw all frames of a film."""
    width, height = film.size
    room = draw_room(seed, shapes=tuple(SHAPE_FAMILIES), step_m=0.08, density=0.6)
    spec = CaptureSpec(room, int(_SECONDS * _PATH_FPS), width, height, seed=seed)
    scene = stage(spec)
    times, place = _times(film, seed)
    upright = _along(scene.world_from_camera, place)
    poses = upright @ _upright_from_stored(film.rotation)
    lenses = _lenses(film, scene.camera, times, seed)
    people = _people(scene, film.passers, seed)
    frames, masks, depths = [], [], []
    for image, mask, depth in _frames(film, scene, poses, lenses, times, people, seed):
        frames.append(image)
        masks.append(mask)
        depths.append(depth)
    focal = np.array([lens.fx for lens in lenses])
    watched = [np.rot90(np.stack(x), film.rotation // 90, axes=(1, 2)) for x in (frames, masks, depths)]
    if not film.passers:
        watched[2] = np.zeros(0, np.float32)
    return Truth(times, upright, focal, *watched)


def _upright_from_stored(rotation: int) -> np.ndarray:
    """Return upright_from_stored (4, 4); the rows of the frames as stored are read from the top."""
    c, s = round(np.cos(np.radians(rotation))), round(np.sin(np.radians(rotation)))
    out = np.eye(4)
    out[:2, :2] = [[c, s], [-s, c]]
    return out


def _times(film: PhoneFilm, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the time of each frame in seconds, and its place on the walk from 0 to 1."""
    times = np.arange(0, _SECONDS, 1 / film.fps)
    if film.times == "dropped":
        drop = np.random.default_rng([seed, 1]).random(len(times)) < 1 / 3
        drop[[0, 1, -1]] = False
        times = times[~drop]
    elif film.times == "slow_motion":
        third = _SECONDS / 3
        fast = np.arange(third, 2 * third, 1 / (4 * film.fps))
        times = np.concatenate([times[times < third - 1e-9], fast, times[times >= 2 * third]])
    place = times / _SECONDS
    if film.times == "pause":
        rest = len(times) // 2
        times = np.arange(2 * len(times)) / film.fps
        place = np.concatenate([place[:rest], np.full(len(place), place[rest]), place[rest:]])
    return times, place


def _along(path: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Interpolate a path (n, 4, 4) smoothly at places (m,) from 0 to 1."""
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    knots = np.linspace(0, 1, len(path))
    out = np.tile(np.eye(4), (len(place), 1, 1))
    out[:, :3, :3] = RotationSpline(knots, Rotation.from_matrix(path[:, :3, :3]))(place).as_matrix()
    out[:, :3, 3] = CubicSpline(knots, path[:, :3, 3])(place)
    return out


def _lenses(film: PhoneFilm, camera: Camera, times: np.ndarray, seed: int) -> list[Camera]:
    """Return the camera of each frame: zoom and the crop's way."""
    share = times / times[-1]
    zoom = np.ones(len(times))
    if film.zoom == "in":
        zoom[share > 0.6] = 2.0
    elif film.zoom == "out":
        zoom[share > 0.45] = 0.5
    elif film.zoom == "pinch":
        zoom = 2.0 ** np.clip((times - times[-1] / 2) + 0.5, 0, 1)
    phase = np.random.default_rng([seed, 2]).uniform(0, 2 * np.pi, 4)
    way = film.wander * max(camera.width, camera.height)
    dx, dy = (
        way
        * (np.sin(2 * np.pi * 0.7 * times + phase[k]) + 0.5 * np.sin(2 * np.pi * 1.9 * times + phase[k + 1]))
        for k in (0, 2)
    )
    return [
        replace(camera, fx=z * camera.fx, fy=z * camera.fy, cx=camera.cx + x, cy=camera.cy + y)
        for z, x, y in zip(zoom, dx, dy)
    ]


def _sensor(film: PhoneFilm, frame_s: float) -> Sensor:
    auto, strong = film.exposure != "steady", film.exposure == "strong"
    return Sensor(
        noise=1.5,
        exposure_drift=0.1 if auto else 0.02,
        exposure_mean=110.0 if auto else 0.0,
        exposure_steps=0.33 if strong else 0.0,
        white_drift=(0.12 if strong else 0.05) if auto else 0.0,
        blur_shutter=film.shutter_s / frame_s,
        blur_jitter=True,
        rolling_shutter=film.readout_s / frame_s,
    )


@dataclass(frozen=True)
class _Person:
    """A walking body: a mesh around the origin, standing on z = 0, and its place over time."""

    vertices: np.ndarray  # float64 (v, 3)
    faces: np.ndarray  # int32 (f, 3)
    colors: np.ndarray  # float32 (f, 3)
    place: Callable[[float], np.ndarray]  # of the film's share from 0 to 1: (3,), or far below the floor


def _people(scene: Scene, count: int, seed: int) -> list[_Person]:
    """Return people in textured clothes: one who crosses the view in the middle, one who stays for 60 % of the film."""
    import trimesh

    rng = np.random.default_rng([seed, 3])
    middle = scene.world_from_camera[len(scene.world_from_camera) // 2]
    right, forward = middle[:3, 0], middle[:3, 2]
    ahead = forward * [1, 1, 0] / np.linalg.norm(forward[:2])
    out = []
    for number in range(count):
        body = trimesh.creation.capsule(height=1.3, radius=0.2, count=[20, 20])
        vertices, faces = trimesh.remesh.subdivide_to_size(body.vertices, body.faces, 0.06)[:2]
        vertices = vertices - [0, 0, vertices[:, 2].min()]
        # Trousers and a shirt, each of one color with a pattern.
        shirt = vertices[faces].mean(1)[:, 2] > 0.9
        plain = np.where(shirt[:, None], *rng.uniform(50, 200, (2, 3)))
        colors = (plain + rng.normal(0, 22, (len(faces), 1))).astype(np.float32)
        start, end = (0.35, 0.65) if number == 0 else (0.25, 0.85)
        reach, far = (1.6, 1.3) if number == 0 else (0.5, 1.6)

        def place(share: float, start=start, end=end, reach=reach, far=far) -> np.ndarray:
            if not start <= share <= end:
                return np.array([0.0, 0.0, -50.0])
            along = reach * (2 * (share - start) / (end - start) - 1)
            at = middle[:3, 3] + far * ahead + along * right
            return np.array([at[0], at[1], 0.0])

        out.append(_Person(vertices, np.asarray(faces, np.int32), colors, place))
    return out


def _frames(
    film: PhoneFilm, scene: Scene, poses: np.ndarray, lenses: list[Camera], times: np.ndarray,
    people: list[_Person], seed: int,
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:  # fmt: skip
    """Yield frames, pixels with people, and true depth without people."""
    sensor = _sensor(film, float(np.median(np.diff(times))))
    electronics = Electronics(sensor, len(poses), seed)
    phase = np.random.default_rng([seed, 4]).uniform(0, 2 * np.pi)
    for number, lens in enumerate(lenses):
        share = float(times[number] / times[-1])
        placed = [(p, p.vertices + p.place(share)) for p in people]

        def draw(camera: Camera, pose: np.ndarray, samples: int, placed=placed) -> np.ndarray:
            image = render_color(scene.film_set, camera, pose, samples, quick=True)
            return _with_people(image, scene, camera, pose, placed)[0] if placed else image

        image = expose(draw, lens, poses, number, sensor, 1)
        gain = np.float32(1 + sensor.exposure_drift * np.sin(phase + 2 * np.pi * 1.3 * share))
        image = electronics.noisy(electronics.develop(image * gain, number), sensor.noise)
        mask, depth = np.zeros(image.shape[:2], bool), np.zeros(image.shape[:2], np.float32)
        if placed:
            _, mask, depth = _with_people(image, scene, lens, poses[number], placed)
        yield np.clip(image + 0.5, 0, 255).astype(np.uint8), mask, depth


def _with_people(
    image: np.ndarray, scene: Scene, camera: Camera, pose: np.ndarray, placed: list
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw people over an image; return it, their pixels bool (h, w), and the room's depth float32 (h, w)."""
    room, _ = render_truth(scene.film_set, camera, pose)
    nearest, out = np.where(room > 0, room, np.inf), image.copy()
    mask = np.zeros(room.shape, bool)
    for person, vertices in placed:
        seen = rasterize_mesh(vertices, person.faces, camera, pose)
        front = (seen.face >= 0) & (seen.depth < nearest)
        out[front] = person.colors[seen.face[front]]
        nearest = np.where(front, seen.depth, nearest)
        mask |= front
    return out, mask, room
