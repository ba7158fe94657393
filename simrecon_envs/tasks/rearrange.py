"""Rearrange: bring objects that were displaced at reset back to their captured positions."""

import functools
import operator
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from simrecon_envs.arrays import Array, larger, norm, real, surely_not, where, whole
from simrecon_envs.oracle import Hand
from simrecon_envs.placement import Placement
from simrecon_envs.robots import robot_shape
from simrecon_envs.tasks.base import Info, Pair, Task, draw
from simrecon_envs.tasks.carry import Carry
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.spec import TaskSpec

WITHIN_M = 0.03  # tolerance around the captured position, horizontally
_MOST = 3  # objects
_MOVED_M = (0.08, 0.30)  # least and greatest displacement
_UPRIGHT = 0.95  # least cosine between an object's up axis and the vertical
_ROBOT_GAP_M = 0.03  # least distance of a displaced object from the robot at rest
_OBJECT_GAP_M = 0.03  # least distance of displaced objects from each other


class Restore(Carry):
    """Success: one object within 3 cm of its captured position, upright, carried by its support, at rest, not held."""

    kind = "restore"
    sentence = "Bring the {subject} back to where it was filmed."

    @classmethod
    def _goals(cls, facts: SceneFacts, spec: TaskSpec) -> np.ndarray:
        return _home(facts, spec.subject_id)[None]

    def prepare(self) -> None:
        """List the positions that the object may be displaced to."""
        super().prepare()
        self.moves = displaced(self.facts, self.subject, self.placement)

    def displace(self, env_idx: torch.Tensor, rng: Any, taken: list[tuple[np.ndarray, float]]) -> None:
        """Displace the object on its support by seed.

        Args:
            env_idx: Indices (n,) of the environments.
            rng: ManiSkill's batched generator.
            taken: Positions (n, 3) and radii of the objects that were displaced before; this one is added.
        """
        key = self.subject
        draws, own = draw(rng, env_idx, 1)[:, 0], self.facts.radius_m(key)
        home = _home(self.facts, key)
        rows = []
        for number, share in enumerate(draws):
            free = [
                spot
                for spot in self.moves
                if all(np.linalg.norm(spot[:2] - p[number, :2]) > own + r + _OBJECT_GAP_M for p, r in taken)
            ]
            choice = free or [home]
            rows.append(choice[int(share * len(choice))])
        spots = np.array(rows)
        taken.append((spots, own))
        self.env.builder.shift(key, env_idx, spots - home, self.env.device)

    def _arrived(self) -> Info:
        near, upright = self._while_still("at home", self._at_home)
        there = near & upright
        if not surely_not(there):  # contacts are slow: read them only if they decide
            there = there & self.env.measures.rests_on(self.subject, self.facts.parent[self.subject])
        return {"is_there": there, "is_near": near, "is_upright": upright}

    def _at_home(self) -> tuple[Array, Array]:
        away = norm((self.env.measures.position(self.subject) - self.goal)[:, :2])
        return away <= WITHIN_M, self.env.measures.up(self.subject) >= _UPRIGHT


class Rearrange(Task):
    """Up to three objects are displaced by 8 to 30 cm at reset. Success: all are back (see `Restore`)."""

    kind = "rearrange"
    sentence = "Bring what was moved back to where it was filmed."
    subjects = False

    @classmethod
    def options(cls, facts: SceneFacts) -> list[Pair]:
        """Return one task where anything can be displaced."""
        return [(None, None)] if chosen_things(facts) else []

    @classmethod
    def problems(cls, facts: SceneFacts, subject: int | None, place: int | None) -> list[str]:
        """Return the reason: no object can be displaced."""
        return [] if chosen_things(facts) else ["nothing here can be lifted and moved about on its support"]

    @classmethod
    def things(cls, facts: SceneFacts) -> list[int]:
        """Return the objects that can be displaced, the easiest first."""
        return chosen_things(facts)

    @classmethod
    def interests(cls, facts: SceneFacts, spec: TaskSpec) -> list[np.ndarray]:
        """Return the easiest object's captured position and the positions that it may be displaced to."""
        return [
            goals
            for key in chosen_things(facts)[:1]
            for goals in (facts.targets[key].center[None], _moves(facts, key))
        ]

    def prepare(self) -> None:
        """Choose the objects within reach; all where none is."""
        things = chosen_things(self.facts)
        near = [
            key
            for key in things
            if self.placement.reaches(self.facts.targets[key].center[None], self.facts.traits)[0]
        ]
        stages = [
            Restore(self.env, TaskSpec("restore", f"restore_{key}", key), self.placement)
            for key in (near or things)
        ]
        self.stages = [stage for stage in stages if len(stage.moves)][:_MOST]

    @property
    def max_reward(self) -> float:
        """Return 1 per object."""
        return float(len(self.stages))

    @property
    def instruction(self) -> str:
        """Return the instruction with the objects that this robot reaches."""
        things = ", the ".join(self.facts.thing(stage.subject) for stage in self.stages)
        return (
            f"Bring the {things} back to where the video shows {'it' if len(self.stages) == 1 else 'them'}."
        )

    def start(self, env_idx: torch.Tensor, rng: Any) -> None:
        """Displace the objects."""
        taken: list[tuple[np.ndarray, float]] = []
        for stage in self.stages:
            stage.start(env_idx, rng)
            stage.displace(env_idx, rng, taken)
        self.env.measures.refresh()

    def evaluate(self) -> Info:
        """Return success: all objects are back."""
        self._infos = [stage.evaluate() for stage in self.stages]
        done = [info["success"] for info in self._infos]
        return {"success": functools.reduce(operator.and_, done), "things_done": sum(map(whole, done))}

    def reward(self, info: Info) -> Array:
        """Return the number of objects that are back plus the best progress among the others: a hand does one thing."""
        shares = [
            where(one["success"], 0.0, stage.reward(one) / Carry.max_reward)
            for stage, one in zip(self.stages, self._infos, strict=True)
        ]
        done = sum((real(one["success"]) for one in self._infos), 0.0)
        return where(info["success"], self.max_reward, done + 0.98 * functools.reduce(larger, shares))

    def observe(self, info: Info) -> dict[str, Array]:
        """Return the observations of each object, prefixed by `thing_N_`."""
        out = {}
        for number, (stage, one) in enumerate(zip(self.stages, self._infos, strict=True)):
            out.update({f"thing_{number}_{key}": value for key, value in stage.observe(one).items()})
        return out

    def script(self, hand: Hand) -> Iterator[np.ndarray]:
        """Carry each object back; a second pass is for objects that were knocked away."""
        for _ in range(2):
            for stage in self.stages:
                if not bool(stage.evaluate()["success"]):
                    yield from stage.script(hand)


def chosen_things(facts: SceneFacts) -> list[int]:
    """Return the objects that can be displaced and brought back, the easiest first; all have one support."""
    liftable = [t for t in facts.ranked if not t.problem and not facts.above(t.id)]
    things = [t.id for t in liftable if len(_moves(facts, t.id))]
    if not things:
        return []
    return [key for key in things if facts.parent[key] == facts.parent[things[0]]]


def displaced(facts: SceneFacts, key: int, placement: Placement) -> np.ndarray:
    """Return the displaced positions (k, 3) clear of the robot; only those within its reach, if any."""
    moves = _beside_robot(facts, key, placement)
    within = placement.reaches(moves, facts.traits)
    return (moves[within] if within.any() else moves)[:48]


def _beside_robot(facts: SceneFacts, key: int, placement: Placement) -> np.ndarray:
    """Return the displaced positions (k, 3) at which an object is clear of the robot at rest."""
    moves, robot = _moves(facts, key), placement.to_world(robot_shape(facts.robot).points)
    height = robot[None, :, 2] - moves[:, 2, None]
    beside = (
        np.linalg.norm(robot[None, :, :2] - moves[:, None, :2], axis=2) > facts.radius_m(key) + _ROBOT_GAP_M
    )
    clear = beside | (height < -_ROBOT_GAP_M) | (height > facts.height_m(key) + _ROBOT_GAP_M)
    return moves[clear.all(axis=1)]


def _home(facts: SceneFacts, key: int) -> np.ndarray:
    """Return the captured position (3,) of the bottom center of an object's box."""
    target = facts.targets[key]
    return np.array([*target.center[:2], target.bottom_m])


def _moves(facts: SceneFacts, key: int) -> np.ndarray:
    """Return the free spots (k, 3) on an object's support 8 to 30 cm from its captured position."""
    target = facts.targets[key]
    spots = facts.spots(facts.parent[key], key)
    away = np.linalg.norm(spots[:, :2] - target.center[:2], axis=1)
    keep = (away >= _MOVED_M[0]) & (away <= _MOVED_M[1]) & (np.abs(spots[:, 2] - target.bottom_m) < 0.01)
    return spots[keep]
