"""Which frames help which, and which depths to try in each."""

from dataclasses import dataclass

import numpy as np

from reconstruction.depth.config import DepthConfig
from reconstruction.types import PosedFrames
from registry.errors import InputError
from registry.geometry import invert_rigid


@dataclass(frozen=True)
class ViewPlan:
    """What the sweep needs to know of each frame before it looks at pixels."""

    sources: np.ndarray  # int32 (n, s) frames to compare with, best first, -1 = none
    neighbors: np.ndarray  # int32 (n, k) frames that check consistency, best first, -1 = none
    near: np.ndarray  # float64 (n,) nearest depth to try
    far: np.ndarray  # float64 (n,)


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
    """Choose sources and neighbours by triangulation angle and overlap at the depths that the frame sees."""
    near, far = depth_ranges(posed)
    n, camera = len(posed.images), posed.camera
    camera_from_world = invert_rigid(posed.world_from_camera)
    grid_x, grid_y = np.meshgrid(np.linspace(0.08, 0.92, 6), np.linspace(0.08, 0.92, 5))
    rays = np.stack(
        [
            (grid_x.ravel() * camera.width - camera.cx) / camera.fx,
            (grid_y.ravel() * camera.height - camera.cy) / camera.fy,
            np.ones(grid_x.size),
        ],
        1,
    )
    sources = np.full((n, config.sources), -1, np.int32)
    neighbors = np.full((n, config.neighbors), -1, np.int32)
    for i in range(n):
        # Sample points at two depths inside the range, in the harmonic middle where most of a room lies.
        middle = 2.0 / (1.0 / (near[i] / 0.65) + 1.0 / (far[i] / 1.5))
        local = np.concatenate([rays * middle * 0.8, rays * middle * 1.4])
        world = local @ posed.world_from_camera[i, :3, :3].T + posed.world_from_camera[i, :3, 3]
        overlap, angle, offset = _relation(world, i, posed, camera_from_world)
        ideal = np.radians(config.best_angle_deg)
        spread = np.where(angle < ideal, 0.45 * ideal, 1.0 * ideal)
        score = overlap * np.exp(-0.5 * ((angle - ideal) / spread) ** 2)
        score[i] = 0.0
        _pick(score, offset, sources[i], min_overlap=0.3, overlap=overlap, repulsion=0.6)
        wide = overlap * np.exp(-0.5 * ((angle - 1.2 * ideal) / (1.5 * ideal)) ** 2)
        wide[i] = 0.0
        _pick(wide, offset, neighbors[i], min_overlap=0.3, overlap=overlap, repulsion=0.3)
    if (sources[:, 0] < 0).mean() > 0.5:
        raise InputError(
            "depth: most frames have no other frame that sees the same things from another place. "
            "Film while walking sideways, not while standing and turning."
        )
    return ViewPlan(sources, neighbors, near, far)


def _relation(world: np.ndarray, i: int, posed: PosedFrames, camera_from_world: np.ndarray):
    """Return for every frame its overlap with frame i, the median triangulation angle, and the baseline direction."""
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
    angle = np.median(np.arccos(np.clip(cosine, -1, 1)), axis=1)
    offset = (centers - centers[i]) @ posed.world_from_camera[i, :3, :3]
    return inside.mean(1), angle, offset


def _pick(score, offset, out, *, min_overlap, overlap, repulsion) -> None:
    """Fill `out` greedily; those beside a chosen one lose score, so that both sides are used."""
    score = np.where(overlap >= min_overlap, score, 0.0)
    for k in range(len(out)):
        best = int(np.argmax(score))
        if score[best] < 1e-3:
            return
        out[k] = best
        gap = np.linalg.norm(offset - offset[best], axis=1)
        reach = 0.5 * np.linalg.norm(offset[best]) + 1e-12
        score = score * (1.0 - repulsion * np.exp(-((gap / reach) ** 2)))
        score[best] = 0.0
