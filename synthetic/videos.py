"""Write video files: films of generated rooms, and the broken or hopeless inputs that people really give.

Every maker of `BAD_VIDEOS` and `HARD_VIDEOS` takes the path to write and is deterministic.
"""

from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from synthetic.camera_paths import handheld_path, pan_path, phone_camera
from synthetic.film import FilmSet, film_room, prepare
from synthetic.room import build_room
from synthetic.sensor import Sensor

_TICKS_PER_S = 90000


def write_video(
    path: Path,
    images: Iterable[np.ndarray],
    fps: float = 12.0,
    *,
    times_s: Sequence[float] | None = None,
    crf: int = 21,
    rotation_deg: int = 0,
    pixel_format: str = "yuv420p",
    faststart: bool = True,
    keyframe_every: int = 24,
    preset: str = "medium",
) -> None:
    """Encode RGB images (h, w, 3) uint8 with H.264.

    Args:
        path: File to write; its suffix chooses the container.
        images: Frames as stored; for a portrait phone video they lie on their side.
        fps: Nominal rate.
        times_s: One time per frame for a variable rate; None: constant rate.
        crf: Quality of x264, lower is better and larger.
        rotation_deg: Counter-clockwise turn that players must apply, written as the track's display matrix as
            phones do. A phone held upright writes -90 (a quarter turn clockwise).
        pixel_format: Of the encoded video.
        faststart: Put the index at the front, so that the start of a cut-off file still plays.
        keyframe_every: Distance of intra-coded frames.
        preset: Speed of x264.
    """
    import av

    options = {"movflags": "faststart"} if faststart and path.suffix in (".mp4", ".mov") else {}
    with av.open(str(path), "w", options=options) as container:
        stream = None
        for number, image in enumerate(images):
            if stream is None:
                # One thread, so that the same frames always give the same file. x264's macroblock tree is off
                # for the same reason: it reads memory that it never wrote.
                settings = {
                    "crf": str(crf),
                    "preset": preset,
                    "threads": "1",
                    "g": str(keyframe_every),
                    "x264-params": "mbtree=0",
                }
                stream = container.add_stream(
                    "libx264", rate=Fraction(fps).limit_denominator(1001), options=settings
                )
                stream.height, stream.width = image.shape[:2]
                stream.pix_fmt = pixel_format
                stream.codec_context.time_base = Fraction(1, _TICKS_PER_S)
                if rotation_deg:
                    stream.set_display_rotation(rotation_deg)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            time = times_s[number] if times_s is not None else number / fps
            frame.pts, frame.time_base = round(time * _TICKS_PER_S), Fraction(1, _TICKS_PER_S)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def short_film(
    n_frames: int = 36, width: int = 320, height: int = 240, *, seed: int = 0, path: np.ndarray | None = None,
    blank_walls: bool = False, objects: Sequence[str] | None = None, sensor: Sensor | None = None,
) -> np.ndarray:  # fmt: skip
    """Return frames uint8 (n, h, w, 3) of a generated room, quickly made (coarse light)."""
    path = handheld_path(n_frames, seed=seed) if path is None else path
    film_set = _quick_set(seed, tuple(objects) if objects is not None else None, blank_walls)
    return film_room(film_set, phone_camera(width, height), path, sensor, seed=seed, supersample=1)


@lru_cache(maxsize=2)  # tests make many films of the same room
def _quick_set(seed: int, objects: tuple[str, ...] | None, blank_walls: bool) -> FilmSet:
    return prepare(
        build_room(seed, objects, step_m=0.08, density=0.5, blank_walls=blank_walls), shadow_px=256
    )


@lru_cache(maxsize=1)
def standard_film() -> np.ndarray:
    """Return 96 frames of 320x240, filmed once per process: most makers below use parts of it."""
    frames = short_film(96)
    frames.flags.writeable = False
    return frames


def _noisy(image: np.ndarray, n_frames: int, sigma: float = 1.6) -> np.ndarray:
    rng = np.random.default_rng(5)
    noise = sigma * rng.standard_normal((n_frames, *image.shape), np.float32)
    return np.clip(image + noise + 0.5, 0, 255).astype(np.uint8)


def write_not_a_video(path: Path) -> None:
    """Text under a video's name."""
    path.write_text("This is a shopping list: milk, bread, and a new phone.\n" * 40)


def write_empty(path: Path) -> None:
    """Zero bytes."""
    path.write_bytes(b"")


def write_cut_before_index(path: Path) -> None:
    """A phone's file (index at the end) whose copy stopped half-way: nothing can be decoded."""
    write_video(path, standard_film()[:24], faststart=False, preset="veryfast")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def write_one_frame(path: Path) -> None:
    """A photograph saved as a video."""
    write_video(path, standard_film()[:1])


def write_too_short(path: Path) -> None:
    """Five frames."""
    write_video(path, standard_film()[:5])


def write_black(path: Path) -> None:
    """Two seconds with the lens covered, with sensor noise."""
    write_video(path, _noisy(np.full((240, 320, 3), 4, np.float32), 24))


def write_still_camera(path: Path) -> None:
    """A camera on a tripod."""
    still = np.repeat(handheld_path(40)[20:21], 2, axis=0)
    image = short_film(2, path=still, sensor=Sensor(noise=0.0, exposure_drift=0.0))[0]
    write_video(path, _noisy(image.astype(np.float32), 36))


def write_blank_wall(path: Path) -> None:
    """A white wall with soft shading, filmed while walking along it."""
    x = np.linspace(-1, 1, 320)[None, :, None]
    y = np.linspace(-1, 1, 240)[:, None, None]
    wall = [214 - 18 * ((x + 0.02 * k) ** 2 + y**2) * np.ones((1, 1, 3)) for k in range(36)]
    rng = np.random.default_rng(6)
    frames = [np.clip(w + 1.6 * rng.standard_normal(w.shape), 0, 255).astype(np.uint8) for w in wall]
    write_video(path, frames)


def write_pure_rotation(path: Path) -> None:
    """Turning on the spot: sharp, textured, moving, and without any parallax."""
    write_video(path, short_film(48, path=pan_path(48)))


BAD_VIDEOS: dict[str, Callable[[Path], None]] = {
    "not_a_video": write_not_a_video,
    "empty": write_empty,
    "cut_before_index": write_cut_before_index,
    "one_frame": write_one_frame,
    "too_short": write_too_short,
    "black": write_black,
    "still_camera": write_still_camera,
    "blank_wall": write_blank_wall,
    "pure_rotation": write_pure_rotation,
}
"""Inputs that no scene can come from. All but `pure_rotation` are refused by the frames stage."""


def write_half_blurred(path: Path) -> None:
    """Every second frame is out of focus."""
    frames = standard_film()
    write_video(path, [cv2.GaussianBlur(f, (0, 0), 3.0) if i % 2 else f for i, f in enumerate(frames)])


def write_half_duplicated(path: Path) -> None:
    """Every frame is there twice, as a converter from 12 to 24 frames/s leaves it."""
    write_video(path, np.repeat(standard_film()[:60], 2, axis=0), fps=24.0)


def write_portrait(path: Path) -> None:
    """A phone held upright: frames lie on their side, the display matrix says how to turn them."""
    upright = short_film(48, 240, 320)
    write_video(path, [np.rot90(f, 1) for f in upright], rotation_deg=-90)


def write_cut_off(path: Path) -> None:
    """A streamable file whose second half is missing: the first half decodes."""
    write_video(path, standard_film())
    data = path.read_bytes()
    path.write_bytes(data[: int(0.6 * len(data))])


def write_damaged(path: Path) -> None:
    """A file with bytes overwritten in the middle, as a failing memory card leaves it."""
    write_video(path, standard_film())
    data = bytearray(path.read_bytes())
    for start in (int(0.4 * len(data)), int(0.6 * len(data))):
        data[start : start + 4000] = b"\0" * 4000
    path.write_bytes(bytes(data))


def write_variable_rate(path: Path) -> None:
    """Phones drop frames in the dark: times are uneven."""
    frames = standard_film()[:60]
    steps = np.random.default_rng(3).choice([1 / 30, 2 / 30, 3 / 30], len(frames) - 1)
    write_video(path, frames, fps=30.0, times_s=[0.0, *np.cumsum(steps)])


HARD_VIDEOS: dict[str, Callable[[Path], None]] = {
    "half_blurred": write_half_blurred,
    "half_duplicated": write_half_duplicated,
    "portrait": write_portrait,
    "cut_off": write_cut_off,
    "damaged": write_damaged,
    "variable_rate": write_variable_rate,
}
"""Inputs with a fault that must work all the same."""


def write_4k60(path: Path, seconds: float = 2.0) -> None:
    """4K at 60 frames/s, enlarged from a small film (slow to encode)."""
    small = short_film(24, 480, 270)

    def frames() -> Iterable[np.ndarray]:
        for number in range(int(60 * seconds)):
            image = small[min(number * len(small) // int(60 * seconds), len(small) - 1)]
            yield cv2.resize(image, (3840, 2160), interpolation=cv2.INTER_LINEAR)

    write_video(path, frames(), fps=60.0, crf=28, preset="ultrafast", keyframe_every=60)
