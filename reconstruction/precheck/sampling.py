"""Sample a film: decode it once at low resolution, measure its motion, keep some frames spread along the motion."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.frames.decoding import ImageFolder, VideoReader
from reconstruction.frames.keyframes import (
    ANALYSIS_SIDE_PX,
    FrameStats,
    MotionMeter,
    Spacing,
    choose_keyframes,
)
from reconstruction.phone_exports.exports import find_export
from reconstruction.world.samples import choose_frames
from registry.errors import InputError, UsageError

MAX_FRAMES = 48  # sampled; more frames cost more time and change no verdict on the generated films
_MIN_SAMPLED = 12
_MAX_METERED = 240  # frames whose motion is measured
_MIN_INTRA = 40  # intra-coded frames that a film needs for being sampled by them alone
_MAX_DECODED_PX = 2.0e9  # of all frames; longer or larger films are decoded at intra-coded frames only
_MIN_STEP = 0.0015  # displacement of a new view, share of the longer side; sensor noise moves corners less


@dataclass(frozen=True)
class Film:
    """Sampled frames of a film, and measurements of all metered ones."""

    file: str
    width: int
    height: int
    fps: float  # 0 for a folder of images
    frame_count: int  # decoded; of a large film: intra-coded frames
    duration_s: float  # 0 for a folder of images
    images: np.ndarray  # uint8 (n, h, w, 3) RGB, longer side at most `ANALYSIS_SIDE_PX`
    names: tuple[str, ...]  # (n,) time, or file name, of each sampled frame
    stats: FrameStats  # of the metered frames
    focal_prior_px: float  # at the sampled size, 0 where unknown
    damage: str = ""  # of the file, in words


class _IntraReader(VideoReader):
    """Decodes intra-coded frames only; frame numbers count these."""

    def _stream(self, container):
        stream = super()._stream(container)
        stream.codec_context.skip_frame = "NONKEY"
        return stream


def sample_film(video: Path, progress: Progress = NO_PROGRESS) -> Film:
    """Sample a video file, a folder of images, or an export of a phone app.

    Raises:
        UsageError: there is no such file or folder.
        InputError: nothing can be decoded.
    """
    video = Path(video)
    if not video.exists():
        raise UsageError(f"{video}: no such file or folder")
    export = find_export(video)
    if export is not None:
        with tempfile.TemporaryDirectory() as scratch:
            return _sample_folder(ImageFolder(export.unpack_images(Path(scratch))), video, progress)
    if video.is_dir():
        return _sample_folder(ImageFolder(video), video, progress)
    return _sample_video(video, progress)


def _sample_video(path: Path, progress: Progress) -> Film:
    reader = VideoReader(path)
    next(reader.frames(), None)  # the size is known afterwards
    announced = reader.announced_frames
    intra_only = False
    kept: list[tuple[np.ndarray, float]] = []
    if announced * reader.width * reader.height > _MAX_DECODED_PX:
        sparse = _IntraReader(path)
        kept = list(_metered(sparse, 0, progress)[0])
        intra_only = len(kept) >= _MIN_INTRA
        reader = sparse if intra_only else reader
    decoded = len(kept)
    if not intra_only:
        kept, decoded = _metered(reader, announced, progress)
    if decoded == 0:
        raise InputError(
            f"frames: no frame of {path} can be decoded. It was cut off or damaged, or its codec "
            "is not supported: copy it again, or convert it to H.264 mp4."
        )
    damage = ""
    if not intra_only and (reader.damaged_packets or decoded < 0.98 * announced):
        of_all = f" of {announced} announced" if announced else ""
        damage = f"the file is damaged or cut off: {decoded} frames{of_all} could be decoded"
    times = [time_s for _, time_s in kept]
    stats, rows = _choose([gray_of(image) for image, _ in kept], times)
    span = times[-1] - times[0]
    rate = reader.nominal_fps if intra_only or span <= 0 else (decoded - 1) / max(span, 1e-6)
    return Film(
        str(path), reader.width, reader.height, rate, decoded, span, np.stack([kept[r][0] for r in rows]),
        tuple(f"{times[r]:.1f} s" for r in rows), stats, reader.focal_prior_px(ANALYSIS_SIDE_PX), damage,
    )  # fmt: skip


def _metered(
    reader: VideoReader, announced: int, progress: Progress
) -> tuple[list[tuple[np.ndarray, float]], int]:
    """Decode a video; return at most about `_MAX_METERED` frames (RGB, seconds), and the number of decoded ones.

    Without an announced number of frames, every second kept frame is dropped whenever there are too many.
    """
    progress.start(announced, "reading frames")
    stride = max(1, -(-announced // _MAX_METERED))
    kept: list[tuple[np.ndarray, float]] = []
    decoded = 0
    for number, time_s, intact, frame in reader.frames():
        decoded = number + 1
        progress.advance()
        if number % stride or not intact:
            continue
        kept.append((reader.to_rgb(frame, ANALYSIS_SIDE_PX), time_s))
        if len(kept) > 2 * _MAX_METERED:
            kept, stride = kept[::2], 2 * stride
    return kept, decoded


def _sample_folder(folder: ImageFolder, path: Path, progress: Progress) -> Film:
    count = len(folder.files)
    progress.start(count, "reading images")
    kept: list[tuple[np.ndarray, str]] = []
    for number in range(0, count, max(1, -(-count // _MAX_METERED))):
        image = folder.load_rgb(number, ANALYSIS_SIDE_PX)
        if image is not None:
            kept.append((image, folder.files[number].name))
        progress.advance()
    if not kept:
        raise InputError(f"frames: none of the {count} images in {path} can be decoded. Copy them again.")
    grays = [gray_of(image) for image, _ in kept]
    stats, rows = _choose(grays, [float(i) for i in range(len(kept))], folder=True)
    return Film(
        str(path), folder.width, folder.height, 0.0, count, 0.0, np.stack([kept[r][0] for r in rows]),
        tuple(kept[r][1] for r in rows), stats, folder.focal_prior_px(ANALYSIS_SIDE_PX),
    )  # fmt: skip


def gray_of(image: np.ndarray) -> np.ndarray:
    """Convert RGB uint8 (h, w, 3) to gray uint8 (h, w)."""
    return cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)


def _choose(
    grays: list[np.ndarray], times: list[float], *, folder: bool = False
) -> tuple[FrameStats, np.ndarray]:
    """Measure the motion; choose at most `MAX_FRAMES` frames, the sharpest of each stretch."""
    meter = MotionMeter()
    for number, (gray, time_s) in enumerate(zip(grays, times)):
        meter.add(number, time_s, gray)
    stats = meter.stats
    if folder:  # photographs need not be in order, and each is one that its owner chose
        return stats, choose_frames(len(grays), MAX_FRAMES)
    spacing = Spacing(  # as the frames that the limits were fitted to
        step=0.03, fewest=min(MAX_FRAMES, 32), most=MAX_FRAMES, blurred_below=0.4, widest_gap=0.22,
        by_parallax=False,
    )  # fmt: skip
    rows = choose_keyframes(stats, np.ones(len(grays), bool), spacing)
    if len(rows) < _MIN_SAMPLED:  # a camera at rest, or one too fast to follow
        rows = choose_frames(len(grays), _MIN_SAMPLED)
    return stats, rows


def distinct_views(film: Film) -> int:
    """Count the metered frames that show a new view: the view has moved since the last counted one."""
    count, last = 0, -np.inf
    for position in film.stats.position:
        if position - last >= _MIN_STEP:
            count, last = count + 1, position
    return count
