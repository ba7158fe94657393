"""Surfaces as fusion makes them: solids joined on a voxel grid, smooth where they touch, colors blurred there."""

from collections.abc import Callable

import numpy as np
from scipy.ndimage import gaussian_filter
from skimage.measure import marching_cubes
from surfaces import Patchwork, surface_from

from reconstruction.core.types import Surface

Solid = tuple[Callable[[np.ndarray], np.ndarray], tuple[int, int, int]]


def box(low, high, color, yaw_rad: float = 0.0) -> Solid:
    """Return a box, turned about its vertical axis: signed distance in metres, and color."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    center, half = 0.5 * (low + high), 0.5 * (high - low)
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)

    def distance(points: np.ndarray) -> np.ndarray:
        local = np.abs((points - center) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])) - half
        return np.linalg.norm(np.maximum(local, 0), axis=-1) + np.minimum(local.max(axis=-1), 0)

    return distance, color


def can(center_xy, radius_m, low_m, high_m, color) -> Solid:
    """Return an upright cylinder."""

    def distance(points: np.ndarray) -> np.ndarray:
        across = np.linalg.norm(points[..., :2] - np.asarray(center_xy), axis=-1) - radius_m
        along = np.abs(points[..., 2] - 0.5 * (low_m + high_m)) - 0.5 * (high_m - low_m)
        both = np.stack([across, along], axis=-1)
        return np.linalg.norm(np.maximum(both, 0), axis=-1) + np.minimum(both.max(axis=-1), 0)

    return distance, color


def tray(low, high, wall_m, color) -> list[Solid]:
    """Return an open container: a bottom and four sides."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    return [
        box((x0, y0, z0), (x1, y1, z0 + wall_m), color),
        box((x0, y0, z0), (x0 + wall_m, y1, z1), color),
        box((x1 - wall_m, y0, z0), (x1, y1, z1), color),
        box((x0, y0, z0), (x1, y0 + wall_m, z1), color),
        box((x0, y1 - wall_m, z0), (x1, y1, z1), color),
    ]


def fused(solids: list[Solid], voxel_m: float = 0.008, half_m: float = 0.5, top_m: float = 1.0) -> Surface:
    """Return the joint surface of solids above a floor, with contacts and colors blurred over a voxel."""
    axes = [np.arange(-half_m, half_m, voxel_m)] * 2 + [np.arange(-3.3 * voxel_m, top_m, voxel_m)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    floor = grid[..., 2]
    field = np.minimum.reduce([floor, *(solid[0](grid) for solid in solids)])
    field = gaussian_filter(np.clip(field, -4 * voxel_m, 4 * voxel_m), 0.8)
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(voxel_m,) * 3)
    vertices = vertices + [axis[0] for axis in axes]
    gaps = np.stack([vertices[:, 2], *(solid[0](vertices) for solid in solids)])
    weight = np.exp(-np.maximum(gaps, 0) / (0.5 * voxel_m))
    paint = np.array([(200, 200, 190), *(solid[1] for solid in solids)], float)
    colors = (weight.T @ paint) / weight.sum(axis=0)[:, None]
    gradient = np.stack(
        [
            np.minimum.reduce([(vertices + step)[:, 2], *(solid[0](vertices + step) for solid in solids)])
            - np.minimum.reduce([(vertices - step)[:, 2], *(solid[0](vertices - step) for solid in solids)])
            for step in 0.25 * voxel_m * np.eye(3)
        ],
        axis=1,
    )
    outward = gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-9)
    corners = vertices[faces]
    turned = (
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) * outward[faces].mean(axis=1)
    ).sum(axis=1) < 0
    faces[turned] = faces[turned][:, ::-1]
    return surface_from(Patchwork(vertices, faces, outward, colors.round().astype(np.uint8)))


def tent(low, high, color, top_m: float = 0.01, yaw_rad: float = 0.0) -> Solid:
    """Return a prism on the floor of a box: two sides lean to each other along y, up to a ridge `top_m` wide."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    center, half, height = 0.5 * (low + high), 0.5 * (high - low), high[2] - low[2]
    lean = (half[1] - 0.5 * top_m) / height
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)

    def distance(points: np.ndarray) -> np.ndarray:
        local = (points - center) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        ends = np.abs(local) - half
        side = np.abs(local[..., 1]) - half[1] + lean * (local[..., 2] + half[2])
        return np.maximum.reduce([ends[..., 0], ends[..., 2], side / np.hypot(1.0, lean)])

    return distance, color
