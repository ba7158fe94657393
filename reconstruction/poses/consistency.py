"""Pairs of frames that contradict the others: the same tile, poster or chair at two places.

Matches make tracks: the features of one point in many frames. Frames that follow each other are hardly ever
confused, so tracks grow from them; then pairs further apart are asked. A match between two tracks that some
frame shows side by side, at different places, cannot be right: they are two points that look alike. A pair
most of whose matches say so shows two look-alikes and is dropped, from other pairs only those matches go.
"""

from dataclasses import dataclass, replace

import numpy as np

from reconstruction.poses.features import Features
from reconstruction.poses.pairs import VerifiedPair

_SAME_PLACE = 0.006  # of the image's diagonal; SIFT gives one corner several features nearby
_MIN_CONTRADICTIONS = 8  # fewer are chance
_MAX_CONTRADICTED_SHARE = 0.35  # of the matches that some frame can judge


_MANY_REJECTED_SHARE = 0.1  # of all pairs: the place is full of look-alikes
_MIN_SUPPORT_SHARE = 0.3  # of a distant pair's matches, there, that must be one point by other frames' word


@dataclass(frozen=True)
class ConsistentPairs:
    """Pairs that do not contradict each other."""

    pairs: list[VerifiedPair]  # in the order given
    rejected: int  # number of pairs that show look-alikes, or may well do so


def reject_look_alikes(
    pairs: list[VerifiedPair],
    features: list[Features],
    near: int,
    min_inliers: int,
    image_size: tuple[int, int],
) -> ConsistentPairs:
    """Drop pairs and matches that join points which another frame shows apart.

    Where many pairs are dropped, what has no such contradiction may still be wrong. Pairs that are not near in
    time are then used only where other frames support them: rather an open loop than one closed wrongly.

    Args:
        pairs: verified pairs.
        features: of all frames.
        near: frames of a video at most this many apart are near in time, and believed first; 0: no video, pairs
            with most matches are believed first.
        min_inliers: a pair that keeps fewer matches is dropped.
        image_size: width and height in pixels.
    """
    tolerance_px = _SAME_PLACE * float(np.hypot(*image_size))
    found = _grow(pairs, _Tracks(features, tolerance_px), near, min_inliers, strict=False)
    if near and found.rejected > _MANY_REJECTED_SHARE * len(pairs):
        found = _grow(pairs, _Tracks(features, tolerance_px), near, min_inliers, strict=True)
    return found


def _grow(
    pairs: list[VerifiedPair], tracks: "_Tracks", near: int, min_inliers: int, strict: bool
) -> ConsistentPairs:
    """Take pairs in the order of trust; `strict`: distant ones need the support of others."""

    def trust(number: int) -> tuple[int, int]:
        pair = pairs[number]
        return (pair.rows[1] - pair.rows[0] if near else 0, -len(pair.matches))

    kept: dict[int, VerifiedPair] = {}
    rejected = 0
    for number in sorted(range(len(pairs)), key=trust):
        pair = pairs[number]
        same, apart = tracks.judge(pair)
        doubted, supported = int(apart.sum()), int(same.sum())
        refuted = doubted >= _MIN_CONTRADICTIONS and doubted > _MAX_CONTRADICTED_SHARE * (doubted + supported)
        distant = pair.rows[1] - pair.rows[0] > near
        if refuted or (strict and distant and supported < _MIN_SUPPORT_SHARE * len(pair.matches)):
            rejected += 1
            continue
        matches = pair.matches[~apart]
        if len(matches) >= min_inliers:
            kept[number] = replace(pair, matches=matches)
            tracks.join(pair.rows, matches)
    return ConsistentPairs([kept[number] for number in sorted(kept)], rejected)


class _Tracks:
    """Which features of all frames are one point, as far as is known; each feature begins alone."""

    def __init__(self, features: list[Features], tolerance_px: float) -> None:
        self.tolerance_px = tolerance_px
        self.first = np.concatenate([[0], np.cumsum([len(f.keypoints) for f in features])])
        self.positions = np.concatenate([f.keypoints for f in features])
        self.track_of = np.full(self.first[-1], -1, np.int64)  # by feature; -1: alone
        self.frames = len(features)
        self.members = np.full((1024, self.frames), -1, np.int32)  # by track and frame: feature or -1
        self.count = 0

    def judge(self, pair: VerifiedPair) -> tuple[np.ndarray, np.ndarray]:
        """Return for each match whether its ends are one point already, and whether a frame shows them apart."""
        a, b = (
            self._members_of(pair.rows[0], pair.matches[:, 0]),
            self._members_of(pair.rows[1], pair.matches[:, 1]),
        )
        both = (a >= 0) & (b >= 0)
        gap = np.linalg.norm(self.positions[a] - self.positions[b], axis=2)
        apart = (both & (gap > self.tolerance_px)).any(axis=1)
        return both.any(axis=1) & ~apart, apart

    def _members_of(self, row: int, features: np.ndarray) -> np.ndarray:
        """Return (m, frames) the features that are known to be the same point as each given one."""
        ids = self.first[row] + features.astype(np.int64)
        tracks = self.track_of[ids]
        out = self.members[tracks]
        out[tracks < 0] = -1
        out[np.arange(len(ids)), row] = ids
        return out

    def join(self, rows: tuple[int, int], matches: np.ndarray) -> None:
        """Take the two features of each match for one point, unless an earlier one of these matches forbids it."""
        for a, b in zip(
            self.first[rows[0]] + matches[:, 0].astype(np.int64), self.first[rows[1]] + matches[:, 1]
        ):
            one, other = self.track_of[a], self.track_of[b]
            if one < 0 and other < 0:
                one = self._new()
            elif one < 0:
                one, other = other, -1
            if other >= 0 and one != other:
                self._merge(one, other)
            for feature, row in ((a, rows[0]), (b, rows[1])):
                if self.track_of[feature] < 0 and self.members[one, row] < 0:
                    self.track_of[feature] = one
                    self.members[one, row] = feature

    def _new(self) -> int:
        if self.count == len(self.members):
            self.members = np.concatenate([self.members, np.full_like(self.members, -1)])
        self.count += 1
        return self.count - 1

    def _merge(self, one: int, other: int) -> None:
        """Move the features of `other` to `one`; where both have one in a frame they stay apart."""
        a, b = self.members[one], self.members[other]
        if ((a >= 0) & (b >= 0)).any():
            return
        moved = b >= 0
        a[moved] = b[moved]
        self.track_of[b[moved]] = one
        b[:] = -1
