"""Compiled: which points on a closed shape a camera sees past the shape itself and past what else is there."""

import math

import numba

SQUARE = 0.5  # cosine; what is seen at a steeper slant waits for a better view


@numba.njit(cache=True, nogil=True)
def see_points(
    start,
    stop,
    eyes,
    points,
    sides,
    normals,
    solid,
    origin,
    cell,
    near,
    near_origin,
    near_cell,
    occupied,
    far_origin,
    far_cell,
    out,
):  # pragma: no cover - compiled
    """Follow the line from every point to every eye through two grids.

    Args:
        start: First eye; stop alike.
        eyes: (k, 3).
        points: (n, 3) on the border of the shape's cells.
        sides: (n, 3) the direction in which the cell at each point ends; normals (n, 3) smooth ones.
        solid: bool grid of the shape; origin (3,) of its corner, cell its size.
        near: fine bool grid of everything else around the shape; near_origin (3,) and near_cell alike.
        occupied: bool grid of everything else, for what lies farther; far_origin (3,) and far_cell alike.
        out: float32 (k, n) filled: 0 where the point is not seen, 1 where it is seen at a slant of up to 60 degrees.
    """
    for k in range(start, stop):
        for i in range(len(points)):
            dx, dy, dz = eyes[k, 0] - points[i, 0], eyes[k, 1] - points[i, 1], eyes[k, 2] - points[i, 2]
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            if length < 1e-6:
                continue
            dx, dy, dz = dx / length, dy / length, dz / length
            if dx * sides[i, 0] + dy * sides[i, 1] + dz * sides[i, 2] <= 0.02:
                continue
            along = dx * normals[i, 0] + dy * normals[i, 1] + dz * normals[i, 2]
            if along <= 0.05:
                continue
            x = points[i, 0] + 0.3 * cell * sides[i, 0]
            y = points[i, 1] + 0.3 * cell * sides[i, 1]
            z = points[i, 2] + 0.3 * cell * sides[i, 2]
            # The cells next to a point hide it only by their own steps.
            if (
                _followed(x, y, z, dx, dy, dz, 1.5 * cell, length, 0.5 * cell, solid, origin, cell, True)
                < 0.0
            ):
                continue
            last = length - 0.05
            at = _followed(
                x, y, z, dx, dy, dz, near_cell, last, 0.5 * near_cell, near, near_origin, near_cell, True
            )  # fmt: skip
            if at < 0.0:
                continue
            at = max(at, far_cell)
            at = _followed(
                x, y, z, dx, dy, dz, at, last, 0.5 * far_cell, occupied, far_origin, far_cell, False
            )  # fmt: skip
            if at >= 0.0:
                out[k, i] = min(along / SQUARE, 1.0)


@numba.njit(cache=True, nogil=True)
def _followed(
    x, y, z, dx, dy, dz, first, last, step, grid, origin, cell, leaves
):  # pragma: no cover - compiled
    """Return how far a line was followed, -1 where it met a marked cell; with `leaves`, it ends with the grid."""
    at = first
    while at < last:
        a = int(math.floor((x + at * dx - origin[0]) / cell))
        b = int(math.floor((y + at * dy - origin[1]) / cell))
        c = int(math.floor((z + at * dz - origin[2]) / cell))
        inside = 0 <= a < grid.shape[0] and 0 <= b < grid.shape[1] and 0 <= c < grid.shape[2]
        if inside:
            if grid[a, b, c]:
                return -1.0
        elif leaves:
            return at
        at += step
    return max(at, 0.0)
