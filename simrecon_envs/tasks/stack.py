"""Stack: put an object on another one that can move."""

import numpy as np
import torch

from simrecon_envs.arrays import Array
from simrecon_envs.tasks.base import Info
from simrecon_envs.tasks.carry import Carry
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.spec import TaskSpec

_UPRIGHT = 0.95  # cosine of how far the lower object may lean


class Stack(Carry):
    """The lower object stands upright and at rest and carries the upper one, which rests, and nobody holds it."""

    kind = "stack"
    joint = "_on_"

    @classmethod
    def options(cls, facts: SceneFacts) -> list[tuple[int | None, int | None]]:
        lower = [key for key in facts.carriers if key in facts.movable]
        return [
            (target.id, key)
            for target in facts.ranked
            for key in lower
            if key not in (target.id, facts.parent.get(target.id)) and key not in facts.above(target.id)
        ]

    @classmethod
    def problems(cls, facts: SceneFacts, subject: int | None, place: int | None) -> list[str]:
        problems = super().problems(facts, subject, place)
        if place not in facts.targets:
            problems.append(f"{facts.thing(place)} cannot move: use place")
        elif place in facts.containers and not problems:
            problems.append(f"{facts.thing(place)} is open: use put")
        return problems

    @classmethod
    def _goals(cls, facts: SceneFacts, spec: TaskSpec) -> np.ndarray:
        spots = facts.spots(spec.place, spec.subject)
        if not len(spots):
            return spots
        # Over the middle it tips least.
        middle = facts.targets[spec.place].center[:2]
        return spots[np.argsort(np.linalg.norm(spots[:, :2] - middle, axis=1), kind="stable")][:1]

    @classmethod
    def words(cls, facts: SceneFacts, spec: TaskSpec) -> str:
        return f"Stack the {facts.thing(spec.subject)} on the {facts.thing(spec.place)}."

    def live_goal(self) -> Array:
        return self._while_still("live_goal", lambda: self.goal + self._moved())

    def _moved(self) -> Array:
        return self.env.measures.position(self.spec.place) - self._lower_home

    def start(self, env_idx: torch.Tensor, rng: object) -> None:
        super().start(env_idx, rng)
        self._lower_home = self.env.measures.array(self.facts.targets[self.spec.place].center)[None]

    def _arrived(self) -> Info:
        measures = self.env.measures
        on_it = measures.supported(self.subject, self.spec.place)
        upright = (measures.up(self.spec.place) >= _UPRIGHT) & measures.at_rest(self.spec.place)
        return {"is_there": on_it & upright, "is_on_it": on_it, "is_lower_upright": upright}
