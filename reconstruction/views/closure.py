"""Estimate the closed shape of a target, and which part of its surface a camera sees.

Gaussians exist only where frames saw surface, but views of unseen sides matter most. The closed shape of an object is a
conservative guess of it: the convex hull of its seen surface and of that surface projected onto its lowest height,
minus observed free space. Carving restores the hollow of a bowl and the space between the legs of a table.
"""

from dataclasses import dataclass

import numpy as np

from reconstruction.core.types import Camera
from reconstruction.gaussians.threads import run_over
from reconstruction.views.scene import Target, ViewScene
from registry.geometry import matrix_from_quat

_FREE, _SURFACE = 1, 2  # states of `SpaceGrid`
_CELLS, _LEAST_CELL_M = 28, 0.006  # cells along the longest side of the target; smallest cell
_OPAQUE = 0.3  # opacity from which a Gaussian is surface
_LEAST_POINTS = 20  # surface vertices of an object; with fewer its Gaussians are used
_OUTLIERS = (0.5, 99.5)  # percentiles outside of which points are dropped
_SMOOTH = 1.2  # standard deviation of the smoothing for normals, in cells
_LEAST_SIDE = 0.05  # smallest area of a cell side, relative to that of a side parallel to the surface
_OWN_CELLS = 2  # surface cells this near to the target are its own if nothing else has Gaussians there
_NEAR_M = 0.12  # margin of the fine grid around the target's box
_NEAR_SHARE = 0.4  # cell of the fine grid relative to that of the scene's grid
_MOST_RINGS = 6  # of sample points on a disk
_STANDS_M = 0.01  # surface lower than this above the target's bottom supports it and does not occlude


@dataclass(frozen=True)
class ClosedShape:
    """The estimated solid of a target, the occluders around it, and sample points on its surface; world space."""

    solid: np.ndarray  # bool (nx, ny, nz) cells of the target
    origin: np.ndarray  # float64 (3,) corner of cell (0, 0, 0)
    cell_m: float
    near: np.ndarray  # bool (ax, ay, az) fine grid of occluders near the target
    near_origin: np.ndarray  # float64 (3,) corner of its cell (0, 0, 0)
    near_cell_m: float
    occupied: np.ndarray  # bool (bx, by, bz) occluders in the scene's occupancy grid
    space_origin: np.ndarray  # float64 (3,) corner of its cell (0, 0, 0)
    space_cell_m: float
    points: np.ndarray  # float64 (n, 3) center of each exposed side of a solid cell
    sides: np.ndarray  # float64 (n, 3) outward axis direction of the side
    normals: np.ndarray  # float64 (n, 3) smooth surface normal
    areas: np.ndarray  # float64 (n,) share of the surface, sum 1

    def seen(self, poses: np.ndarray, camera: Camera) -> np.ndarray:
        """Return the visibility of the points from world_from_camera poses (k, 4, 4), float32 (k, n).

        0 if occluded or out of view; 1 up to 60 degrees from the normal, less beyond.
        """
        from reconstruction.views.line_of_sight import see_points

        out = np.zeros((len(poses), len(self.points)), np.float32)
        run_over(
            len(poses), see_points, np.ascontiguousarray(poses[:, :3, 3]), self.points, self.sides, self.normals,
            self.solid, self.origin, self.cell_m, self.near, self.near_origin, self.near_cell_m, self.occupied,
            self.space_origin, self.space_cell_m, out,
        )  # fmt: skip
        for row, pose in zip(out, poses):
            local = (self.points - pose[:3, 3]) @ pose[:3, :3]
            local[:, 2] = np.maximum(local[:, 2], 1e-6)
            u, v = camera.project(local)
            row *= (local[:, 2] > 1e-3) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        return out


def close_shape(scene: ViewScene, target: Target) -> ClosedShape:
    """Estimate the closed shape of a target; each object of a region is closed separately."""
    clouds = [cloud for number in target.ids if len(cloud := _cloud(scene, target, number))]
    every = np.concatenate(clouds)
    low, high = every.min(axis=0), every.max(axis=0)
    cell = max(float((high - low).max()) / _CELLS, _LEAST_CELL_M)
    origin = low - 1.5 * cell
    shape = np.ceil((high - origin) / cell).astype(int) + 2
    centers = origin + (np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 3) + 0.5) * cell
    inside = np.zeros(len(centers), bool)
    for cloud in clouds:
        inside |= _in_hull(cloud, centers, 0.25 * cell)
    inside[inside] = scene.space.lookup(centers[inside]) != _FREE
    solid = inside.reshape(shape)
    solid[tuple(np.floor((every - origin) / cell).astype(int).T)] = True
    points, sides, normals, areas = _border(solid, origin, cell)
    space = scene.space
    return ClosedShape(
        solid, origin, cell, *_occupied_near(scene, target, low, high), _occupied(scene, target, every),
        np.asarray(space.origin, np.float64), float(space.voxel_size_m), points, sides, normals, areas,
    )  # fmt: skip


def _cloud(scene: ViewScene, target: Target, number: int) -> np.ndarray:
    """Return the surface points (n, 3) of one object without outliers; its opaque Gaussians if it has no surface."""
    points = scene.points[scene.point_instance == number]
    if len(points) < _LEAST_POINTS:
        packed = scene.packed[target.rows[scene.instance[target.rows] == number]].astype(np.float64)
        opaque = _opaque(packed)
        points = packed[opaque if opaque.sum() > 3 else slice(None), :3]
    if not len(points):
        return points
    low, high = np.percentile(points, _OUTLIERS, axis=0)
    near = ((points >= low - 0.01) & (points <= high + 0.01)).all(axis=1)
    return points[near] if near.any() else points


def _opaque(packed: np.ndarray) -> np.ndarray:
    """Return the mask (n,) of packed Gaussians (n, 13) that are opaque enough to be surface."""
    return 1.0 / (1.0 + np.exp(-packed[:, 9])) > _OPAQUE


def _in_hull(cloud: np.ndarray, centers: np.ndarray, slack: float) -> np.ndarray:
    """Return the mask of centers (k, 3) in the convex hull of a cloud and its projection onto its lowest height."""
    from scipy.spatial import ConvexHull, QhullError

    shadow = np.column_stack([cloud[:, :2], np.full(len(cloud), cloud[:, 2].min())])
    try:
        hull = ConvexHull(np.concatenate([cloud, shadow]))
    except (QhullError, ValueError):
        return np.zeros(len(centers), bool)  # degenerate: flat, or too few points
    inside = np.ones(len(centers), bool)
    for plane in np.unique(np.round(hull.equations, 6), axis=0):
        inside &= centers @ plane[:3] + plane[3] < slack
    return inside


def _border(
    solid: np.ndarray, origin: np.ndarray, cell: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return points, sides, normals and areas of `ClosedShape`, one per exposed side of a solid cell."""
    from scipy import ndimage

    smooth = ndimage.gaussian_filter(solid.astype(np.float32), _SMOOTH)
    slope = np.moveaxis(np.asarray(np.gradient(smooth)), 0, -1)
    points, sides, normals = [], [], []
    for axis in range(3):
        for way in (1, -1):
            cells = np.argwhere(solid & ~np.roll(solid, -way, axis=axis))
            side = np.zeros(3)
            side[axis] = way
            points.append(origin + (cells + 0.5 + 0.5 * side) * cell)
            sides.append(np.tile(side, (len(cells), 1)))
            normals.append(-slope[tuple(cells.T)])
    side, normal = np.concatenate(sides), np.concatenate(normals).astype(np.float64)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    # The sides of a staircase are larger than the slope: scale them by the cosine. Sheets of one cell have no gradient.
    along = (side * normal).sum(axis=1)
    normal = np.where((along > _LEAST_SIDE)[:, None], normal, side)
    area = np.maximum(along, _LEAST_SIDE)
    return np.concatenate(points), side, normal, area / area.sum()


def _occupied_near(
    scene: ViewScene, target: Target, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the fine occluder grid around the target's box, its corner and its cell size.

    The scene's grid would close gaps between objects that stand close together. A Gaussian occupies the disk of its
    first standard deviation. Cells below the target are empty.
    """
    cell = _NEAR_SHARE * float(scene.space.voxel_size_m)
    origin = low - _NEAR_M
    shape = np.ceil((high + _NEAR_M - origin) / cell).astype(int)
    out = np.zeros(shape, bool)
    others = _opaque(scene.packed)
    others[target.rows] = False
    means = scene.packed[:, :3]
    others &= ((means > origin - 0.1) & (means < high + _NEAR_M + 0.1)).all(axis=1)
    packed = scene.packed[others].astype(np.float64)
    if len(packed):
        sizes, turn = np.exp(packed[:, 7:9]), matrix_from_quat(packed[:, 3:7])
        counts = np.minimum(np.ceil(sizes.max(axis=1) / cell), _MOST_RINGS).astype(int)
        for count in np.unique(counts):
            rows = counts == count
            steps = np.linspace(-1.0, 1.0, 2 * count + 1)
            a, b = (grid.ravel() for grid in np.meshgrid(steps, steps))
            inside = a**2 + b**2 <= 1.01
            across = turn[rows][:, :, :2] * sizes[rows][:, None, :]  # (r, 3, 2)
            disk = np.stack([a[inside], b[inside]])
            points = packed[rows, None, :3] + np.einsum("rcs,sp->rpc", across, disk)
            cells = np.floor((points.reshape(-1, 3) - origin) / cell).astype(np.int64)
            out[tuple(cells[((cells >= 0) & (cells < shape)).all(axis=1)].T)] = True
    out[:, :, : int(np.floor((low[2] + _STANDS_M - origin[2]) / cell)) + 1] = False
    return out, origin, cell


def _occupied(scene: ViewScene, target: Target, cloud: np.ndarray) -> np.ndarray:
    """Return the occluders in the scene's grid: surface cells except the target and what supports it."""
    space = scene.space
    out = space.state == _SURFACE
    shape = np.array(out.shape)

    def cells_of(points: np.ndarray) -> np.ndarray:
        cells = np.floor((points - space.origin) / space.voxel_size_m).astype(np.int64)
        return cells[((cells >= 0) & (cells < shape)).all(axis=1)]

    opaque = _opaque(scene.packed)
    opaque[target.rows] = False
    others = np.zeros(out.shape, bool)
    others[tuple(cells_of(scene.packed[opaque, :3].astype(np.float64)).T)] = True
    own = np.zeros(out.shape, bool)
    own[tuple(cells_of(cloud).T)] = True
    out &= others | ~_grown(own, _OWN_CELLS)
    carrying = int(np.floor((cloud[:, 2].min() + _STANDS_M - space.origin[2]) / space.voxel_size_m)) + 1
    out[:, :, : max(carrying, 0)] = False
    return out


def _grown(cells: np.ndarray, by: int) -> np.ndarray:
    """Dilate a mask (nx, ny, nz) by `by` cells along every axis."""
    from scipy import ndimage

    out = cells.copy()
    if cells.any():
        rows = [np.flatnonzero(cells.any(axis=tuple({0, 1, 2} - {axis}))) for axis in range(3)]
        box = tuple(slice(max(0, row[0] - by), row[-1] + 1 + by) for row in rows)
        out[box] = ndimage.maximum_filter(cells[box].view(np.uint8), 2 * by + 1, mode="constant").astype(bool)
    return out
