"""A closed star-shaped mesh on a grid of directions: the box around a scene, pushed out to farther measured points."""

from dataclasses import dataclass

import numpy as np

from reconstruction.assets.texture import push_pull

ROWS = 90  # of the grid, from straight down to straight up: 2 degrees
_LEAST_SAMPLES = 10  # points in a direction; fewer may all be outliers of one pixel's neighborhood
_FARTHEST = 10.0  # largest radius relative to the box; farther, parallax within a room is below a pixel


@dataclass(frozen=True)
class Shell:
    """A star-shaped mesh around `center`, seen from inside."""

    center: np.ndarray  # float64 (3,)
    points: (
        np.ndarray
    )  # float64 (rows + 1, columns + 1, 3); row 0 is straight down, the last column repeats the first

    def mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return vertices (v, 3), faces (f, 3) that face inward, and equirectangular uvs (v, 2)."""
        rows, columns = self.points.shape[0] - 1, self.points.shape[1] - 1
        index = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
        a, b, c, d = (x.ravel() for x in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
        v, u = np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
        # One triangle of each cell at a pole has no area.
        faces = np.concatenate([np.stack([a, d, c], -1)[:-columns], np.stack([a, c, b], -1)[columns:]])
        return self.points.reshape(-1, 3), faces.astype(np.int32), np.stack([u, v], -1).reshape(-1, 2)

    def at(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the points (n, 3) at texture coordinates u, v (n,), bilinear between vertices."""
        rows, columns = self.points.shape[0] - 1, self.points.shape[1] - 1
        y, x = np.clip(v * rows, 0, rows - 1e-9), np.clip(u * columns, 0, columns - 1e-9)
        i, j = y.astype(int), x.astype(int)
        s, t = (y - i)[:, None], (x - j)[:, None]
        near = self.points[i, j] * (1 - t) + self.points[i, j + 1] * t
        far = self.points[i + 1, j] * (1 - t) + self.points[i + 1, j + 1] * t
        return near * (1 - s) + far * s


def room_shell(
    center: np.ndarray, low: np.ndarray, high: np.ndarray, points: np.ndarray, looked: np.ndarray, rows: int = ROWS
) -> Shell:  # fmt: skip
    """Push a box out to points where these are farther.

    A cell of directions takes the median of its points. Cells that were looked at without a point are interpolated
    between their neighbors; all others stay on the box.

    Args:
        center: (3,) inside of the box.
        low: (3,) lower corner.
        high: (3,) upper corner.
        points: (n, 3) measured beyond the scene's meshes, in the scene or outside of the box.
        looked: (k, 3) on the box, where rays leave it that hit nothing in the scene.
        rows: of the grid.
    """
    elevation, azimuth = np.meshgrid(
        np.linspace(-np.pi / 2, np.pi / 2, rows + 1), np.linspace(-np.pi, np.pi, 2 * rows + 1), indexing="ij"
    )
    flat = np.cos(elevation)
    directions = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1)
    box = box_distance(center, directions.reshape(-1, 3), low, high).reshape(elevation.shape)
    measured = _cell_medians(center, low, high, points, rows)
    known = np.isfinite(measured)
    ratio = np.where(known, measured, 1.0)
    looked_at = np.zeros((rows, 2 * rows), bool)
    looked_at.ravel()[_cells(looked - center, rows)] = True
    known |= ~looked_at
    # Three copies side by side, as directions wrap around.
    wide = push_pull(np.tile(np.log(ratio)[..., None], (1, 3, 3)).astype(np.float32), np.tile(known, (1, 3)))
    cells = np.exp(np.where(known, np.log(ratio), wide[:, 2 * rows : 4 * rows, 0]))
    corners = _corner_means(np.clip(cells, 1.0, _FARTHEST))
    return Shell(center, center + directions * (box * corners)[..., None])


def box_distance(origin: np.ndarray, directions: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the distances (n,), in lengths of `directions` (n, 3), at which rays from inside leave a box."""
    with np.errstate(divide="ignore", invalid="ignore"):
        along = np.where(directions > 0, high - origin, low - origin) / directions
    return np.where(np.abs(directions) > 1e-12, along, np.inf).min(axis=-1)


def _cells(away: np.ndarray, rows: int) -> np.ndarray:
    """Return the cell (n,) of the grid of directions of vectors (n, 3)."""
    elevation = np.arctan2(away[:, 2], np.hypot(away[:, 0], away[:, 1]))
    azimuth = np.arctan2(away[:, 1], away[:, 0])
    i = np.clip(((elevation / np.pi + 0.5) * rows).astype(int), 0, rows - 1)
    return i * 2 * rows + np.clip(((azimuth / np.pi + 1) * rows).astype(int), 0, 2 * rows - 1)


def _cell_medians(
    center: np.ndarray, low: np.ndarray, high: np.ndarray, points: np.ndarray, rows: int
) -> np.ndarray:
    """Return the median radius of points relative to the box in each cell (rows, 2 rows), NaN where there are few."""
    out = np.full(2 * rows * rows, np.nan)
    if len(points):
        away = points - center
        radius = np.linalg.norm(away, axis=1)
        ratio = radius / box_distance(center, away / np.maximum(radius, 1e-9)[:, None], low, high)
        cell = _cells(away, rows)
        order = np.lexsort((ratio, cell))
        found, first, count = np.unique(cell[order], return_index=True, return_counts=True)
        enough = count >= _LEAST_SAMPLES
        out[found[enough]] = ratio[order][(first + count // 2)[enough]]
    return out.reshape(rows, 2 * rows)


def _corner_means(cells: np.ndarray) -> np.ndarray:
    """Return the mean (r + 1, c + 1) of the cells (r, c) around each corner; columns wrap around."""
    padded = np.pad(np.pad(cells, ((0, 0), (1, 1)), mode="wrap"), ((1, 1), (0, 0)), mode="edge")
    out = (padded[:-1, :-1] + padded[1:, :-1] + padded[:-1, 1:] + padded[1:, 1:]) / 4
    out[0], out[-1] = out[0].mean(), out[-1].mean()
    return out
