"""Usable robots, their reach and gripper sizes, and their collision geometry at rest."""

import contextlib
import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from registry import EnvironmentMissing, UsageError
from registry.errors import did_you_mean

_SAMPLE_SPACING_M = 0.02  # of surface points


@dataclass(frozen=True)
class HandShape:
    """Sizes (m) of a parallel gripper that points down, relative to its tool centre point (between the fingertips)."""

    opening_m: float
    """Maximum distance between the fingers."""
    finger_m: tuple[float, float]
    """Size of a finger across and along the closing direction."""
    tip_below_m: float
    """Distance of the fingertips below the tool centre point."""
    palm_above_m: float
    """Height of the palm above the tool centre point."""
    palm_half_m: tuple[float, float]
    """Half size of the palm along and across the closing direction."""


@dataclass(frozen=True)
class RobotTraits:
    """Properties of a robot for its placement; lengths in metres."""

    mobile: bool
    """Drives on the floor; others are mounted at the height of the target's support."""
    reach_m: tuple[float, float, float]
    """Minimum, best and maximum horizontal distance from the root to a grasp."""
    work_height_m: tuple[float, float]
    """Minimum and maximum height of a grasp above the root."""
    hand: HandShape
    payload_kg: float
    footprint_radius_m: float
    aside_rad: float = np.pi
    """Maximum angle between the root's forward axis and a grasp; pi for an arm that turns on its foot."""


_PANDA_HAND = HandShape(0.08, (0.022, 0.016), 0.0095, 0.037, (0.104, 0.032))
_FETCH_HAND = HandShape(0.10, (0.026, 0.015), 0.031, 0.032, (0.063, 0.040))
_SMALL_HAND = HandShape(0.06, (0.020, 0.015), 0.010, 0.035, (0.040, 0.030))
_ARM = RobotTraits(False, (0.35, 0.50, 0.68), (-0.25, 0.60), _PANDA_HAND, 3.0, 0.13)
_SMALL_ARM = RobotTraits(False, (0.15, 0.22, 0.32), (-0.10, 0.20), _SMALL_HAND, 0.3, 0.08)
TRAITS = {
    "panda": _ARM,
    "panda_wristcam": _ARM,
    "fetch": RobotTraits(True, (0.50, 0.62, 0.85), (0.30, 1.20), _FETCH_HAND, 3.0, 0.30, 1.1),
    "so100": _SMALL_ARM,
    "koch-v1.1": _SMALL_ARM,
}
"""Tested robots. Others get the traits of the panda."""


@dataclass(frozen=True)
class RobotShape:
    """Collision geometry of a robot at rest, root space."""

    points: np.ndarray  # float64 (n, 3) on its surface
    has_gripper: bool  # can detect grasps
    control_modes: tuple[str, ...] = ()


def usable_robots() -> list[str]:
    """Return the names of ManiSkill robots whose files are installed."""
    return sorted(uid for uid, agent in _agents().items() if _file_of(agent) is not None)


def check_robot(uid: str) -> None:
    """Check that a robot can be built; ManiSkill itself would prompt on the terminal and exit.

    Raises:
        UsageError: The robot is unknown.
        EnvironmentMissing: Its files are not installed.
    """
    agents = _agents()
    listed = ", ".join(usable_robots())
    if uid not in agents:
        meant = did_you_mean(str(uid), agents)
        raise UsageError(f"robot {uid!r} is not known to ManiSkill.{meant} Usable here: {listed}")
    if _file_of(agents[uid]) is None:
        raise EnvironmentMissing(
            f"robot {uid!r}: its files are not on this machine; get them with "
            f"`python -m mani_skill.utils.download_asset {uid}`. Usable here: {listed}"
        )


def traits_of(uid: str) -> RobotTraits:
    """Return the traits of a robot."""
    return TRAITS.get(uid, _ARM)


@functools.lru_cache(maxsize=8)
def robot_shape(uid: str) -> RobotShape:
    """Build a robot in an empty scene, without rendering, and sample points on its collision shapes at rest."""
    import sapien
    import torch
    from mani_skill.envs.scene import ManiSkillScene
    from mani_skill.envs.utils.system.backend import parse_sim_and_render_backend

    backend = parse_sim_and_render_backend("physx_cpu", "none")
    scene = ManiSkillScene(
        [sapien.Scene([sapien.physx.PhysxCpuSystem()])], device=torch.device("cpu"), backend=backend
    )
    agent = _agents()[uid](scene, 20, initial_pose=sapien.Pose())
    agent.robot.set_qpos(torch.as_tensor(rest_qpos(agent), dtype=torch.float32)[None])
    clouds = []
    for link in agent.robot.get_links():
        body = link._objs[0]
        for shape in body.collision_shapes:
            pose = body.entity.pose * shape.local_pose
            clouds.append(
                surface_points(shape, _SAMPLE_SPACING_M) @ pose.to_transformation_matrix()[:3, :3].T + pose.p
            )
    points = np.concatenate(clouds) if clouds else np.zeros((0, 3))
    # Keep one point per cell.
    _, kept = np.unique(np.floor(points / _SAMPLE_SPACING_M), axis=0, return_index=True)
    grips = hasattr(agent, "is_grasping") and hasattr(agent, "tcp")
    return RobotShape(points[np.sort(kept)], grips, tuple(agent.supported_control_modes))


def check_control_mode(uid: str, mode: str | None) -> None:
    """Check that a robot has a control mode; None is its default.

    Raises:
        UsageError: The mode is unknown; lists the robot's modes.
    """
    modes = robot_shape(uid).control_modes
    if mode is not None and mode not in modes:
        raise UsageError(
            f"control_mode {mode!r}: expected one of {', '.join(modes)} of robot {uid!r}."
            + did_you_mean(str(mode), modes)
        )


def rest_qpos(agent: Any) -> np.ndarray:
    """Return the joint positions (d,) of a robot's keyframe "rest", else of its first keyframe, else zeros."""
    frames = agent.keyframes
    frame = frames.get("rest") or next(iter(frames.values()), None)
    if frame is None or frame.qpos is None:
        return np.zeros(agent.robot.max_dof)
    return np.asarray(frame.qpos, dtype=np.float64)


def surface_points(shape: Any, spacing_m: float) -> np.ndarray:
    """Sample points (n, 3) on a PhysX shape, in its own space, at most `spacing_m` apart; none on a plane."""
    import trimesh
    from sapien import physx

    if isinstance(shape, physx.PhysxCollisionShapeBox):
        mesh = trimesh.creation.box(2 * np.asarray(shape.half_size))
    elif isinstance(shape, physx.PhysxCollisionShapeSphere):
        mesh = trimesh.creation.icosphere(radius=shape.radius, subdivisions=2)
    elif isinstance(shape, physx.PhysxCollisionShapeCapsule | physx.PhysxCollisionShapeCylinder):
        # SAPIEN's cylinders lie along x. A capsule is approximated by a cylinder of the same length.
        caps = 2 * shape.radius if isinstance(shape, physx.PhysxCollisionShapeCapsule) else 0.0
        mesh = trimesh.creation.cylinder(shape.radius, 2 * shape.half_length + caps)
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    elif isinstance(shape, physx.PhysxCollisionShapePlane):
        return np.zeros((0, 3))
    else:
        mesh = trimesh.Trimesh(
            np.asarray(shape.vertices) * np.asarray(shape.scale), shape.triangles, process=False
        )
    found = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, spacing_m, max_iter=12)
    return np.asarray(found[0])


def _agents() -> dict[str, Any]:
    import mani_skill.agents.robots  # noqa: F401 - importing it registers the robots
    from mani_skill.agents.registration import REGISTERED_AGENTS

    return {uid: spec.agent_cls for uid, spec in REGISTERED_AGENTS.items()}


def _file_of(agent: Any) -> str | None:
    from mani_skill import format_path

    path = agent.urdf_path or agent.mjcf_path
    with contextlib.suppress(KeyError, IndexError, ValueError):
        path = format_path(str(path)) if path else None
    return path if path and Path(path).exists() else None
