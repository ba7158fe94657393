"""Pictures and videos of an environment: for the demo, the command line and people."""

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from registry import UsageError
from simrecon_envs.oracle import CONTROL_MODE, Oracle
from simrecon_envs.registration import make

POLICIES = ("scripted", "random", "still")


def record_rollout(
    scene: str,
    out_mp4: Path | str,
    steps: int = 100,
    policy: str = "scripted",
    seed: int = 0,
    *,
    robot: str = "panda",
    task: str = "pick",
    registry: Path | str | None = None,
    size_px: int = 512,
) -> dict[str, Any]:
    """Record a rollout as a video.

    Args:
        scene: `scene0001` or `SimRecon/scene0001`.
        out_mp4: The video's file; written whole or not at all.
        steps: Control steps, 1/20 s each; one picture a step.
        policy: "scripted" (the oracle does the task), "random" or "still".
        seed: Of the reset and of the random actions.
        robot: A robot of ManiSkill.
        task: A kind of task or a task's name.
        registry: The registry's folder; the default registry where None.
        size_px: Width and height of the pictures.

    Returns:
        {"steps", "success", "return", "target_id", "instruction", "task_note", "policy"}; `policy` is the one
        that was used: "random" where there is no task.

    Raises:
        EnvironmentMissing: nothing can render here.
    """
    if policy not in POLICIES:
        raise UsageError(f"policy {policy!r} is not one of {', '.join(POLICIES)}")
    kwargs = {"control_mode": CONTROL_MODE} if policy == "scripted" else {}
    env = make(
        scene,
        registry=registry,
        render_mode="rgb_array",
        robot_uids=robot,
        task=task,
        max_episode_steps=steps + 1,
        human_render_camera_configs={"width": size_px, "height": size_px},
        **kwargs,
    )
    try:
        return _record(env, Path(out_mp4), steps, policy, seed)
    finally:
        env.close()


@contextlib.contextmanager
def open_video(out_mp4: Path, fps: int) -> Iterator[Callable[[np.ndarray], None]]:
    """Yield what adds a picture (h, w, 3) uint8 to a video, which is written whole or not at all."""
    import imageio.v2 as imageio

    out_mp4.parent.mkdir(parents=True, exist_ok=True)
    partial = out_mp4.with_name(f".{out_mp4.stem}-{os.getpid()}.mp4")
    try:
        with imageio.get_writer(partial, fps=fps, codec="libx264", macro_block_size=2) as video:
            yield video.append_data
        os.replace(partial, out_mp4)
    finally:
        partial.unlink(missing_ok=True)


def _record(env: gym.Env, out_mp4: Path, steps: int, policy: str, seed: int) -> dict[str, Any]:
    scene_env = env.unwrapped
    env.reset(seed=seed)
    env.action_space.seed(seed)
    if policy == "scripted" and scene_env.task_object is None:
        policy = "random"
    script = Oracle(scene_env) if policy == "scripted" else None
    still = np.zeros(env.action_space.shape, np.float32)
    total, success = 0.0, False
    with open_video(out_mp4, scene_env.control_freq) as add:
        add(_picture(env))
        for _ in range(steps):
            if script is not None:
                action = script.action()
            else:
                action = env.action_space.sample() if policy == "random" else still
            _, reward, _, _, info = env.step(action)
            total += float(reward)
            success = success or bool(info.get("success", False))
            add(_picture(env))
    return {
        "steps": steps,
        "success": success,
        "return": total,
        "target_id": scene_env.target_id,
        "instruction": scene_env.instruction,
        "task_note": scene_env.task_note,
        "policy": policy,
    }


def render_scene_picture(
    scene: str,
    out_png: Path | str,
    *,
    robot: str = "none",
    registry: Path | str | None = None,
    size_px: int = 768,
) -> Path:
    """Render the assembled scene from a viewpoint that shows much of it; returns the picture's file.

    Args:
        scene: `scene0001` or `SimRecon/scene0001`.
        out_png: The picture's file.
        robot: A robot of ManiSkill to show in it, or "none".
        registry: The registry's folder; the default registry where None.
        size_px: Width and height.

    Raises:
        EnvironmentMissing: nothing can render here.
    """
    import imageio.v2 as imageio

    env = make(
        scene,
        registry=registry,
        render_mode="rgb_array",
        robot_uids=robot,
        human_render_camera_configs={"width": size_px, "height": size_px},
    )
    try:
        env.reset(seed=0)
        out_png = Path(out_png)
        out_png.parent.mkdir(parents=True, exist_ok=True)
        imageio.imwrite(out_png, _picture(env))
    finally:
        env.close()
    return out_png


def _picture(env: gym.Env) -> np.ndarray:
    return np.asarray(env.render()[0].cpu(), dtype=np.uint8)
