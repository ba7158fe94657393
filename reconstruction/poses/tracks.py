"""Track points through all frames of a film where few features match between its keyframes.

Plain walls, blur and a camera that turns on the spot leave some fifty SIFT matches between neighbors, which is too few
for exact cameras. Corners, also weak ones, are followed from frame to frame by pyramidal Lucas-Kanade optical flow
(Bouguet 2001) forward and backward, and aligned with the keyframe before, so that they do not drift in between. They
become features without a descriptor, matched by their track.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.core.types import FrameSet
from reconstruction.frames.config import HELD_OUT_EVERY
from reconstruction.frames.gray_frames import gray_frames
from reconstruction.poses.colmap_types import ColmapCamera
from reconstruction.poses.config import PosesConfig
from reconstruction.poses.features import Features
from reconstruction.poses.pairs import VerifiedPair, verify_matches
from reconstruction.poses.parallel import ordered_map

_CELLS = 27  # along the longer image side; one point is followed in each
_LEAST_CORNER = 2e-6  # smaller eigenvalue of the gradient matrix
_LEAST_RATIO = 0.1  # of the eigenvalues: points slide along edges (Lowe 2004 has the same bound for SIFT)
_BORDER_PX = 8
_WINDOW_PX = 15
_LEVELS = 4  # of the image pyramid; 1 where the place is nearly known
_CLOSED_PX = 0.4  # largest distance of a point followed there and back
_DRIFT_PX = 2.5  # largest correction by the keyframe before
_LEAST_KEYFRAMES = 3  # of a track
_MAX_FPS = 30.0  # frames closer in time are left out


@dataclass
class Tracks:
    """Points followed through a film: for each keyframe with any, their numbers int64 (k,) and pixels (k, 2)."""

    numbers: dict[int, np.ndarray] = field(default_factory=dict)
    pixels: dict[int, np.ndarray] = field(
        default_factory=dict
    )  # float32; the first pixel's center is (0.5, 0.5)

    def long_ones(self) -> "Tracks":
        """Return those that at least `_LEAST_KEYFRAMES` keyframes show."""
        if not self.numbers:
            return self
        seen = np.bincount(np.concatenate(list(self.numbers.values())))
        out = Tracks()
        for row, numbers in self.numbers.items():
            kept = seen[numbers] >= _LEAST_KEYFRAMES
            out.numbers[row], out.pixels[row] = numbers[kept], self.pixels[row][kept]
        return out


def with_tracks(
    frames: FrameSet,
    features: list[Features],
    pairs: list[VerifiedPair],
    camera: ColmapCamera,
    config: PosesConfig,
    progress: Progress,
) -> tuple[list[Features], list[VerifiedPair]]:
    """Add tracked points to the features, and their matches to the pairs near in time, where pairs have few matches.

    Args:
        frames: keyframes of a video; others are returned as they are.
        features: of the keyframes.
        pairs: verified ones.
        camera: shared by the frames.
        config: `min_neighbor_matches` says what few matches are.
        progress: receives steps, and a note if the film cannot be read again.
    """
    weak = _weak_rows(len(features), pairs, config.min_neighbor_matches)
    source = Path(frames.source.file)
    if not frames.ordered or not weak.any():
        return features, pairs
    if not source.exists():
        progress.note(f"poses: {source} is gone: no points are followed between keyframes with few matches")
        return features, pairs
    tracks = follow(frames, weak, _frames_between(source, frames, weak), progress).long_ones()
    joined = [_joined(row, feature, tracks) for row, feature in enumerate(features)]
    found = {pair.rows: pair for pair in pairs}

    def extended(rows: tuple[int, int]) -> VerifiedPair | None:
        i, j = rows
        pair = found.get(rows)
        _, a, b = np.intersect1d(
            tracks.numbers[i], tracks.numbers[j], assume_unique=True, return_indices=True
        )
        if not len(a):
            return pair
        offsets = len(features[i].keypoints), len(features[j].keypoints)
        matches = (np.stack([a, b], axis=1) + offsets).astype(np.uint32)
        if pair is not None:
            matches = np.concatenate([pair.matches, matches])
        return verify_matches(rows, joined[i], joined[j], matches, camera, config) or pair

    near = [
        (i, j)
        for i in sorted(tracks.numbers)
        for j in range(i + 1, i + 1 + config.sequential_overlap)
        if j in tracks.numbers
    ]
    found |= {pair.rows: pair for pair in ordered_map(extended, near) if pair is not None}
    return joined, [found[rows] for rows in sorted(found)]


def _weak_rows(count: int, pairs: list[VerifiedPair], least: int) -> np.ndarray:
    """Return which keyframes, bool (count,), have fewer than `least` matches with a neighbor in time."""
    matches = np.zeros(max(count - 1, 0), int)
    for pair in pairs:
        if pair.rows[1] == pair.rows[0] + 1:
            matches[pair.rows[0]] = len(pair.matches)
    out = np.zeros(count, bool)
    out[:-1] |= matches < least
    out[1:] |= matches < least
    return out


def _frames_between(source: Path, frames: FrameSet, rows: np.ndarray) -> Iterable[tuple[int, np.ndarray]]:
    """Yield number and gray image uint8 (h, w) of the frames from keyframe to keyframe of `rows`, bool (n,).

    Held-out frames are left out: no cameras depend on them.
    """
    key, numbers = set(frames.indices.tolist()), frames.indices
    stride = max(1, round(frames.source.fps / _MAX_FPS))
    wanted = set(numbers[rows].tolist())
    for row in np.flatnonzero(rows[:-1] & rows[1:]):
        between = range(int(numbers[row]) + 1, int(numbers[row + 1]))
        wanted |= {n for n in between if n % HELD_OUT_EVERY and (n % stride == 0 or n in key)}
    height, width = frames.images.shape[1:3]
    return gray_frames(source, wanted, max(width, height))


def follow(
    frames: FrameSet, rows: np.ndarray, images: Iterable[tuple[int, np.ndarray]], progress: Progress
) -> Tracks:
    """Follow corners through gray images; return where the keyframes show them.

    Args:
        frames: keyframes.
        rows: bool (n,) the keyframes in question. Tracks end where a keyframe is none of them.
        images: (frame number, gray uint8 (h, w)) in time order, with those keyframes and frames between them.
        progress: receives a step for each of the keyframes.
    """
    row_of = {int(number): row for row, number in enumerate(frames.indices) if rows[row]}
    progress.start(len(row_of), "following points")
    out = Tracks()
    pixels, numbers = np.zeros((0, 2), np.float32), np.zeros(0, np.int64)
    before = keyframe = None
    count, last_row = 0, -2
    for number, gray in images:
        if before is not None and len(pixels):
            pixels, kept = _flow(before, gray, pixels)
            pixels, numbers = pixels[kept], numbers[kept]
        before = gray
        if number not in row_of:
            continue
        row = row_of[number]
        if row != last_row + 1:
            pixels, numbers, keyframe = pixels[:0], numbers[:0], None
        if keyframe is not None and len(pixels):
            pixels, kept = _aligned(keyframe, gray, pixels, numbers)
            pixels, numbers = pixels[kept], numbers[kept]
        new = _corners(gray, pixels)
        pixels = np.concatenate([pixels, new])
        numbers = np.concatenate([numbers, count + np.arange(len(new))])
        count, last_row, keyframe = count + len(new), row, (gray, numbers, pixels)
        out.numbers[row], out.pixels[row] = numbers, pixels + np.float32(0.5)
        progress.advance()
    return out


def _flow(
    first: np.ndarray, second: np.ndarray, pixels: np.ndarray, guess: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Follow pixels (k, 2) from one image to another; return where they are there, and which came back, bool (k,)."""
    settings: Any = {
        "winSize": (_WINDOW_PX, _WINDOW_PX),
        "maxLevel": _LEVELS if guess is None else 1,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01),
        "flags": 0 if guess is None else cv2.OPTFLOW_USE_INITIAL_FLOW,
    }
    start: Any = None if guess is None else guess.copy()
    there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, pixels, start, **settings)
    start = None if guess is None else pixels.copy()
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(second, first, there, start, **settings)
    height, width = second.shape
    inside = (there > _BORDER_PX / 2).all(1) & (there < np.array([width, height]) - _BORDER_PX / 2).all(1)
    closed = np.linalg.norm(back - pixels, axis=1) < _CLOSED_PX
    return there, (found.ravel() > 0) & (found_back.ravel() > 0) & closed & inside


def _aligned(
    keyframe: tuple[np.ndarray, np.ndarray, np.ndarray],
    gray: np.ndarray,
    pixels: np.ndarray,
    numbers: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Align points (k, 2) with the keyframe before, which shows all of them; return pixels, and which fit it."""
    image, its_numbers, its_pixels = keyframe
    there, kept = _flow(image, gray, its_pixels[np.searchsorted(its_numbers, numbers)], pixels)
    return there, kept & (np.linalg.norm(there - pixels, axis=1) < _DRIFT_PX)


def _corners(gray: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return the best corner float32 (k, 2) of each image cell without one of the pixels (n, 2)."""
    cell = max(4, round(max(gray.shape) / _CELLS))
    rows, columns = (side // cell for side in gray.shape)
    eigen = cv2.cornerEigenValsAndVecs(cv2.GaussianBlur(gray, (0, 0), 1.0), 7, ksize=3)[..., :2]
    strength = eigen.min(-1)
    strength[strength < _LEAST_RATIO * eigen.max(-1)] = 0
    strength[:_BORDER_PX] = strength[-_BORDER_PX:] = 0
    strength[:, :_BORDER_PX] = strength[:, -_BORDER_PX:] = 0
    blocks = strength[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell)
    blocks = blocks.swapaxes(1, 2).reshape(rows, columns, -1)
    wanted = blocks.max(-1) > _LEAST_CORNER
    at = (pixels / cell).astype(int)
    at = at[(at[:, 0] < columns) & (at[:, 1] < rows)]
    wanted[at[:, 1], at[:, 0]] = False
    y, x = np.nonzero(wanted)
    best = blocks.argmax(-1)[wanted]
    return np.stack([x * cell + best % cell, y * cell + best // cell], axis=1).astype(np.float32)


def _joined(row: int, features: Features, tracks: Tracks) -> Features:
    """Append a keyframe's tracked points to its features: of size 0, with a descriptor that matches nothing."""
    if row not in tracks.numbers:
        return features
    pixels = tracks.pixels[row]
    return replace(
        features,
        keypoints=np.concatenate([features.keypoints, pixels]),
        sizes=np.concatenate([features.sizes, np.zeros(len(pixels), np.float32)]),
        descriptors=np.concatenate([features.descriptors, np.zeros((len(pixels), 128), np.float32)]),
    )
