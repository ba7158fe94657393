"""Record the oracle's episodes of a suite as demonstrations; episodes without success are dropped."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from registry import UsageError
from simrecon_envs.benchmark.demonstration import Demonstration
from simrecon_envs.benchmark.episodes import Episode, run_episode
from simrecon_envs.benchmark.policies import CONTROL_MODE, OraclePolicy
from simrecon_envs.benchmark.reporting import Reporter
from simrecon_envs.benchmark.run import RunSettings, check_revisions
from simrecon_envs.benchmark.suite import Suite, SuiteTask
from simrecon_envs.files import absolute
from simrecon_envs.unwrapped import scene_of

if TYPE_CHECKING:
    from simrecon_envs.benchmark.demonstrations_maniskill import TrajectoryFile


def record_demonstrations(
    suite: Suite,
    tasks: list[SuiteTask],
    *,
    maniskill: Path | None = None,
    lerobot: Path | None = None,
    obs_mode: str = "state_dict",
    renderer: str = "mesh",
    episodes: int | None = None,
    registry: Path | None = None,
    any_revision: bool = False,
    reporter: Reporter | None = None,
) -> dict[str, Any]:
    """Run the oracle on the seeds of some tasks and write the episodes.

    Args:
        suite: The suite.
        tasks: Its tasks to record.
        maniskill: Folder for ManiSkill trajectories; one subfolder per task.
        lerobot: Folder for LeRobot datasets; one per robot, since action spaces differ.
        obs_mode: "state_dict", or a mode with images.
        renderer: "mesh" or "splats", see `SceneEnv`.
        episodes: Greatest number per task; all where None.
        registry: The registry's folder; the default registry where None.
        any_revision: Accept scenes with another revision than the suite's.
        reporter: Receives progress messages.

    Returns:
        {"tasks", "episodes", "steps", "written": files and folders, "failed": texts}.

    Raises:
        UsageError: scenes are missing or of another revision; an output folder is not empty; `obs_mode` does not fit
            the dataset.
        EnvironmentMissing: the extra `lerobot` is not installed, or images cannot be rendered.
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
        env = suite.make(task, registry=root, control_mode=CONTROL_MODE, obs_mode=obs_mode, renderer=renderer)
        file, seeds = None, task.seeds[:episodes]
        try:
            file = TrajectoryFile(env, maniskill / task.name) if maniskill is not None else None
            found = [_record(task, env, seed, file, datasets) for seed in seeds]
        finally:
            written += file.close() if file is not None else []
            env.close()
        done = [episode.steps for episode in found if episode.success]
        count, steps = count + len(done), steps + sum(done)
        failed += [
            f"{task.name}: seed {e.seed} was not solved and is left out" for e in found if not e.success
        ]
        reporter.done(f"{task.name}: {len(done)} of {len(seeds)}")
    written += datasets.close() if datasets is not None else []
    return {"tasks": len(tasks), "episodes": count, "steps": steps, "written": written, "failed": failed}


def _record(
    task: SuiteTask, env: gym.Env, seed: int, file: "TrajectoryFile | None", datasets: "_Datasets | None"
) -> Episode:
    """Run the oracle for one episode; add it to the outputs if it succeeds."""
    recorder, recorded = _Recorder(), file.env if file is not None else env
    episode = run_episode(recorded, OraclePolicy(recorded), seed, recorder)
    if file is not None:
        file.end_episode(keep=episode.success)
    if episode.success and datasets is not None:
        datasets.add(recorder.demonstration(task, scene_of(env), seed))
    return episode


class _Recorder:
    """Collects the steps of an episode."""

    def __init__(self) -> None:
        self.rows: list[tuple[Any, Any, tuple]] = []

    def __call__(self, obs: Any, action: Any, result: tuple | None) -> None:
        """Store one step; the callback of `run_episode`."""
        if result is not None:
            self.rows.append((obs, action, result))

    def demonstration(self, task: SuiteTask, scene: Any, seed: int) -> Demonstration:
        """Return the collected episode."""
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
    """One LeRobot dataset per robot, created by its first demonstration."""

    def __init__(self, folder: Path, obs_mode: str) -> None:
        from simrecon_envs.benchmark.demonstrations_lerobot import check_folder, need_pyarrow

        if obs_mode in ("state", "none"):
            raise UsageError(
                f"--demo-obs {obs_mode}: a LeRobot dataset stores joints separately, which needs state_dict or a mode "
                "with images such as rgb"
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
        """Finish all datasets; return their folders."""
        return [str(writer.close()) for writer in self._made.values()]
