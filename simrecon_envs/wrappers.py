"""The plain Gymnasium API over a batched ManiSkill environment."""

from typing import Any

import numpy as np
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper


class NumpyEnv(CPUGymWrapper):
    """ManiSkill's `CPUGymWrapper`, with the types that Gymnasium's checker and most libraries expect.

    Rewards are `float`, `terminated` and `truncated` are `bool`, and the texts of the task are in the info of `reset`.
    """

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        """Step with an unbatched NumPy action."""
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, float(np.asarray(reward)), bool(terminated), bool(truncated), info

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        """Reset; `info` also has "instruction" and "task_note"."""
        obs, info = super().reset(seed=seed, options=options)
        scene_env = self.unwrapped
        return obs, {**info, "instruction": scene_env.instruction, "task_note": scene_env.task_note}

    def render(self) -> np.ndarray | None:
        """Return an RGB picture (h, w, 3) uint8, or None where the render mode has none."""
        return super().render()


