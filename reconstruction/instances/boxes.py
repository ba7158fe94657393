"""Upright bounding boxes of noisy, partly observed objects."""

from dataclasses import dataclass
from functools import cache

import numpy as np

_TRIM = 0.004  # share of the area that is cut off at each end of an axis


@dataclass(frozen=True)
class UprightBox:
    """A box with vertical sides, rotated by `yaw_rad` about +z, in world space."""

    center: np.ndarray  # float64 (3,)
    yaw_rad: float
    extents_m: np.ndarray  # float64 (3,)

    def plan_offsets(self, points: np.ndarray) -> np.ndarray:
        """Return offsets (n, 2) of points (n, 3) from the center, along the two horizontal axes of the box."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return (points[:, :2] - self.center[:2]) @ np.array([[c, -s], [s, c]])


def upright_box(points: np.ndarray, areas: np.ndarray, yaw_rad: float | None = None) -> UprightBox:
    """Return the upright box of least footprint around points (n, 3), with the outlying area trimmed.

    A box parallel to the world axes is preferred where its footprint is less than 6 % larger: furniture stands along
    walls. A given `yaw_rad` fixes the orientation.
    """
    points = np.asarray(points, np.float64)
    weights = np.maximum(np.asarray(areas, np.float64), 1e-9)

    @cache
    def span(yaw: float) -> tuple[np.ndarray, np.ndarray]:
        c, s = np.cos(yaw), np.sin(yaw)
        turned = points[:, :2] @ np.array([[c, -s], [s, c]])
        low, high = zip(*(_range(turned[:, k], weights) for k in range(2)))
        return np.array(low), np.array(high)

    def area(yaw: float) -> float:
        low, high = span(yaw)
        return float(np.prod(np.maximum(high - low, 1e-3)))

    if yaw_rad is None:
        yaw_rad = min(np.radians(np.arange(-44, 46, 3.0)).tolist(), key=area)
        yaw_rad = min((yaw_rad + np.radians(np.arange(-2, 2.1, 0.5))).tolist(), key=area)
        if area(0.0) < 1.06 * area(yaw_rad):
            yaw_rad = 0.0
    low, high = span(yaw_rad)
    bottom, top = _range(points[:, 2], weights)
    middle = 0.5 * (low + high)
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    center = np.array([c * middle[0] - s * middle[1], s * middle[0] + c * middle[1], 0.5 * (bottom + top)])
    return UprightBox(center, float(yaw_rad), np.maximum([*(high - low), top - bottom], 1e-3))


def _range(values: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    low, high = quantiles(values, weights, (_TRIM, 1 - _TRIM))
    return float(low), float(high)


def quantiles(values: np.ndarray, weights: np.ndarray, shares: tuple[float, ...]) -> np.ndarray:
    """Return quantiles of values (n,) weighted by area, which do not depend on how densely a mesh is sampled."""
    values, weights = np.asarray(values, np.float64), np.maximum(weights, 1e-12)
    return np.quantile(values, shares, weights=weights, method="inverted_cdf")


def with_bottom(box: UprightBox, bottom: float) -> UprightBox:
    """Return the box with its bottom at height `bottom`; the top stays, the height is at least 5 mm."""
    top = max(box.center[2] + 0.5 * box.extents_m[2], bottom + 0.005)
    center = np.array([box.center[0], box.center[1], 0.5 * (bottom + top)])
    return UprightBox(center, box.yaw_rad, np.array([box.extents_m[0], box.extents_m[1], top - bottom]))
