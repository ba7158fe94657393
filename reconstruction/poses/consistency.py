"""Reject pairs of frames that match repeated structure (two copies of a tile, poster or chair) by track consistency.

Matches are merged into tracks: the features of one 3D point, at most one per frame. Pairs near in time are merged
first, as they hardly ever confuse copies; then more distant pairs are tested. A match between two tracks that another
frame observes at different positions is contradicted: the tracks are different points. A pair with mostly
contradicted matches is dropped; from other pairs only the contradicted matches are dropped.
"""

from dataclasses import dataclass, replace

import numpy as np

from reconstruction.poses.features import Features
from reconstruction.poses.pairs import VerifiedPair

_SAME_PLACE = 0.006  # share of the image diagonal; SIFT detects one corner several times nearby
_MIN_CONTRADICTIONS = 8  # matches; fewer are chance
_MAX_CONTRADICTED_SHARE = 0.35  # of the matches that other frames confirm or contradict
_MANY_REJECTED_SHARE = 0.1  # of all pairs; with more, distant pairs need support
_MIN_SUPPORT_SHARE = 0.3  # of a distant pair's matches that the tracks must confirm then


@dataclass(frozen=True)
class ConsistentPairs:
    """Pairs whose matches do not contradict each other."""

    pairs: list[VerifiedPair]  # in the order given
    rejected: int  # number of pairs dropped as repeated structure


def reject_look_alikes(
    pairs: list[VerifiedPair],
    features: list[Features],
    near: int,
    min_inliers: int,
    image_size: tuple[int, int],
) -> ConsistentPairs:
    """Drop pairs and matches that merge points which another frame observes at different positions.

    If many pairs are dropped, pairs without a contradiction may be wrong too. Pairs that are not near in time are
    then kept only where other frames support them: an open loop is better than a wrong loop closure.

    Args:
        pairs: verified pairs.
        features: features of all frames.
        near: largest distance in rows of pairs near in time, which are merged first; 0 for unordered images, where
            pairs with most matches are merged first.
        min_inliers: pairs that keep fewer matches are dropped.
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
    """Test and merge pairs in the order of trust; `strict`: distant pairs need support."""

    def trust(number: int) -> tuple[int, int]:
        pair = pairs[number]
        return (pair.rows[1] - pair.rows[0] if near else 0, -len(pair.matches))

    kept: dict[int, VerifiedPair] = {}
    rejected = 0
    for number in sorted(range(len(pairs)), key=trust):
        pair = pairs[number]
        same, apart = tracks.judge(pair)
        contradicted, supported = int(apart.sum()), int(same.sum())
        most = _MAX_CONTRADICTED_SHARE * (contradicted + supported)
        distant = pair.rows[1] - pair.rows[0] > near
        if (contradicted >= _MIN_CONTRADICTIONS and contradicted > most) or (
            strict and distant and supported < _MIN_SUPPORT_SHARE * len(pair.matches)
        ):
            rejected += 1
            continue
        matches = pair.matches[~apart]
        if len(matches) >= min_inliers:
            kept[number] = replace(pair, matches=matches)
            tracks.join(pair.rows, matches)
    return ConsistentPairs([kept[number] for number in sorted(kept)], rejected)


class _Tracks:
    """Partition of all features into tracks, at most one feature per frame; initially each feature is on its own."""

    def __init__(self, features: list[Features], tolerance_px: float) -> None:
        self.tolerance_px = tolerance_px
        self.first = np.concatenate([[0], np.cumsum([len(f.keypoints) for f in features])])
        self.positions = np.concatenate([f.keypoints for f in features])
        self.track_of = np.full(self.first[-1], -1, np.int64)  # by feature; -1: on its own
        self.frames = len(features)
        self.members = np.full((1024, self.frames), -1, np.int32)  # by track and frame: feature or -1
        self.count = 0

    def judge(self, pair: VerifiedPair) -> tuple[np.ndarray, np.ndarray]:
        """Return for each match, bool (k,) each: the tracks confirm it; a frame contradicts it."""
        a, b = (self._members_of(row, rows) for row, rows in zip(pair.rows, pair.matches.T))
        both = (a >= 0) & (b >= 0)
        gap = np.linalg.norm(self.positions[a] - self.positions[b], axis=2)
        apart = (both & (gap > self.tolerance_px)).any(axis=1)
        return both.any(axis=1) & ~apart, apart

    def _members_of(self, row: int, features: np.ndarray) -> np.ndarray:
        """Return the track of each given feature of a frame: features by frame (m, frames), -1 where none."""
        ids = self.first[row] + features.astype(np.int64)
        tracks = self.track_of[ids]
        out = self.members[tracks]
        out[tracks < 0] = -1
        out[np.arange(len(ids)), row] = ids
        return out

    def join(self, rows: tuple[int, int], matches: np.ndarray) -> None:
        """Merge the tracks of each match, unless both have a feature in one frame."""
        for a, b in zip(
            self.first[rows[0]] + matches[:, 0].astype(np.int64), self.first[rows[1]] + matches[:, 1]
        ):
            one, other = int(self.track_of[a]), int(self.track_of[b])
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
        """Move the features of track `other` to `one`, unless both have a feature in one frame."""
        a, b = self.members[one], self.members[other]
        if ((a >= 0) & (b >= 0)).any():
            return
        moved = b >= 0
        a[moved] = b[moved]
        self.track_of[b[moved]] = one
        b[:] = -1
