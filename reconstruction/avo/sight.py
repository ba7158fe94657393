"""Compiled: which points on a closed shape a camera sees past the shape itself and past what else is there."""

import math

import numba


@numba.njit(cache=True, nogil=True)
def see_points(
    start, stop, eyes, points, sides, normals, solid, origin, cell, occupied, far_origin, far_cell, out
):  # pragma: no cover - compiled
    """Follow the line from every point to every eye through two grids.

    Args:
        start: First eye; stop alike.
        eyes: (k, 3).
        points: (n, 3) on the border of the shape's cells.
        sides: (n, 3) the direction in which the cell at each point ends; normals (n, 3) smooth ones.
        solid: bool grid of the shape; origin (3,) of its corner, cell its size.
        occupied: bool grid of everything else; far_origin (3,) and far_cell alike.
        out: bool (k, n) filled.
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
            if dx * normals[i, 0] + dy * normals[i, 1] + dz * normals[i, 2] <= 0.05:
                continue
            x = points[i, 0] + 0.3 * cell * sides[i, 0]
            y = points[i, 1] + 0.3 * cell * sides[i, 1]
            z = points[i, 2] + 0.3 * cell * sides[i, 2]
            # The cells next to a point hide it only by their own steps.
            if _hits(x, y, z, dx, dy, dz, 1.5 * cell, length, 0.5 * cell, solid, origin, cell, True):
                continue
            hidden = _hits(
                x, y, z, dx, dy, dz, far_cell, length - 0.05, 0.5 * far_cell, occupied, far_origin, far_cell, False
            )  # fmt: skip
            out[k, i] = not hidden


@numba.njit(cache=True, nogil=True)
def _hits(x, y, z, dx, dy, dz, first, last, step, grid, origin, cell, leaves):  # pragma: no cover - compiled
    """Tell whether a line meets a marked cell; with `leaves`, it is over where the line leaves the grid."""
    at = first
    while at < last:
        a = int(math.floor((x + at * dx - origin[0]) / cell))
        b = int(math.floor((y + at * dy - origin[1]) / cell))
        c = int(math.floor((z + at * dz - origin[2]) / cell))
        inside = 0 <= a < grid.shape[0] and 0 <= b < grid.shape[1] and 0 <= c < grid.shape[2]
        if inside:
            if grid[a, b, c]:
                return True
        elif leaves:
            return False
        at += step
    return False
