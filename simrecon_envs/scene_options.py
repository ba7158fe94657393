"""Checks of `SceneEnv`'s options and loading of its bundle, before anything is built."""

import warnings
from typing import Any

import torch
from mani_skill.envs.utils.observations import parse_obs_mode_to_struct

from registry import (
    BundleError,
    EnvironmentMissing,
    SceneBundle,
    SceneNotFound,
    UsageError,
    open_registry,
    registry_folder,
)
from registry.errors import did_you_mean
from simrecon_envs.errors import SceneAssetsMissing
from simrecon_envs.robots import check_control_mode, check_robot

OBS_MODES = (
    "state", "state_dict", "none", "rgb", "depth", "segmentation", "rgbd", "pointcloud", "sensor_data",
)  # fmt: skip
RENDERERS = ("mesh", "splats")
REWARD_MODES = ("normalized_dense", "dense", "sparse", "none")


def check_options(scene_id: str, robot: Any, obs_mode: str | None, options: dict[str, Any]) -> None:
    """Check the robot and the options of `SceneEnv` that ManiSkill checks late or with unclear messages.

    Raises:
        UsageError: The robot, control mode, observation mode or reward mode is unknown.
        EnvironmentMissing: The robot's files are not installed, or `num_envs` needs CUDA.
    """
    if not isinstance(robot, str):
        raise UsageError(f"scene {scene_id}: robot_uids: expected the name of one robot, got {robot!r}")
    if robot != "none":
        check_robot(robot)
        check_control_mode(robot, options.get("control_mode"))
    try:
        parse_obs_mode_to_struct(obs_mode or "state")
    except AssertionError as error:
        raise UsageError(
            f"obs_mode {obs_mode!r}: expected {', '.join(OBS_MODES)}, or several with + in between."
            + did_you_mean(str(obs_mode), OBS_MODES)
        ) from error
    reward_mode = options.get("reward_mode")
    if reward_mode not in (None, *REWARD_MODES):
        near = did_you_mean(str(reward_mode), REWARD_MODES)
        raise UsageError(f"reward_mode {reward_mode!r}: expected one of {', '.join(REWARD_MODES)}.{near}")
    count = options.get("num_envs", 1)
    if count > 1 and not torch.cuda.is_available():
        raise EnvironmentMissing(
            f"num_envs={count} is simulated on a GPU, and there is no CUDA here; "
            f"simrecon_envs.make_vec({scene_id!r}, {count}) starts one process per environment"
        )


def check_renderer(renderer: str, obs_mode: str | None) -> None:
    """Check `renderer` and whether it has the images of the observation mode.

    Raises:
        UsageError: The renderer is unknown, or has no raw images.
    """
    if renderer not in RENDERERS:
        near = did_you_mean(str(renderer), RENDERERS)
        raise UsageError(f"renderer {renderer!r}: expected one of {', '.join(RENDERERS)}.{near}")
    if renderer == "splats" and obs_mode == "sensor_data":
        raise UsageError(
            "renderer='splats' has no raw images for obs_mode 'sensor_data'; use 'rgb+depth+segmentation'"
        )


def load_bundle(
    scene_id: str, revision: str | None, registry: str | None, strict: bool
) -> tuple[SceneBundle, str]:
    """Open the current revision of a scene.

    Returns:
        The bundle, and a note if its revision is not the requested one, else "".

    Raises:
        SceneNotFound: The registry has no such scene.
        SceneAssetsMissing: Its files are missing or damaged, or (with `strict`) the revision is another one.
    """
    root = registry_folder(registry)
    try:
        bundle = open_registry(root).load(scene_id)
    except SceneNotFound as error:
        raise SceneNotFound(
            f"{error}. Call simrecon_envs.register_scenes() to see what the registry has now"
        ) from error
    except BundleError as error:
        option = "" if registry is None else f" --registry {root}"
        raise SceneAssetsMissing(
            f"scene {scene_id}: its files in {root} are gone or damaged: {error}. "
            f"`simrecon verify {scene_id}{option}` says more; make it again with "
            f"`simrecon reconstruct VIDEO --scene {scene_id}{option}`"
        ) from error
    if revision is None or bundle.revision == revision:
        return bundle, ""
    replaced = f"scene {scene_id}: revision {revision} was replaced by {bundle.revision}"
    if strict:
        raise SceneAssetsMissing(
            f"{replaced}; call simrecon_envs.register_scenes() to register the new one, or leave out strict_revision"
        )
    note = f"{replaced}, which is used"
    warnings.warn(note, stacklevel=3)
    return bundle, note
