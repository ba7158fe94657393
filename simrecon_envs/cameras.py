"""Choose viewpoints of an environment's cameras by their visibility of target, robot and objects in an occupancy grid.

SAPIEN camera: +x forward, +y left, +z up. OpenCV camera: +x right, +y down, +z forward.
"""

import copy
from dataclasses import dataclass

import numpy as np

from registry import SceneBundle
from registry.geometry import SAPIEN_CAMERA_FROM_OPENCV, matrix_from_quat, quat_from_matrix
from simrecon_envs.occupancy import ConvexSolid, OccupancyGrid
from simrecon_envs.placement import Placement

_WORKSPACE_FOV_RAD = 1.05
_MAX_CAPTURE_CANDIDATES = 40  # video frames whose cameras are tried


@dataclass(frozen=True)
class Viewpoint:
    """Pose and vertical field of view of a camera with square images."""

    eye: np.ndarray  # float64 (3,) world
    quat_wxyz: np.ndarray  # float64 (4,) world_from_sapien_camera
    fov_rad: float

    def seen_share(self, points: np.ndarray, grid: OccupancyGrid) -> float:
        """Return the share of world points (n, 3) that are inside the image and not occluded in the grid."""
        local = (points - self.eye) @ matrix_from_quat(self.quat_wxyz)
        limit = np.tan(self.fov_rad / 2) * 0.95
        inside = (local[:, 0] > 0.1) & (np.abs(local[:, 1:]) <= limit * local[:, :1].clip(1e-6)).all(axis=1)
        return float((inside & grid.visible(self.eye, points)).mean())


def look_at(eye: np.ndarray, target: np.ndarray, fov_rad: float) -> Viewpoint:
    """Return the upright viewpoint at `eye` (3,) that looks at `target` (3,), world space."""
    forward = np.asarray(target, np.float64) - eye
    forward /= np.linalg.norm(forward)
    left = np.cross([0.0, 0.0, 1.0], forward)
    # Looking straight up or down leaves the roll undefined: use world y.
    left = left / np.linalg.norm(left) if np.linalg.norm(left) > 1e-6 else np.array([0.0, 1.0, 0.0])
    world_from_camera = np.stack([forward, left, np.cross(forward, left)], axis=1)
    return Viewpoint(np.asarray(eye, np.float64), quat_from_matrix(world_from_camera), fov_rad)


def from_capture(world_from_camera: np.ndarray, params: np.ndarray, width: int, height: int) -> Viewpoint:
    """Return the viewpoint of a video frame: its pose and a square image that covers the longer side.

    Args:
        world_from_camera: (4, 4), OpenCV axes.
        params: Intrinsics in pixels; the first two are the focal lengths.
        width: Image width in pixels.
        height: Image height in pixels.
    """
    world_from_sapien = np.asarray(world_from_camera)[:3, :3] @ SAPIEN_CAMERA_FROM_OPENCV[:3, :3].T
    fov = 2 * np.arctan(max(width / 2 / params[0], height / 2 / params[1]))
    eye = np.asarray(world_from_camera)[:3, 3]
    return Viewpoint(eye, quat_from_matrix(world_from_sapien), float(min(fov, 1.6)))


def workspace_view(
    solids: list[ConvexSolid], placement: Placement, middle: np.ndarray, robot_points: np.ndarray
) -> Viewpoint:
    """Choose the observation camera: the candidate beside or opposite the robot with the least occluded target.

    Args:
        solids: All convex solids of the scene.
        placement: Place of the robot and its target.
        middle: Point (3,) to look at without a target.
        robot_points: Points (n, 3) on the robot at rest, root space; they occlude.
    """
    target = placement.target
    focus = target.center if target is not None else middle
    reach = 0.5 * (target.top_m - target.bottom_m) if target is not None else 0.1
    grid = _grid_around(solids, focus, 2.0)
    if len(robot_points):
        grid.add_points(placement.to_world(robot_points))
    points = focus + reach * np.array([[0, 0, 0.9], [0.5, 0, 0], [-0.5, 0, 0], [0, 0.5, 0], [0, -0.5, 0]])
    ranked = []
    for turn_deg in (150, -150, 120, -120, 180, 90, -90, 60, -60, 30, -30):
        for distance, lift in (
            (0.80, 0.50),
            (0.75, 0.35),
            (0.70, 0.25),
            (1.0, 0.5),
            (0.45, 0.6),
            (0.35, 0.3),
        ):
            angle = placement.yaw_rad + np.pi + np.deg2rad(turn_deg)
            eye = focus + np.array([distance * np.cos(angle), distance * np.sin(angle), lift])
            view = look_at(eye, focus + np.array([0, 0, 0.05]), _WORKSPACE_FOV_RAD)
            hidden = 1 - view.seen_share(points, grid) + 2.0 * float(grid.occupied(eye))
            ranked.append((round(hidden, 4), len(ranked), view))
    return min(ranked, key=lambda entry: entry[:2])[2]


def room_view(
    bundle: SceneBundle, solids: list[ConvexSolid], placement: Placement | None, robot_points: np.ndarray
) -> Viewpoint:
    """Choose the view that shows most of the robot, its target and the objects.

    Candidates are cameras of video frames and points on circles around the scene. Arguments as in `workspace_view`.
    """
    boxes: dict[int, list[np.ndarray]] = {item.id: [] for item in bundle.objects}
    for solid in solids:
        if solid.owner in boxes:
            boxes[solid.owner].append((solid.lower + solid.upper) / 2)
    centers = np.array([np.mean(parts, axis=0) for parts in boxes.values() if parts]).reshape(-1, 3)
    groups = [(centers, 1.0)] if len(centers) else []
    robot = np.zeros((0, 3))
    if placement is not None and len(robot_points):
        robot = placement.to_world(robot_points)
        if placement.target is not None:
            groups.append((placement.target.center[None], 1.0))
        groups.append((robot[:: max(len(robot) // 40, 1)], 1.5))
    focus = np.mean([points.mean(axis=0) for points, _ in groups], axis=0) if groups else np.zeros(3)
    grid = _grid_around(solids, focus, 5.0, cell_m=0.05)
    hiding = copy.deepcopy(grid)
    hiding.add_points(robot)
    # The robot, which is the last group, occludes the others, but not itself.
    seen = [(points, weight, hiding) for points, weight in groups]
    if len(robot):
        seen[-1] = (*groups[-1], grid)
    best, best_score = None, -np.inf
    everything = np.concatenate([points for points, _ in groups]) if groups else focus[None]
    for view, bonus in _room_candidates(bundle, focus, everything):
        if hiding.occupied(view.eye):
            continue
        score = bonus + sum(weight * view.seen_share(points, by) for points, weight, by in seen)
        if groups and placement is not None:
            # Prefer a distance of about 1.8 m to the workspace.
            middle = groups[-1][0] if placement.target is None else placement.target.center[None]
            distance = np.linalg.norm(middle.mean(axis=0) - view.eye)
            score -= 0.5 * abs(np.log(max(distance, 0.1) / 1.8))
            # Prefer views from the front: the robot's body occludes its hand from behind.
            ahead = np.array([np.cos(placement.yaw_rad), np.sin(placement.yaw_rad)])
            aside = view.eye[:2] - placement.position[:2]
            score += 0.6 * min(float(ahead @ aside) / max(float(np.linalg.norm(aside)), 0.1), 0.3)
        if score > best_score + 1e-9:
            best, best_score = view, score
    return best if best is not None else look_at(focus + np.array([2.0, -2.0, 1.8]), focus, 1.0)


def _framing(eye: np.ndarray, focus: np.ndarray, points: np.ndarray) -> Viewpoint:
    """Return the view towards `focus` whose field of view fits the 90th percentile of the points (n, 3)."""
    forward = (focus - eye) / np.linalg.norm(focus - eye)
    rays = points - eye
    cosine = rays @ forward / np.linalg.norm(rays, axis=1).clip(1e-6)
    half = np.percentile(np.arccos(cosine.clip(-1, 1)), 90)
    return look_at(eye, focus, float(np.clip(2.2 * half, 0.5, 1.25)))


def _room_candidates(
    bundle: SceneBundle, focus: np.ndarray, points: np.ndarray
) -> list[tuple[Viewpoint, float]]:
    """Return viewpoints and their bonus: video cameras, these turned towards `focus`, and circles around it."""
    cameras = bundle.cameras
    count = len(cameras.indices)
    views = []
    rows = np.linspace(0, count - 1, min(count, _MAX_CAPTURE_CANDIDATES)).astype(int)
    for row in np.unique(rows):
        captured = from_capture(cameras.world_from_camera[row], cameras.params, cameras.width, cameras.height)
        # The capture positions are inside the room, and stay so when turned towards the focus.
        views.append((captured, 0.1))
        views.append((_framing(captured.eye, focus, points), 0.3))
    for radius in (1.4, 1.8, 2.3):
        for step in range(16):
            for lift in (0.7, 1.1):
                angle = 2 * np.pi * step / 16
                eye = focus + np.array([radius * np.cos(angle), radius * np.sin(angle), lift])
                views.append((_framing(eye, focus, points), 0.0))
    return views


def _grid_around(
    solids: list[ConvexSolid], center: np.ndarray, radius: float, cell_m: float = 0.03
) -> OccupancyGrid:
    return OccupancyGrid(solids, center - radius, center + radius, cell_m=cell_m, margin_m=-cell_m / 2)
