"""Stack: put an object on another movable object."""

from typing import Any

import numpy as np
import torch

from simrecon_envs.arrays import Array
from simrecon_envs.tasks.base import Info, Pair
from simrecon_envs.tasks.carry import Carry
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.spec import TaskSpec

_UPRIGHT = 0.95  # least cosine between the lower object's up axis and the vertical


class Stack(Carry):
    """Success: the lower object is upright, at rest and carries the upper one, which is at rest and not held."""

    kind = "stack"
    sentence = "Stack the {subject} on the {place}."
    joint = "_on_"

    @classmethod
    def options(cls, facts: SceneFacts) -> list[Pair]:
        """Return each movable object with each movable support that it is not in a stack with."""
        lower = [key for key in facts.carriers if key in facts.movable]
        return [
            (target.id, key)
            for target in facts.ranked
            for key in lower
            if key not in (target.id, facts.parent.get(target.id)) and key not in facts.above(target.id)
        ]

    @classmethod
    def problems(cls, facts: SceneFacts, subject: int | None, place: int | None) -> list[str]:
        """Return the reasons of `Carry`, or that the place is fixed or a container."""
        problems = super().problems(facts, subject, place)
        assert place is not None
        if place not in facts.targets:
            problems.append(f"{facts.thing(place)} cannot move: use place")
        elif place in facts.containers and not problems:
            problems.append(f"{facts.thing(place)} is open: use put")
        return problems

    @classmethod
    def _goals(cls, facts: SceneFacts, spec: TaskSpec) -> np.ndarray:
        spots = facts.spots(spec.place_id, spec.subject_id)
        if not len(spots):
            return spots
        # The spot nearest to the center tips least.
        middle = facts.targets[spec.place_id].center[:2]
        return spots[np.argsort(np.linalg.norm(spots[:, :2] - middle, axis=1), kind="stable")][:1]

    def live_goal(self) -> Array:
        """Return the goal (b, 3), shifted with the lower object."""
        return self._while_still("live_goal", lambda: self.goal + self._moved())

    def _moved(self) -> Array:
        return self.env.measures.position(self.place) - self._lower_home

    def start(self, env_idx: torch.Tensor, rng: Any) -> None:
        """Draw a goal; store the lower object's captured position."""
        super().start(env_idx, rng)
        self._lower_home = self.env.measures.array(self.facts.targets[self.place].center)[None]

    def _arrived(self) -> Info:
        measures = self.env.measures
        on_it = measures.supported(self.subject, self.place)
        upright = (measures.up(self.place) >= _UPRIGHT) & measures.at_rest(self.place)
        return {"is_there": on_it & upright, "is_on_it": on_it, "is_lower_upright": upright}
