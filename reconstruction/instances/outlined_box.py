"""A box on a wall by its outlines in frames: where it is, and how far it stands out."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.types import BaseEntity, Camera
from registry.geometry import invert_rigid, transform_points

MIN_FRONT_M = 0.025  # of a framed picture
_FRONTS_M = np.r_[MIN_FRONT_M, np.arange(0.05, 0.41, 0.025)]
_GAIN = 0.02  # in IoU: less says nothing against a flat thing
_SLIM, _MOST_FRONT_M = (
    3.0,
    0.3,
)  # as wide to its height: no picture but a shelf or a rack, as deep as it is high
_EDGE_PX = 2
_OUTER_PERCENT = 0.5
_MIN_PX = 20


@dataclass(frozen=True)
class Wall:
    """A wall's plane, n . x + offset = 0, and coordinates on it: along it, and up."""

    id: int
    normal: np.ndarray  # float64 (3,) into the room, level
    offset: float
    along: np.ndarray  # float64 (3,) level, in the plane

    @staticmethod
    def of(base: BaseEntity) -> "Wall":
        """Read a wall off a base entity; it is taken to be upright."""
        plane = base.surface.plane
        size = float(np.hypot(plane[0], plane[1]))
        normal = np.array([plane[0], plane[1], 0.0]) / size
        return Wall(base.id, normal, float(plane[3]) / size, np.array([-normal[1], normal[0], 0.0]))

    @property
    def yaw(self) -> float:
        """Return the heading of its normal in radians."""
        return float(np.arctan2(self.normal[1], self.normal[0]))

    def points(self, places: np.ndarray, front: float = 0.0) -> np.ndarray:
        """Return world points (n, 3) of places (n, 2) on the wall, so far before it."""
        up = np.array([0.0, 0.0, 1.0])
        return places[:, :1] * self.along + places[:, 1:] * up + (front - self.offset) * self.normal

    def depth(self, camera: Camera, world_from_camera: np.ndarray) -> np.ndarray:
        """Return the z-depth (h, w) at which rays meet the wall; infinity where they do not."""
        rays = _rays(camera, np.arange(camera.height)[:, None], np.arange(camera.width)[None])
        toward = (rays @ np.asarray(world_from_camera)[:3, :3].T) @ self.normal
        away = float(np.asarray(world_from_camera)[:3, 3] @ self.normal + self.offset)
        return np.where(toward < -1e-6, away / np.maximum(-toward, 1e-6), np.inf)


@dataclass(frozen=True)
class Window:
    """A mask as one frame shows it on a wall."""

    outline: np.ndarray  # float64 (k, 2) where the rays through its pixels meet the wall
    sides: np.ndarray  # float64 (2, 2) the least and the greatest of that
    cut: np.ndarray  # bool (2, 2): the picture's edge cuts that side off
    eye: np.ndarray  # float64 (2,) the camera on the wall
    away: float  # its distance from it
    hull: np.ndarray  # bool (h, w)
    camera: Camera
    pose: np.ndarray  # float64 (4, 4) world from camera

    @staticmethod
    def of(mask: np.ndarray, wall: Wall, camera: Camera, pose: np.ndarray) -> "Window | None":
        """Look at a mask bool (h, w); None where its rays do not all meet the wall."""
        rows, columns = np.nonzero(mask)
        away = float(pose[:3, 3] @ wall.normal + wall.offset)
        rays = _rays(camera, rows, columns) @ pose[:3, :3].T
        toward = rays @ wall.normal
        if len(rows) < _MIN_PX or away < 0.1 or toward.max() > -1e-3:
            return None
        points = pose[:3, 3] + rays * (away / -toward)[:, None]
        outline = np.column_stack([points @ wall.along, points[:, 2]])
        sides = np.percentile(outline, [_OUTER_PERCENT, 100 - _OUTER_PERCENT], axis=0)
        edge = (rows < _EDGE_PX) | (columns < _EDGE_PX)
        edge |= (rows >= camera.height - _EDGE_PX) | (columns >= camera.width - _EDGE_PX)
        cut = np.zeros((2, 2), bool)
        for axis in range(2):
            band = 0.03 * (sides[1, axis] - sides[0, axis])
            cut[0, axis] = edge[outline[:, axis] <= sides[0, axis] + band].mean() > 0.2
            cut[1, axis] = edge[outline[:, axis] >= sides[1, axis] - band].mean() > 0.2
        hull = np.zeros(mask.shape, np.uint8)
        corners = cv2.convexHull(np.column_stack([columns, rows]).astype(np.int32))
        cv2.fillConvexPoly(hull, corners, 1)
        eye = np.array([pose[:3, 3] @ wall.along, pose[2, 3]])
        return Window(outline, sides, cut, eye, away, hull > 0, camera, pose)

    def sides_at(self, front: float) -> np.ndarray:
        """Return the sides (2, 2) of a box that stands out so far and has this outline.

        Of its two edges on a side, that of the front is the outer one where the camera is within it.
        """
        nearer = self.eye + (self.sides - self.eye) * (self.away - front) / self.away
        inside = np.array([self.sides[0] < self.eye, self.sides[1] > self.eye])
        return np.where(inside, nearer, self.sides)


@dataclass(frozen=True)
class WallBox:
    """A box with its back on a wall."""

    low: np.ndarray  # float64 (2,) along the wall, and height
    high: np.ndarray
    front: float  # how far it stands out

    @property
    def size(self) -> np.ndarray:
        """Return its width and height (2,)."""
        return self.high - self.low


def fit_box(wall: Wall, windows: list[Window]) -> WallBox:
    """Return the box that looks most like all outlines; where they do not tell, a flat one, or a bar if it is slim."""
    tried = [_box_at(windows, float(front)) for front in _FRONTS_M]
    scores = [float(np.mean([_agreement(box, wall, w) for w in windows])) for box in tried]
    best = int(np.argmax(scores))
    if scores[best] > scores[0] + _GAIN:
        return tried[best]
    width, height = tried[0].size
    slim = width > _SLIM * height and not np.all([w.cut[:, 1] for w in windows], axis=0).any()
    return _box_at(windows, float(min(height, _MOST_FRONT_M))) if slim else _completed(tried[0], windows)


def _completed(box: WallBox, windows: list[Window]) -> WallBox:
    """Return a flat box made as long as it is wide where every frame cuts a side off: likeliest for a picture."""
    always = np.all([w.cut for w in windows], axis=0)
    low, high = box.low.copy(), box.high.copy()
    for axis in range(2):
        missing = max(float(box.size[1 - axis] - box.size[axis]), 0.0) / max(int(always[:, axis].sum()), 1)
        low[axis] -= missing * always[0, axis]
        high[axis] += missing * always[1, axis]
    return WallBox(low, high, box.front)


def _box_at(windows: list[Window], front: float) -> WallBox:
    sides = np.stack([w.sides_at(front) for w in windows])
    cut = np.stack([w.cut for w in windows])
    out = np.zeros((2, 2))
    for end in range(2):
        for axis in range(2):
            whole = ~cut[:, end, axis]
            values = sides[:, end, axis]
            outer = values.min() if end == 0 else values.max()
            out[end, axis] = np.median(values[whole]) if whole.any() else outer
    return WallBox(out[0], np.maximum(out[1], out[0] + 1e-3), front)


def _agreement(box: WallBox, wall: Wall, window: Window) -> float:
    """Return the IoU of a box's silhouette with a mask's hull."""
    shape = silhouette(box, wall, window.camera, window.pose)
    if shape is None:
        return 0.0
    return float((shape & window.hull).sum() / max((shape | window.hull).sum(), 1))


def silhouette(box: WallBox, wall: Wall, camera: Camera, pose: np.ndarray) -> np.ndarray | None:
    """Return bool (h, w): where a box shows in a frame; None where it does not."""
    places = np.array([[x, z] for x in (box.low[0], box.high[0]) for z in (box.low[1], box.high[1])])
    corners = np.concatenate([wall.points(places), wall.points(places, box.front)])
    local = transform_points(invert_rigid(pose), corners)
    if local[:, 2].min() < 0.05:
        return None
    pixels = np.column_stack(
        [camera.fx * local[:, 0] / local[:, 2] + camera.cx, camera.fy * local[:, 1] / local[:, 2] + camera.cy]
    )
    if np.abs(pixels).max() > 1e4:
        return None
    out = np.zeros((camera.height, camera.width), np.uint8)
    cv2.fillConvexPoly(out, cv2.convexHull(np.round(pixels - 0.5).astype(np.int32)), 1)
    return out > 0 if out.any() else None


def _rays(camera: Camera, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return rays (..., 3) through pixels, camera space, at z = 1."""
    x, y = np.broadcast_arrays((columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy)
    return np.stack([x, y, np.ones_like(x)], axis=-1)
