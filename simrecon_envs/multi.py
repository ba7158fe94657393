"""`SimRecon/Multi-v0`: an environment that draws the scene of every episode from a split of the registry."""

import hashlib
from collections import OrderedDict
from pathlib import Path
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np

from registry import UsageError, open_registry
from simrecon_envs.registration import env_id, make_cpu, register_scenes
from simrecon_envs.unwrapped import scene_of

SPLITS = ("train", "test", "all")
_TEST_PERCENT = 20


class MultiSceneEnv(gym.Env):
    """Unbatched NumPy environment over many scenes; keeps the environments of the most recently used scenes.

    `info` of `reset` has "scene" and "instruction". `skipped` maps scenes without the task to the reason.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 - as in Gymnasium

    def __init__(
        self,
        scenes: list[str] | str | None = None,
        split: str = "all",
        *,
        task: str = "pick",
        cache_size: int = 4,
        registry: str | Path | None = None,
        render_mode: str | None = None,
        **kwargs: Any,
    ) -> None:
        """Choose the scenes; create the first one with the task, for the spaces.

        Args:
            scenes: Scene ids, as a list or comma-separated; None for all of the registry.
            split: "train" (80 %), "test" (20 %) or "all". The split depends only on the hash of the scene's id, so it
                does not change when scenes are added or removed.
            task: A kind of task, or the name of a task that all scenes have.
            cache_size: Number of environments kept.
            registry: Folder of the registry; None for the default one.
            render_mode: See `SceneEnv`.
            **kwargs: Other arguments of `SceneEnv`.

        Raises:
            UsageError: The split is unknown or has no scene, or no scene has the task.
        """
        if split not in SPLITS:
            raise UsageError(f"Multi-v0: split {split!r} is not one of {', '.join(SPLITS)}")
        if cache_size < 1:
            raise UsageError(f"Multi-v0: cache_size={cache_size} is not at least 1")
        catalog = open_registry(registry)
        known = list(catalog.revisions())
        wanted = scenes.split(",") if isinstance(scenes, str) else scenes
        missing = [scene for scene in wanted or () if scene not in known]
        if missing:
            catalog.get(missing[0])  # raises SceneNotFound with suggestions
        self.scenes = [s for s in (wanted or known) if split in ("all", split_of(s))]
        if not self.scenes:
            raise UsageError(
                f"Multi-v0: no scene in the split {split!r} of {len(wanted or known)} in {catalog.root}"
            )
        register_scenes(registry)
        self._registry = registry
        self._task, self._size = task, cache_size
        self._kwargs = {"observe_objects": False, **kwargs, "render_mode": render_mode}
        self.render_mode = render_mode
        self.skipped: dict[str, str] = {}
        self._made: OrderedDict[str, gym.Env] = OrderedDict()
        self._spaces: tuple[gym.Space[Any], gym.Space[Any]] | None = None
        self._env = self._first()
        self._spaces = self._env.observation_space, self._env.action_space
        self.observation_space, self.action_space = self._spaces

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        """Draw a scene and reset it; `options={"scene": id}` chooses the scene."""
        super().reset(seed=seed)
        wanted = (options or {}).get("scene")
        while True:
            if len(self.skipped) >= len(self.scenes):
                raise UsageError(self._nothing())
            # Draw from all scenes: the meaning of a seed must not depend on the scenes skipped so far.
            scene = wanted
            if scene is None:
                scene = self.scenes[int(self.np_random.integers(len(self.scenes)))]
            env = self._open(scene)
            if env is not None:
                break
            if wanted is not None:
                raise UsageError(f"Multi-v0: scene {scene}: {self.skipped[scene]}")
        self._env = env
        obs, info = env.reset(seed=int(self.np_random.integers(2**31)))
        return obs, {**info, "scene": scene}

    def step(self, action: np.ndarray) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step the current scene."""
        return self._env.step(action)

    def render(self) -> Any:
        """Return an image of the current scene."""
        return self._env.render()

    def close(self) -> None:
        """Close all kept environments."""
        for env in self._made.values():
            env.close()
        self._made.clear()

    def _first(self) -> gym.Env:
        for scene in self.scenes:
            env = self._open(scene)
            if env is not None:
                return env
        raise UsageError(self._nothing())

    def _nothing(self) -> str:
        some = "; ".join(f"{scene}: {why}" for scene, why in list(self.skipped.items())[:5])
        return f"Multi-v0: none of {len(self.scenes)} scenes can do the task {self._task!r}: {some}"

    def _open(self, scene: str) -> gym.Env | None:
        """Return the environment of a scene, or None if it does not have the task."""
        if scene in self.skipped:
            return None
        if scene not in self._made:
            try:
                env = make_cpu(env_id(scene), registry=self._registry, task=self._task, **self._kwargs)
            except UsageError as error:
                self.skipped[scene] = str(error)
                return None
            inner = scene_of(env)
            problem = inner.task_note or ("" if inner.task_object else "there is no task")
            if not problem and self._spaces is not None and self._spaces[0] != env.observation_space:
                problem = f"its observations are {env.observation_space}, not {self._spaces[0]}"
            if problem:
                env.close()
                self.skipped[scene] = problem
                return None
            self._made[scene] = env
            while len(self._made) > self._size:
                self._made.popitem(last=False)[1].close()
        self._made.move_to_end(scene)
        return self._made[scene]


def split_of(scene: str) -> str:
    """Return "train" or "test" for a scene id, by its hash; one in five is "test"."""
    number = int.from_bytes(hashlib.sha256(scene.encode()).digest()[:4], "big")
    return "test" if number % 100 < _TEST_PERCENT else "train"
