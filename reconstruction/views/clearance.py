"""Signed distance field of observed free space: how far a camera is from occupied or unobserved space."""

from dataclasses import dataclass

import numpy as np

from reconstruction.core.types import SpaceGrid

_FREE = 1  # state of `SpaceGrid`
_MAX_CELLS = 3_000_000  # of the distance field; larger grids are coarsened
_BODY_M = 0.15  # radius around input cameras that is free, since somebody held them there


@dataclass(frozen=True)
class Clearance:
    """Signed distance to the border of observed free space on a grid, metres, positive inside."""

    origin: np.ndarray  # float64 (3,) center of cell (0, 0, 0), world space
    cell_m: float
    distance: np.ndarray  # float32 (nx, ny, nz)

    def at(self, point: np.ndarray) -> float:
        """Return the clearance at a world point (3,), metres."""
        return self.with_gradient(point)[0]

    def with_gradient(self, point: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the trilinearly interpolated clearance at a world point (3,) and its gradient (3,).

        Outside of the grid it is the clearance at the nearest grid point minus the distance to it.
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
        weights = ((slope, wy, wz), (wx, slope, wz), (wx, wy, slope))
        gradient = np.array([np.einsum("ijk,i,j,k->", corner, *axes) for axes in weights])
        away = float(np.linalg.norm(beyond))
        if away > 0.0:
            gradient[beyond != 0.0] = 0.0
            return value - away, gradient - beyond / away
        return value, gradient


def measure_clearance(space: SpaceGrid, cameras: np.ndarray) -> Clearance:
    """Compute the signed distance field of the free space that is connected to the input cameras.

    Other free components lie behind surfaces and do not count.

    Args:
        space: of the surface stage.
        cameras: (n, 3) centers of the input cameras, world space.
    """
    from scipy import ndimage

    step = 1
    while np.prod(np.array(space.state.shape, float) / step) > _MAX_CELLS:
        step += 1
    free = _coarser(space.state == _FREE, step)
    cell = space.voxel_size_m * step
    origin = np.asarray(space.origin, np.float64) + 0.5 * cell
    free, origin = _with_bodies(free, origin, cell, cameras)
    parts = np.asarray(ndimage.label(free)[0])  # pyright: ignore[reportIndexIssue]
    rows = np.round((cameras - origin) / cell).astype(int)
    reached = np.unique(parts[tuple(rows.T)])
    free = np.isin(parts, reached[reached > 0])
    # The border lies half a cell nearer than the center of the next cell, on both sides.
    inside = np.asarray(ndimage.distance_transform_edt(free), np.float32)
    outside = np.asarray(ndimage.distance_transform_edt(~free), np.float32)
    distance = np.where(free, inside - 0.5, 0.5 - outside) * np.float32(cell)
    return Clearance(origin, cell, distance)


def _coarser(free: np.ndarray, step: int) -> np.ndarray:
    """Return the mask of cells of step^3 voxels that are wholly free."""
    if step == 1:
        return free
    free = np.pad(free, [(0, -size % step) for size in free.shape])
    x, y, z = (size // step for size in free.shape)
    return np.asarray(free.reshape(x, step, y, step, z, step).all(axis=(1, 3, 5)))


def _with_bodies(
    free: np.ndarray, origin: np.ndarray, cell: float, cameras: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mark balls around the input cameras as free; the grid grows to hold them and a border that is not free."""
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
