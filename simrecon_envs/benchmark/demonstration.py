"""A recorded episode."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Demonstration:
    """One episode: what was seen before each action, the action, and what came of it."""

    task: str
    instruction: str
    robot: str
    seed: int
    fps: int
    joint_names: tuple[str, ...]
    observations: list[dict]  # t of them, NumPy, as with obs_mode "state_dict" or one with pictures
    actions: np.ndarray  # float32 (t, a)
    rewards: np.ndarray  # float32 (t,)
    success: np.ndarray  # bool (t,)
