"""`Demonstration`: one recorded episode."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Demonstration:
    """Observations, actions, rewards and success of an episode of t steps."""

    task: str
    instruction: str
    robot: str
    seed: int
    fps: int
    joint_names: tuple[str, ...]
    observations: list[dict]  # t, each before its action; nested dicts of NumPy arrays
    actions: np.ndarray  # float32 (t, a)
    rewards: np.ndarray  # float32 (t,)
    success: np.ndarray  # bool (t,)
