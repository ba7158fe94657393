"""View selection: keyframes with sparse points -> sources, neighbors and depth range of each view."""

from dataclasses import dataclass

import numpy as np

from reconstruction.core.types import Camera, PosedFrames
from reconstruction.depth.config import DepthConfig
from registry.errors import InputError
from registry.geometry import invert_rigid

# Parts of a frame have sources of their own, since few frames see all of another one well.
_ROWS, _COLUMNS = 2, 2
# Grid of sample points in a part, as shares of its width and height: first, last, count.
_GRID = (0.06, 0.94, 5)
# Enough good views of a point: two sources, since one may be occluded, and three neighbors.
_SOURCES_ENOUGH, _NEIGHBORS_ENOUGH = 2.0, 3.0


@dataclass(frozen=True)
class ViewPlan:
    """Sources, neighbors and depth range of each view."""

    sources: np.ndarray  # int32 (n, parts, s) frames to compare each part with, best first, -1 = none
    neighbors: np.ndarray  # int32 (n, k) frames that check consistency, best first, -1 = none
    near: np.ndarray  # float64 (n,) nearest depth to try
    far: np.ndarray  # float64 (n,)

    def parts_with_sources(self, i: int, height: int, width: int):
        """Yield bounds (4,), top, bottom, left, right, and sources (k,) of the parts of frame i that have any."""
        for bounds, row in zip(frame_parts(height, width), self.sources[i]):
            if row[0] >= 0:
                yield np.array(bounds), row[row >= 0]


def frame_parts(height: int, width: int) -> list[tuple[int, int, int, int]]:
    """Return top, bottom, left and right of the parts of a frame, in the order of `ViewPlan.sources`."""
    y = [height * row // _ROWS for row in range(_ROWS + 1)]
    x = [width * column // _COLUMNS for column in range(_COLUMNS + 1)]
    return [(y[j], y[j + 1], x[i], x[i + 1]) for j in range(_ROWS) for i in range(_COLUMNS)]


def _frame_depths(posed: PosedFrames) -> list[np.ndarray]:
    """Return the depths of the sparse points that each frame observed."""
    camera_from_world = invert_rigid(posed.world_from_camera)
    frame, point = posed.observations[:, 0], posed.observations[:, 1]
    z = (
        np.einsum("oj,oj->o", camera_from_world[frame, 2, :3], posed.points[point])
        + camera_from_world[frame, 2, 3]
    )
    return [z[(frame == i) & (z > 0)] for i in range(len(posed.images))]


def depth_ranges(posed: PosedFrames) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest and farthest depth (n,) to try in each frame, from sparse points of it and its neighbours."""
    depths = _frame_depths(posed)
    if sum(len(d) for d in depths) < 20:
        raise InputError(
            f"depth: the poses came with {len(posed.points)} sparse points, too few to know the depth range. "
            "Give poses with points (a COLMAP model or a nerfstudio export with a point cloud)."
        )
    n = len(depths)
    centers = posed.world_from_camera[:, :3, 3]
    near, far = np.zeros(n), np.zeros(n)
    for i in range(n):
        # A frame with few points borrows from the frames nearest in space, until there are enough.
        pool: list[np.ndarray] = []
        for j in np.argsort(np.linalg.norm(centers - centers[i], axis=1), kind="stable"):
            pool.append(depths[j])
            if len(pool) >= 3 and sum(len(p) for p in pool) >= 150:
                break
        low, high = np.percentile(np.concatenate(pool), [1.5, 98.5])
        near[i], far[i] = low * 0.65, high * 1.5
    return near, far


def plan_views(posed: PosedFrames, config: DepthConfig) -> ViewPlan:
    """Choose sources and neighbors of each view by triangulation angle, so that all parts of it are covered.

    Raises:
        InputError: If most frames have no other that sees the same things from another place.
    """
    near, far = depth_ranges(posed)
    n, camera = len(posed.images), posed.camera
    camera_from_world = invert_rigid(posed.world_from_camera)
    rays = [_rays(camera, *part) for part in frame_parts(camera.height, camera.width)]
    sources = np.full((n, len(rays), config.sources), -1, np.int32)
    neighbors = np.full((n, config.neighbors), -1, np.int32)
    ideal = np.radians(config.best_angle_deg)
    for i in range(n):
        # Sample points at two depths inside the range, in the harmonic middle where most of a room lies.
        middle = 2.0 / (1.0 / (near[i] / 0.65) + 1.0 / (far[i] / 1.5))
        local = np.concatenate([np.concatenate([r * middle * 0.8, r * middle * 1.4]) for r in rays])
        world = local @ posed.world_from_camera[i, :3, :3].T + posed.world_from_camera[i, :3, 3]
        inside, angle, offset = _relation(world, i, posed, camera_from_world)
        inside[i] = False
        spread = np.where(angle < ideal, 0.45 * ideal, 1.0 * ideal)
        worth = inside * np.exp(-0.5 * ((angle - ideal) / spread) ** 2)
        for part, own in enumerate(np.split(worth, len(rays), axis=1)):
            _pick(own, offset, sources[i, part], enough=_SOURCES_ENOUGH, repulsion=0.6)
        wide = inside * np.exp(-0.5 * ((angle - 1.2 * ideal) / (1.5 * ideal)) ** 2)
        _pick(wide, offset, neighbors[i], enough=_NEIGHBORS_ENOUGH, repulsion=0.3)
    if (sources[..., 0] < 0).mean() > 0.5:
        raise InputError(
            "depth: most frames have no other frame that sees the same things from another place. "
            "Film while walking sideways, not while standing and turning."
        )
    return ViewPlan(sources, neighbors, near, far)


def _rays(camera: Camera, top: int, bottom: int, left: int, right: int) -> np.ndarray:
    """Return rays (p, 3) with z = 1 spread over a part of a frame."""
    share = np.linspace(*_GRID)
    x, y = np.meshgrid(left + share * (right - left), top + share * (bottom - top))
    return np.stack(
        [(x.ravel() - camera.cx) / camera.fx, (y.ravel() - camera.cy) / camera.fy, np.ones(x.size)], 1
    )


def _relation(world: np.ndarray, i: int, posed: PosedFrames, camera_from_world: np.ndarray):
    """Return which points every frame has inside and their angle to frame i (n, p), and the baselines (n, 3)."""
    camera = posed.camera
    local = np.einsum("nij,pj->npi", camera_from_world[:, :3, :3], world) + camera_from_world[:, None, :3, 3]
    z = np.maximum(local[..., 2], 1e-12)
    u, v = camera.fx * local[..., 0] / z + camera.cx, camera.fy * local[..., 1] / z + camera.cy
    inside = (local[..., 2] > 0) & (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height)
    centers = posed.world_from_camera[:, :3, 3]
    a = world - centers[i]
    b = world[None] - centers[:, None]
    cosine = np.einsum("pk,npk->np", a, b) / np.maximum(
        np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=2), 1e-12
    )
    offset = (centers - centers[i]) @ posed.world_from_camera[i, :3, :3]
    return inside, np.arccos(np.clip(cosine, -1, 1)), offset


def _pick(worth: np.ndarray, offset: np.ndarray, out: np.ndarray, *, enough: float, repulsion: float) -> None:
    """Write the views that add most coverage of the points to `out`, greedily.

    Args:
        worth: float (n, p) of each view at each point.
        offset: float (n, 3) baselines.
        out: int (k,) written.
        enough: worth from which a point counts little more.
        repulsion: loss of views beside a chosen one, so that both sides are used.
    """
    seen, keen = np.zeros(worth.shape[1]), np.ones(len(worth))
    for k in range(len(out)):
        score = keen * (worth @ np.exp(-0.5 * (seen / enough) ** 2))
        best = int(np.argmax(score))
        if score[best] < 1e-3 * worth.shape[1]:
            return
        out[k] = best
        seen += worth[best]
        gap = np.linalg.norm(offset - offset[best], axis=1)
        reach = 0.5 * np.linalg.norm(offset[best]) + 1e-12
        keen *= 1.0 - repulsion * np.exp(-((gap / reach) ** 2))
        keen[best] = 0.0
