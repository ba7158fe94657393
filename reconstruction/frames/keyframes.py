"""Select keyframes: measure sharpness, texture and motion of small gray frames, sample them along the motion.

Motion is the optical flow from a reference frame, which is replaced once the view has moved enough. Sensor noise of a
camera at rest and repeated frames therefore do not accumulate. Parallax is the part of the flow that no rotation of the
camera explains. Depth comes from parallax alone, so that keyframes are spaced by it: a person who turns on the spot
gives few of them, a person who walks gives many (as VINS-Mono chooses keyframes: Qin et al., T-RO 2018).
"""

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

ANALYSIS_SIDE_PX = 480  # sharpness is measured here
_TRACK_SIDE_PX = 240  # texture and motion are measured here
_MOVED_ON = 0.03  # displacement (share of the longer side) at which the reference is replaced
_LOST_STEP = 0.08  # displacement assumed where tracking fails, half of it parallax
_PARALLAX_PERCENTILE = 75.0  # of the points: most lie on what is explained with the rotation
_FLOW_SHARE = 0.25  # weight of displacement beside parallax in the spacing of keyframes
_SAME = 1e-3  # displacement (share of the longer side) up to which frames repeat each other
_TEXTURED_EIGENVALUE = 6e-5  # of the gradient matrix; smoothed noise of a blank wall is below


@dataclass
class FrameStats:
    """Measurements of each analyzed frame, in time order."""

    indices: list[int] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    sharpness: list[float] = field(default_factory=list)  # variance of the Laplacian
    brightness: list[float] = field(default_factory=list)  # mean gray
    texture: list[float] = field(default_factory=list)  # share of image blocks with a corner in them
    # accumulated displacement in shares of the longer side, non-decreasing
    position: list[float] = field(default_factory=list)
    parallax: list[float] = field(default_factory=list)  # the part of it that no rotation explains
    similarity: list[float] = field(default_factory=list)  # share of points tracked from the reference
    change: list[float] = field(default_factory=list)  # mean gray difference to the frame before


class MotionMeter:
    """Measures gray frames, given in time order, into a `FrameStats`."""

    def __init__(self) -> None:
        """Start without a reference."""
        self.stats = FrameStats()
        self._reference: np.ndarray | None = None
        self._points: np.ndarray | None = None
        self._at_reference = np.zeros(2)  # accumulated displacement and parallax
        self._lost_in_a_row = 0
        self._before: np.ndarray | None = None

    def add(self, index: int, time_s: float, gray: np.ndarray) -> None:
        """Measure a gray frame uint8 (h, w), its longer side about `ANALYSIS_SIDE_PX`."""
        s = self.stats
        scale = _TRACK_SIDE_PX / max(gray.shape)
        size = (max(16, round(gray.shape[1] * scale)), max(16, round(gray.shape[0] * scale)))
        small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
        s.indices.append(index)
        s.times_s.append(time_s)
        s.sharpness.append(float(cv2.Laplacian(gray, cv2.CV_32F).var()))
        s.brightness.append(float(gray.mean()))
        s.texture.append(_textured_share(small))
        (position, parallax), similarity = self._move(small)
        s.position.append(max(position, s.position[-1] if s.position else 0.0))
        s.parallax.append(max(parallax, s.parallax[-1] if s.parallax else 0.0))
        s.similarity.append(similarity)
        s.change.append(255.0 if self._before is None else float(cv2.absdiff(small, self._before).mean()))
        self._before = small

    def _move(self, small: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the accumulated displacement and parallax (2,) and the share of points tracked."""
        if self._reference is None:
            self._anchor(small, self._at_reference)
            return self._at_reference, 1.0
        shift, share = self._displacement(small)
        if share < 0.4:
            # A single blurred frame must not end the track: keep the reference for two more frames.
            self._lost_in_a_row += 1
            if self._lost_in_a_row < 3:
                return self._at_reference, share
            shift = np.array([_LOST_STEP, _LOST_STEP / 2])
        position = self._at_reference + shift
        if shift[0] > _MOVED_ON or share < 0.6:
            self._anchor(small, position)
        self._lost_in_a_row = 0
        return position, share

    def _anchor(self, small: np.ndarray, position: np.ndarray) -> None:
        self._reference, self._at_reference = small, position
        self._points = cv2.goodFeaturesToTrack(small, 160, 0.01, 6)

    def _displacement(self, small: np.ndarray) -> tuple[np.ndarray, float]:
        """Return median displacement and parallax (2,), shares of the longer side, and the share of points tracked."""
        assert self._reference is not None
        if self._points is None or len(self._points) < 8:
            self._points = cv2.goodFeaturesToTrack(self._reference, 160, 0.01, 6)
            if self._points is None or len(self._points) < 8:
                self._anchor(small, self._at_reference)
                return np.zeros(2), 1.0
        settings: Any = {"winSize": (15, 15), "maxLevel": 3, "nextPts": None}
        there, found, _ = cv2.calcOpticalFlowPyrLK(self._reference, small, self._points, **settings)
        back, found_back, _ = cv2.calcOpticalFlowPyrLK(small, self._reference, there, **settings)
        closes = np.linalg.norm((back - self._points).reshape(-1, 2), axis=1) < 1.0
        good = (found.ravel() > 0) & (found_back.ravel() > 0) & closes
        if good.sum() < 6:
            return np.zeros(2), 0.0
        side = max(small.shape)
        at = (self._points.reshape(-1, 2)[good] - np.array(small.shape[::-1]) / 2) / side
        flow = (there - self._points).reshape(-1, 2)[good] / side
        left = np.linalg.norm(flow - rotational_flow(at, flow), axis=1)
        shift = np.median(np.linalg.norm(flow, axis=1)), np.percentile(left, _PARALLAX_PERCENTILE)
        return np.array(shift), float(good.mean())


def rotational_flow(at: np.ndarray, flow: np.ndarray, focal: float = 1.0) -> np.ndarray:
    """Fit the flow (n, 2) at points (n, 2) by that of a rotating camera; return the fitted flow (n, 2).

    Least absolute deviation by reweighting: the rotation is that of most points (Longuet-Higgins and Prazdny 1980).
    Lengths are in shares of the longer image side, from the image's center. A phone's focal length is .7 to 1.1.
    """
    x, y = at.T / focal
    along_x = np.stack([x * y, -(1 + x * x), y], axis=1)
    along_y = np.stack([1 + y * y, -x * y, -x], axis=1)
    terms, wanted = focal * np.concatenate([along_x, along_y]), flow.T.reshape(-1)
    fitted = np.zeros_like(flow)
    for _ in range(8):
        left = np.linalg.norm(flow - fitted, axis=1)
        weight = np.tile(1 / np.sqrt(np.maximum(left, 1e-4)), 2)
        turn = np.linalg.lstsq(terms * weight[:, None], wanted * weight, rcond=None)[0]
        fitted = (terms @ turn).reshape(2, -1).T
    return fitted


def _textured_share(small: np.ndarray) -> float:
    """Return the share of 16x16 blocks with at least one corner stronger than noise."""
    smooth = cv2.GaussianBlur(small, (0, 0), 1.0)
    strength = cv2.cornerMinEigenVal(smooth, 5, ksize=3)
    rows, columns = strength.shape[0] // 16 * 16, strength.shape[1] // 16 * 16
    blocks = strength[:rows, :columns].reshape(rows // 16, 16, columns // 16, 16).max(axis=(1, 3))
    return float((blocks > _TEXTURED_EIGENVALUE).mean())


def repeats_of(stats: FrameStats, originals: np.ndarray, same_below: float = 0.25) -> np.ndarray:
    """Return which frames, bool (n,), repeat one of `originals`, bool (n,)."""
    run = np.cumsum(np.array(stats.change) >= same_below)
    return np.isin(run, run[originals]) & ~originals


def relative_sharpness(stats: FrameStats, window_s: float = 0.75) -> np.ndarray:
    """Return sharpness (n,) relative to the 80th percentile of the neighbors in time; about 1 is sharp."""
    sharpness, times = np.array(stats.sharpness), np.array(stats.times_s)
    out = np.ones(len(sharpness))
    low = np.searchsorted(times, times - window_s)
    high = np.searchsorted(times, times + window_s, side="right")
    for i in range(len(sharpness)):
        # At least five neighbors, also where frames are sparse or irregular.
        a, b = min(low[i], max(i - 2, 0)), max(high[i], min(i + 3, len(sharpness)))
        out[i] = sharpness[i] / max(float(np.percentile(sharpness[a:b], 80)), 1e-9)
    return out


@dataclass(frozen=True)
class Spacing:
    """Parameters of keyframe selection."""

    step: float  # desired mean displacement between keyframes, share of the longer side
    fewest: int
    most: int
    blurred_below: float  # relative sharpness of a blurred frame
    widest_gap: float  # largest gap that dropping a blurred frame may leave, share of the longer side
    by_parallax: bool = True  # else by displacement alone


def choose_keyframes(stats: FrameStats, usable: np.ndarray, spacing: Spacing) -> np.ndarray:
    """Select keyframes among the `usable` frames, bool (n,): rows of `stats`, ascending.

    Their number follows from the accumulated displacement; they are spaced by parallax, and to a part by displacement,
    so that neighbors overlap where the camera only turns. The path is divided into equal cells, and the sharpest frame
    of each is selected. Frames that repeat a selected one have the same position and are not selected too.
    """
    rows = np.flatnonzero(usable)
    quality = relative_sharpness(stats)[rows]
    if len(rows) == 0:
        return rows
    position = np.array(stats.position)[rows]
    length = float(position[-1] - position[0])
    if length <= 0:
        return rows[[int(np.argmax(quality))]]
    distinct = 1 + int((np.diff(position) > _SAME).sum())
    wanted = int(np.clip(round(length / spacing.step), spacing.fewest, spacing.most))
    path = position
    if spacing.by_parallax:
        path = _FLOW_SHARE * position + np.array(stats.parallax)[rows]
        path *= length / (path[-1] - path[0])
    target = min(wanted, distinct)
    cells = wanted
    chosen = _sharpest_per_cell(path, position, quality, cells)
    # Fast motion leaves cells empty, so finer cells may be needed to reach the count.
    while len(chosen) < target and cells < 40 * wanted:
        cells = int(cells * 1.15) + 1
        finer = _sharpest_per_cell(path, position, quality, cells)
        if len(finer) > spacing.most:
            break
        chosen = finer
    return rows[_without_blurred(chosen, position, quality, spacing)]


def _sharpest_per_cell(path: np.ndarray, position: np.ndarray, quality: np.ndarray, cells: int) -> np.ndarray:
    """Return the rows of the sharpest frame of each of the equal cells of a path (n,)."""
    coordinate = (path - path[0]) / (path[-1] - path[0]) * cells
    cell = np.minimum(coordinate.astype(int), cells - 1)
    # Of equally sharp frames, prefer the one nearest to the middle of the cell.
    score = np.minimum(quality, 1.3) - 0.25 * np.abs(coordinate - cell - 0.5)
    order = np.lexsort((-score, cell))
    first = np.concatenate([[True], np.diff(cell[order]) > 0])
    chosen = np.sort(order[first])
    # Frames on both sides of a cell border may repeat each other: keep the sharper one.
    keep = [chosen[0]]
    for row in chosen[1:]:
        if position[row] - position[keep[-1]] > _SAME:
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
