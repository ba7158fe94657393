"""Detect SIFT features and match their descriptors between frames, deterministically.

Descriptors are RootSIFT, rounded to integers below 256 and stored as float32. Dot products of two are integers below
2**24, hence exact in any order of summation: matches do not depend on the BLAS library or its number of threads.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.poses.parallel import ordered_map

_DESCRIPTOR_SCALE = 512.0
_MAX_RATIO = 0.8  # Lowe's ratio test, on angles between descriptors
_MAX_ANGLE_RAD = 0.7  # between matching descriptors


@dataclass(frozen=True)
class Features:
    """The features of one frame, strongest first."""

    keypoints: np.ndarray  # float32 (k, 2) pixels; the center of the first pixel is (0.5, 0.5)
    sizes: np.ndarray  # float32 (k,) diameter in pixels
    descriptors: np.ndarray  # float32 (k, 128) integers below 256


def extract_features(
    images: np.ndarray, max_features: int, contrast_threshold: float, progress: Progress
) -> list[Features]:
    """Detect SIFT features in each of the images uint8 (n, h, w, 3)."""

    def extract(image: np.ndarray) -> Features:
        sift = cv2.SIFT_create(  # pyright: ignore[reportAttributeAccessIssue]
            max_features, 3, contrast_threshold, 10.0, 1.6, enable_precise_upscale=True
        )
        gray = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
        keypoints, descriptors = sift.detectAndCompute(gray, None)
        return _pack(keypoints, descriptors, max_features)

    out = []
    for found in ordered_map(extract, images):
        out.append(found)
        progress.advance()
    return out


def _pack(keypoints: list, descriptors: np.ndarray | None, max_features: int) -> Features:
    if not keypoints or descriptors is None:
        return Features(np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros((0, 128), np.float32))
    # The center of OpenCV's first pixel is (0, 0).
    points = np.array([k.pt for k in keypoints], np.float32) + np.float32(0.5)
    size = np.array([k.size for k in keypoints], np.float32)
    response = np.array([k.response for k in keypoints], np.float32)
    order = np.lexsort((points[:, 1], points[:, 0], -response))[:max_features]
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))
    quantized = np.minimum(np.round(_DESCRIPTOR_SCALE * root), 255.0).astype(np.float32)
    return Features(points[order], size[order], quantized[order])


def match(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Match descriptors (n, 128) and (m, 128): mutual nearest neighbors int64 (k, 2) that pass the ratio test."""
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.int64)
    similarity = a @ b.T
    column_best = similarity.max(0)
    rows = np.arange(len(a))
    best = similarity.argmax(1)
    first = similarity[rows, best]
    similarity[rows, best] = -1.0
    mutual = first == column_best[best]
    passed = np.flatnonzero(mutual & _passes_ratio(first, similarity.max(1)))
    # Where two rows tie for a column, the first keeps it: the stronger feature.
    _, unique = np.unique(best[passed], return_index=True)
    passed = np.sort(passed[unique])
    return np.stack([passed, best[passed]], axis=1)


def _passes_ratio(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    angle, other = (np.arccos(np.minimum(x / _DESCRIPTOR_SCALE**2, 1.0)) for x in (first, second))
    return (angle < _MAX_ANGLE_RAD) & (angle < _MAX_RATIO * other)


def overlap_scores(features: list[Features], progress: Progress, count: int = 256) -> np.ndarray:
    """Count mutual matches among the `count` largest features of every two frames: int32 (n, n), symmetric."""
    n = len(features)
    stacked = np.zeros((n, count, 128), np.float32)
    for row, feature in enumerate(features):
        largest = np.argsort(-feature.sizes, kind="stable")[:count]
        stacked[row, : len(largest)] = feature.descriptors[largest]
    scores = np.zeros((n, n), np.int32)
    rows = range(n - 1)
    for row, counts in zip(rows, ordered_map(lambda r: _coarse_matches(stacked[r], stacked[r + 1 :]), rows)):
        scores[row, row + 1 :] = counts
        progress.advance()
    return scores + scores.T


def _coarse_matches(one: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Count mutual matches that pass the ratio test between (c, 128) and each of (n, c, 128): int (n,)."""
    n, count = others.shape[:2]
    similarity = (one @ others.reshape(n * count, 128).T).reshape(count, n, count)
    column_best = similarity.max(0)
    best = similarity.argmax(2)[..., None]
    first = np.take_along_axis(similarity, best, 2)
    np.put_along_axis(similarity, best, np.float32(-1.0), 2)
    mutual = first[..., 0] == np.take_along_axis(column_best, best[..., 0].T, 1).T
    # Absent features are zeros: their similarity of 0 is a right angle, which is no match.
    return (mutual & _passes_ratio(first[..., 0], similarity.max(2))).sum(0)
