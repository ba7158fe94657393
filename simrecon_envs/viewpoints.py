"""Create ManiSkill camera configs from names of observing cameras."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import sapien
from mani_skill.sensors.camera import CameraConfig

from registry import UsageError
from registry.geometry import SAPIEN_CAMERA_FROM_OPENCV, quat_from_matrix
from simrecon_envs.cameras import Viewpoint, room_view, workspace_view
from simrecon_envs.placement import Placement

NAMES = ("workspace", "overview", "wrist", "capture", "capture:N")
SIZE_PX = 128
_DEFAULT_CAPTURES = 3  # video frames of "capture"


def parse_cameras(value: str | Sequence[str]) -> tuple[str, ...]:
    """Parse an option such as "workspace,wrist" or ("overview", "capture:4") into names.

    Raises:
        UsageError: A name is unknown; lists the known names.
    """
    names = tuple(value.split(",")) if isinstance(value, str) else tuple(value)
    names = tuple(str(name).strip() for name in names)
    for name in names:
        if name not in NAMES[:4] and not re.fullmatch(r"capture:[1-9]\d{0,2}", name):
            raise UsageError(f"cameras: {name!r} is not one of {', '.join(NAMES)}")
    return names


def observing_cameras(env: Any, names: tuple[str, ...]) -> list[CameraConfig]:
    """Return the camera configs of a `SceneEnv` with a built robot."""
    out = []
    for name in names:
        if name == "workspace":
            middle = (env.builder.extent[0] + env.builder.extent[1]) / 2
            placement = env.placement or Placement(middle, 0.0, 0.0, None, "")
            view = workspace_view(env.facts.solids, placement, middle, env.robot_points)
            out.append(camera("base_camera", view, SIZE_PX))
        elif name == "overview":
            view = room_view(env.bundle, env.facts.solids, env.placement, env.robot_points)
            out.append(camera("overview", view, SIZE_PX))
        elif name == "wrist":
            out += _wrist(env)
        else:
            given = env._custom_sensor_configs or {}
            out += _captured(env.bundle, int(name.partition(":")[2] or _DEFAULT_CAPTURES), given)
    return out


def camera(uid: str, view: Viewpoint, size_px: int) -> CameraConfig:
    """Return the config of a square camera at a viewpoint."""
    pose = _pose(view.eye, view.quat_wxyz)
    return CameraConfig(
        uid=uid, pose=pose, width=size_px, height=size_px, fov=view.fov_rad, near=0.01, far=100
    )


def _pose(position: Any, quat_wxyz: Any) -> Any:
    return sapien.Pose(position, quat_wxyz)


def _wrist(env: Any) -> list[CameraConfig]:
    """Return a hand camera that looks along the fingers; empty if the robot has a hand camera."""
    if env.agent is None or not hasattr(env.agent, "tcp"):
        raise UsageError(f"cameras: 'wrist' needs a robot with a hand, {env.robot_uids!r} has none")
    carried = [config.uid for config in np.ravel(env.agent._sensor_configs).tolist()]
    if any("hand" in uid for uid in carried):
        return []
    # Beside the hand. The hand points along +z, a camera along +x.
    pose = _pose([0.07, 0.0, -0.10], [np.cos(np.pi / 4), 0, -np.sin(np.pi / 4), 0])
    return [
        CameraConfig(
            uid="hand_camera", pose=pose, width=SIZE_PX, height=SIZE_PX, fov=1.4, near=0.01, far=100,
            mount=env.agent.tcp,
        )
    ]  # fmt: skip


def _captured(bundle: Any, count: int, given: dict[str, Any]) -> list[CameraConfig]:
    """Return cameras of evenly spread video frames, with the whole frame in the height that `sensor_configs` gives."""
    cameras = bundle.cameras
    total = len(cameras.indices)
    if not total:
        raise UsageError(f"cameras: scene {bundle.scene['id']} has no capture cameras")
    rows = np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(int))
    out = []
    for row in rows:
        pose = np.asarray(cameras.world_from_camera[row])
        quat = quat_from_matrix(pose[:3, :3] @ SAPIEN_CAMERA_FROM_OPENCV[:3, :3].T)
        uid = f"capture_{int(cameras.indices[row])}"
        # ManiSkill sets width and height from `sensor_configs` and keeps the intrinsics.
        height = {**given, **given.get(uid, {})}.get("height", SIZE_PX)
        scale = height / cameras.height
        fx, fy, cx, cy = np.asarray(cameras.params, np.float64)[:4] * scale
        lens = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float32)
        out.append(
            CameraConfig(
                uid=uid, pose=_pose(pose[:3, 3], quat), width=round(cameras.width * scale), height=height,
                intrinsic=lens, near=0.01, far=100,
            )
        )  # fmt: skip
    return out
