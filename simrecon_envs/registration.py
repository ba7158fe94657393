"""Rows of the registry's index -> Gymnasium ids. Imports Gymnasium and the registry, nothing heavy.

Ids are unversioned (`SimRecon/scene0001`): what changes is the bundle, which has a revision. The revision
that was current at registration travels in the kwargs; `SceneEnv` says what it does when the scene has a
newer one.
"""

import difflib
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, WrapperSpec

from registry import SceneNotFound, SceneRecord, SceneRegistry, SimReconError, default_registry_root

NAMESPACE = "SimRecon"
MAX_EPISODE_STEPS = 200
_ENTRY_POINT = "simrecon_envs.scene_env:SceneEnv"


def env_id(scene: str) -> str:
    """Return the Gymnasium id of a scene; accepts `scene0001` and `SimRecon/scene0001`."""
    return f"{NAMESPACE}/{scene.removeprefix(NAMESPACE + '/')}"


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
    records = SceneRegistry(Path(folder)).list()
    ids = [env_id(record.scene_id) for record in records]
    for known in [name for name, spec in gym.registry.items() if _registry_of(spec) == folder]:
        if known not in ids:
            del gym.registry[known]
    for name, record in zip(ids, records):
        # Straight into the table: `gym.register` searches all of it on every call and warns when one is
        # replaced.
        gym.registry[name] = _spec(name, record, folder)
    return ids


def register_default_scenes() -> list[str]:
    """Register the default registry's scenes; a damaged one gives a warning, because an import must
    succeed.
    """
    try:
        return register_scenes()
    except SimReconError as error:
        warnings.warn(f"simrecon_envs: no scene was registered: {error}", RuntimeWarning, stacklevel=3)
        return []


def make(scene: str, *, registry: Path | str | None = None, **kwargs: Any) -> gym.Env:
    """Make the environment of a scene: `gym.make`, after looking for scenes that are new.

    Args:
        scene: `scene0001` or `SimRecon/scene0001`.
        registry: The registry's folder; the default registry where left out.
        **kwargs: As for `gym.make`; see `SceneEnv`.

    Raises:
        SceneNotFound: names the scenes that exist, and the nearest.
    """
    name = env_id(scene)
    if registry is not None or name not in gym.registry:
        ids = register_scenes(registry)
        if name not in ids:
            raise SceneNotFound(_not_found(name, ids, registry))
    return gym.make(name, **kwargs)


def make_cpu(scene: str, *, registry: Path | str | None = None, **kwargs: Any) -> gym.Env:
    """Make the environment of a scene with the plain Gymnasium API: unbatched NumPy arrays, Python scalars.

    Takes what `make` takes.
    """
    env = make(scene, registry=registry, **kwargs)
    from simrecon_envs.wrappers import NumpyEnv

    return NumpyEnv(env)


def _spec(name: str, record: SceneRecord, folder: str) -> EnvSpec:
    return EnvSpec(
        id=name,
        entry_point=_ENTRY_POINT,
        max_episode_steps=MAX_EPISODE_STEPS,
        # ManiSkill's environments return batched tensors, which Gymnasium's checker does not know.
        disable_env_checker=True,
        kwargs={"scene_id": record.scene_id, "revision": record.revision, "registry": folder},
        additional_wrappers=(
            WrapperSpec(
                name="BatchedTimeLimit", entry_point="simrecon_envs.wrappers:BatchedTimeLimit", kwargs={}
            ),
        ),
    )


def _registry_of(spec: EnvSpec) -> str | None:
    return spec.kwargs.get("registry") if spec.entry_point == _ENTRY_POINT else None


def _not_found(name: str, ids: list[str], registry: Path | str | None) -> str:
    place = registry if registry is not None else default_registry_root()
    if not ids:
        hint = "make a scene with `simrecon reconstruct VIDEO`"
        return f"{name} does not exist: the registry {place} is empty; {hint}"
    near = difflib.get_close_matches(name, ids, n=1)
    shown = ", ".join(ids[:10]) + (f" and {len(ids) - 10} more" if len(ids) > 10 else "")
    meant = f" Did you mean {near[0]}?" if near else ""
    return f"{name} does not exist in the registry {place}.{meant} There are: {shown}"
