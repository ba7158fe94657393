"""Register the scenes of the registry's index as Gymnasium ids. Imports only Gymnasium and the registry.

`SimRecon/scene0001` is a scene. Its spec holds the revision that was current at registration; `SceneEnv` defines what
happens if the scene has a newer one. `SimRecon/scene0001-pick_mug-v0` is a task in it; its version is that of the rules
of success and reward. Scenes have entries in Gymnasium's registry; specs of tasks are created on demand from the id.
"""

import re
import sys
import warnings
from copy import copy
from dataclasses import fields
from functools import cached_property
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.envs import registration as gym_registration
from gymnasium.envs.registration import EnvSpec, WrapperSpec

from registry import SimReconError, UsageError, default_registry_root, open_registry, registry_folder
from registry.errors import did_you_mean
from simrecon_envs.collection import without_collection
from simrecon_envs.errors import EnvNotFound

NAMESPACE = "SimRecon"
TASK_VERSION = 0
MAX_EPISODE_STEPS = 200  # 1/20 s each
_KIND_STEPS = {
    "reach": 100,
    "place": 250,
    "put": 250,
    "stack": 250,
    "rearrange": 600,
}  # others: MAX_EPISODE_STEPS
MULTI_ID = f"{NAMESPACE}/Multi-v0"
_ENTRY_POINT = "simrecon_envs.entry:SceneEnv"
_TASK_ID = re.compile(rf"{NAMESPACE}/(?P<scene>[a-z0-9_]+)-(?P<task>[A-Za-z0-9_-]+?)-v(?P<version>\d+)")
_WRAPPERS = (
    WrapperSpec(name="BatchedTimeLimit", entry_point="simrecon_envs.wrappers:BatchedTimeLimit", kwargs={}),
)


def env_id(scene: str, task: str | None = None) -> str:
    """Return the Gymnasium id of a scene (`scene0001` or `SimRecon/scene0001`), or of a task in it."""
    name = f"{NAMESPACE}/{scene.removeprefix(NAMESPACE + '/')}"
    return name if task is None else f"{name}-{task}-v{TASK_VERSION}"


def register_scenes(root: Path | str | None = None) -> list[str]:
    """Register every scene of a registry; call it again after scenes were added or removed.

    Removed scenes of the same registry are unregistered. A scene with the same id in another registry is replaced.

    Args:
        root: Folder or address of the registry; None for the default one.

    Returns:
        The Gymnasium ids of this registry's scenes, in order.

    Raises:
        SimReconError: The registry's index is damaged or cannot be read.
    """
    return sorted(_register(root))


def _register(root: Path | str | None, known_only: bool = False) -> dict[str, EnvSpec]:
    """Register as `register_scenes` does; return {id: spec} of the registry's scenes, in any order.

    With `known_only` nothing is asked of an address: its scenes that were listed before are registered.
    """
    # Absolute, because the working folder may change before the environment is made.
    folder = str(registry_folder(root).absolute())
    with without_collection():
        # Not by `gym.register`, which searches the whole registry in every call and warns about replaced ids.
        revisions = open_registry(folder).revisions(ordered=False, known_only=known_only)
        specs = _scene_specs(revisions, folder)
        for known in [name for name, spec in gym.registry.items() if _registry_of(spec) == folder]:
            if known not in specs:
                del gym.registry[known]
        gym.registry.update(specs)
    return specs


def register_default_scenes() -> None:
    """Register the scenes of the default registry; if it is damaged, only warn, so that the import succeeds."""
    gym.registry[MULTI_ID] = EnvSpec(id=MULTI_ID, entry_point="simrecon_envs.multi:MultiSceneEnv",
                                     disable_env_checker=True, order_enforce=False)  # fmt: skip
    try:
        _register(None, known_only=True)
    except (SimReconError, RuntimeError) as error:  # RuntimeError: this user has no home folder
        warnings.warn(f"simrecon_envs: no scene was registered: {error}", RuntimeWarning, stacklevel=3)


def make(scene: str, *, registry: Path | str | None = None, **kwargs: Any) -> gym.Env:
    """Make the environment of a scene with `gym.make`; register new scenes first.

    Args:
        scene: `scene0001`, `SimRecon/scene0001` or `SimRecon/scene0001-pick_mug-v0`.
        registry: Folder of the registry; None for the default one.
        **kwargs: Arguments of `gym.make` and `SceneEnv`.

    Raises:
        EnvNotFound: The scene does not exist; names the closest and the existing ones.
        UsageError: An argument has a wrong value; names it.
    """
    steps = kwargs.get("max_episode_steps", 1)
    if steps is not None and (isinstance(steps, bool) or not hasattr(steps, "__index__") or steps < 1):
        raise UsageError(f"max_episode_steps {steps!r}: expected a whole number, at least 1")
    name = env_id(scene)
    match = _TASK_ID.fullmatch(name)
    row = env_id(match["scene"]) if match is not None else name
    if registry is not None or row not in gym.registry:
        ids = register_scenes(registry)
        if row not in ids and name != MULTI_ID:
            raise EnvNotFound(_not_found(name, ids, registry))
    return gym.make(name, **kwargs)


def make_cpu(scene: str, *, registry: Path | str | None = None, **kwargs: Any) -> gym.Env:
    """Make the environment of a scene with unbatched NumPy arrays and Python scalars; arguments as for `make`."""
    env = make(scene, registry=registry, **kwargs)
    from simrecon_envs.wrappers import NumpyEnv

    return NumpyEnv(env)


def find_spec(name: str) -> EnvSpec | None:
    """Return the spec of a task's id; None if the id is in Gymnasium's registry or outside our namespace.

    Raises:
        EnvNotFound: The id is in our namespace and does not exist; names the closest and the existing ones.
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
    ids = sorted(known for known, spec in gym.registry.items() if _registry_of(spec) is not None)
    raise EnvNotFound(_not_found(name, ids, None))


def teach_gymnasium() -> None:
    """Wrap Gymnasium's look-up, so that `gym.make` and `gym.spec` find ids of tasks and raise helpful errors.

    Gymnasium has no hook for specs created on demand. Ids outside our namespace are passed on. If a version of
    Gymnasium has another look-up, only scenes can be found.
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
    gym_registration._simrecon = True  # pyright: ignore[reportAttributeAccessIssue]


def answer_running_look_up() -> None:
    """Make `gym.make("simrecon_envs:SimRecon/scene0001-pick_mug-v0")` work if it imports this package.

    Gymnasium then imports the package inside its own, still unwrapped look-up, and reads its registry afterwards. Find
    the requested id in the call stack and register its spec.

    Raises:
        EnvNotFound: The scene or the version of the task does not exist; names the closest and the existing ones.
    """
    frame = sys._getframe()
    while frame is not None and frame.f_code is not _GYMNASIUM_CODE:
        frame = frame.f_back
    name = frame.f_locals.get("env_name") if frame is not None else None
    if isinstance(name, str) and (spec := find_spec(name)) is not None:
        gym.registry[name] = spec


# Code of Gymnasium's own look-up, before `teach_gymnasium` wraps it.
_GYMNASIUM_CODE = getattr(getattr(gym_registration, "_find_spec", None), "__code__", None)


class _SceneSpec(EnvSpec):
    """Spec of a scene whose id and arguments are made when they are first read; copies of it are plain `EnvSpec`.

    An import makes one for each scene. A whole `EnvSpec` is a kilobyte: 100,000 of them take a quarter of a second.
    """

    # Fields without an entry in the instance.
    namespace, version, entry_point = NAMESPACE, None, _ENTRY_POINT
    max_episode_steps = MAX_EPISODE_STEPS
    disable_env_checker = True  # Gymnasium's checker does not support ManiSkill's batched tensors
    additional_wrappers = _WRAPPERS
    _revision: str
    _registry: str

    @cached_property
    def id(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return env_id(self.name)

    @cached_property
    def kwargs(self) -> dict[str, Any]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return {"scene_id": self.name, "revision": self._revision, "registry": self._registry}

    def __reduce__(self) -> tuple[Any, ...]:
        return _plain, ({field.name: getattr(self, field.name) for field in fields(EnvSpec)},)

    def __eq__(self, other: object) -> bool:
        return copy(self) == (copy(other) if isinstance(other, _SceneSpec) else other)

    __hash__ = None  # as of every EnvSpec


def _scene_specs(revisions: dict[str, str], registry: str) -> dict[str, EnvSpec]:
    new, prefix = object.__new__, env_id("")
    specs: dict[str, EnvSpec] = {}
    for scene, revision in revisions.items():
        specs[prefix + scene] = spec = new(_SceneSpec)  # the constructor parses the id
        spec.name, spec._revision, spec._registry = scene, revision, registry
    return specs


def _plain(values: dict[str, Any]) -> EnvSpec:
    spec = object.__new__(EnvSpec)
    vars(spec).update(values)
    return spec


def episode_steps(task: str) -> int:
    """Return the maximum steps of a task's episode; composite tasks have the sum of their stages."""
    return sum(_KIND_STEPS.get(stage.split("_")[0], MAX_EPISODE_STEPS) for stage in task.split("-then-"))


def _registry_of(spec: EnvSpec) -> str | None:
    if isinstance(spec, _SceneSpec):
        return spec._registry
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
