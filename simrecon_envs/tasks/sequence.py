"""Composites: `put_can_in_tray-then-stack_box_on_book`, one stage after the other."""

from collections.abc import Iterator

import numpy as np
import torch

from simrecon_envs.arrays import Array, clamp, pick, real, stack, where, whole
from simrecon_envs.tasks.base import Info, Task
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.kinds import KINDS
from simrecon_envs.tasks.spec import TaskSpec


class Sequence(Task):
    """Done when the last stage is done and what earlier stages put somewhere is still there.

    Reaching, picking and driving count once they are done; the reward is 1 a finished stage and the share of the
    present one.
    """

    kind = "sequence"

    @classmethod
    def interests(cls, facts: SceneFacts, spec: TaskSpec) -> list[np.ndarray]:
        out = [goals for stage in spec.stages for goals in KINDS[stage.kind].interests(facts, stage)]
        others = {stage.subject for stage in spec.stages[1:]} & facts.targets.keys()
        return out + [facts.targets[key].center[None] for key in sorted(others)]

    def __init__(self, env: object, spec: TaskSpec, placement: object) -> None:
        super().__init__(env, spec, placement)
        self.stages = [KINDS[stage.kind](env, stage, placement) for stage in spec.stages]

    @property
    def max_reward(self) -> float:
        return float(len(self.stages))

    @classmethod
    def words(cls, facts: SceneFacts, spec: TaskSpec) -> str:
        return " Then: ".join(KINDS[stage.kind].words(facts, stage) for stage in spec.stages)

    def start(self, env_idx: torch.Tensor, rng: object) -> None:
        if not hasattr(self, "stage"):
            self.stage = whole(self._zeros(1)[:, 0])
        self.stage[env_idx] = 0
        for stage in self.stages:
            stage.start(env_idx, rng)

    def evaluate(self) -> Info:
        infos = [stage.evaluate() for stage in self.stages]
        done = stack([info["success"] for info in infos])
        advance = (self.stage < len(infos)) & pick(done, self._present())
        self.stage = self.stage + whole(advance)
        kept = stack(
            [done[:, k] if stage.lasting else done[:, k] | True for k, stage in enumerate(self.stages)]
        )
        self._infos = infos
        return {
            "success": (self.stage >= len(infos)) & kept.all(1),
            "stage": self.stage + 0,
            "stages_done": done.sum(1),
        }

    def reward(self, info: Info) -> Array:
        shares = [s.reward(one) / s.max_reward for s, one in zip(self.stages, self._infos, strict=True)]
        reward = real(self.stage) * 0.98 + 0.98 * pick(stack(shares), self._present())
        reward = clamp(reward, most=0.98 * len(self.stages))
        return where(info["success"], self.max_reward, reward)

    def observe(self, info: Info) -> dict[str, Array]:
        out = {"stage": stack([real(self.stage == k) for k in range(len(self.stages) + 1)])}
        for number, (stage, one) in enumerate(zip(self.stages, self._infos, strict=True)):
            out.update({f"stage_{number}_{key}": value for key, value in stage.observe(one).items()})
        return out

    def _present(self) -> Array:
        """Return the number (b,) of the stage that is to be done, the last one at the end."""
        return clamp(self.stage, most=len(self.stages) - 1)

    def script(self, hand: "Hand") -> Iterator[np.ndarray]:  # noqa: F821
        for number, stage in enumerate(self.stages):
            if number:
                yield from hand.let_go()
            for action in stage.script(hand):
                yield action
                if int(self.stage[0]) > number and number + 1 < len(self.stages):
                    break
