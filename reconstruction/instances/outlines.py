"""Outlines in plan, as masks of cells and as polygons."""

import cv2
import numpy as np


def filled_polygon(shape: tuple[int, ...], corners: np.ndarray) -> np.ndarray:
    """Return the cells, bool of a shape (nx, ny), that a convex polygon covers; corners int32 (k, 1, 2) or (k, 2)."""
    grid = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(grid, corners, 1)
    return grid > 0


def filled_hull(cells: np.ndarray) -> np.ndarray:
    """Return a mask of cells (nx, ny) filled to its convex hull."""
    return filled_polygon(cells.shape, cv2.convexHull(np.argwhere(cells)[:, ::-1].astype(np.int32)))


def inset(outline: np.ndarray, points_xy: np.ndarray) -> np.ndarray:
    """Return how far points are within an outline in plan, in meters; negative outside of it.

    Args:
        outline: float32 (k, 1, 2) or (k, 2) corners of a polygon in order, such as `cv2.convexHull` returns.
        points_xy: (n, 2), rounded to float32 as the corners are.

    Returns:
        float64 (n,) distance to the nearest side.
    """
    points = np.asarray(points_xy, np.float64).tolist()
    return np.array([cv2.pointPolygonTest(outline, (x, y), True) for x, y in points], np.float64)
