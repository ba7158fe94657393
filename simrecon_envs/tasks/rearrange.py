"""Rearrange: things were moved about on their support; bring them back to where the video shows them."""

import functools
import operator
from collections.abc import Iterator

import numpy as np
import torch

from simrecon_envs.arrays import Array, larger, norm, real, surely_not, where, whole
from simrecon_envs.placement import Placement
from simrecon_envs.robots import robot_shape
from simrecon_envs.tasks.base import Info, Task, draw
from simrecon_envs.tasks.carry import Carry
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.spec import TaskSpec

WITHIN_M = 0.03
_MOST = 3
_MOVED_M = (0.08, 0.30)
_UPRIGHT = 0.95
_ROBOT_GAP_M = 0.03


class Restore(Carry):
    """One object back on its captured place: within 3 cm, upright, carried by its support, at rest, let go."""

    kind = "restore"

    @classmethod
    def _goals(cls, facts: SceneFacts, spec: TaskSpec) -> np.ndarray:
        target = facts.targets[spec.subject]
        return np.array([[*target.center[:2], target.bottom_m]])

    def __init__(self, env: object, spec: TaskSpec, placement: object) -> None:
        super().__init__(env, spec, placement)
        self.moves = displaced(self.facts, spec.subject, placement)

    def displace(self, env_idx: torch.Tensor, rng: object, taken: list[tuple[np.ndarray, float]]) -> None:
        """Move the object on its support by seed, clear of what was moved before (`taken`: centre, radius)."""
        key = self.subject
        draws, own = draw(rng, env_idx, 1)[:, 0], self.facts.radius_m(key)
        rows = []
        for number, share in enumerate(draws):
            free = [
                spot
                for spot in self.moves
                if all(np.linalg.norm(spot[:2] - p[number, :2]) > own + r + 0.03 for p, r in taken)
            ]
            choice = free or [
                np.array([*self.facts.targets[key].center[:2], self.facts.targets[key].bottom_m])
            ]
            rows.append(choice[int(share * len(choice))])
        spots = np.array(rows)
        taken.append((spots, own))
        shift = spots - [*self.facts.targets[key].center[:2], self.facts.targets[key].bottom_m]
        self.env.builder.shift(key, env_idx, shift, self.env.device)

    @classmethod
    def words(cls, facts: SceneFacts, spec: TaskSpec) -> str:
        return f"Bring the {facts.thing(spec.subject)} back to where it was filmed."

    def _arrived(self) -> Info:
        near, upright = self._while_still("at home", self._at_home)
        there = near & upright
        if not surely_not(there):  # contacts are asked for only where they decide
            there = there & self.env.measures.rests_on(self.subject, self.facts.parent[self.subject])
        return {"is_there": there, "is_near": near, "is_upright": upright}

    def _at_home(self) -> tuple[Array, Array]:
        away = norm((self.env.measures.position(self.subject) - self.goal)[:, :2])
        return away <= WITHIN_M, self.env.measures.up(self.subject) >= _UPRIGHT


class Rearrange(Task):
    """Up to three things stand 8 to 30 cm from where they were filmed; done when all are back."""

    kind = "rearrange"
    subjects = False

    @classmethod
    def options(cls, facts: SceneFacts) -> list[tuple[int | None, int | None]]:
        return [(None, None)] if chosen_things(facts) else []

    @classmethod
    def problems(cls, facts: SceneFacts, subject: int | None, place: int | None) -> list[str]:
        return [] if chosen_things(facts) else ["nothing here can be lifted and moved about on its support"]

    @classmethod
    def things(cls, facts: SceneFacts) -> list[int]:
        """Return what can be moved about, the easiest first."""
        return chosen_things(facts)

    @classmethod
    def interests(cls, facts: SceneFacts, spec: TaskSpec) -> list[np.ndarray]:
        return [
            goals
            for key in chosen_things(facts)[:1]
            for goals in (facts.targets[key].center[None], _moves(facts, key))
        ]

    def __init__(self, env: object, spec: TaskSpec, placement: object) -> None:
        super().__init__(env, spec, placement)
        things = chosen_things(self.facts)
        near = [
            key
            for key in things
            if placement.reaches(self.facts.targets[key].center[None], self.facts.traits)[0]
        ]
        stages = [
            Restore(env, TaskSpec("restore", f"restore_{key}", key), placement) for key in (near or things)
        ]
        self.stages = [stage for stage in stages if len(stage.moves)][:_MOST]

    @property
    def max_reward(self) -> float:
        return float(len(self.stages))

    @classmethod
    def words(cls, facts: SceneFacts, spec: TaskSpec) -> str:
        return "Bring what was moved back to where it was filmed."

    @property
    def instruction(self) -> str:
        """Return the task with the things that this robot reaches."""
        things = ", the ".join(self.facts.thing(stage.subject) for stage in self.stages)
        return (
            f"Bring the {things} back to where the video shows {'it' if len(self.stages) == 1 else 'them'}."
        )

    def start(self, env_idx: torch.Tensor, rng: object) -> None:
        taken: list[tuple[np.ndarray, float]] = []
        for stage in self.stages:
            stage.start(env_idx, rng)
            stage.displace(env_idx, rng, taken)
        self.env.measures.refresh()

    def evaluate(self) -> Info:
        self._infos = [stage.evaluate() for stage in self.stages]
        done = [info["success"] for info in self._infos]
        return {"success": functools.reduce(operator.and_, done), "things_done": sum(map(whole, done))}

    def reward(self, info: Info) -> Array:
        reward, best = 0.0, None
        for stage, one in zip(self.stages, self._infos, strict=True):
            # What is done counts whole, of the rest only what is farthest along: one hand does one thing.
            share = where(one["success"], 0.0, stage.reward(one) / Carry.max_reward)
            best = share if best is None else larger(best, share)
            reward = reward + real(one["success"])
        return where(info["success"], self.max_reward, reward + 0.98 * best)

    def observe(self, info: Info) -> dict[str, Array]:
        out = {}
        for number, (stage, one) in enumerate(zip(self.stages, self._infos, strict=True)):
            out.update({f"thing_{number}_{key}": value for key, value in stage.observe(one).items()})
        return out

    def script(self, hand: "Hand") -> Iterator[np.ndarray]:  # noqa: F821
        for _ in range(2):  # once more for what was knocked away
            for stage in self.stages:
                if not bool(stage.evaluate()["success"]):
                    yield from stage.script(hand)


def chosen_things(facts: SceneFacts) -> list[int]:
    """Return what can be moved about and brought back, the easiest first: things on one support."""
    liftable = [t for t in facts.ranked if not t.problem and not facts.above(t.id)]
    things = [t.id for t in liftable if len(_moves(facts, t.id))]
    if not things:
        return []
    return [key for key in things if facts.parent[key] == facts.parent[things[0]]]


def displaced(facts: SceneFacts, key: int, placement: Placement) -> np.ndarray:
    """Return where a thing may be moved to on its support (k, 3): beside the robot, within its reach if anything is."""
    moves = _beside_robot(facts, key, placement)
    within = placement.reaches(moves, facts.traits)
    return (moves[within] if within.any() else moves)[:48]


def _beside_robot(facts: SceneFacts, key: int, placement: Placement) -> np.ndarray:
    """Return where a thing may be moved to (k, 3) without touching the robot at rest."""
    moves, robot = _moves(facts, key), placement.to_world(robot_shape(facts.robot).points)
    height = robot[None, :, 2] - moves[:, 2, None]
    beside = (
        np.linalg.norm(robot[None, :, :2] - moves[:, None, :2], axis=2) > facts.radius_m(key) + _ROBOT_GAP_M
    )
    clear = beside | (height < -_ROBOT_GAP_M) | (height > facts.height_m(key) + _ROBOT_GAP_M)
    return moves[clear.all(axis=1)]


def _moves(facts: SceneFacts, key: int) -> np.ndarray:
    target = facts.targets[key]
    spots = facts.spots(facts.parent[key], key)
    away = np.linalg.norm(spots[:, :2] - target.center[:2], axis=1)
    keep = (away >= _MOVED_M[0]) & (away <= _MOVED_M[1]) & (np.abs(spots[:, 2] - target.bottom_m) < 0.01)
    return spots[keep]
