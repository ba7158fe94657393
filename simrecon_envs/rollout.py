"""Render images and record videos of an environment."""

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
from simrecon_envs.unwrapped import scene_of

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
        out_mp4: The video file; written atomically.
        steps: Control steps of 1/20 s; one image per step.
        policy: "scripted" (the scripted expert), "random" or "still".
        seed: Seed of the reset and of random actions.
        robot: A robot of ManiSkill.
        task: A kind of task or the name of a task.
        registry: Folder of the registry; None for the default one.
        size_px: Width and height of the images.

    Returns:
        {"steps", "success", "return", "target_id", "instruction", "task_note", "policy"}. `policy` is the one that was
        used: "random" instead of "scripted" if there is no task.

    Raises:
        UsageError: The policy is unknown.
        EnvironmentMissing: There is no usable renderer.
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
    """Yield a function that appends an image (h, w, 3) uint8 to a video, which is written atomically."""
    import imageio.v2 as imageio

    out_mp4.parent.mkdir(parents=True, exist_ok=True)
    partial = out_mp4.with_name(f".{out_mp4.stem}-{os.getpid()}.mp4")
    try:
        writer: Any = imageio.get_writer(partial, fps=fps, codec="libx264", macro_block_size=2)
        with writer as video:
            yield video.append_data
        partial.replace(out_mp4)
    finally:
        partial.unlink(missing_ok=True)


def _record(env: gym.Env, out_mp4: Path, steps: int, policy: str, seed: int) -> dict[str, Any]:
    scene_env = scene_of(env)
    env.reset(seed=seed)
    env.action_space.seed(seed)
    if policy == "scripted" and scene_env.task_object is None:
        policy = "random"
    script = Oracle(scene_env) if policy == "scripted" else None
    still = np.zeros(env.action_space.shape or (), np.float32)
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
    """Render the assembled scene from the viewpoint of `cameras.room_view`; return the image file.

    Args:
        scene: `scene0001` or `SimRecon/scene0001`.
        out_png: The image file.
        robot: A robot of ManiSkill, or "none".
        registry: Folder of the registry; None for the default one.
        size_px: Width and height of the image.

    Raises:
        EnvironmentMissing: There is no usable renderer.
    """
    import imageio.v2 as imageio

    size = {"width": size_px, "height": size_px}
    env = make(
        scene, registry=registry, render_mode="rgb_array", robot_uids=robot, human_render_camera_configs=size
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
    images: Any = env.render()
    return np.asarray(images[0].cpu(), dtype=np.uint8)
