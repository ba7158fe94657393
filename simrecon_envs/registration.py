"""Rows of the registry's index -> Gymnasium ids. Imports Gymnasium and the registry, nothing heavy.

`SimRecon/scene0001` is a scene: what changes is the bundle, which has a revision. The revision that was current at
registration travels in the kwargs; `SceneEnv` says what it does when the scene has a newer one.
`SimRecon/scene0001-pick_mug-v0` is a task in it. Scenes have a row in Gymnasium's table each; tasks are read from
the id when it is made, and their version is that of the rules of success and reward.
"""

import re
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.envs import registration as gym_registration
from gymnasium.envs.registration import EnvSpec, WrapperSpec

from registry import SceneRegistry, SimReconError, default_registry_root
from registry.errors import did_you_mean
from simrecon_envs.errors import EnvNotFound

NAMESPACE = "SimRecon"
TASK_VERSION = 0
MAX_EPISODE_STEPS = 200  # 1/20 s each
_KIND_STEPS = {"reach": 100, "place": 250, "put": 250, "stack": 250, "rearrange": 600}  # others as above
MULTI_ID = f"{NAMESPACE}/Multi-v0"
_ENTRY_POINT = "simrecon_envs.scene_env:SceneEnv"
_TASK_ID = re.compile(rf"{NAMESPACE}/(?P<scene>[a-z0-9_]+)-(?P<task>[A-Za-z0-9_-]+?)-v(?P<version>\d+)")
_WRAPPERS = (
    WrapperSpec(name="BatchedTimeLimit", entry_point="simrecon_envs.wrappers:BatchedTimeLimit", kwargs={}),
)


def env_id(scene: str, task: str | None = None) -> str:
    """Return the Gymnasium id of a scene, or of a task in it; accepts `scene0001` and `SimRecon/scene0001`."""
    name = f"{NAMESPACE}/{scene.removeprefix(NAMESPACE + '/')}"
    return name if task is None else f"{name}-{task}-v{TASK_VERSION}"


def register_scenes(root: Path | str | None = None) -> list[str]:
    """Register every scene of a registry; may be called again at any time, and after scenes came or went.

    Scenes that this function registered earlier from the same registry and that are gone are dropped. A scene
    of the same name in another registry is replaced: the last call wins.

    Args:
        root: The registry's folder; the default registry where left out.

    Returns:
        The Gymnasium ids of this registry's scenes, in order.

    Raises:
        SimReconError: the registry's index is damaged, or cannot be read.
    """
    # Absolute, because the working folder may be another one when the environment is made.
    folder = str((default_registry_root() if root is None else Path(root).expanduser()).absolute())
    revisions = SceneRegistry(Path(folder)).revisions()
    ids = {env_id(scene): scene for scene in revisions}
    for known in [name for name, spec in gym.registry.items() if _registry_of(spec) == folder]:
        if known not in ids:
            del gym.registry[known]
    for name, scene in ids.items():
        # Straight into the table: `gym.register` searches all of it on every call and warns when one is
        # replaced.
        gym.registry[name] = _spec(name, scene, revisions[scene], folder)
    return list(ids)


def register_default_scenes() -> list[str]:
    """Register the default registry's scenes; a damaged one gives a warning, because an import must
    succeed.
    """
    gym.registry[MULTI_ID] = EnvSpec(id=MULTI_ID, entry_point="simrecon_envs.multi:MultiSceneEnv",
                                     disable_env_checker=True, order_enforce=False)  # fmt: skip
    try:
        return register_scenes()
    except SimReconError as error:
        warnings.warn(f"simrecon_envs: no scene was registered: {error}", RuntimeWarning, stacklevel=3)
        return []


def make(scene: str, *, registry: Path | str | None = None, **kwargs: Any) -> gym.Env:
    """Make the environment of a scene: `gym.make`, after looking for scenes that are new.

    Args:
        scene: `scene0001`, `SimRecon/scene0001` or `SimRecon/scene0001-pick_mug-v0`.
        registry: The registry's folder; the default registry where left out.
        **kwargs: As for `gym.make`; see `SceneEnv`.

    Raises:
        EnvNotFound: names the scenes that exist, and the nearest.
    """
    name = env_id(scene)
    match = _TASK_ID.fullmatch(name)
    row = env_id(match["scene"]) if match is not None else name
    if registry is not None or row not in gym.registry:
        ids = register_scenes(registry)
        if row not in ids and name != MULTI_ID:
            raise EnvNotFound(_not_found(name, ids, registry))
    return gym.make(name, **kwargs)


def make_cpu(scene: str, *, registry: Path | str | None = None, **kwargs: Any) -> gym.Env:
    """Make the environment of a scene with the plain Gymnasium API: unbatched NumPy arrays, Python scalars.

    Takes what `make` takes.
    """
    env = make(scene, registry=registry, **kwargs)
    from simrecon_envs.wrappers import NumpyEnv

    return NumpyEnv(env)


def find_spec(name: str) -> EnvSpec | None:
    """Return the spec of an id in our namespace, or None where Gymnasium's own table has it or it is not ours.

    Raises:
        EnvNotFound: names what exists, and the nearest.
    """
    if not name.startswith(NAMESPACE + "/") or name in gym.registry:
        return None
    match = _TASK_ID.fullmatch(name)
    if match is not None and (row := gym.registry.get(env_id(match["scene"]))) is not None:
        if int(match["version"]) != TASK_VERSION:
            there = env_id(match["scene"], match["task"])
            raise EnvNotFound(f"{name} does not exist: the version of tasks is {TASK_VERSION}, as in {there}")
        kwargs = {**row.kwargs, "task": match["task"]}
        return EnvSpec(
            id=name, entry_point=_ENTRY_POINT, max_episode_steps=episode_steps(match["task"]), disable_env_checker=True,
            kwargs=kwargs, additional_wrappers=_WRAPPERS,
        )  # fmt: skip
    ids = [known for known, spec in gym.registry.items() if _registry_of(spec) is not None]
    raise EnvNotFound(_not_found(name, ids, None))


def teach_gymnasium() -> None:
    """Let `gym.make` and `gym.spec` find ids of tasks, and say what there is where an id of ours is wrong.

    Gymnasium has no way to ask for ids that are made on demand, so its look-up is wrapped; ids outside our namespace
    go through as before. Where a version of Gymnasium has another look-up, scenes still work, and
    `simrecon_envs.make` takes the ids of tasks by their spec.
    """
    if getattr(gym_registration, "_simrecon", False) or not hasattr(gym_registration, "_find_spec"):
        return
    look_up, look_up_spec = gym_registration._find_spec, gym_registration.spec

    def _find_spec(env_id: str) -> EnvSpec:
        return find_spec(env_id.split(":")[-1]) or look_up(env_id)

    def spec(env_id: str) -> EnvSpec:
        return find_spec(env_id) or look_up_spec(env_id)

    spec.__doc__ = look_up_spec.__doc__
    gym_registration._find_spec = _find_spec
    gym_registration.spec = spec
    if gym.spec is look_up_spec:
        gym.spec = spec
    gym_registration._simrecon = True


def answer_running_look_up() -> None:
    """Make `gym.make("simrecon_envs:SimRecon/scene0001-pick_mug-v0")` work in a process that has not imported us yet.

    Gymnasium imports the package in the midst of its own look-up, which began before ours was in place and reads the
    table once more afterwards: the task that it looks for gets a row there.

    Raises:
        EnvNotFound: there is no such scene or task's version; names what exists, and the nearest.
    """
    frame = sys._getframe()
    while frame is not None and frame.f_code is not _GYMNASIUM_CODE:
        frame = frame.f_back
    name = frame.f_locals.get("env_name") if frame is not None else None
    if isinstance(name, str) and (spec := find_spec(name)) is not None:
        gym.registry[name] = spec


# Of Gymnasium's own look-up; this module is imported once, before `teach_gymnasium` puts another in its place.
_GYMNASIUM_CODE = getattr(getattr(gym_registration, "_find_spec", None), "__code__", None)

_TEMPLATE = vars(
    EnvSpec(
        id=f"{NAMESPACE}/template",
        entry_point=_ENTRY_POINT,
        max_episode_steps=MAX_EPISODE_STEPS,
        # ManiSkill's environments return batched tensors, which Gymnasium's checker does not know.
        disable_env_checker=True,
        additional_wrappers=_WRAPPERS,
    )
)


def _spec(name: str, scene: str, revision: str, folder: str) -> EnvSpec:
    # Without the constructor, which takes every id apart again: tens of thousands of scenes are registered at import.
    spec = object.__new__(EnvSpec)
    kwargs = {"scene_id": scene, "revision": revision, "registry": folder}
    spec.__dict__ = {**_TEMPLATE, "id": name, "name": scene, "kwargs": kwargs}
    return spec


def episode_steps(task: str) -> int:
    """Return how long an episode of a task is; composites have the steps of all stages."""
    return sum(_KIND_STEPS.get(stage.split("_")[0], MAX_EPISODE_STEPS) for stage in task.split("-then-"))


def _registry_of(spec: EnvSpec) -> str | None:
    return spec.kwargs.get("registry") if spec.entry_point == _ENTRY_POINT else None


def _not_found(name: str, ids: list[str], registry: Path | str | None) -> str:
    place = registry if registry is not None else default_registry_root()
    if not ids:
        hint = "make a scene with `simrecon reconstruct VIDEO`"
        return f"{name} does not exist: the registry {place} is empty; {hint}"
    shown = ", ".join(ids[:10]) + (f" and {len(ids) - 10} more" if len(ids) > 10 else "")
    meant = did_you_mean(name.split("-")[0], ids)
    where = f"in the registry {place}" if registry is not None else "among the registered scenes"
    tasks = f" Tasks are {NAMESPACE}/SCENE-TASK-v{TASK_VERSION}: simrecon_envs.list_tasks(SCENE) lists them."
    return f"{name} does not exist {where}.{meant} There are: {shown}.{tasks}"
