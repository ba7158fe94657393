"""Upright boxes around noisy, partly seen things."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class UprightBox:
    """A box with vertical sides, turned by `yaw_rad` about +z."""

    center: np.ndarray  # float64 (3,)
    yaw_rad: float
    extents_m: np.ndarray  # float64 (3,)


def upright_box(points: np.ndarray, areas: np.ndarray, yaw_rad: float | None = None) -> UprightBox:
    """Return the smallest upright box around points (n, 3), a sliver of outlying area left out.

    A box parallel to the world axes is preferred where it is nearly as small: furniture stands along walls.
    """
    points = np.asarray(points, np.float64)
    weights = np.maximum(np.asarray(areas, np.float64), 1e-9)
    trim = 0.004
    spans = {}

    def span(yaw: float) -> tuple[np.ndarray, np.ndarray]:
        if yaw not in spans:
            c, s = np.cos(yaw), np.sin(yaw)
            turned = points[:, :2] @ np.array([[c, -s], [s, c]])
            spans[yaw] = tuple(
                np.array(x) for x in zip(*(_range(turned[:, k], weights, trim) for k in range(2)))
            )
        return spans[yaw]

    def area(yaw: float) -> float:
        low, high = span(yaw)
        return float(np.prod(np.maximum(high - low, 1e-3)))

    if yaw_rad is None:
        yaw_rad = min(np.radians(np.arange(-44, 46, 3.0)).tolist(), key=area)
        yaw_rad = min((yaw_rad + np.radians(np.arange(-2, 2.1, 0.5))).tolist(), key=area)
        if area(0.0) < 1.06 * area(yaw_rad):
            yaw_rad = 0.0
    low, high = span(yaw_rad)
    bottom, top = _range(points[:, 2], weights, trim)
    middle = 0.5 * (low + high)
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    center = np.array([c * middle[0] - s * middle[1], s * middle[0] + c * middle[1], 0.5 * (bottom + top)])
    return UprightBox(center, float(yaw_rad), np.maximum([*(high - low), top - bottom], 1e-3))


def _range(values: np.ndarray, weights: np.ndarray, trim: float) -> tuple[float, float]:
    low, high = quantiles(values, weights, (trim, 1 - trim))
    return float(low), float(high)


def quantiles(values: np.ndarray, weights: np.ndarray, shares: tuple[float, ...]) -> np.ndarray:
    """Return the weighted quantiles of values (n,), so that it does not matter how densely a mesh samples them."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(np.maximum(weights, 1e-12)[order])
    index = np.searchsorted(total, np.asarray(shares) * total[-1])
    return np.asarray(values, np.float64)[order[np.minimum(index, len(order) - 1)]]


def with_bottom(box: UprightBox, bottom: float) -> UprightBox:
    """Return the box reaching down (or up) to a height; never flatter than 5 mm."""
    top = max(box.center[2] + 0.5 * box.extents_m[2], bottom + 0.005)
    center = np.array([box.center[0], box.center[1], 0.5 * (bottom + top)])
    return UprightBox(center, box.yaw_rad, np.array([box.extents_m[0], box.extents_m[1], top - bottom]))
