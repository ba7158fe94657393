"""Convex polygons in the plane: what layout needs to keep things apart and on their supports.

Polygons are float64 (k, 2), counter-clockwise, in metres.
"""

import numpy as np


def convex_hull(points: np.ndarray) -> np.ndarray:
    """Return the hull (k, 2) of points (n, 2), without collinear corners (monotone chain)."""
    ordered = np.unique(np.round(points, 9), axis=0)

    def chain(sequence: np.ndarray) -> list[np.ndarray]:
        out: list[np.ndarray] = []
        for p in sequence:
            while len(out) > 1 and _cross(out[-1] - out[-2], p - out[-1]) <= 1e-12:
                out.pop()
            out.append(p)
        return out[:-1]

    return np.array(chain(ordered) + chain(ordered[::-1]))


def _cross(a: np.ndarray, b: np.ndarray) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def rectangle(width: float, depth: float, x: float = 0.0, y: float = 0.0) -> np.ndarray:
    """Return an axis-aligned rectangle around (x, y)."""
    half = np.array([width, depth]) / 2
    return np.array([x, y]) + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


def disc(radius: float, corners: int = 24) -> np.ndarray:
    """Return a regular polygon inside a circle around the origin."""
    angles = np.arange(corners) * 2 * np.pi / corners
    return radius * np.stack([np.cos(angles), np.sin(angles)], -1)


def turned(polygon: np.ndarray, yaw_rad: float, x: float = 0.0, y: float = 0.0) -> np.ndarray:
    """Turn around the origin, then shift."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return polygon @ np.array([[c, s], [-s, c]]) + (x, y)


def _normals(polygon: np.ndarray) -> np.ndarray:
    edge = np.roll(polygon, -1, axis=0) - polygon
    outward = np.stack([edge[:, 1], -edge[:, 0]], -1)
    return outward / np.linalg.norm(outward, axis=1, keepdims=True)


def depth_inside(points: np.ndarray, polygon: np.ndarray) -> float:
    """Return how deep the shallowest of the points (n, 2) lies inside; negative where one is outside."""
    normals = _normals(polygon)
    return float(-(points @ normals.T - np.sum(polygon * normals, axis=1)).max())


def distance(a: np.ndarray, b: np.ndarray) -> float:
    """Return the distance between two convex polygons; where they overlap, minus the depth of the overlap."""
    normals = np.concatenate([_normals(a), -_normals(b)])
    gap = float(((b @ normals.T).min(0) - (a @ normals.T).max(0))[: len(a)].max())
    gap = max(gap, float(((b @ normals.T).min(0) - (a @ normals.T).max(0))[len(a) :].max()))
    if gap <= 0:
        return gap
    return min(
        point_distance(a, b), point_distance(b, a)
    )  # corner to corner can be farther than any axis says


def point_distance(points: np.ndarray, polygon: np.ndarray) -> float:
    """Return the smallest distance of points (n, 2) to the edges of a polygon."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    away = points[:, None] - polygon
    share = np.clip(np.sum(away * edge, -1) / np.sum(edge**2, -1), 0, 1)
    return float(np.linalg.norm(away - share[..., None] * edge, axis=-1).min())


def intersection(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the common part (k, 2) of two convex polygons, (0, 2) where there is none."""
    out = a
    for normal, corner in zip(_normals(b), b):
        if len(out) == 0:
            break
        height = (out - corner) @ normal
        clipped = []
        for i in range(len(out)):
            j = (i + 1) % len(out)
            if height[i] <= 0:
                clipped.append(out[i])
            if (height[i] <= 0) != (height[j] <= 0):
                share = height[i] / (height[i] - height[j])
                clipped.append(out[i] + share * (out[j] - out[i]))
        out = np.array(clipped).reshape(-1, 2)
    return out


def area(polygon: np.ndarray) -> float:
    """Return the area in square metres."""
    if len(polygon) < 3:
        return 0.0
    x, y = polygon.T
    return float(0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
