"""`SimRecon/Multi-v0`: another scene in every episode, drawn from a split of the registry."""

import hashlib
from collections import OrderedDict
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from registry import SceneRegistry, UsageError
from simrecon_envs.registration import env_id, make_cpu, register_scenes

SPLITS = ("train", "test", "all")
_TEST_PERCENT = 20


class MultiSceneEnv(gym.Env):
    """Plain Gymnasium (NumPy, no batch) over many scenes; environments are kept for the next time, a few of them.

    `info` of `reset` has "scene" and "instruction". `skipped` says which scenes cannot do the task, and why.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 - Gymnasium's own way

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
        """Choose the scenes; the first that can do the task is made at once, for the spaces.

        Args:
            scenes: Ids of scenes, as a list or with commas; all of the registry where None.
            split: "train" (four fifths), "test" (the others) or "all"; by the hash of the scene's id, so that a
                scene keeps its side when others come or go.
            task: A kind of task, or a task's name that all scenes have.
            cache_size: How many environments are kept.
            registry: The registry's folder; the default registry where None.
            render_mode: As for `SceneEnv`.
            **kwargs: As for `SceneEnv`; one robot, one observation mode.

        Raises:
            UsageError: there is no such split, no scene in it, or none that can do the task.
        """
        if split not in SPLITS:
            raise UsageError(f"Multi-v0: split {split!r} is not one of {', '.join(SPLITS)}")
        if cache_size < 1:
            raise UsageError(f"Multi-v0: cache_size={cache_size} is not at least 1")
        catalog = SceneRegistry(None if registry is None else Path(registry))
        known = list(catalog.revisions())
        wanted = scenes.split(",") if isinstance(scenes, str) else scenes
        missing = [scene for scene in wanted or () if scene not in known]
        if missing:
            catalog.get(missing[0])  # says what there is, and the nearest
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
        self.observation_space = None
        self._env = self._first()
        self.observation_space, self.action_space = self._env.observation_space, self._env.action_space

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        """Draw a scene by the seed and reset it; `options={"scene": id}` chooses one."""
        super().reset(seed=seed)
        wanted = (options or {}).get("scene")
        while True:
            if len(self.skipped) >= len(self.scenes):
                raise UsageError(self._nothing())
            # Drawn from all: what was found to be unsuitable before must not change what a seed means.
            scene = (
                wanted if wanted is not None else self.scenes[int(self.np_random.integers(len(self.scenes)))]
            )
            env = self._open(scene)
            if env is not None:
                break
            if wanted is not None:
                raise UsageError(f"Multi-v0: scene {scene}: {self.skipped[scene]}")
        self._env = env
        obs, info = env.reset(seed=int(self.np_random.integers(2**31)))
        return obs, {**info, "scene": scene}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict]:
        """Step the present scene."""
        return self._env.step(action)

    def render(self) -> Any:
        """Return a picture of the present scene."""
        return self._env.render()

    def close(self) -> None:
        """Close all environments that are kept."""
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
        """Return the environment of a scene, None where it cannot do the task."""
        if scene in self.skipped:
            return None
        if scene not in self._made:
            try:
                env = make_cpu(env_id(scene), registry=self._registry, task=self._task, **self._kwargs)
            except UsageError as error:
                self.skipped[scene] = str(error)
                return None
            problem = env.unwrapped.task_note or ("" if env.unwrapped.task_object else "there is no task")
            if not problem and self.observation_space not in (None, env.observation_space):
                problem = f"its observations are {env.observation_space}, not {self.observation_space}"
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
    """Return "train" or "test" for a scene's id; one in five is "test"."""
    number = int.from_bytes(hashlib.sha256(scene.encode()).digest()[:4], "big")
    return "test" if number % 100 < _TEST_PERCENT else "train"
