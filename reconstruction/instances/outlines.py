"""Outlines in plan, as masks of cells."""

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
