"""Pictures of walls: every keyframe laid onto a wall's plane, and what most of them agree on."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.instances._wall_kernels import median_colors
from reconstruction.instances.outlined_box import Wall
from reconstruction.types import Camera, DepthMaps, InstanceSet, PosedFrames
from registry.geometry import invert_rigid

_CELL_M, _MOST_CELLS = 0.0075, 250_000
_LOWEST_M, _HIGHEST_M = 0.05, 3.0
_CORNER_M = 0.03  # from another wall: its own corner is not sharp
_MIN_AWAY_M = 0.3  # of a camera from the wall
_MAX_FRONT_M = 0.45  # what was measured farther before the wall hides it
_STEP = 2  # of the pixels that say what hides the wall
_LEAST_SEEN = 0.01  # of the picture, by a frame
_LIGHTNESS = 0.8  # shadows and gradients of light matter less than color
_SMOOTH_PX = 1.0


@dataclass(frozen=True)
class WallPicture:
    """What keyframes show of a wall, laid onto its plane: column along the wall, row downwards."""

    wall: Wall
    low: float  # where the first column starts, along the wall
    top: float  # height at which the first row starts
    cell_m: float
    rows: np.ndarray  # int64 (n,) of the keyframes that see enough of it
    frames: np.ndarray  # uint8 (n, h, w, 3) their colors, CIELAB as OpenCV scales it
    valid: np.ndarray  # bool (n, h, w) where they see the wall, or what hangs there
    hidden: np.ndarray  # bool (h, w) where a thing hides the wall in most frames that look there

    @staticmethod
    def of(
        wall: Wall, found: InstanceSet, posed: PosedFrames, depth: DepthMaps, points: np.ndarray
    ) -> "WallPicture | None":
        """Lay keyframes onto a wall; None where hardly any sees it.

        Args:
            wall: its plane.
            found: its other walls bound it; things of its id maps hide it.
            posed: keyframes in world space.
            depth: their depth; what was measured far before the wall hides it.
            points: surface (v, 3), which bounds the wall where no other wall does.
        """
        sides = _sides(wall, found, points)
        if sides is None:
            return None
        (low, high), top = sides, _HIGHEST_M
        cell = max(_CELL_M, float(np.sqrt((high - low) * (top - _LOWEST_M) / _MOST_CELLS)))
        size = (int((high - low) / cell), int((top - _LOWEST_M) / cell))
        free = np.array([0, wall.id, *(o.id for o in found.objects if o.attached_hint)])
        rows, frames, valid = [], [], []
        looked = np.zeros(size[::-1], np.int32)
        shown = np.zeros(size[::-1], np.int32)
        for row, pose in enumerate(np.asarray(posed.world_from_camera, np.float64)):
            if pose[:3, 3] @ wall.normal + wall.offset < _MIN_AWAY_M:
                continue
            into_camera = invert_rigid(pose) @ _world_from_cells(wall, low, top, cell)
            state = _seen(wall, found, depth, row, pose, free)
            seen = _laid(state, into_camera, _coarse(depth.camera), size, cv2.INTER_NEAREST)
            if (seen == 2).mean() < _LEAST_SEEN:
                continue
            image = cv2.cvtColor(np.asarray(posed.images[row]), cv2.COLOR_RGB2LAB)
            rows.append(row)
            frames.append(_laid(image, into_camera, posed.camera, size, cv2.INTER_LINEAR))
            valid.append(seen == 2)
            looked += seen > 0
            shown += seen == 2
        if len(rows) < 2:
            return None
        hidden = (looked > 0) & (shown < 0.5 * looked)
        return WallPicture(wall, low, top, cell, np.array(rows), np.stack(frames), np.stack(valid), hidden)

    @property
    def seen(self) -> np.ndarray:
        """Return how many frames see each cell, int64 (h, w)."""
        return self.valid.sum(axis=0)

    def median(self) -> np.ndarray:
        """Return the color that most frames agree on, float32 CIELAB (h, w, 3)."""
        return smooth(median_colors(self.frames, self.valid), self.seen > 0)

    def into_camera(self, row: int, posed: PosedFrames, camera: Camera) -> np.ndarray:
        """Return the homography (3, 3) from cells (column, row, 1) to a camera's pixels."""
        pose = np.asarray(posed.world_from_camera[row], np.float64)
        return _homography(
            invert_rigid(pose) @ _world_from_cells(self.wall, self.low, self.top, self.cell_m), camera
        )


def smooth(colors: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return float32 CIELAB of colors uint8 (h, w, 3) as OpenCV has them, smoothed over what was seen, bool (h, w).

    Lightness counts less, so that distances are those that tell a thing from its wall.
    """
    mask = seen.astype(np.float32)
    lab = (colors.astype(np.float32) - [0, 128, 128]) * [_LIGHTNESS * 100 / 255, 1, 1]
    weight = cv2.GaussianBlur(mask, (0, 0), _SMOOTH_PX)[..., None] + 1e-6
    return cv2.GaussianBlur(lab.astype(np.float32) * mask[..., None], (0, 0), _SMOOTH_PX) / weight


def _sides(wall: Wall, found: InstanceSet, points: np.ndarray) -> tuple[float, float] | None:
    """Return how far a wall reaches along itself: to the other walls, or as far as there is surface."""
    along = points @ wall.along
    low, high = np.percentile(along, [0.5, 99.5])
    for other in found.base:
        if other.label != "wall" or other.id == wall.id or not other.observed:
            continue
        second = Wall.of(other)
        across = float(second.normal @ wall.along)
        if abs(across) < 0.5:
            continue
        corner = -(second.offset - wall.offset * float(second.normal @ wall.normal)) / across
        low, high = (
            (max(low, corner + _CORNER_M), high) if across > 0 else (low, min(high, corner - _CORNER_M))
        )
    return (float(low), float(high)) if high - low > 0.3 else None


def _seen(
    wall: Wall, found: InstanceSet, depth: DepthMaps, row: int, pose: np.ndarray, free: np.ndarray
) -> np.ndarray:
    """Return what a frame shows, uint8 (h, w), every other pixel.

    2 is what may be the wall or hang there, 1 something else.
    """
    ids = found.id_maps[row][::_STEP, ::_STEP]
    measured = np.asarray(depth.depth[row])[::_STEP, ::_STEP]
    coarse = _coarse(depth.camera)
    plane = wall.depth(coarse, pose)[: ids.shape[0], : ids.shape[1]]
    before = (measured > 0) & (measured < plane - _MAX_FRONT_M)
    return np.where(np.isin(ids, free) & ~before & np.isfinite(plane), 2, 1).astype(np.uint8)


def _coarse(camera: Camera) -> Camera:
    return camera.resized(-(-camera.width // _STEP), -(-camera.height // _STEP))


def _world_from_cells(wall: Wall, low: float, top: float, cell: float) -> np.ndarray:
    """Return (4, 3): world points of cell centers (column, row, 1)."""
    first = (low + 0.5 * cell) * wall.along - wall.offset * wall.normal + [0, 0, top - 0.5 * cell]
    out = np.zeros((4, 3))
    out[:3] = np.column_stack([cell * wall.along, [0, 0, -cell], first])
    out[3, 2] = 1.0
    return out


def _homography(camera_from_cells: np.ndarray, camera: Camera) -> np.ndarray:
    inner = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1.0]])
    return inner @ camera_from_cells[:3]


def _laid(
    image: np.ndarray, camera_from_cells: np.ndarray, camera: Camera, size: tuple[int, int], how: int
) -> np.ndarray:
    """Return an image as the wall has it, 0 where it shows none of it; the camera is before the whole wall's plane."""
    flags = how | cv2.WARP_INVERSE_MAP
    out = cv2.warpPerspective(image, _homography(camera_from_cells, camera), size, flags=flags)
    if how == cv2.INTER_NEAREST:  # what is behind the camera
        column, row = np.arange(size[0]), np.arange(size[1])
        z = camera_from_cells[2]
        out[(z[0] * column + z[2] + z[1] * row[:, None]) < 0.2] = 0
    return out
