"""Estimate the focal length that all frames share from the fundamental matrices of pairs of frames.

Of a camera with square pixels and a known principal point, K^T F K is an essential matrix: its two singular values are
equal (Mendonça and Cipolla, A Simple Technique for Self-Calibration, CVPR 1999). Each pair votes for the focal lengths
at which they nearly are; most votes win. Structure from motion that starts 20 % off bends the path of a camera that
turns on the spot, and does not recover.
"""

import numpy as np

from reconstruction.poses.pairs import VerifiedPair

PLAUSIBLE_FOCAL = (0.35, 4.0)  # of the longer image side
_STEP = 0.015  # between candidates, relative
_TOLERANCE = 0.025  # of the difference of the singular values over their sum; half a vote there
_LEAST_PAIRS = 10


def estimate_focal_length(pairs: list[VerifiedPair], width: int, height: int) -> float | None:
    """Return the focal length in pixels, to about 2 %, or None where too few pairs tell.

    Args:
        pairs: verified; those of planes and of a camera that only turned have no fundamental matrix and do not vote.
        width: of the frames, pixels. Their principal point is taken to be in the middle.
        height: the same.
    """
    import pycolmap

    kinds = pycolmap.TwoViewGeometryConfiguration
    voting = {kinds.CALIBRATED.value, kinds.UNCALIBRATED.value}
    matrices = [pair.geometry.F for pair in pairs if int(pair.geometry.config) in voting]
    matrices = np.array([matrix for matrix in matrices if matrix is not None], np.float64)
    if len(matrices) < _LEAST_PAIRS:
        return None
    side = max(width, height)
    low, high = np.log(PLAUSIBLE_FOCAL)
    focals = side * np.exp(np.linspace(low, high, 1 + round((high - low) / _STEP)))
    votes = [(1 / (1 + (_asymmetry(matrices, f, width, height) / _TOLERANCE) ** 2)).sum() for f in focals]
    return float(focals[int(np.argmax(votes))])


def _asymmetry(matrices: np.ndarray, focal_px: float, width: int, height: int) -> np.ndarray:
    """Return |a - b| / (a + b) of the singular values a and b of K^T F K, for fundamental matrices (n, 3, 3)."""
    k = np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])
    essential = k.T @ matrices @ k
    gram = essential @ essential.swapaxes(1, 2)  # its eigenvalues are a^2, b^2 and 0
    squares = np.trace(gram, axis1=1, axis2=2)
    twice_product = np.sqrt(np.maximum(2 * (squares**2 - (gram**2).sum((1, 2))), 0.0))
    return np.sqrt(np.maximum(squares - twice_product, 0.0) / (squares + twice_product))
