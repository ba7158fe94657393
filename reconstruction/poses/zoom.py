"""Find where a film changes its focal length: zoom, or another lens.

Structure from motion with one camera explains a zoom as motion, and registers every frame at a wrong place. A change of
scale between neighbors in time raises suspicion; then the frames are mapped with a focal length of their own each.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.core.types import FrameSet
from reconstruction.poses import diagnose, mapping
from reconstruction.poses.colmap_types import ColmapCamera
from reconstruction.poses.config import PosesConfig
from reconstruction.poses.features import Features
from reconstruction.poses.pairs import VerifiedPair
from registry.errors import InputError

_SUSPICIOUS_SCALE = 1.25  # within `_ZOOM_S`; lenses of phones differ by 2 and more
_ZOOM_S = 2.0  # a zoom is done in less
_MAX_MAPPED = 100  # frames with focal lengths of their own; thinner films fall apart
_SAME_FOCAL = 1.05  # largest ratio within a part; the focal lengths of generated films scatter by up to 1.03
_LEAST_REGISTERED = 0.8  # of the mapped frames; with fewer the focal lengths prove nothing


@dataclass(frozen=True)
class Part:
    """Frames in a row with one focal length, and the smallest and largest focal length of the film."""

    first: int
    last: int  # inclusive
    focal_px: tuple[float, float]


def search_zoom(
    frames: FrameSet,
    features: list[Features],
    pairs: list[VerifiedPair],
    camera: ColmapCamera,
    config: PosesConfig,
    work_dir: Path,
) -> Part | None:
    """Return the longest part with one focal length; None where the film has one, or is a set of pictures."""
    if not frames.ordered or not _scale_changes(frames.times_s, features, pairs):
        return None
    return _longest_part(features, pairs, camera, config, work_dir)


def cut_to_part(
    part: Part, frames: FrameSet, features: list[Features], pairs: list[VerifiedPair], progress: Progress
) -> tuple[FrameSet, list[Features], list[VerifiedPair]]:
    """Return frames, features and pairs of a part.

    Raises:
        InputError: it has too few frames.
    """
    low, high = part.focal_px
    start_s, end_s = frames.times_s[part.first], frames.times_s[part.last]
    found = (
        f"poses: the zoom or the lens changes during the film (focal length {low:.0f} to {high:.0f} px); the "
        f"longest part with one focal length is {start_s:.1f}-{end_s:.1f} s"
    )
    if part.last - part.first + 1 < diagnose.MIN_FRAMES:
        raise InputError(f"{found}, too short. Film again with one lens and without zoom.")
    progress.note(f"{found}, and only that is used. To have all of it, film with one lens and without zoom")
    rows = np.arange(part.first, part.last + 1)
    kept = [
        replace(pair, rows=(pair.rows[0] - part.first, pair.rows[1] - part.first))
        for pair in pairs
        if part.first <= min(pair.rows) and max(pair.rows) <= part.last
    ]
    return _selected(frames, rows), features[part.first : part.last + 1], kept


def _scale_changes(times_s: np.ndarray, features: list[Features], pairs: list[VerifiedPair]) -> bool:
    """Tell whether matched features grow or shrink by `_SUSPICIOUS_SCALE` within `_ZOOM_S` or between neighbors."""
    step = np.zeros(len(features))
    for pair in pairs:
        i, j = pair.rows
        if j == i + 1:
            a, b = features[i].sizes[pair.matches[:, 0]], features[j].sizes[pair.matches[:, 1]]
            step[j] = np.median(np.log(b / a))
    total = np.cumsum(step)
    soon = np.abs(np.subtract.outer(times_s, times_s)) <= _ZOOM_S
    change = np.where(soon, np.abs(np.subtract.outer(total, total)), 0.0)
    return max(change.max(), np.abs(step).max()) >= np.log(_SUSPICIOUS_SCALE)


def _longest_part(
    features: list[Features],
    pairs: list[VerifiedPair],
    camera: ColmapCamera,
    config: PosesConfig,
    work_dir: Path,
) -> Part | None:
    """Map some frames with own focal lengths; return the longest part with one, None where all have the same."""
    stride = -(-len(features) // _MAX_MAPPED)
    rows = np.arange(0, len(features), stride)
    chosen = [
        replace(pair, rows=(pair.rows[0] // stride, pair.rows[1] // stride))
        for pair in pairs
        if pair.rows[0] % stride == 0 and pair.rows[1] % stride == 0
    ]
    folder = work_dir / "zoom"
    folder.mkdir(parents=True, exist_ok=True)
    database = folder / "database.db"
    database.unlink(missing_ok=True)
    shown = [features[r] for r in rows]
    mapping.write_database(database, camera, shown, chosen, own_cameras=True)
    models = mapping.incremental_models(database, shown, chosen, camera, config, NO_PROGRESS)
    if not models or models[0].num_reg_images() < _LEAST_REGISTERED * len(rows):
        return None
    model = models[0]
    ids = sorted(model.reg_image_ids())
    focal = np.array([model.cameras[model.image(i).camera_id].focal_length for i in ids])
    first, last = longest_run(focal, _SAME_FOCAL)
    outside = np.delete(focal, np.arange(first, last + 1))
    # One frame alone may have a badly determined focal length.
    if len(outside) < 2 or np.ptp(np.log([np.median(outside), np.median(focal[first : last + 1])])) < np.log(
        _SUSPICIOUS_SCALE
    ):
        return None
    low, high = np.quantile(focal, [0.05, 0.95])
    return Part(int(rows[ids[first] - 1]), int(rows[ids[last] - 1]), (float(low), float(high)))


def longest_run(values: np.ndarray, ratio: float) -> tuple[int, int]:
    """Return first and last index of the longest run of values (n,) that differ by at most a factor of `ratio`."""
    best, start = (0, 0), 0
    for end in range(len(values)):
        while values[start : end + 1].max() > ratio * values[start : end + 1].min():
            start += 1
        if end - start > best[1] - best[0]:
            best = start, end
    return best


def _selected(frames: FrameSet, rows: np.ndarray) -> FrameSet:
    """Return the keyframes of the given rows, and the held-out frames between them."""
    times = frames.times_s[rows]
    held = (frames.held_out_times_s >= times[0]) & (frames.held_out_times_s <= times[-1])
    return replace(
        frames,
        images=frames.images[rows],
        indices=frames.indices[rows],
        times_s=times,
        sharpness=frames.sharpness[rows],
        held_out_images=frames.held_out_images[held],
        held_out_indices=frames.held_out_indices[held],
        held_out_times_s=frames.held_out_times_s[held],
    )
