"""Measure exposure: dark and clipped pixels of frames, and the change of exposure along the film."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.precheck.two_view import Pair

_CLIPPED_FROM = 250  # gray levels; codecs rarely reach 255
_MIN_MATCHES = 20


@dataclass(frozen=True)
class Exposure:
    """Exposure of the sampled frames."""

    bright: np.ndarray  # float (n,) 90th percentile of the gray values
    clipped: np.ndarray  # float (n,) share of clipped pixels
    drift_stops: float  # range of the exposure over the film, from the gray values of matched points


def measure_exposure(grays: list[np.ndarray], pairs: list[Pair]) -> Exposure:
    """Measure gray images uint8 (h, w); the change of exposure is chained over consecutive frames.

    Args:
        grays: n images.
        pairs: verified pairs; those of consecutive frames are used.
    """
    bright = np.array([np.quantile(gray, 0.9) for gray in grays])
    clipped = np.array([(gray >= _CLIPPED_FROM).mean() for gray in grays])
    smooth = [cv2.GaussianBlur(gray, (0, 0), 2.0) for gray in grays]
    step = np.zeros(len(grays))
    for pair in pairs:
        if pair.rows[1] - pair.rows[0] == 1 and len(pair.first) >= _MIN_MATCHES:
            before, after = (
                _values(smooth[row], points) for row, points in zip(pair.rows, (pair.first, pair.second))
            )
            usable = (before > 15) & (after > 15) & (before < 240) & (after < 240)
            if usable.sum() >= _MIN_MATCHES:
                # Gray values are about the 2.2nd root of light.
                step[pair.rows[1]] = 2.2 * float(np.median(np.log2(after[usable] / before[usable])))
    return Exposure(bright, clipped, float(np.ptp(np.cumsum(step))))


def _values(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    x = np.clip(points[:, 0].astype(int), 0, image.shape[1] - 1)
    y = np.clip(points[:, 1].astype(int), 0, image.shape[0] - 1)
    return image[y, x].astype(np.float64)
