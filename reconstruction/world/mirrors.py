"""Find plane mirrors on upright planes: openings through which the film seems to see the room reflected.

Multi-view stereo measures the virtual image behind a mirror as if it were there. An opening is a patch of a plane
through which rays measure depth behind it, with the plane's own surface around the patch. It is a mirror if the points
behind it, reflected at the plane, lie on surface that other frames measured. Behind windows and doors they lie in space
that the frames see to be empty.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.types import DepthMaps, Plane, PosedFrames
from registry.geometry import invert_rigid, transform_points

_MEASURED = 2  # confidence of a measured depth
_PIXEL_STEP = 3
_CELL_M = 0.05  # of the grid on a plane
_REACH_M = 8.0  # half size of the grid
_GRAZING = 0.15  # cosine between ray and normal; at flatter angles the place on the plane is uncertain
_ON_M, _ON_SHARE = 0.02, 0.01  # of the distance: depth this near to the plane is on it
_BEHIND_M = 0.10  # at right angles to the plane
_LEAST_RAYS = 3  # of a cell
_LEAST_AREA_M2 = 0.05
_RING_CELLS = 3
_RING_ON = 0.5  # least share of the plane's own surface among the known cells around an opening
_RING_KNOWN = 0.3  # least share of known cells around it
_OFFSETS_M = np.arange(-0.06, 0.0601, 0.01)  # of the glass from the plane of the wall around it
_POINTS, _FRAMES = 4000, 24  # most reflected points of an opening, and frames that judge them
_AGREE_M, _AGREE_SHARE = 0.04, 0.01  # depth at which a reflected point lies on measured surface
_EMPTY_M, _EMPTY_SHARE = 0.10, 0.02  # depth behind a reflected point that shows the place to be empty
_ACROSS = 0.1  # most cosine between the normals of planes at right angles
_TELLING_M = 0.06  # from such planes
_JUDGED = 100  # least number of reflected points that any frame judges
_TRUE_IMAGE = 0.5  # least share of them that lie on surface


@dataclass(frozen=True)
class _Axes:
    """In-plane axes of an upright plane."""

    normal: np.ndarray  # float64 (3,) unit, towards the cameras
    offset: float  # normal . x + offset = 0
    along: np.ndarray  # float64 (3,) unit, level
    up: np.ndarray  # float64 (3,) unit
    origin: np.ndarray  # float64 (3,), below the cameras on the plane

    def at(self, a: float, b: float, shift_m: float) -> np.ndarray:
        """Return the point (3,) at in-plane coordinates, shifted along the normal."""
        return self.origin + a * self.along + b * self.up + shift_m * self.normal


@dataclass(frozen=True)
class _Hits:
    """Where measured rays meet a plane, and what they measured."""

    cells: np.ndarray  # int64 (m, 2) rows (up), columns (along)
    behind: np.ndarray  # bool (m,) they measured depth behind the plane
    on: np.ndarray  # bool (m,) on the plane
    points: np.ndarray  # float64 (m, 3) measured


def find_mirrors(
    posed: PosedFrames, depth: DepthMaps, planes: Sequence[tuple[np.ndarray, float]]
) -> tuple[Plane, ...]:
    """Return the glass of each mirror: its plane, normal into the room, with a level rectangle as outline.

    Args:
        posed: keyframes in world space, metres, +z up.
        depth: their depth maps, metres.
        planes: unit normals (3,) and offsets o of the level and upright planes n . x = o of the room.
    """
    found: list[tuple[float, Plane]] = []
    for normal, offset in planes:
        axes = _axes(normal, offset, posed.world_from_camera[:, :3, 3])
        if axes is None:
            continue
        across = [(n, o) for n, o in planes if abs(n @ axes.normal) < _ACROSS]
        hits = _hits(axes, posed, depth)
        for cells in _openings(hits):
            inside = cells[hits.cells[:, 0], hits.cells[:, 1]] & hits.behind
            share, shift = _reflection(axes, _telling(hits.points[inside], across), posed, depth)
            if share >= _TRUE_IMAGE:
                found.append((share, _outline(axes, cells, shift)))
    kept: list[Plane] = []
    for _, glass in sorted(found, key=lambda item: -item[0]):
        middle = glass.polygon.mean(axis=0)
        if all(np.linalg.norm(middle - other.polygon.mean(axis=0)) > 0.3 for other in kept):
            kept.append(glass)
    return tuple(kept)


def _axes(normal: np.ndarray, offset: float, eyes: np.ndarray) -> _Axes | None:
    """Return the axes of an upright plane turned to the cameras (n, 3); None if it is not upright or between them."""
    if abs(normal[2]) > _ACROSS:
        return None
    heights = eyes @ normal - offset
    if np.median(heights) < 0:
        normal, offset, heights = -normal, -offset, -heights
    if np.quantile(heights, 0.05) <= 0:
        return None
    along = np.cross([0.0, 0.0, 1.0], normal)
    along /= np.linalg.norm(along)
    middle = np.median(eyes, axis=0)
    origin = middle - (middle @ normal - offset) * normal
    return _Axes(normal, -float(offset), along, np.cross(normal, along), origin)


def _hits(axes: _Axes, posed: PosedFrames, depth: DepthMaps) -> _Hits:
    rays = depth.camera.pixel_rays()[::_PIXEL_STEP, ::_PIXEL_STEP].reshape(-1, 3)
    parts = []
    for row, pose in enumerate(posed.world_from_camera):
        z = np.asarray(depth.depth[row])[::_PIXEL_STEP, ::_PIXEL_STEP].ravel().astype(np.float64)
        sure = np.asarray(depth.confidence[row])[::_PIXEL_STEP, ::_PIXEL_STEP].ravel() == _MEASURED
        directions = rays @ pose[:3, :3].T
        towards = -directions @ axes.normal
        kept = sure & (z > 0) & (towards > _GRAZING * np.linalg.norm(directions, axis=1))
        height = float(pose[:3, 3] @ axes.normal + axes.offset)
        if height <= 0 or not kept.any():
            continue
        z, directions, towards = z[kept], directions[kept], towards[kept]
        crossing = height / towards
        local = pose[:3, 3] + crossing[:, None] * directions - axes.origin
        cells = np.column_stack([local @ axes.up, local @ axes.along]) + _REACH_M
        cells = np.floor(cells / _CELL_M).astype(np.int64)
        beyond = (z - crossing) * towards
        on = np.abs(beyond) < _ON_M + _ON_SHARE * crossing
        behind = beyond > _BEHIND_M + _ON_SHARE * crossing
        known = (on | behind) & ((cells >= 0) & (cells < _grid())).all(axis=1)
        points = pose[:3, 3] + z[known, None] * directions[known]
        parts.append((cells[known], behind[known], on[known], points))
    if not parts:
        return _Hits(np.zeros((0, 2), np.int64), np.zeros(0, bool), np.zeros(0, bool), np.zeros((0, 3)))
    return _Hits(*(np.concatenate(column) for column in zip(*parts)))


def _grid() -> int:
    return int(2 * _REACH_M / _CELL_M)


def _openings(hits: _Hits) -> list[np.ndarray]:
    """Return masks bool (g, g) of the openings of a plane."""
    size = _grid()
    flat = hits.cells[:, 0] * size + hits.cells[:, 1]
    behind = np.bincount(flat[hits.behind], minlength=size * size).reshape(size, size)
    on = np.bincount(flat[hits.on], minlength=size * size).reshape(size, size)
    through = (behind >= _LEAST_RAYS) & (behind > 2 * on)
    solid = (on >= _LEAST_RAYS) & (on > 2 * behind)
    kernel = np.ones((3, 3), np.uint8)
    closed = cv2.morphologyEx(through.astype(np.uint8), cv2.MORPH_CLOSE, kernel) > 0
    closed &= ~solid
    count, labels, stats, _ = cv2.connectedComponentsWithStats(closed.astype(np.uint8), connectivity=4)
    out = []
    for number in range(1, count):
        if stats[number, cv2.CC_STAT_AREA] * _CELL_M**2 < _LEAST_AREA_M2:
            continue
        part = labels == number
        ring = cv2.dilate(part.astype(np.uint8), kernel, iterations=_RING_CELLS) > 0
        ring &= ~part
        known = ring & (solid | through)
        if known.sum() < _RING_KNOWN * ring.sum() or (ring & solid).sum() < _RING_ON * known.sum():
            continue
        out.append(part)
    return out


def _telling(points: np.ndarray, across: Sequence[tuple[np.ndarray, float]]) -> np.ndarray:
    """Return the points (k, 3) of (n, 3) that are on none of the planes at right angles to the mirror.

    Floor, ceiling and side walls go on behind a door as they do in a mirror: they tell nothing.
    """
    kept = np.ones(len(points), bool)
    for normal, offset in across:
        kept &= np.abs(points @ normal - offset) > _TELLING_M
    return points[kept]


def _reflection(axes: _Axes, points: np.ndarray, posed: PosedFrames, depth: DepthMaps) -> tuple[float, float]:
    """Return the share of points behind an opening whose reflections lie on measured surface, and the best offset.

    The share counts reflections that a frame judges: on surface, or in space that it sees to be empty.
    """
    rng = np.random.default_rng(0)
    if len(points) > _POINTS:
        points = points[rng.choice(len(points), _POINTS, replace=False)]
    rows = np.unique(np.linspace(0, len(posed.world_from_camera) - 1, _FRAMES).round().astype(int))
    best = (0.0, 0.0)
    for shift in _OFFSETS_M:
        heights = points @ axes.normal + axes.offset - shift
        image = points - 2 * heights[:, None] * axes.normal
        on, empty = np.zeros(len(image), bool), np.zeros(len(image), bool)
        for row in rows:
            agrees, passes = _judged(image, depth, int(row), posed.world_from_camera[row])
            on |= agrees
            empty |= passes
        judged = on | empty
        if judged.sum() >= _JUDGED:
            # A frame that sees past the point at an outline and one that measured it: it is there.
            share = float(on.sum() / judged.sum())
            best = max(best, (share, float(shift)))
    return best


def _judged(
    points: np.ndarray, depth: DepthMaps, row: int, world_from_camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return which points (n, 3) lie on the measured surface of a frame, and which in space that it sees through."""
    local = transform_points(invert_rigid(world_from_camera), points)
    z = local[:, 2]
    u, v = depth.camera.project(np.column_stack([local[:, :2], np.maximum(z, 1e-6)]))
    inside = (z > 0.05) & (u >= 0) & (v >= 0) & (u < depth.camera.width) & (v < depth.camera.height)
    column, line = np.where(inside, u, 0).astype(int), np.where(inside, v, 0).astype(int)
    measured = np.asarray(depth.depth[row])[line, column]
    inside &= (measured > 0) & (np.asarray(depth.confidence[row])[line, column] == _MEASURED)
    on = inside & (np.abs(measured - z) < _AGREE_M + _AGREE_SHARE * z)
    return on, inside & (measured - z > _EMPTY_M + _EMPTY_SHARE * z)


def _outline(axes: _Axes, cells: np.ndarray, shift_m: float) -> Plane:
    """Return the glass plane with the rectangle around the cells of an opening."""
    rows, columns = np.nonzero(cells)
    bottom, top = rows.min() * _CELL_M - _REACH_M, (rows.max() + 1) * _CELL_M - _REACH_M
    left, right = columns.min() * _CELL_M - _REACH_M, (columns.max() + 1) * _CELL_M - _REACH_M
    corners = [(left, bottom), (right, bottom), (right, top), (left, top)]
    polygon = np.array([axes.at(a, b, shift_m) for a, b in corners])
    return Plane(np.append(axes.normal, axes.offset - shift_m), polygon)
