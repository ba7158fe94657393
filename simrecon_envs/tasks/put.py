"""Put: drop an object into an open container."""

import numpy as np
import torch

from simrecon_envs.arrays import Array, component, largest, smallest, turn
from simrecon_envs.tasks.base import Info
from simrecon_envs.tasks.carry import Carry
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.spec import TaskSpec

_CELL_REACH_M = 0.01  # cells of the inside are 2 cm apart
_DROP_M = 0.03  # above the floor of the container, where it is let go


class Put(Carry):
    """The object's middle is inside the container's walls and it reaches below the rim; it rests, nobody holds it."""

    kind = "put"
    joint = "_in_"

    @classmethod
    def options(cls, facts: SceneFacts) -> list[tuple[int | None, int | None]]:
        return [
            (target.id, key)
            for target in facts.ranked
            for key in facts.containers
            if key not in (target.id, facts.parent.get(target.id)) and key not in facts.above(target.id)
        ]

    @classmethod
    def problems(cls, facts: SceneFacts, subject: int | None, place: int | None) -> list[str]:
        if subject in facts.targets and facts.container(place) is None:
            return [f"{facts.thing(place)} is no open container"]
        return super().problems(facts, subject, place)

    @classmethod
    def _goals(cls, facts: SceneFacts, spec: TaskSpec) -> np.ndarray:
        inside = facts.container(spec.place)
        if inside is None or facts.radius_m(spec.subject) > inside.radius_m:
            return np.zeros((0, 3))
        spots = facts.spots(spec.place, spec.subject)
        if len(spots):
            xy = np.round(inside.cells / 1e-3)
            keep = [bool((np.abs(xy - np.round(spot[:2] / 1e-3)).max(axis=1) <= 20).any()) for spot in spots]
            spots = spots[np.array(keep) & (spots[:, 2] < inside.rim_m - 0.01)]
        return spots if len(spots) else inside.center[None]

    @classmethod
    def words(cls, facts: SceneFacts, spec: TaskSpec) -> str:
        return f"Put the {facts.thing(spec.subject)} in the {facts.thing(spec.place)}."

    def start(self, env_idx: torch.Tensor, rng: object) -> None:
        super().start(env_idx, rng)
        inside = self.facts.container(self.spec.place)
        self._cells = self.env.measures.array(inside.cells)
        self._low = (inside.cells.min(axis=0) - _CELL_REACH_M).tolist()
        self._high = (inside.cells.max(axis=0) + _CELL_REACH_M).tolist()
        target = self.facts.targets.get(self.spec.place)
        center = np.zeros(3) if target is None else target.center
        self._container_home = self.env.measures.array(center)[None]

    def _from_captured(self, points: Array, back: bool = False) -> Array:
        """Take points (b, 3) along with the container from where it was captured, or `back` there."""
        if self.spec.place not in self.facts.targets:
            return points
        measures, home = self.env.measures, self._container_home
        here, yaw = measures.position(self.spec.place), measures.yaw(self.spec.place)
        if back:
            here, home, yaw = home, here, -yaw
        return turn(points - home, yaw) + here

    def live_goal(self) -> Array:
        """Return the goal inside the container, where that is now."""
        return self._while_still("live_goal", lambda: self._from_captured(self.goal))

    def _within_walls(self, local: Array) -> Array:
        """Return whether points (b, 3), where the container was captured, are over its inside."""
        if isinstance(local, np.ndarray):
            x, y = local[0, :2].tolist()
            if not (self._low[0] <= x <= self._high[0] and self._low[1] <= y <= self._high[1]):
                return np.False_  # spares looking at all cells
        return smallest(largest(abs(local[:, None, :2] - self._cells[None]))) <= _CELL_REACH_M

    def _arrived(self) -> Info:
        return self._while_still("arrived", self._inside)

    def _inside(self) -> Info:
        inside = self.facts.container(self.spec.place)
        local = self._from_captured(self.env.measures.position(self.subject), back=True)
        within = self._within_walls(local)
        height = component(local, 2)
        bottom = height - self.facts.height_m(self.subject) / 2
        # A thing that fell over inside has another height: its middle below the rim will do as well.
        below = (bottom < inside.rim_m - 0.008) | (height < inside.rim_m)
        there = within & below
        if self.spec.place in self.facts.targets:
            there = there & (self.env.measures.up(self.spec.place) > 0.9)
        return {"is_there": there, "is_within_walls": within, "is_below_rim": below}
