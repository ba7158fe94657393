"""Order pairs of frames by how surely they start a model: verified pairs and a first focal length in, rows out."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from reconstruction.poses.colmap_types import ColmapCamera
from reconstruction.poses.features import Features
from reconstruction.poses.pairs import VerifiedPair, fit_homography

MIN_ANGLE_DEG, MIN_INLIERS = 2.0, 50  # median triangulation angle, and inliers, of a pair that starts a model
_CANDIDATES = 40  # pairs with most matches off any homography
_PLACES = 12  # parts of a film that models start in, where the first model is doubtful
_SAMPLES = 8  # random halves of the matches
_MAX_ERROR_PX = 1.5  # inlier threshold of an essential matrix
_CONFIDENCE = 0.999
_FARTHEST = 1e4  # depth of a point, in baselines


def rank_starts(
    features: list[Features], pairs: list[VerifiedPair], camera: ColmapCamera, seed: int
) -> list[tuple[int, int]]:
    """Order pairs by the spread of their relative rotation over random halves of their matches, least first.

    Views of a plane, of points that are far away or of somebody who walks by have several relative poses that explain
    them, of which one is right (Longuet-Higgins, 1986, for planes). Which of them is found then depends on the matches
    that are used. The spread tells that without truth (bootstrap, Efron 1979).

    Args:
        features: of the frames.
        pairs: of the frames, verified.
        camera: a first focal length.
        seed: of the samples.

    Returns:
        Rows of at most 40 pairs.
    """
    off = [_off_homography(features, pair) for pair in pairs]
    most = sorted(range(len(pairs)), key=lambda k: (-off[k], pairs[k].rows))[:_CANDIDATES]
    return _by_spread(features, [pairs[k] for k in most], camera, seed)


def starts_along_film(
    features: list[Features], pairs: list[VerifiedPair], camera: ColmapCamera, seed: int
) -> list[tuple[int, int]]:
    """Return the surest pair of each twelfth of the frames, by its first frame; see `rank_starts`."""
    first: dict[int, tuple[int, int]] = {}
    for rows in _by_spread(features, pairs, camera, seed):
        first.setdefault(rows[0] * _PLACES // len(features), rows)
    return [first[place] for place in sorted(first)]


def _by_spread(
    features: list[Features], pairs: list[VerifiedPair], camera: ColmapCamera, seed: int
) -> list[tuple[int, int]]:
    """Order the pairs that can start a model by the spread of their relative rotation, least first."""
    spread = {pair.rows: _rotation_spread_deg(features, pair, camera, seed) for pair in pairs}
    return sorted(
        (rows for rows in spread if np.isfinite(spread[rows])), key=lambda rows: (spread[rows], rows)
    )


def _off_homography(features: list[Features], pair: VerifiedPair) -> int:
    """Return how many matches the best homography does not explain."""
    matrix, inliers = fit_homography(features, pair)
    return 0 if matrix is None else int((~inliers).sum())


def _rotation_spread_deg(
    features: list[Features], pair: VerifiedPair, camera: ColmapCamera, seed: int
) -> float:
    """Return the largest angle between the rotation of all matches and that of a half; inf where none can start."""
    i, j = pair.rows
    a, b = features[i].keypoints[pair.matches[:, 0]], features[j].keypoints[pair.matches[:, 1]]
    pixels = np.concatenate([a, b], axis=1).astype(np.float64)
    of_all = _relative_rotation(pixels, camera.calibration_matrix())
    if of_all is None or of_all[1] < MIN_ANGLE_DEG or of_all[2] < MIN_INLIERS:
        return np.inf
    random = np.random.default_rng(seed)
    spread = 0.0
    for _ in range(_SAMPLES):
        half = pixels[random.choice(len(pixels), len(pixels) // 2, replace=False)]
        if (of_half := _relative_rotation(half, camera.calibration_matrix())) is None:
            return np.inf
        turned = Rotation.from_matrix(of_half[0] @ of_all[0].T).magnitude()
        spread = max(spread, float(np.degrees(turned)))
    return spread


def _relative_rotation(pixels: np.ndarray, intrinsics: np.ndarray) -> tuple[np.ndarray, float, int] | None:
    """Fit an essential matrix to matches (k, 4); return its rotation, median triangulation angle, and inliers."""
    a, b = np.ascontiguousarray(pixels[:, :2]), np.ascontiguousarray(pixels[:, 2:])
    matrix, inliers = cv2.findEssentialMat(a, b, intrinsics, cv2.RANSAC, _CONFIDENCE, _MAX_ERROR_PX)
    if matrix is None or matrix.shape != (3, 3):
        return None
    count, rotation, shift, before, points = cv2.recoverPose(
        matrix, a, b, intrinsics, distanceThresh=_FARTHEST, mask=inliers
    )
    if not count:
        return None
    points = points[:3, before.ravel() > 0] / points[3, before.ravel() > 0]
    rays = points / np.linalg.norm(points, axis=0), points + rotation.T @ shift
    cosine = (rays[0] * rays[1]).sum(0) / np.linalg.norm(rays[1], axis=0)
    return rotation, float(np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1))))), count
