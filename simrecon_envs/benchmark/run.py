"""Run a policy on a suite: `run_suite` returns `Results`."""

import statistics
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from registry import UsageError, open_registry
from simrecon_envs.benchmark.episodes import Episode, run_episode
from simrecon_envs.benchmark.fetching import how_to_get, wanted_scenes
from simrecon_envs.benchmark.parallel import Workers
from simrecon_envs.benchmark.policies import PolicySpec
from simrecon_envs.benchmark.records import Records
from simrecon_envs.benchmark.reporting import Reporter
from simrecon_envs.benchmark.results import EpisodeResult, Results
from simrecon_envs.benchmark.splits import episode_seed
from simrecon_envs.benchmark.suite import Suite, SuiteTask
from simrecon_envs.files import versions
from simrecon_envs.rollout import open_video
from simrecon_envs.unwrapped import scene_of


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """Settings of a run."""

    episodes: int | None = None
    """Greatest number of episodes per task; all of its seeds where None."""
    fresh: int = 0
    """Number of episodes from seeds that are not in the suite, instead of its own; 0: its own."""
    any_revision: bool = False
    """Accept scenes with another revision than the suite's; the results note it."""
    videos: str | None = None
    """Folder for a video of each task's first episode."""
    video_size_px: int = 384
    timeout_s: float | None = None
    """Longest time of one call of the policy, in seconds; no limit where None."""
    registry: str | None = None

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.episodes is not None and self.episodes < 1:
            raise UsageError(f"--episodes {self.episodes}: expected at least 1")
        if self.fresh < 0:
            raise UsageError(
                f"--fresh-seeds {self.fresh}: expected at least 1, or 0 for the suite's own seeds"
            )


def run_suite(
    suite: Suite,
    tasks: list[SuiteTask],
    policy: PolicySpec,
    settings: RunSettings,
    *,
    jobs: int = 1,
    records: Records | None = None,
    reporter: Reporter | None = None,
    suite_name: str = "",
    selection: dict[str, Any] | None = None,
) -> Results:
    """Run a policy on tasks of a suite.

    Args:
        suite: The suite.
        tasks: Its tasks to run, as of `suite.select`.
        policy: The policy; every task gets a new instance.
        settings: Settings of the run.
        jobs: Number of processes.
        records: Store of finished tasks; a run that was killed continues from it.
        reporter: Receives progress messages.
        suite_name: Recorded in the results.
        selection: How the tasks were chosen; recorded in the results.

    Raises:
        UsageError: scenes are missing or of another revision (lists all), or there is no such policy.
    """
    reporter = reporter or Reporter(quiet=True)
    notes = check_revisions(tasks, settings)
    for note in notes:
        reporter.note(f"note: {note}")
    options = [policy.options(task) for task in tasks]  # fails before anything is built
    made_with = versions()
    frame = {
        "suite": suite.digest,
        "policy": {**asdict(policy), "digest": policy.digest()},
        "settings": asdict(settings),
        "versions": made_with,
    }
    found: dict[str, list[EpisodeResult]] = {}
    for task in tasks:
        record = records.get({**frame, "task": task.name}) if records else None
        if record is not None:
            found[task.name] = [EpisodeResult(**entry) for entry in record["episodes"]]
    open_ = [task for task in tasks if task.name not in found]
    reporter.start(len(open_), f"{policy.name}: {len(tasks)} tasks, {len(found)} of them from an earlier run")
    with Workers(jobs) as workers:
        for number, rows in workers.map(run_task, open_, suite.options, policy, settings, suite.settings):
            task = open_[number]
            found[task.name] = rows
            if records:
                records.put({**frame, "task": task.name}, {"episodes": [asdict(row) for row in rows]})
            reporter.done(f"{task.name}: {sum(row.success for row in rows)} of {len(rows)}")
    return Results(
        suite={"name": suite_name, "digest": suite.digest},
        policy={"name": policy.name, "arguments": policy.arguments, "options": _common(options)},
        selection={**(selection or {}), "episodes": settings.episodes, "fresh_seeds": settings.fresh},
        episodes=tuple(row for task in tasks for row in found[task.name]),
        notes=tuple(notes),
        made_with=made_with,
    )


def check_revisions(tasks: list[SuiteTask], settings: RunSettings) -> list[str]:
    """Return a note for each scene with another revision than the suite's.

    Raises:
        UsageError: scenes are missing, or have another revision without `any_revision`; lists all of them.
    """
    catalog = open_registry(settings.registry)
    known = catalog.revisions()
    wanted = wanted_scenes(tasks)
    missing = [scene for scene in wanted if scene not in known]
    other = [scene for scene, revision in wanted.items() if known.get(scene, revision) != revision]
    changed = [f"{scene} is {known[scene]}, the suite's is {wanted[scene]}" for scene in other]
    if missing:
        more = f"; and of another revision: {'; '.join(changed)}" if changed else ""
        raise UsageError(
            f"{len(missing)} of the suite's {len(wanted)} scenes are not in the registry {catalog.root}: "
            f"{', '.join(f'{scene} (revision {wanted[scene]})' for scene in missing)}{more}. Name another registry "
            "with --registry, or choose tasks of the scenes that are here with --tasks 'SCENE-*'; "
            f"{how_to_get({scene: wanted[scene] for scene in missing}, replace=False)}"
        )
    if changed and not settings.any_revision:
        raise UsageError(
            f"the registry {catalog.root} has other revisions of scenes than the suite was proven in: "
            f"{'; '.join(changed)}. Generate the suite again, or accept them with --any-revision; the results note it. "
            f"Or {how_to_get({scene: wanted[scene] for scene in other}, replace=True)}"
        )
    return [f"scene {text}" for text in changed]


def run_task(
    task: SuiteTask, options: dict[str, Any], policy: PolicySpec, settings: RunSettings, made: dict[str, Any]
) -> list[EpisodeResult]:
    """Run the episodes of a task in one environment. `made` are the settings of the suite."""
    suite = Suite(tasks=(task,), options=options)
    extra: dict[str, Any] = policy.options(task)
    if settings.videos is not None:
        size = settings.video_size_px
        extra |= {"render_mode": "rgb_array", "human_render_camera_configs": {"width": size, "height": size}}
    env = suite.make(task, registry=settings.registry, **extra)
    try:
        actor = policy.make(env, settings.timeout_s)
        rows = []
        for number, seed in enumerate(_seeds(task, settings, int(made.get("seed", 0)))):
            video = ""
            if settings.videos is not None and number == 0:
                video = f"{task.name}-{seed}.mp4"
                with open_video(Path(settings.videos) / video, scene_of(env).control_freq) as add:
                    episode = run_episode(env, actor, seed, lambda *_: add(np.asarray(env.render())))
            else:
                episode = run_episode(env, actor, seed)
            rows.append(_row(task, scene_of(env).bundle.revision, episode, video))
        return rows
    finally:
        env.close()


def _common(options: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the options that all tasks share."""
    return {key: value for key, value in options[0].items() if all(o.get(key) == value for o in options)}


def _seeds(task: SuiteTask, settings: RunSettings, suite_seed: int) -> list[int]:
    if settings.fresh:
        return [episode_seed(suite_seed, f"{task.name}/fresh", number) for number in range(settings.fresh)]
    return list(task.seeds[: settings.episodes])


def _row(task: SuiteTask, revision: str, episode: Episode, video: str) -> EpisodeResult:
    known = {run.seed: run for run in task.oracle}
    mine = [known[episode.seed]] if episode.seed in known else list(task.oracle)
    return EpisodeResult(
        task=task.name,
        revision=revision,
        kind=task.kind,
        scene=task.scene,
        robot=task.robot,
        scene_side=task.scene_side,
        object_side=task.object_side,
        seed=episode.seed,
        proven=episode.seed in known,
        success=episode.success,
        steps=episode.steps,
        path_m=round(episode.path_m, 4),
        oracle_path_m=statistics.median(run.path_m for run in mine),
        oracle_steps=statistics.median(run.steps for run in mine),
        reward=round(episode.reward, 4),
        act_ms=round(1000 * episode.act_s / max(episode.steps, 1), 3),
        video=video,
    )
