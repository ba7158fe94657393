"""Compiled ray marching: visibility of surface points of a closed shape past itself and other occluders."""

import math

import numba

SQUARE = 0.5  # cosine to the normal from which a point counts as fully visible


@numba.njit(cache=True, nogil=True)
def see_points(
    start, stop, eyes, points, sides, normals, solid, origin, cell, near, near_origin, near_cell, occupied, far_origin,
    far_cell, out,
):  # fmt: skip  # pragma: no cover - compiled
    """March from every point to the eyes start..stop through the shape, near occluders and far occluders.

    eyes (k, 3), points, sides and normals (n, 3), and the three bool grids with corner and cell size are those of
    `ClosedShape`. Fills out, float32 (k, n): 0 if occluded, 1 if seen up to 60 degrees from the normal.
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
            # Start 1.5 cells away: adjacent cells would hide the point by their staircase alone.
            if (
                _followed(x, y, z, dx, dy, dz, 1.5 * cell, length, 0.5 * cell, solid, origin, cell, True)
                < 0.0
            ):
                continue
            last = length - 0.05
            at = _followed(
                x, y, z, dx, dy, dz, near_cell, last, 0.5 * near_cell, near, near_origin, near_cell, True
            )
            if at < 0.0:
                continue
            at = max(at, far_cell)
            at = _followed(
                x, y, z, dx, dy, dz, at, last, 0.5 * far_cell, occupied, far_origin, far_cell, False
            )
            if at >= 0.0:
                out[k, i] = min(along / SQUARE, 1.0)


@numba.njit(cache=True, nogil=True)
def _followed(
    x, y, z, dx, dy, dz, first, last, step, grid, origin, cell, leaves
):  # pragma: no cover - compiled
    """March along a ray; return the distance reached, -1 at a marked cell. With `leaves`, stop outside of the grid."""
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
