"""Two-view geometry of sampled frames: matches, epipolar inliers, and the parallax that no rotation explains."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.progress import NO_PROGRESS
from reconstruction.poses.features import Features, extract_features, match, overlap_scores
from reconstruction.poses.parallel import ordered_map

_MAX_FEATURES = 700
_CONTRAST = 0.01  # as `PosesConfig.contrast_threshold`
_MAX_ERROR_PX = 2.0  # of the fundamental matrix and the rotation, at sampled size
MIN_INLIERS = 20  # as `PosesConfig.min_inliers`
_GAPS = (1, 2, 4, 8, 16)  # between the rows of matched frames
_ORDERLESS_PARTNERS = 5  # of each photograph of a folder, by coarse overlap
_FOCALS = np.geomspace(0.6, 1.7, 9)  # tried, as shares of the longer side: fields of view of 80 to 33 degrees


@dataclass(frozen=True)
class Pair:
    """Two sampled frames with epipolar inliers."""

    rows: tuple[int, int]
    first: np.ndarray  # float32 (k, 2) pixels in the first frame
    second: np.ndarray  # float32 (k, 2) pixels in the second


def match_frames(images: np.ndarray, *, ordered: bool) -> list[Pair]:
    """Detect features in images uint8 (n, h, w, 3), match frames near in time, keep epipolar inliers.

    Args:
        images: sampled frames.
        ordered: frames are in time order; else all pairs with some overlap are matched.

    Returns:
        The pairs with at least `MIN_INLIERS` inliers.
    """
    features = extract_features(images, _MAX_FEATURES, _CONTRAST, NO_PROGRESS)
    n = len(images)
    wanted = {(i, i + gap) for gap in _GAPS for i in range(n - gap)}
    if not ordered:
        wanted |= _alike(features)
    found = ordered_map(lambda rows: _verified(rows, features), sorted(wanted))
    return [pair for pair in found if pair is not None]


def _alike(features: list[Features]) -> set[tuple[int, int]]:
    scores = overlap_scores(features, NO_PROGRESS, count=128)
    best = np.argsort(-scores, axis=1, kind="stable")[:, :_ORDERLESS_PARTNERS]
    return {
        (min(i, int(j)), max(i, int(j))) for i in range(len(features)) for j in best[i] if scores[i, j] > 3
    }


def _verified(rows: tuple[int, int], features: list[Features]) -> Pair | None:
    a, b = features[rows[0]], features[rows[1]]
    matches = match(a.descriptors, b.descriptors)
    if len(matches) < MIN_INLIERS:
        return None
    first, second = a.keypoints[matches[:, 0]], b.keypoints[matches[:, 1]]
    try:
        matrix, inliers = cv2.findFundamentalMat(first, second, cv2.USAC_ACCURATE, _MAX_ERROR_PX, 0.999, 2000)
    except cv2.error:  # degenerate samples only, e.g. all points on one line
        return None
    if matrix is None or (keep := inliers.ravel() > 0).sum() < MIN_INLIERS:
        return None
    return Pair(rows, first[keep], second[keep])


def rotation_between(pair: Pair, focal_px: float, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit the rotation that explains a pair best, for a pinhole camera.

    Args:
        pair: inliers.
        focal_px: focal length.
        center: (2,) principal point.

    Returns:
        Rotation second_from_first (3, 3), and the angles (k,) in degrees that it leaves between the rays.
    """
    a, b = (rays(points, focal_px, center) for points in (pair.first, pair.second))
    weights = np.ones(len(a))
    rotation = np.eye(3)
    left = np.zeros(len(a))
    for _ in range(6):  # iteratively reweighted: the median counts, not the nearest things
        u, _, vt = np.linalg.svd((b * weights[:, None]).T @ a)
        rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
        left = np.linalg.norm(np.cross(a @ rotation.T, b), axis=1)
        weights = 1 / np.maximum(left, 2e-3)
    return rotation, np.degrees(np.arcsin(np.clip(left, 0, 1)))


def rays(points: np.ndarray, focal_px: float, center: np.ndarray) -> np.ndarray:
    """Return unit rays (k, 3) through pixels (k, 2)."""
    out = np.column_stack([(points - center) / focal_px, np.ones(len(points))]).astype(np.float64)
    return out / np.linalg.norm(out, axis=1, keepdims=True)


@dataclass(frozen=True)
class Parallax:
    """Parallax of pairs of frames: angles between matched rays after the best rotation."""

    focal_px: float  # given, or the one with the smallest angles
    degrees: np.ndarray  # float (pairs,) upper quartile of the angles of a pair's inliers


def measure_parallax(pairs: list[Pair], size: tuple[int, int], focal_px: float = 0.0) -> Parallax:
    """Measure the parallax of pairs against rotations of one camera.

    Without a known focal length, the one is taken under which rotations explain the film best: a camera on a tripod
    then leaves noise only, and a camera that moves leaves parallax under any.

    Args:
        pairs: verified pairs.
        size: (width, height) of the frames.
        focal_px: focal length from metadata; 0: unknown.
    """
    center = np.array(size, np.float64) / 2
    if not pairs:
        return Parallax(focal_px or float(max(size)), np.zeros(0))
    tried = [focal_px] if focal_px else [share * max(size) for share in _FOCALS]
    best: tuple[float, float] | None = None
    some = [pairs[k] for k in np.unique(np.linspace(0, len(pairs) - 1, min(40, len(pairs))).astype(int))]
    for focal in tried:
        # In pixels, not degrees: a long focal length makes all angles small.
        left = [np.radians(np.median(rotation_between(p, focal, center)[1])) * focal for p in some]
        if best is None or np.median(left) < best[0]:
            best = float(np.median(left)), focal
    assert best is not None
    left = [np.quantile(rotation_between(p, best[1], center)[1], 0.75) for p in pairs]
    return Parallax(best[1], np.array(left))
