"""Choose pairs of frames to match, and verify each pair by two-view geometry."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.poses.colmap_types import ColmapCamera, TwoViewGeometry
from reconstruction.poses.config import PosesConfig
from reconstruction.poses.features import Features, match
from reconstruction.poses.parallel import ordered_map

_MIN_OVERLAP_SCORE = 6  # mutual matches; with fewer, full matching finds next to nothing
_EXHAUSTIVE_BELOW = 40  # frames; up to this many, nearly all pairs are candidates
_MAX_EPIPOLAR_ERROR_PX = 3.0  # inlier threshold
_HOMOGRAPHY_ERROR_PX = 3.0  # inlier threshold


@dataclass(frozen=True)
class VerifiedPair:
    """Two frames whose matches are inliers of one two-view geometry."""

    rows: tuple[int, int]
    matches: np.ndarray  # uint32 (k, 2) rows of both frames' features, inliers of `geometry`
    geometry: TwoViewGeometry


def choose_pairs(scores: np.ndarray, ordered: bool, config: PosesConfig) -> list[tuple[int, int, bool]]:
    """Choose pairs (row, later row, near in time): neighbors in time and the partners with the highest overlap.

    Args:
        scores: int (n, n), symmetric, from `overlap_scores`.
        ordered: rows are in time order.
        config: overlap and number of partners.
    """
    n = len(scores)
    gap = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    likely = (scores >= _MIN_OVERLAP_SCORE) & (gap > 0)
    if n <= _EXHAUSTIVE_BELOW:
        likely |= scores > 1
    rank = np.argsort(np.argsort(-scores, axis=1, kind="stable"), axis=1, kind="stable")
    partner = likely & (rank < config.max_pairs_per_frame)
    wanted = partner | partner.T
    near = np.zeros_like(wanted)
    if ordered:
        near = (gap > 0) & (gap <= max(1, config.sequential_overlap // 2))
        wanted |= (gap > 0) & (gap <= config.sequential_overlap)
        # Doubling distances connect the sequence at all time scales, as COLMAP's quadratic overlap.
        power = 2 * config.sequential_overlap
        while power < n:
            wanted |= (gap == power) & likely
            power *= 2
    rows, columns = np.nonzero(np.triu(wanted))
    return [(int(i), int(j), bool(near[i, j])) for i, j in zip(rows, columns)]


def verify_pairs(
    pairs: list[tuple[int, int, bool]],
    features: list[Features],
    camera: ColmapCamera,
    config: PosesConfig,
    progress: Progress,
) -> list[VerifiedPair]:
    """Match the features of each pair; return the pairs whose two-view geometry has enough inliers.

    Pairs not near in time are matched by the stronger half of the features only: a quarter of the cost, and weak
    features rarely match across a large change of viewpoint.
    """
    import pycolmap

    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers = config.min_inliers
    options.detect_watermark = False
    options.ransac.random_seed = config.seed
    options.ransac.max_error = _MAX_EPIPOLAR_ERROR_PX
    options.ransac.max_num_trials = 2000  # the matches given are inliers already

    def verify(pair: tuple[int, int, bool]) -> VerifiedPair | None:
        i, j, near = pair
        a, b = features[i], features[j]
        limit = config.max_features if near else max(512, config.max_features // 2)
        matches = match(a.descriptors[:limit], b.descriptors[:limit])
        matches = _epipolar_inliers(a.keypoints, b.keypoints, matches, config.min_inliers)
        if len(matches) < config.min_inliers:
            return None
        first, second = a.keypoints.astype(np.float64), b.keypoints.astype(np.float64)
        rows = matches.astype(np.uint32)
        geometry = pycolmap.estimate_two_view_geometry(camera, first, camera, second, rows, options)
        if len(geometry.inlier_matches) < config.min_inliers:
            return None
        return VerifiedPair((i, j), np.asarray(geometry.inlier_matches), geometry)

    out = []
    for found in ordered_map(verify, pairs):
        out += [] if found is None else [found]
        progress.advance()
    return out


def _epipolar_inliers(a: np.ndarray, b: np.ndarray, matches: np.ndarray, least: int) -> np.ndarray:
    """Return the matches (k, 2) that are inliers of one fundamental matrix, by OpenCV's USAC."""
    if len(matches) < least:
        return matches[:0]
    try:
        matrix, inliers = cv2.findFundamentalMat(
            a[matches[:, 0]], b[matches[:, 1]], cv2.USAC_ACCURATE, _MAX_EPIPOLAR_ERROR_PX, 0.999, 5000
        )
    except cv2.error:  # degenerate samples only, e.g. all points on one line
        return matches[:0]
    return matches[:0] if matrix is None else matches[inliers.ravel() > 0]


def fit_homography(features: list[Features], pair: VerifiedPair) -> tuple[np.ndarray | None, np.ndarray]:
    """Fit a homography to the matches (k, 2) of a pair; return it (3, 3) or None, and its inliers, bool (k,)."""
    i, j = pair.rows
    a, b = features[i].keypoints[pair.matches[:, 0]], features[j].keypoints[pair.matches[:, 1]]
    matrix, inliers = cv2.findHomography(a, b, cv2.USAC_DEFAULT, _HOMOGRAPHY_ERROR_PX)
    return matrix, np.zeros(len(a), bool) if matrix is None else inliers.ravel() > 0
