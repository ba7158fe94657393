"""Prove a candidate for a suite: the oracle solves it from every seed, and doing nothing does not."""

import math
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym

from registry import SimReconError
from simrecon_envs.benchmark.candidates import Candidate
from simrecon_envs.benchmark.episodes import Episode, run_episode
from simrecon_envs.benchmark.policies import CONTROL_MODE, OraclePolicy, StillPolicy
from simrecon_envs.benchmark.splits import episode_seed
from simrecon_envs.benchmark.suite import OracleRun
from simrecon_envs.randomization import Randomization
from simrecon_envs.registration import make_cpu
from simrecon_envs.unwrapped import scene_of

_ORACLE_HORIZON = 2.0  # step limit of the oracle, as a multiple of the kind's usual limit
_SLACK = 1.5  # least step limit of a policy, as a multiple of the oracle's longest episode
_STEPS_UNIT = 50  # step limits beyond the usual one are multiples of it


@dataclass(frozen=True, kw_only=True)
class ProofSettings:
    """Settings of all proofs of a suite."""

    seed: int = 0
    seeds: int = 5
    randomize: dict[str, float] = field(default_factory=dict)
    registry: str | None = None

    def options(self) -> dict[str, Any]:
        """Return the keyword arguments of `gym.make` that all tasks of the suite have."""
        return {"randomize": self.randomize} if self.randomize else {}


@dataclass(frozen=True, kw_only=True)
class Proof:
    """Result of a proof; `reason` says why it failed and is empty for a proven candidate."""

    reason: str
    instruction: str = ""
    max_steps: int = 0
    oracle: tuple[OracleRun, ...] = ()


def prove(candidate: Candidate, settings: ProofSettings) -> Proof:
    """Prove a candidate. An error while its environment is made is a failed proof and does not end a long run."""
    if candidate.problems:
        return Proof(reason="; ".join(candidate.problems))
    options = {**settings.options(), "robot_uids": candidate.robot, "control_mode": CONTROL_MODE}
    try:
        env = make_cpu(candidate.env_id, registry=settings.registry, **options)
    except SimReconError as error:
        return Proof(reason=str(error))
    except Exception as error:
        return Proof(reason=f"defect: making its environment failed with {type(error).__name__}: {error}")
    try:
        return _prove(env, candidate, settings)
    finally:
        env.close()


def _prove(env: gym.Env, candidate: Candidate, settings: ProofSettings) -> Proof:
    scene = scene_of(env)
    if scene.task_note or scene.task_object is None:
        return Proof(reason=scene.task_note or "there is no task")
    assert env.spec is not None
    assert env.spec.max_episode_steps is not None
    usual = env.spec.max_episode_steps
    _limit(env, int(_ORACLE_HORIZON * usual))
    runs: list[Episode] = []
    policy = OraclePolicy(env)
    for seed in _seeds(candidate, settings):
        run = run_episode(env, policy, seed)
        if run.at_reset:
            return Proof(reason=f"it is done at reset, before any action (seed {seed})")
        if not run.success:
            return Proof(
                reason=f"the oracle failed from seed {seed}, after solving {len(runs)} of {settings.seeds} seeds"
            )
        runs.append(run)
        if _same_start(runs, settings):
            runs.pop()  # nothing is randomized: one episode suffices
            break
    again = run_episode(env, policy, runs[0].seed)
    if (again.steps, again.path_m) != (runs[0].steps, runs[0].path_m):
        return Proof(
            reason=f"defect: seed {runs[0].seed} gave another path or number of steps when run again"
        )
    longest = max(run.steps for run in runs)
    max_steps = max(usual, _STEPS_UNIT * math.ceil(_SLACK * longest / _STEPS_UNIT))
    _limit(env, max_steps)
    still = StillPolicy(env)
    for run in runs:
        if run_episode(env, still, run.seed).success:
            return Proof(reason=f"doing nothing solves it (seed {run.seed})")
    oracle = tuple(OracleRun(seed=r.seed, steps=r.steps, path_m=max(round(r.path_m, 4), 1e-4)) for r in runs)
    return Proof(reason="", instruction=scene.instruction, max_steps=max_steps, oracle=oracle)


def _seeds(candidate: Candidate, settings: ProofSettings) -> list[int]:
    return [episode_seed(settings.seed, candidate.name, number) for number in range(settings.seeds)]


def _same_start(runs: list[Episode], settings: ProofSettings) -> bool:
    """Return whether the first two episodes begin alike; masses and frictions are not part of the state."""
    unseen = Randomization.parse(settings.randomize or None)
    return len(runs) == 2 and runs[0].start == runs[1].start and not (unseen.mass or unseen.friction)


def _limit(env: gym.Env, steps: int) -> None:
    """Set the step limit of episodes."""
    from simrecon_envs.wrappers import BatchedTimeLimit

    wrapper: Any = env
    while not isinstance(wrapper, BatchedTimeLimit):
        wrapper = wrapper.env
    wrapper._max_episode_steps = steps
