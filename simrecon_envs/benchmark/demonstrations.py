"""The oracle's runs of a suite, recorded: every episode is run again, and kept if it succeeds."""

from pathlib import Path
from typing import Any

import numpy as np

from registry import UsageError
from simrecon_envs.benchmark.demonstration import Demonstration
from simrecon_envs.benchmark.episodes import run_episode
from simrecon_envs.benchmark.policies import CONTROL_MODE, OraclePolicy
from simrecon_envs.benchmark.reporting import Reporter
from simrecon_envs.benchmark.run import RunSettings, check_revisions
from simrecon_envs.benchmark.suite import Suite, SuiteTask
from simrecon_envs.files import absolute


def record_demonstrations(
    suite: Suite,
    tasks: list[SuiteTask],
    *,
    maniskill: Path | None = None,
    lerobot: Path | None = None,
    obs_mode: str = "state_dict",
    episodes: int | None = None,
    registry: Path | None = None,
    any_revision: bool = False,
    reporter: Reporter | None = None,
) -> dict[str, Any]:
    """Record the oracle's episodes of some tasks.

    Args:
        suite: The suite.
        tasks: Those of it that are recorded.
        maniskill: A folder for trajectories of ManiSkill, one folder a task.
        lerobot: A folder for LeRobot datasets, one a robot: its actions are not another's.
        obs_mode: What is observed; "state_dict", or a mode with pictures.
        episodes: Most of a task; all where None.
        registry: The registry's folder; the default registry where None.
        any_revision: Go on where a scene has another revision than the suite's.
        reporter: Is told what happens.

    Returns:
        {"tasks", "episodes", "steps", "written": files and folders, "failed": texts}.

    Raises:
        UsageError: scenes are missing or of another revision; a folder is there already and not empty; nothing can
            be observed so.
        EnvironmentMissing: the extra `lerobot` is not installed, or pictures cannot be rendered.
    """
    from simrecon_envs.benchmark.demonstrations_maniskill import TrajectoryFile

    reporter = reporter or Reporter(quiet=True)
    root = absolute(registry)
    settings = RunSettings(registry=root, any_revision=any_revision, episodes=episodes)
    failed = check_revisions(tasks, settings)
    datasets = _Datasets(lerobot, obs_mode) if lerobot is not None else None
    reporter.start(len(tasks), f"recording {len(tasks)} tasks")
    count = steps = 0
    written: list[str] = []
    for task in tasks:
        env = suite.make(task, registry=root, control_mode=CONTROL_MODE, obs_mode=obs_mode)
        file = None
        try:
            file = TrajectoryFile(env, maniskill / task.name) if maniskill is not None else None
            recorded = file.env if file is not None else env
            policy = OraclePolicy(recorded)
            done = 0
            for seed in task.seeds[:episodes]:
                shown = _Recorder()
                episode = run_episode(recorded, policy, seed, shown)
                if file is not None:
                    file.end_episode(keep=episode.success)
                if not episode.success:
                    failed.append(f"{task.name}: seed {seed} was not done and is left out")
                    continue
                done, steps = done + 1, steps + episode.steps
                if datasets is not None:
                    datasets.add(shown.demonstration(task, env.unwrapped, seed))
            count += done
        finally:
            written += file.close() if file is not None else []
            env.close()
        reporter.done(f"{task.name}: {done} of {len(task.seeds[:episodes])}")
    written += datasets.close() if datasets is not None else []
    return {"tasks": len(tasks), "episodes": count, "steps": steps, "written": written, "failed": failed}


class _Recorder:
    """Collects an episode."""

    def __init__(self) -> None:
        self.rows: list[tuple[Any, Any, tuple]] = []

    def __call__(self, obs: Any, action: Any, result: tuple | None) -> None:
        """Take what `run_episode` tells of a step."""
        if result is not None:
            self.rows.append((obs, action, result))

    def demonstration(self, task: SuiteTask, scene: Any, seed: int) -> Demonstration:
        """Return the episode."""
        return Demonstration(
            task=task.name,
            instruction=scene.instruction,
            robot=task.robot,
            seed=seed,
            fps=int(scene.control_freq),
            joint_names=tuple(joint.name for joint in scene.agent.robot.active_joints),
            observations=[obs for obs, _, _ in self.rows],
            actions=np.array([action for _, action, _ in self.rows], np.float32),
            rewards=np.array([result[1] for _, _, result in self.rows], np.float32),
            success=np.array([bool(np.ravel(result[4]["success"])[0]) for _, _, result in self.rows]),
        )


class _Datasets:
    """One LeRobot dataset a robot, begun with its first demonstration."""

    def __init__(self, folder: Path, obs_mode: str) -> None:
        from simrecon_envs.benchmark.demonstrations_lerobot import check_folder, need_pyarrow

        if obs_mode in ("state", "none"):
            raise UsageError(
                f"--demo-obs {obs_mode}: a LeRobot dataset keeps joints apart from the rest, which needs state_dict, "
                "or a mode with pictures such as rgb"
            )
        need_pyarrow()
        check_folder(folder)
        self._folder = folder
        self._made: dict[str, Any] = {}

    def add(self, demonstration: Demonstration) -> None:
        from simrecon_envs.benchmark.demonstrations_lerobot import LeRobotWriter

        robot = demonstration.robot
        if robot not in self._made:
            self._made[robot] = LeRobotWriter(self._folder / robot, demonstration)
        self._made[robot].add(demonstration)

    def close(self) -> list[str]:
        """Finish all; return their folders."""
        return [str(writer.close()) for writer in self._made.values()]
