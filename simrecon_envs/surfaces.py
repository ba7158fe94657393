"""Height maps of convex solids; free horizontal spots on supports and the insides of containers.

NumPy and SciPy only; used before the simulator is built.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from simrecon_envs.occupancy import ConvexSolid

CELL_M = 0.015
_FINE_CELL_M = 0.006  # for the insides of containers
_LEVEL_M = 0.006  # maximum height range within a spot
_KEEP_OFF_M = 0.02  # free distance around a spot
_RIM_M = 0.015  # minimum depth of a container
_MAX_WINDOW_M = 2.4  # side of the searched window of a large support


@dataclass(frozen=True)
class HeightMap:
    """Grid of surface heights in top view; -inf in empty cells."""

    lower: np.ndarray  # float64 (2,)
    top: np.ndarray  # float64 (nx, ny) world z
    cell_m: float

    def centers(self) -> np.ndarray:
        """Return the cell centres (nx, ny, 2)."""
        axes = [self.lower[a] + (np.arange(self.top.shape[a]) + 0.5) * self.cell_m for a in range(2)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


@dataclass(frozen=True)
class Container:
    """The inside of an open container, in world space at its captured pose."""

    id: int
    cells: np.ndarray  # float64 (k, 2) xy of inner cells
    floor_m: float
    rim_m: float
    center: np.ndarray  # float64 (3,) on its floor, farthest from the wall
    radius_m: float  # distance of the centre from the wall


def height_map(
    solids: list[ConvexSolid], lower: np.ndarray, upper: np.ndarray, cell_m: float = CELL_M
) -> HeightMap:
    """Rasterize the heights of solids over the rectangle from `lower` (2,) to `upper` (2,)."""
    shape = np.maximum(np.ceil((np.asarray(upper) - lower) / cell_m).astype(int), 1)
    out = HeightMap(np.asarray(lower, np.float64), np.full(tuple(shape), -np.inf), cell_m)
    for solid in solids:
        low = np.floor((solid.lower[:2] - lower) / cell_m).astype(int).clip(0, shape)
        high = np.ceil((solid.upper[:2] - lower) / cell_m).astype(int).clip(0, shape)
        if (high <= low).any():
            continue
        x, y = (out.lower[a] + (np.arange(low[a], high[a]) + 0.5) * cell_m for a in range(2))
        above, below = np.full((len(x), len(y)), np.inf), np.full((len(x), len(y)), -np.inf)
        for nx, ny, nz, d in solid.half_spaces:
            level = (nx * x)[:, None] + (ny * y)[None, :] + d
            if abs(nz) > 1e-6:
                bound = -level / nz
                if nz > 0:
                    above = np.minimum(above, bound)
                else:
                    below = np.maximum(below, bound)
            else:
                above = np.where(level > 1e-9, -np.inf, above)
        inside = np.where(above >= below - 1e-9, above, -np.inf)
        window = out.top[low[0] : high[0], low[1] : high[1]]
        np.maximum(window, inside, out=window)
    return out


def free_spots(
    solids: list[ConvexSolid],
    support: int,
    radius_m: float,
    ignored: frozenset[int] = frozenset(),
    around: np.ndarray | None = None,
) -> np.ndarray:
    """Return horizontal spots (k, 3) on top of a support where a disk is free, those with most space first.

    Args:
        solids: All convex solids of the scene.
        support: Id of the object or base entity.
        radius_m: Radius of the disk.
        ignored: Ids that are no obstacles, such as the object to be moved.
        around: Middle (2,) of the searched window of a large support; None for the whole support.
    """
    from scipy import ndimage

    own = [s for s in solids if s.owner == support]
    if not own:
        return np.zeros((0, 3))
    lower = np.min([s.lower for s in own], axis=0)[:2]
    upper = np.max([s.upper for s in own], axis=0)[:2]
    if around is not None:
        lower = np.maximum(lower, np.asarray(around) - _MAX_WINDOW_M / 2)
        upper = np.minimum(upper, np.asarray(around) + _MAX_WINDOW_M / 2)
    if (upper - lower <= 2 * radius_m).any():
        return np.zeros((0, 3))
    mine = height_map(own, lower, upper)
    rest = height_map([s for s in solids if s.owner != support and s.owner not in ignored], lower, upper).top
    disk = _disk(radius_m)
    low = ndimage.minimum_filter(mine.top, footprint=disk, mode="constant", cval=-np.inf)
    high = ndimage.maximum_filter(mine.top, footprint=disk, mode="constant", cval=np.inf)
    with np.errstate(invalid="ignore"):
        level = np.isfinite(low) & np.isfinite(high) & (high - low <= _LEVEL_M)
    taken = rest > mine.top + 0.003
    room = np.asarray(ndimage.distance_transform_edt(~taken)) * CELL_M
    free = level & (room > radius_m + _KEEP_OFF_M)
    spots = np.column_stack([mine.centers()[free], high[free]])
    # Order by free distance, capped 10 cm beyond the radius.
    order = np.lexsort((np.arange(len(spots)), -np.minimum(room[free], radius_m + 0.10).round(3)))
    return spots[order]


def find_container(solids: list[ConvexSolid], owner: int) -> Container | None:
    """Return the inside of an object with a closed wall and an open top, or None if it is no container."""
    from scipy import ndimage

    own = [s for s in solids if s.owner == owner]
    if len(own) < 3:  # too few convex parts for a container
        return None
    lower, upper = np.min([s.lower for s in own], axis=0), np.max([s.upper for s in own], axis=0)
    if (upper - lower)[2] < _RIM_M or (upper - lower).max() > 1.0:
        return None
    margin = 3 * _FINE_CELL_M
    heights = height_map(own, lower[:2] - margin, upper[:2] + margin, _FINE_CELL_M)
    for rim in np.linspace(upper[2] - 0.004, lower[2] + _RIM_M + 0.004, 8):
        # Dilate: a wall thinner than a cell may lie between cell centres.
        wall = np.asarray(ndimage.binary_dilation(heights.top >= rim), bool)
        inside = np.asarray(ndimage.binary_fill_holes(wall)) & ~wall
        inside &= np.isfinite(heights.top) & (heights.top < rim - _RIM_M + 0.004)
        distance = np.asarray(ndimage.distance_transform_edt(inside)) * _FINE_CELL_M
        best = np.unravel_index(np.argmax(distance), distance.shape)
        if distance[best] < 0.02:
            continue
        components: Any = ndimage.label(inside)
        inside = components[0] == components[0][best]
        floor = float(np.median(heights.top[inside]))
        xy = heights.centers()
        center = np.array([*xy[best], floor])
        return Container(owner, xy[inside], floor, float(rim), center, float(distance[best]))
    return None


def _disk(radius_m: float) -> np.ndarray:
    cells = int(np.ceil(radius_m / CELL_M))
    axis = np.arange(-cells, cells + 1)
    return axis[:, None] ** 2 + axis[None, :] ** 2 <= (radius_m / CELL_M + 0.5) ** 2
