"""Composite tasks, stages in order: `put_can_in_tray-then-stack_box_on_book`."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from simrecon_envs.arrays import Array, clamp, pick, real, stack, where, whole
from simrecon_envs.oracle import Hand
from simrecon_envs.tasks.base import Info, Task
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.kinds import KINDS
from simrecon_envs.tasks.spec import TaskSpec


class Sequence(Task):
    """Success: all stages succeeded in order, and the lasting ones still hold at the end.

    Kinds with `lasting = False` (reach, pick) need not hold later. The reward is the number of finished stages plus the
    normalized reward of the current one.
    """

    kind = "sequence"

    @classmethod
    def interests(cls, facts: SceneFacts, spec: TaskSpec) -> list[np.ndarray]:
        """Return the stages' interests and the subjects of the later stages."""
        out = [goals for stage in spec.stages for goals in KINDS[stage.kind].interests(facts, stage)]
        others = {stage.subject for stage in spec.stages[1:]}
        return out + [facts.targets[key].center[None] for key in sorted(facts.targets) if key in others]

    def prepare(self) -> None:
        """Make the stages."""
        self.stages = [KINDS[stage.kind](self.env, stage, self.placement) for stage in self.spec.stages]

    @property
    def max_reward(self) -> float:
        """Return 1 per stage."""
        return float(len(self.stages))

    @classmethod
    def words(cls, facts: SceneFacts, spec: TaskSpec) -> str:
        """Return the stages' instructions."""
        return " Then: ".join(KINDS[stage.kind].words(facts, stage) for stage in spec.stages)

    def start(self, env_idx: torch.Tensor, rng: Any) -> None:
        """Begin all stages; the first is current."""
        if not hasattr(self, "stage"):
            self.stage = whole(self._zeros(1)[:, 0])
        self.stage[env_idx] = 0
        for stage in self.stages:
            stage.start(env_idx, rng)

    def evaluate(self) -> Info:
        """Advance the current stage (b,) where it succeeded; return success and the stage."""
        infos = [stage.evaluate() for stage in self.stages]
        done = stack([info["success"] for info in infos])
        advance = (self.stage < len(infos)) & pick(done, self._present())
        self.stage = self.stage + whole(advance)
        kept = stack([done[:, k] | (not stage.lasting) for k, stage in enumerate(self.stages)])
        self._infos = infos
        return {
            "success": (self.stage >= len(infos)) & kept.all(1),
            "stage": self.stage + 0,
            "stages_done": done.sum(1),
        }

    def reward(self, info: Info) -> Array:
        """Return the finished stages plus the normalized reward of the current one."""
        shares = [s.reward(one) / s.max_reward for s, one in zip(self.stages, self._infos, strict=True)]
        reward = real(self.stage) * 0.98 + 0.98 * pick(stack(shares), self._present())
        reward = clamp(reward, most=0.98 * len(self.stages))
        return where(info["success"], self.max_reward, reward)

    def observe(self, info: Info) -> dict[str, Array]:
        """Return the stage as a one-hot vector, and the stages' observations, prefixed by `stage_N_`."""
        out = {"stage": stack([real(self.stage == k) for k in range(len(self.stages) + 1)])}
        for number, (stage, one) in enumerate(zip(self.stages, self._infos, strict=True)):
            out.update({f"stage_{number}_{key}": value for key, value in stage.observe(one).items()})
        return out

    def _present(self) -> Array:
        """Return the index (b,) of the current stage; of the last one after the end."""
        return clamp(self.stage, most=len(self.stages) - 1)

    def script(self, hand: Hand) -> Iterator[np.ndarray]:
        """Run the stages' scripts, each until its stage succeeds; open the hand in between."""
        for number, stage in enumerate(self.stages):
            if number:
                yield from hand.let_go()
            for action in stage.script(hand):
                yield action
                if int(self.stage[0]) > number and number + 1 < len(self.stages):
                    break
