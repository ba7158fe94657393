"""Choose keyframes: measure sharpness, texture and motion of small gray frames, thin them along the motion.

Motion is measured against a reference frame that is replaced once the view has moved on, so that sensor
noise of a camera that stands still does not add up to a path, and repeated frames do not advance it.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np

ANALYSIS_SIDE_PX = 480  # sharpness is measured here
_TRACK_SIDE_PX = 240  # texture and motion are measured here
_MOVED_ON = 0.03  # displacement (share of the longer side) that replaces the reference
_LOST_STEP = 0.08  # what a jump too large to track counts as
_TEXTURED_EIGENVALUE = (
    6e-5  # of the gradient matrix; sensor noise of a blank wall stays below after averaging
)


@dataclass
class FrameStats:
    """What pass 1 knows of each analysed frame, in time order."""

    indices: list[int] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    sharpness: list[float] = field(default_factory=list)  # variance of the Laplacian
    brightness: list[float] = field(default_factory=list)  # mean gray
    texture: list[float] = field(default_factory=list)  # share of image blocks with a corner in them
    position: list[float] = field(
        default_factory=list
    )  # path in shares of the longer image side, non-decreasing
    similarity: list[float] = field(default_factory=list)  # share of points tracked from the reference
    change: list[float] = field(default_factory=list)  # mean gray difference from the frame before


class MotionMeter:
    """Feed it gray frames in time order; it fills a `FrameStats`."""

    def __init__(self) -> None:
        """Start without a reference."""
        self.stats = FrameStats()
        self._reference: np.ndarray | None = None
        self._points: np.ndarray | None = None
        self._at_reference = 0.0
        self._lost_in_a_row = 0
        self._before: np.ndarray | None = None

    def add(self, index: int, time_s: float, gray: np.ndarray) -> None:
        """Measure one frame: uint8 (h, w), longer side about ANALYSIS_SIDE_PX."""
        s = self.stats
        scale = _TRACK_SIDE_PX / max(gray.shape)
        size = (max(16, round(gray.shape[1] * scale)), max(16, round(gray.shape[0] * scale)))
        small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
        s.indices.append(index)
        s.times_s.append(time_s)
        s.sharpness.append(float(cv2.Laplacian(gray, cv2.CV_32F).var()))
        s.brightness.append(float(gray.mean()))
        s.texture.append(_textured_share(small))
        position, similarity = self._move(small)
        s.position.append(max(position, s.position[-1] if s.position else 0.0))
        s.similarity.append(similarity)
        s.change.append(255.0 if self._before is None else float(cv2.absdiff(small, self._before).mean()))
        self._before = small

    def _move(self, small: np.ndarray) -> tuple[float, float]:
        if self._reference is None:
            self._anchor(small, 0.0)
            return 0.0, 1.0
        shift, share = self._displacement(small)
        if share < 0.4:
            # One blurred frame in between must not break the chain: wait before giving the reference up.
            self._lost_in_a_row += 1
            if self._lost_in_a_row < 3:
                return self._at_reference, share
            shift = _LOST_STEP
        position = self._at_reference + shift
        if shift > _MOVED_ON or share < 0.6:
            self._anchor(small, position)
        self._lost_in_a_row = 0
        return position, share

    def _anchor(self, small: np.ndarray, position: float) -> None:
        self._reference, self._at_reference = small, position
        self._points = cv2.goodFeaturesToTrack(small, 160, 0.01, 6)

    def _displacement(self, small: np.ndarray) -> tuple[float, float]:
        """Return (median displacement from the reference by the longer side, share of points tracked)."""
        if self._points is None or len(self._points) < 8:
            self._points = cv2.goodFeaturesToTrack(self._reference, 160, 0.01, 6)
            if self._points is None or len(self._points) < 8:
                self._anchor(small, self._at_reference)
                return 0.0, 1.0
        settings = {"winSize": (15, 15), "maxLevel": 3}
        there, found, _ = cv2.calcOpticalFlowPyrLK(self._reference, small, self._points, None, **settings)
        back, found_back, _ = cv2.calcOpticalFlowPyrLK(small, self._reference, there, None, **settings)
        closes = np.linalg.norm((back - self._points).reshape(-1, 2), axis=1) < 1.0
        good = (found.ravel() > 0) & (found_back.ravel() > 0) & closes
        if good.sum() < 6:
            return 0.0, 0.0
        moved = np.linalg.norm((there - self._points).reshape(-1, 2)[good], axis=1)
        return float(np.median(moved)) / max(small.shape), float(good.mean())


def _textured_share(small: np.ndarray) -> float:
    """Share of 16x16 blocks that hold at least one corner which noise would not make."""
    smooth = cv2.GaussianBlur(small, (0, 0), 1.0)
    strength = cv2.cornerMinEigenVal(smooth, 5, 3)
    rows, columns = strength.shape[0] // 16 * 16, strength.shape[1] // 16 * 16
    blocks = strength[:rows, :columns].reshape(rows // 16, 16, columns // 16, 16).max(axis=(1, 3))
    return float((blocks > _TEXTURED_EIGENVALUE).mean())


def repeats_of(stats: FrameStats, originals: np.ndarray, same_below: float = 0.25) -> np.ndarray:
    """Return which frames (n,) bool are the same picture as one of `originals` (n,) bool."""
    run = np.cumsum(np.array(stats.change) >= same_below)
    return np.isin(run, run[originals]) & ~originals


def relative_sharpness(stats: FrameStats, window_s: float = 0.75) -> np.ndarray:
    """Return sharpness (n,) relative to the sharp frames (80th percentile) around each; about 1 is sharp."""
    sharpness, times = np.array(stats.sharpness), np.array(stats.times_s)
    out = np.ones(len(sharpness))
    low = np.searchsorted(times, times - window_s)
    high = np.searchsorted(times, times + window_s, side="right")
    for i in range(len(sharpness)):
        # At least five neighbours, also where frames are few or irregular.
        a, b = min(low[i], max(i - 2, 0)), max(high[i], min(i + 3, len(sharpness)))
        out[i] = sharpness[i] / max(float(np.percentile(sharpness[a:b], 80)), 1e-9)
    return out


@dataclass(frozen=True)
class Spacing:
    """How densely keyframes follow the motion."""

    step: float  # wanted displacement between keyframes, share of the longer side
    fewest: int
    most: int
    blurred_below: float  # relative sharpness under which a frame is avoided
    widest_gap: float  # a blurred frame is kept where leaving it out would open a wider gap than this


def choose_keyframes(stats: FrameStats, usable: np.ndarray, spacing: Spacing) -> np.ndarray:
    """Return rows of `stats`, ascending, chosen among those where `usable` (n,) bool holds.

    The path is cut into equal cells; each gives its sharpest frame. Frames that repeat a chosen one have
    its place on the path and are never chosen beside it.
    """
    rows = np.flatnonzero(usable)
    position = np.array(stats.position)[rows]
    quality = relative_sharpness(stats)[rows]
    if len(rows) == 0:
        return rows
    length = float(position[-1] - position[0])
    if length <= 0:
        return rows[[int(np.argmax(quality))]]
    distinct = 1 + int((np.diff(position) > 1e-3).sum())
    wanted = int(np.clip(round(length / spacing.step), spacing.fewest, spacing.most))
    target = min(wanted, distinct)
    cells = wanted
    chosen = _sharpest_per_cell(position, quality, cells)
    # Motion is uneven: fast parts leave cells empty, so finer cells may be needed to reach the count.
    while len(chosen) < target and cells < 40 * wanted:
        cells = int(cells * 1.15) + 1
        finer = _sharpest_per_cell(position, quality, cells)
        if len(finer) > spacing.most:
            break
        chosen = finer
    return rows[_without_blurred(chosen, position, quality, spacing)]


def _sharpest_per_cell(position: np.ndarray, quality: np.ndarray, cells: int) -> np.ndarray:
    start, length = position[0], position[-1] - position[0]
    coordinate = (position - start) / length * cells
    cell = np.minimum(coordinate.astype(int), cells - 1)
    # Of equally sharp frames the one nearest to the middle of its cell keeps the spacing even.
    score = np.minimum(quality, 1.3) - 0.25 * np.abs(coordinate - cell - 0.5)
    order = np.lexsort((-score, cell))
    first = np.concatenate([[True], np.diff(cell[order]) > 0])
    chosen = np.sort(order[first])
    # Two chosen frames on either side of a cell's border may still be the same picture.
    keep = [chosen[0]]
    for row in chosen[1:]:
        if position[row] - position[keep[-1]] > 1e-3:
            keep.append(row)
        elif quality[row] > quality[keep[-1]]:
            keep[-1] = row
    return np.array(keep)


def _without_blurred(
    chosen: np.ndarray, position: np.ndarray, quality: np.ndarray, spacing: Spacing
) -> np.ndarray:
    keep = list(chosen)
    for row in sorted((r for r in chosen if quality[r] < spacing.blurred_below), key=lambda r: quality[r]):
        at = keep.index(row)
        before = position[keep[at - 1]] if at > 0 else position[row]
        after = position[keep[at + 1]] if at + 1 < len(keep) else position[row]
        if after - before <= spacing.widest_gap and len(keep) > 2:
            keep.pop(at)
    return np.array(keep)
