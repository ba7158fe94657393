"""Fit a box on a wall to the masks of several frames: position, size, and how far it stands out from the wall."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.types import BaseEntity, Camera
from registry.geometry import invert_rigid, transform_points

MIN_FRONT_M = 0.025  # thickness of a framed picture
_FRONTS_M = np.r_[MIN_FRONT_M, np.arange(0.05, 0.41, 0.025)]  # thicknesses that are tried
_GAIN = 0.02  # least gain in IoU over a flat box
_SLIM = 3.0  # a box with a larger ratio of width to height is a shelf or a rack, as deep as it is high,
_MOST_FRONT_M = 0.3  # but not deeper than this
_EDGE_PX = 2  # width of the image border at which a mask is cut off
_OUTER_PERCENT = 0.5  # of the mask's pixels beyond each side of the rectangle
_MIN_PX = 20


@dataclass(frozen=True)
class Wall:
    """A vertical plane n . x + offset = 0 with 2D coordinates: along the wall, and height."""

    id: int
    normal: np.ndarray  # float64 (3,) unit, horizontal, into the room
    offset: float
    along: np.ndarray  # float64 (3,) unit, horizontal, in the plane

    @staticmethod
    def of(base: BaseEntity) -> "Wall":
        """Return the wall of a base entity, its plane made vertical."""
        plane = base.surface.plane
        size = float(np.hypot(plane[0], plane[1]))
        normal = np.array([plane[0], plane[1], 0.0]) / size
        return Wall(base.id, normal, float(plane[3]) / size, np.array([-normal[1], normal[0], 0.0]))

    @property
    def yaw(self) -> float:
        """Return the yaw of the normal in radians."""
        return float(np.arctan2(self.normal[1], self.normal[0]))

    def points(self, places: np.ndarray, front: float = 0.0) -> np.ndarray:
        """Return the world points (n, 3) of wall coordinates (n, 2), `front` metres in front of the wall."""
        up = np.array([0.0, 0.0, 1.0])
        return places[:, :1] * self.along + places[:, 1:] * up + (front - self.offset) * self.normal

    def depth(self, camera: Camera, world_from_camera: np.ndarray) -> np.ndarray:
        """Return the z-depth (h, w) of the wall at each pixel, infinity where the ray does not hit it."""
        toward = (camera.pixel_rays() @ np.asarray(world_from_camera)[:3, :3].T) @ self.normal
        away = float(np.asarray(world_from_camera)[:3, 3] @ self.normal + self.offset)
        return np.where(toward < -1e-6, away / np.maximum(-toward, 1e-6), np.inf)


@dataclass(frozen=True)
class WallMask:
    """A mask of one frame projected onto a wall."""

    outline: np.ndarray  # float64 (k, 2) wall coordinates of its pixels
    sides: np.ndarray  # float64 (2, 2) bounding rectangle of these: low, high
    cut: np.ndarray  # bool (2, 2) whether the image border cuts that side off
    eye: np.ndarray  # float64 (2,) wall coordinates of the camera
    away: float  # distance of the camera to the wall, metres
    hull: np.ndarray  # bool (h, w) convex hull of the mask in the image
    camera: Camera
    pose: np.ndarray  # float64 (4, 4) world_from_camera

    @staticmethod
    def of(mask: np.ndarray, wall: Wall, camera: Camera, pose: np.ndarray) -> "WallMask | None":
        """Project a mask bool (h, w); None where it is tiny, or one of its rays does not hit the wall."""
        rows, columns = np.nonzero(mask)
        away = float(pose[:3, 3] @ wall.normal + wall.offset)
        rays = camera.unproject(columns + 0.5, rows + 0.5, np.ones(len(rows))) @ pose[:3, :3].T
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
        return WallMask(outline, sides, cut, eye, away, hull > 0, camera, pose)

    def sides_at(self, front: float) -> np.ndarray:
        """Return the rectangle (2, 2) of the box of thickness `front` that projects onto this mask.

        On each side the outline is that of the box's front edge where the camera is inside of that side, else that of
        the back edge.
        """
        nearer = self.eye + (self.sides - self.eye) * (self.away - front) / self.away
        inside = np.array([self.sides[0] < self.eye, self.sides[1] > self.eye])
        return np.where(inside, nearer, self.sides)


@dataclass(frozen=True)
class WallBox:
    """A box with its back on a wall."""

    low: np.ndarray  # float64 (2,) wall coordinates
    high: np.ndarray  # float64 (2,)
    front: float  # thickness, metres

    @property
    def size(self) -> np.ndarray:
        """Return width and height (2,)."""
        return self.high - self.low


def fit_box(wall: Wall, masks: list[WallMask]) -> WallBox:
    """Return the box whose silhouettes have the highest mean IoU with the masks.

    If no thickness is clearly better than a flat box, a wide and low box gets a thickness equal to its height; every
    other box is flat.
    """
    tried = [_box_at(masks, float(front)) for front in _FRONTS_M]
    scores = [float(np.mean([_agreement(box, wall, mask) for mask in masks])) for box in tried]
    best = int(np.argmax(scores))
    if scores[best] > scores[0] + _GAIN:
        return tried[best]
    width, height = tried[0].size
    slim = width > _SLIM * height and not np.all([mask.cut[:, 1] for mask in masks], axis=0).any()
    return _box_at(masks, float(min(height, _MOST_FRONT_M))) if slim else _completed(tried[0], masks)


def _completed(box: WallBox, masks: list[WallMask]) -> WallBox:
    """Extend a flat box to a square over the sides that every frame cuts off."""
    always = np.all([mask.cut for mask in masks], axis=0)
    low, high = box.low.copy(), box.high.copy()
    for axis in range(2):
        missing = max(float(box.size[1 - axis] - box.size[axis]), 0.0) / max(int(always[:, axis].sum()), 1)
        low[axis] -= missing * always[0, axis]
        high[axis] += missing * always[1, axis]
    return WallBox(low, high, box.front)


def _box_at(masks: list[WallMask], front: float) -> WallBox:
    """Return the box of one thickness: each side is the median over the masks that are not cut off there."""
    sides = np.stack([mask.sides_at(front) for mask in masks])
    cut = np.stack([mask.cut for mask in masks])
    out = np.zeros((2, 2))
    for end in range(2):
        for axis in range(2):
            whole = ~cut[:, end, axis]
            values = sides[:, end, axis]
            outer = values.min() if end == 0 else values.max()
            out[end, axis] = np.median(values[whole]) if whole.any() else outer
    return WallBox(out[0], np.maximum(out[1], out[0] + 1e-3), front)


def _agreement(box: WallBox, wall: Wall, mask: WallMask) -> float:
    """Return the IoU of a box's silhouette with a mask's hull."""
    shape = silhouette(box, wall, mask.camera, mask.pose)
    if shape is None:
        return 0.0
    return float((shape & mask.hull).sum() / max((shape | mask.hull).sum(), 1))


def silhouette(box: WallBox, wall: Wall, camera: Camera, pose: np.ndarray) -> np.ndarray | None:
    """Return the silhouette bool (h, w) of a box in a frame; None where it is outside or reaches behind the camera."""
    places = np.array([[x, z] for x in (box.low[0], box.high[0]) for z in (box.low[1], box.high[1])])
    corners = np.concatenate([wall.points(places), wall.points(places, box.front)])
    local = transform_points(invert_rigid(pose), corners)
    if local[:, 2].min() < 0.05:
        return None
    pixels = np.column_stack(camera.project(local))
    if np.abs(pixels).max() > 1e4:
        return None
    out = np.zeros((camera.height, camera.width), np.uint8)
    cv2.fillConvexPoly(out, cv2.convexHull(np.round(pixels - 0.5).astype(np.int32)), 1)
    return out > 0 if out.any() else None
