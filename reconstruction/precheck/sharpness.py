"""Measure the blur of an image at its edges (Zhuo & Sim 2011), by direction."""

import cv2
import numpy as np

_REBLUR_PX = 1.5  # standard deviation of the known second blur
_SMOOTH_PX = 0.7  # against sensor noise, subtracted from the result
_DIRECTIONS = 6  # of the gradient, over 180 degrees
_MIN_EDGES = 60  # pixels that a direction needs
_MAX_BLUR_PX = 8.0
_EDGE_QUANTILE = 0.93  # of the gradient magnitude: pixels below are no edges
_MIN_GRADIENT = 6.0  # gray levels per pixel


def edge_blur_px(gray: np.ndarray) -> float:
    """Return the standard deviation of the blur at the edges of an image uint8 (h, w), in pixels.

    At a step edge that a Gaussian of standard deviation s has blurred, a second blur s0 lowers the gradient by
    R = sqrt(1 + s0^2 / s^2), so s = s0 / sqrt(R^2 - 1). The median is taken over the edges of each direction, and
    the largest one is returned: motion blurs the edges across it only. Without edges: `_MAX_BLUR_PX`.
    """
    image = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), _SMOOTH_PX)
    again = cv2.GaussianBlur(image, (0, 0), _REBLUR_PX)
    gx, gy = (cv2.Scharr(image, cv2.CV_32F, *d, scale=1 / 32) for d in ((1, 0), (0, 1)))
    hx, hy = (cv2.Scharr(again, cv2.CV_32F, *d, scale=1 / 32) for d in ((1, 0), (0, 1)))
    strength, weaker = np.hypot(gx, gy), np.hypot(hx, hy)
    edge = strength > max(float(np.quantile(strength, _EDGE_QUANTILE)), _MIN_GRADIENT)
    edge &= strength >= cv2.dilate(strength, np.ones((3, 3), np.uint8)) - 1e-3  # ridges: the edges themselves
    ratio = strength[edge] / np.maximum(weaker[edge], 1e-3)
    blur = _REBLUR_PX / np.sqrt(np.maximum(ratio**2 - 1, (_REBLUR_PX / _MAX_BLUR_PX) ** 2))
    direction = (np.arctan2(gy[edge], gx[edge]) % np.pi / np.pi * _DIRECTIONS).astype(int) % _DIRECTIONS
    medians = [
        np.median(blur[direction == k]) for k in range(_DIRECTIONS) if (direction == k).sum() >= _MIN_EDGES
    ]
    if not medians:
        medians = [np.median(blur)] if len(blur) >= _MIN_EDGES else [_MAX_BLUR_PX]
    return float(np.sqrt(max(max(medians) ** 2 - _SMOOTH_PX**2, 0.0)))
