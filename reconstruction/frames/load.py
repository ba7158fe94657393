"""Stage 1: select upright keyframes and held-out frames from a video or a folder of images.

Videos are decoded twice: pass 1 measures sharpness, texture and motion at low resolution, pass 2 decodes the selected
frames at working resolution. Inputs that cannot be reconstructed are refused: no video, blank, at rest, too short. Lack
of parallax is detected by the poses stage.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.core.types import FrameSet, VideoSource
from reconstruction.frames.config import HELD_OUT_EVERY, FramesConfig
from reconstruction.frames.decoding import ImageFolder, VideoReader, file_sha256, list_images, working_size
from reconstruction.frames.keyframes import (
    ANALYSIS_SIDE_PX,
    FrameStats,
    MotionMeter,
    Spacing,
    choose_keyframes,
    repeats_of,
)
from reconstruction.phone_exports.exports import Export, find_export
from reconstruction.phone_exports.polycam import polycam_turns
from registry.errors import InputError, UsageError


def load_frames(video: Path, config: FramesConfig, *, progress: Progress = NO_PROGRESS) -> FrameSet:
    """Choose and load keyframes from a video file or a folder of jpg and png images.

    Args:
        video: a file that ffmpeg decodes, a folder of images in name order, or an export of Record3D or Polycam.
        config: settings.
        progress: receives steps and notes.

    Returns:
        Keyframes and held-out frames, upright, at working resolution, in time order.

    Raises:
        UsageError: there is no such file or folder.
        InputError: it cannot be decoded or reconstructed (blank, at rest, too short).
    """
    video = Path(video)
    if not video.exists():
        raise UsageError(f"frames: there is no file or folder {video}. Check the path.")
    export = find_export(video)
    if export is not None:
        return _from_export(export, config, progress)
    return _from_folder(video, config, progress) if video.is_dir() else _from_video(video, config, progress)


def check_input(video: Path) -> None:
    """Check that a path can be an input, without reading it: a regular file, or a folder with images or an export.

    Raises:
        UsageError: there is nothing, or no file.
        InputError: it is a folder without images.
    """
    if not video.exists():
        raise UsageError(f"{video}: no such file or folder")
    if not video.is_dir():
        if not video.is_file():
            raise UsageError(f"{video} is a device or a pipe; give a video file or a folder of images")
        return
    if find_export(video) is None:
        list_images(video)


# --- Videos -----------------------------------------------------------------------------------------------


def _from_video(path: Path, config: FramesConfig, progress: Progress) -> FrameSet:
    reader = VideoReader(path)
    stats, times, smeared = _measure_video(reader, config, progress)
    damage = _note_decoding(reader, len(times), progress)
    try:
        usable = _usable_frames(stats, len(times), config, str(path), progress)
        usable, smeared = _without_smeared(stats, usable, smeared, config, progress)
        usable = _without_held_out(stats, usable, config, progress)
        chosen = choose_keyframes(stats, usable, _spacing(config))
        _require_enough(len(chosen), config, str(path))
    except InputError as error:
        if not damage:
            raise
        raise InputError(f"{error} But the file is damaged or cut off: {damage}; copy it again.") from error
    keep = [stats.indices[row] for row in chosen]
    candidates = [i for i in range(0, len(times), HELD_OUT_EVERY) if i not in smeared]
    held = _spread(np.array(candidates, int), config.max_held_out)
    images = _decode_chosen(reader, {*keep, *held}, config, progress)
    missing = [i for i in keep if i not in images]
    if missing:
        raise InputError(f"frames: {path} changed while it was read: frame {missing[0]} is gone. Run again.")
    span = times[-1] - times[0]
    fps = (len(times) - 1) / span if span > 0 else reader.nominal_fps
    source = VideoSource(
        file=str(path),
        sha256=file_sha256(path),
        width=reader.width,
        height=reader.height,
        fps=round(float(fps), 6),
        frame_count=len(times),
        duration_s=float(span + 1 / fps) if fps > 0 else 0.0,
    )
    progress.note(f"{len(keep)} keyframes of {len(times)} frames, {len(held)} held out for evaluation")
    sharpness = [stats.sharpness[row] for row in chosen]
    focal_px = reader.focal_prior_px(config.max_side_px)
    frames = _frame_set(source, images, keep, held, times, sharpness, focal_px, ordered=True)
    return replace(frames, quarter_turns=reader.quarter_turns)


def _measure_video(
    reader: VideoReader, config: FramesConfig, progress: Progress
) -> tuple[FrameStats, list[float], set[int]]:
    """Pass 1: measure frames; return their measurements, the times of all frames, the numbers of smeared ones."""
    progress.start(reader.announced_frames, "measuring frames")
    meter, times, smeared = MotionMeter(), [], set()
    stride = max(1, round(reader.nominal_fps / config.max_analysis_fps))
    # The announced rate of a variable-rate file may be wrong: only frames closer in time than this are skipped.
    spacing_s = 0.6 * stride / max(reader.nominal_fps, 1e-6) if stride > 1 else 0.0
    last = -np.inf
    for number, time_s, intact, frame in reader.frames():
        times.append(time_s)
        if not intact:
            smeared.add(number)
        held_out = number % HELD_OUT_EVERY == 0  # measured too, for continuous motion
        if held_out or stride == 1 or time_s - last >= spacing_s:
            meter.add(number, time_s, reader.to_gray(frame, ANALYSIS_SIDE_PX))
            last = time_s
        progress.advance()
    return meter.stats, times, smeared


def _without_smeared(
    stats: FrameStats, usable: np.ndarray, smeared: set[int], config: FramesConfig, progress: Progress
) -> tuple[np.ndarray, set[int]]:
    """Exclude frames smeared by damaged data from the usable ones, unless too few would be left."""
    if not smeared:
        return usable, smeared
    intact = usable & ~np.isin(stats.indices, list(smeared))
    if intact.sum() < max(config.min_keyframes // 2, 0.3 * usable.sum()):
        progress.note(
            f"{len(smeared)} frames after damaged data may be smeared; still used: others are too few"
        )
        return usable, set()
    progress.note(f"{len(smeared)} frames after damaged data are smeared: not used")
    return intact, smeared


def _without_held_out(
    stats: FrameStats, usable: np.ndarray, config: FramesConfig, progress: Progress
) -> np.ndarray:
    """Exclude held-out frames and their repeats from the usable ones, bool (n,)."""
    held_out = np.array(stats.indices) % HELD_OUT_EVERY == 0
    repeats = repeats_of(stats, held_out) & usable
    without = usable & ~held_out & ~repeats
    if repeats.any() and len(choose_keyframes(stats, without, _spacing(config))) < config.min_keyframes // 2:
        progress.note(f"{int(repeats.sum())} frames repeat held-out ones; still used: others are too few")
        return usable & ~held_out
    return without


def _decode_chosen(
    reader: VideoReader, wanted: set[int], config: FramesConfig, progress: Progress
) -> dict[int, np.ndarray]:
    """Pass 2: decode the wanted frames; upright RGB images by frame number."""
    progress.start(len(wanted), "decoding keyframes")
    images: dict[int, np.ndarray] = {}
    last = max(wanted)
    for number, _, _, frame in reader.frames():
        if number in wanted:
            images[number] = reader.to_rgb(frame, config.max_side_px)
            progress.advance()
        if number >= last:
            break
    return images


def _note_decoding(reader: VideoReader, decoded: int, progress: Progress) -> str:
    """Note properties of the file, and return a description of its damage or ""; raise `InputError` without frames."""
    if decoded == 0:
        raise InputError(
            f"frames: no frame of {reader.path} can be decoded. It was cut off or damaged, or its codec "
            "is not supported: copy it again, or convert it to H.264 mp4."
        )
    damage = ""
    if reader.damaged_packets or decoded < 0.98 * reader.announced_frames:
        announced = f" of {reader.announced_frames} announced" if reader.announced_frames else ""
        damage = f"{decoded} frames{announced} could be decoded"
        progress.note(f"the file is damaged or cut off: {damage}; going on with them")
    if reader.interlaced:
        progress.note("interlaced video: one field of every frame is used")
    if reader.high_dynamic_range:
        progress.note("high dynamic range video: converted to standard range")
    if reader.quarter_turns:
        progress.note(
            f"rotated by {360 - 90 * reader.quarter_turns} degrees clockwise, by the file's metadata"
        )
    return damage


# --- Folders of images ------------------------------------------------------------------------------------


def _from_folder(path: Path, config: FramesConfig, progress: Progress) -> FrameSet:
    folder = ImageFolder(path)
    progress.start(len(folder.files), "reading images")
    meter = MotionMeter()
    gray_size = working_size(folder.width, folder.height, ANALYSIS_SIDE_PX)
    for number in range(len(folder.files)):
        image = folder.load_rgb(number, config.max_side_px)
        if image is not None:
            gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
            meter.add(number, float(number), cv2.resize(gray, gray_size, interpolation=cv2.INTER_AREA))
        progress.advance()
    stats = meter.stats
    for note in folder.notes[:10]:
        progress.note(note)
    if len(folder.notes) > 10:
        progress.note(f"and {len(folder.notes) - 10} more images left out")
    ordered = _looks_ordered(stats)
    usable = _usable_frames(stats, len(stats.indices), config, str(path), progress, moving=ordered)
    held: list[int] = []
    if len(stats.indices) >= config.hold_out_images_from:
        held_out = np.array(stats.indices) % HELD_OUT_EVERY == 0
        usable[held_out] = False
        held = _spread(np.array(stats.indices)[held_out], config.max_held_out)
    else:
        progress.note(f"only {len(stats.indices)} images: none is held out, all are used")
    rows = np.flatnonzero(usable)
    if len(rows) > config.max_keyframes and ordered:
        rows = choose_keyframes(stats, usable, _spacing(config))
    elif len(rows) > config.max_keyframes:
        rows = np.array(_spread(rows, config.max_keyframes))
    _require_enough(len(rows), config, str(path))
    keep = [stats.indices[r] for r in rows]
    loaded = ((i, folder.load_rgb(i, config.max_side_px)) for i in (*keep, *held))
    images = {i: image for i, image in loaded if image is not None}
    count = len(folder.files)
    source = VideoSource(str(path), folder.sha256(), folder.width, folder.height, 1.0, count, float(count))
    progress.note(
        f"{len(keep)} of {count} images chosen, {len(held)} held out for evaluation; "
        + ("neighbors in name order look alike" if ordered else "in no particular order")
    )
    sharpness = [stats.sharpness[r] for r in rows]
    focal_px = folder.focal_prior_px(config.max_side_px)
    return _frame_set(source, images, keep, held, range(count), sharpness, focal_px, ordered=ordered)


def _from_export(export: Export, config: FramesConfig, progress: Progress) -> FrameSet:
    """Load the images of a phone app's export, turned upright according to its poses."""
    turns = polycam_turns(export) if export.kind == "polycam" else 0
    app = {"polycam": "Polycam", "record3d": "Record3D"}[export.kind]
    progress.note(f"an export of {app}: its {len(export.images)} images are the input, its poses are used")
    if turns:
        progress.note(f"images turned by {360 - 90 * turns} degrees clockwise, as their poses say")
    with tempfile.TemporaryDirectory() as scratch:
        frames = _from_folder(export.unpack_images(Path(scratch)), config, progress)
    source = replace(frames.source, file=str(export.path))
    if turns % 2:
        source = replace(source, width=source.height, height=source.width)
    images, held_out = (
        np.ascontiguousarray(np.rot90(x, turns, axes=(1, 2))) for x in (frames.images, frames.held_out_images)
    )
    return replace(frames, source=source, images=images, held_out_images=held_out)


def _looks_ordered(stats: FrameStats) -> bool:
    """Tell whether most neighbors in name order overlap."""
    similarity = np.array(stats.similarity[1:])
    return bool(len(similarity) > 0 and np.mean(similarity > 0.4) > 0.7)


# --- Shared -----------------------------------------------------------------------------------------------


def _spacing(config: FramesConfig) -> Spacing:
    c = config
    return Spacing(c.step, c.min_keyframes, c.max_keyframes, c.blurred_below, c.widest_gap)


def _frame_set(
    source: VideoSource,
    images: dict[int, np.ndarray],
    keep: list[int],
    held: list[int],
    times: Sequence[float],
    sharpness: list[float],
    focal_px: float,
    *,
    ordered: bool,
) -> FrameSet:
    """Collect the artifact; `images` and `times` are by frame number, `sharpness` is of the keyframes."""
    nothing = np.zeros((0, *images[keep[0]].shape), np.uint8)
    return FrameSet(
        source=source,
        images=np.stack([images[i] for i in keep]),
        indices=np.array(keep, np.int32),
        times_s=np.array([times[i] for i in keep], np.float64),
        sharpness=np.array(sharpness, np.float32),
        held_out_images=np.stack([images[i] for i in held]) if held else nothing,
        held_out_indices=np.array(held, np.int32),
        held_out_times_s=np.array([times[i] for i in held], np.float64),
        focal_prior_px=focal_px,
        ordered=ordered,
    )


def _spread(numbers: np.ndarray, most: int) -> list[int]:
    """Return at most `most` of the numbers (n,), spread evenly."""
    if len(numbers) <= most:
        return [int(i) for i in numbers]
    return [int(i) for i in numbers[np.linspace(0, len(numbers) - 1, most).round().astype(int)]]


def _usable_frames(
    stats: FrameStats,
    decoded: int,
    config: FramesConfig,
    name: str,
    progress: Progress,
    *,
    moving: bool = True,
) -> np.ndarray:
    """Return which analyzed frames have texture, bool (n,); raise `InputError` for too few, blank or static inputs."""
    if decoded == 1:
        raise InputError(
            f"frames: {name} is a single image. Give a video of 5 to 60 s, or at least 20 images."
        )
    if decoded < config.min_usable_frames:
        raise InputError(
            f"frames: {name} has only {decoded} frames, too few for a scene. Film for 5 to 60 s while "
            "walking around the things, or give at least 20 images."
        )
    texture, brightness = np.array(stats.texture), np.array(stats.brightness)
    usable = texture >= 0.02
    if usable.mean() < 0.1 or usable.sum() < config.min_usable_frames:
        what = (
            "is black: nothing can be seen. Take off the lens cover or turn on the light"
            if np.median(brightness) < 16
            else "shows nothing but blank surfaces (no texture to follow). "
            "Film things and their surroundings from 1 to 3 m"
        )
        raise InputError(f"frames: {name} {what}, and film again.")
    if not usable.all():
        progress.note(f"{int((~usable).sum())} of {len(usable)} frames are blank or black: not used")
    position = np.array(stats.position)[usable]
    if moving and position[-1] - position[0] < config.still_below:
        raise InputError(
            f"frames: the camera of {name} stands still. Depth needs motion: film again while walking "
            "around the things, at least half a circle or a few steps sideways."
        )
    return usable


def _require_enough(count: int, config: FramesConfig, name: str) -> None:
    if count < config.min_usable_frames:
        raise InputError(
            f"frames: only {count} different frames of {name} can be used (need {config.min_usable_frames}). "
            "Film for 5 to 60 s while walking slowly around the things."
        )
