"""Where a camera may be: how far a point lies inside the space that frames looked through."""

from dataclasses import dataclass

import numpy as np

from reconstruction.core.types import SpaceGrid

_FREE = 1
_MAX_CELLS = 3_000_000
_BODY_M = 0.15  # whoever filmed held the camera there: that much around it is free


@dataclass(frozen=True)
class Clearance:
    """Signed distance to the border of observed free space, on a grid: positive inside, in metres."""

    origin: np.ndarray  # float64 (3,) center of cell (0, 0, 0)
    cell_m: float
    distance: np.ndarray  # float32 (nx, ny, nz)

    def at(self, point: np.ndarray) -> float:
        """Return the clearance of a point (3,)."""
        return self.with_gradient(point)[0]

    def with_gradient(self, point: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the clearance of a point (3,), interpolated, and its derivative (3,).

        Outside the grid it is that of the nearest border cell, less the distance to it.
        """
        place = (np.asarray(point, np.float64) - self.origin) / self.cell_m
        top = np.array(self.distance.shape) - 1.0
        inside = np.clip(place, 0.0, top)
        beyond = (place - inside) * self.cell_m
        low = np.minimum(inside.astype(np.int64), self.distance.shape - np.array([2, 2, 2]))
        share = inside - low
        i, j, k = low
        corner = self.distance[i : i + 2, j : j + 2, k : k + 2].astype(np.float64)
        wx, wy, wz = (np.array([1.0 - s, s]) for s in share)
        slope = np.array([-1.0, 1.0]) / self.cell_m
        value = float(np.einsum("ijk,i,j,k->", corner, wx, wy, wz))
        gradient = np.array(
            [
                np.einsum("ijk,i,j,k->", corner, slope, wy, wz),
                np.einsum("ijk,i,j,k->", corner, wx, slope, wz),
                np.einsum("ijk,i,j,k->", corner, wx, wy, slope),
            ]
        )
        away = float(np.linalg.norm(beyond))
        if away > 0.0:
            gradient[beyond != 0.0] = 0.0
            return value - away, gradient - beyond / away
        return value, gradient


def measure_clearance(space: SpaceGrid, cameras: np.ndarray) -> Clearance:
    """Measure how far every point lies within the observed free space that the cameras moved in.

    Free space that no way leads to from a camera is not counted: it lies behind a surface.

    Args:
        space: of the surface stage.
        cameras: (n, 3) centers of the input cameras, in time order.
    """
    from scipy import ndimage

    step = 1
    while np.prod(np.array(space.state.shape, float) / step) > _MAX_CELLS:
        step += 1
    free = _coarser(space.state == _FREE, step)
    cell = space.voxel_size_m * step
    origin = np.asarray(space.origin, np.float64) + 0.5 * cell
    free, origin = _with_bodies(free, origin, cell, cameras)
    parts, _ = ndimage.label(free)
    rows = np.round((cameras - origin) / cell).astype(int)
    reached = np.unique(parts[tuple(rows.T)])
    free = np.isin(parts, reached[reached > 0])
    # Borders lie between cells: half a cell less than from center to center, on both sides.
    inside = ndimage.distance_transform_edt(free).astype(np.float32)
    outside = ndimage.distance_transform_edt(~free).astype(np.float32)
    distance = np.where(free, inside - 0.5, 0.5 - outside) * np.float32(cell)
    return Clearance(origin, cell, distance)


def _coarser(free: np.ndarray, step: int) -> np.ndarray:
    """Return cells of step^3 voxels that are free as a whole, with a border of cells that are not."""
    if step > 1:
        padding = [(0, -size % step) for size in free.shape]
        free = np.pad(free, padding)
        x, y, z = (size // step for size in free.shape)
        free = free.reshape(x, step, y, step, z, step).all(axis=(1, 3, 5))
    return free


def _with_bodies(
    free: np.ndarray, origin: np.ndarray, cell: float, cameras: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Free the places of the input cameras; the grid grows to hold them, and by a border that is not free."""
    radius = int(np.ceil(_BODY_M / cell))
    rows = np.round((cameras - origin) / cell).astype(int)
    below = np.maximum(radius + 1 - rows.min(axis=0), 1)
    above = np.maximum(rows.max(axis=0) + radius + 2 - np.array(free.shape), 1)
    free = np.pad(free, list(zip(below, above)))
    around = np.stack(np.meshgrid(*[np.arange(-radius, radius + 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
    around = around[(around**2).sum(axis=1) * cell**2 <= _BODY_M**2]
    places = (rows + below)[:, None] + around[None]
    free[tuple(places.reshape(-1, 3).T)] = True
    return free, origin - below * cell
