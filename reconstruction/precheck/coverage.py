"""Map the directions that a film shows: chained rotations, vertical from line segments, a map in yaw and pitch."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.types import Camera
from reconstruction.precheck.two_view import Pair, rays, rotation_between

MAP_STEP_DEG = 10  # of yaw and pitch
_MIN_LENGTH = 0.06  # of a line segment, as a share of the longer side
_MAX_TILT_DEG = 60.0  # between a segment and the image's vertical
_ON_LINE_DEG = 1.5  # between a vertical segment and the vertical direction
_MAX_ROLL_DEG = 15.0  # mean over the frames: people hold cameras level
_MIN_LINES = 12  # segments that must agree on the vertical
_USUAL_FOCAL = 0.85  # of the longer side: a field of view of 61 degrees
_MIN_PARALLAX_DEG = 0.3  # below it an essential matrix is not determined
_ESSENTIAL_ERROR_PX = 1.0
_FLOOR_BELOW_DEG = 30.0  # below the horizon: at a height of 1.4 m, the floor 2.4 m away


@dataclass(frozen=True)
class Coverage:
    """The directions of the sampled frames, relative to the first frame of the largest connected part."""

    rows: np.ndarray  # int (m,) frames of the largest connected part
    rotations: np.ndarray  # float64 (m, 3, 3) first_from_camera
    up: np.ndarray | None  # (3,) unit, in the first camera; None: not found
    seen: np.ndarray  # int (18, 36) frames that see a cell; rows: pitch from +90 down, columns: yaw from -180
    lower_edge_deg: float | None  # median pitch of the lower edge of the frames; negative: below the horizon

    @property
    def yaw_deg(self) -> float:
        """Return the range of yaw in view, degrees."""
        return float(MAP_STEP_DEG * (self.seen.sum(axis=0) > 0).sum())

    @property
    def sees_floor(self) -> bool | None:
        """Tell whether most frames look down far enough to show the floor; None: not known."""
        return None if self.lower_edge_deg is None else self.lower_edge_deg < -_FLOOR_BELOW_DEG


def largest_part(count: int, pairs: list[Pair]) -> np.ndarray:
    """Return the frames, int (m,), of the largest connected component under the pairs."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    rows = np.array([pair.rows for pair in pairs], int).reshape(-1, 2)
    graph = coo_array((np.ones(len(rows)), (rows[:, 0], rows[:, 1])), shape=(count, count))
    label = connected_components(graph, directed=False)[1]
    return np.flatnonzero(label == np.bincount(label).argmax())


def measure_coverage(grays: list[np.ndarray], pairs: list[Pair], focal_px: float = 0.0) -> Coverage:
    """Chain the rotations of pairs over the largest connected part; find the vertical; map the directions.

    Args:
        grays: images uint8 (h, w).
        pairs: verified pairs.
        focal_px: focal length from metadata; 0: that of a usual phone.
    """
    rows = largest_part(len(grays), pairs)
    height, width = grays[0].shape
    focal = focal_px or _USUAL_FOCAL * max(width, height)
    camera = Camera(width, height, focal, focal, width / 2, height / 2)
    chained = _chain(rows, pairs, camera)
    up = _vertical([grays[r] for r in rows], chained, camera)
    upright = _upright(up) if up is not None else np.eye(3)
    seen = np.zeros((180 // MAP_STEP_DEG, 360 // MAP_STEP_DEG), int)
    u, v = np.meshgrid(np.linspace(0, width, 13), np.linspace(0, height, 11))
    grid = _rays(np.column_stack([u.ravel(), v.ravel()]), camera)
    lower = []
    for rotation in chained:
        yaw, pitch = _angles(grid @ (upright @ rotation).T)
        cells = np.zeros_like(seen)
        row = np.clip(((90 - pitch) / MAP_STEP_DEG).astype(int), 0, len(seen) - 1)
        cells[row, ((yaw + 180) / MAP_STEP_DEG).astype(int) % seen.shape[1]] = 1
        seen += cells
        lower.append(np.median(pitch[v.ravel() == height]))
    return Coverage(rows, chained, up, seen, float(np.median(lower)) if up is not None else None)


def _rays(points: np.ndarray, camera: Camera) -> np.ndarray:
    return rays(points, camera.fx, np.array([camera.cx, camera.cy]))


def _chain(rows: np.ndarray, pairs: list[Pair], camera: Camera) -> np.ndarray:
    """Return first_from_camera (m, 3, 3), along the spanning tree of the pairs with the most inliers."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

    between = {pair.rows: pair for pair in pairs}
    out = {int(rows[0]): np.eye(3)}
    if pairs:
        ends = np.array(list(between), int)
        weights = 1 / np.array([len(pair.first) for pair in pairs])
        graph = coo_array((weights, (ends[:, 0], ends[:, 1])), shape=(ends.max() + 1,) * 2)
        order, before = breadth_first_order(minimum_spanning_tree(graph), rows[0], directed=False)
        for row in map(int, order[1:]):
            parent = int(before[row])
            forward = between.get((parent, row))
            if forward is not None:
                out[row] = out[parent] @ _rotation(forward, camera).T
            else:
                out[row] = out[parent] @ _rotation(between[row, parent], camera)
    return np.stack([out[int(r)] for r in rows])


def _rotation(pair: Pair, camera: Camera) -> np.ndarray:
    """Return second_from_first of a pair: of its essential matrix if there is parallax, else the best rotation."""
    fitted, left = rotation_between(pair, camera.fx, np.array([camera.cx, camera.cy]))
    if np.quantile(left, 0.75) < _MIN_PARALLAX_DEG:
        return fitted
    essential, _ = cv2.findEssentialMat(
        pair.first, pair.second, camera.matrix, cv2.USAC_MAGSAC, 0.999, _ESSENTIAL_ERROR_PX
    )
    if essential is None or essential.shape != (3, 3):
        return fitted
    return cv2.recoverPose(essential, pair.first, pair.second, camera.matrix)[1]


def _vertical(grays: list[np.ndarray], rotations: np.ndarray, camera: Camera) -> np.ndarray | None:
    """Find the direction, (3,) in the first camera, that the near-vertical line segments of all frames share."""
    detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_NONE)
    normals, lengths = [], []
    for gray, rotation in zip(grays[::3], rotations[::3]):
        found = detector.detect(gray)[0]
        lines = np.zeros((0, 4)) if found is None else found.reshape(-1, 4).astype(np.float64)
        along = lines[:, 2:] - lines[:, :2]
        length = np.linalg.norm(along, axis=1)
        steep = np.abs(along[:, 0]) < np.tan(np.radians(_MAX_TILT_DEG)) * np.abs(along[:, 1])
        use = steep & (length > _MIN_LENGTH * max(gray.shape))
        a, b = (_rays(lines[use, k : k + 2], camera) for k in (0, 2))
        normal = np.cross(a, b)
        normals.append(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9) @ rotation.T)
        lengths.append(length[use])
    normal, length = np.concatenate(normals), np.concatenate(lengths)
    if len(normal) < _MIN_LINES:
        return None
    likely = -rotations[:, :, 1].mean(axis=0)  # mean of the frames' upward axes
    rng = np.random.default_rng(0)
    first, second = rng.integers(len(normal), size=(2, 1500))
    tried = np.cross(normal[first], normal[second])
    norm = np.linalg.norm(tried, axis=1)
    tried = tried[norm > 0.02] / norm[norm > 0.02, None]
    tried *= np.sign(tried @ likely)[:, None]
    level = np.abs(rotations[:, :, 0] @ tried.T).mean(axis=0) < np.sin(np.radians(_MAX_ROLL_DEG))
    tried = tried[level & (tried @ likely > np.cos(np.radians(_MAX_TILT_DEG)) * np.linalg.norm(likely))]
    if not len(tried):
        return None
    on = np.abs(normal @ tried.T) < np.sin(np.radians(_ON_LINE_DEG))
    best = int((length[:, None] * on).sum(axis=0).argmax())
    return tried[best] if on[:, best].sum() >= _MIN_LINES else None


def _upright(up: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) that takes `up` to -y, with the first camera's view at yaw 0."""
    down = -up
    right = np.cross(down, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, down, np.cross(right, down)])


def _angles(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return yaw and pitch (k,) in degrees of directions (k, 3), axes x right, y down, z ahead."""
    x, y, z = directions.T
    return np.degrees(np.arctan2(x, z)), np.degrees(np.arcsin(np.clip(-y, -1, 1)))
