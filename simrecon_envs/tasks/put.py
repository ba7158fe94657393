"""Put: drop an object into an open container."""

from typing import Any

import numpy as np
import torch

from simrecon_envs.arrays import Array, component, largest, smallest, turn
from simrecon_envs.surfaces import Container
from simrecon_envs.tasks.base import Info, Pair
from simrecon_envs.tasks.carry import Carry
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.spec import TaskSpec

_CELL_REACH_M = 0.01  # half the spacing of a container's cells


class Put(Carry):
    """Success: the object's center is within the container's walls and below its rim, at rest, not held."""

    kind = "put"
    sentence = "Put the {subject} in the {place}."
    joint = "_in_"

    @classmethod
    def options(cls, facts: SceneFacts) -> list[Pair]:
        """Return each movable object with each container that neither holds it nor stands on it."""
        return [
            (target.id, key)
            for target in facts.ranked
            for key in facts.containers
            if key not in (target.id, facts.parent.get(target.id)) and key not in facts.above(target.id)
        ]

    @classmethod
    def problems(cls, facts: SceneFacts, subject: int | None, place: int | None) -> list[str]:
        """Return the reasons of `Carry`, or that the place is not a container."""
        assert place is not None
        if subject in facts.targets and facts.container(place) is None:
            return [f"{facts.thing(place)} is no open container"]
        return super().problems(facts, subject, place)

    @classmethod
    def _goals(cls, facts: SceneFacts, spec: TaskSpec) -> np.ndarray:
        inside = facts.container(spec.place_id)
        if inside is None or facts.radius_m(spec.subject_id) > inside.radius_m:
            return np.zeros((0, 3))
        spots = facts.spots(spec.place_id, spec.subject_id)
        if len(spots):
            xy = np.round(inside.cells / 1e-3)
            keep = [bool((np.abs(xy - np.round(spot[:2] / 1e-3)).max(axis=1) <= 20).any()) for spot in spots]
            spots = spots[np.array(keep) & (spots[:, 2] < inside.rim_m - 0.01)]
        return spots if len(spots) else inside.center[None]

    @property
    def _container(self) -> Container:
        container = self.facts.container(self.place)
        assert container is not None
        return container

    def start(self, env_idx: torch.Tensor, rng: Any) -> None:
        """Draw a goal; store the container's inside as it was captured."""
        super().start(env_idx, rng)
        inside = self._container
        self._cells = self.env.measures.array(inside.cells)
        self._low = (inside.cells.min(axis=0) - _CELL_REACH_M).tolist()
        self._high = (inside.cells.max(axis=0) + _CELL_REACH_M).tolist()
        target = self.facts.targets.get(self.place)
        center = np.zeros(3) if target is None else target.center
        self._container_home = self.env.measures.array(center)[None]

    def _from_captured(self, points: Array, back: bool = False) -> Array:
        """Move points (b, 3) with the container from its captured to its present pose, or `back`."""
        if self.place not in self.facts.targets:
            return points
        measures, home = self.env.measures, self._container_home
        here, yaw = measures.position(self.place), measures.yaw(self.place)
        if back:
            here, home, yaw = home, here, -yaw
        return turn(points - home, yaw) + here

    def live_goal(self) -> Array:
        """Return the goal (b, 3), moved with the container."""
        return self._while_still("live_goal", lambda: self._from_captured(self.goal))

    def _within_walls(self, local: Array) -> Array:
        """Return whether points (b, 3), relative to the captured container, are over a cell of its inside."""
        if isinstance(local, np.ndarray):
            x, y = local[0, :2].tolist()
            if not (self._low[0] <= x <= self._high[0] and self._low[1] <= y <= self._high[1]):
                return np.False_  # outside of the bounding box: saves the distance to all cells
        return smallest(largest(abs(local[:, None, :2] - self._cells[None]))) <= _CELL_REACH_M

    def _arrived(self) -> Info:
        return self._while_still("arrived", self._inside)

    def _inside(self) -> Info:
        inside = self._container
        local = self._from_captured(self.env.measures.position(self.subject), back=True)
        within = self._within_walls(local)
        height = component(local, 2)
        bottom = height - self.facts.height_m(self.subject) / 2
        # An object that fell over has another height, so its center below the rim also counts.
        below = (bottom < inside.rim_m - 0.008) | (height < inside.rim_m)
        there = within & below
        if self.place in self.facts.targets:
            there = there & (self.env.measures.up(self.place) > 0.9)
        return {"is_there": there, "is_within_walls": within, "is_below_rim": below}
