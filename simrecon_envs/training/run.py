"""Train, evaluate, record: `train` begins a run, `resume` continues an interrupted one."""

import datetime
import json
import platform
import time
from pathlib import Path
from typing import Any

from registry import SimReconError, UsageError
from simrecon_envs.files import versions, write_json
from simrecon_envs.training.config import TrainConfig
from simrecon_envs.training.environments import env_kwargs, make_several, resolve
from simrecon_envs.training.folder import SCHEMA, RunFolder
from simrecon_envs.training.progress import Interrupted, Progress


def train(
    config: TrainConfig,
    out: Path | str | None = None,
    *,
    quiet: bool = True,
    video: bool = True,
) -> dict[str, Any]:
    """Begin a run: train, evaluate, record a video.

    Args:
        config: Configuration of the run.
        out: The run's folder; a new one in `runs_root()` where None.
        quiet: Show no progress.
        video: Record a video at the end, if this machine can render.

    Returns:
        The content of `results.json`, or {"interrupted": True, "folder", "steps"}.

    Raises:
        UsageError: the configuration is wrong; no folder was made.
        EnvironmentMissing: there is no CUDA, or images are observed and nothing can render.
    """
    from simrecon_envs.training.models import check_device

    check_device(config.device)
    config, scene = resolve(config)
    folder = RunFolder.create(None if out is None else Path(out), _name(config))
    with folder.held():
        entry = {
            "schema": SCHEMA,
            "config": config.to_json(),
            "scene": scene,
            "environment": env_kwargs(config),
            "total_steps": config.total_steps,
            "versions": {"python": platform.python_version(), **versions("stable-baselines3")},
            "began": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        }
        write_json(folder.config_file, entry)
        return _go(config, folder, entry, quiet=quiet, video=video)


def resume(
    folder: RunFolder, *, steps: int | None = None, quiet: bool = True, video: bool = True
) -> dict[str, Any]:
    """Continue a run from its latest checkpoint, or from its beginning.

    Args:
        folder: The run's folder.
        steps: A new, greater total number of steps.
        quiet: Show no progress.
        video: Record a video at the end, if this machine can render.

    Returns:
        As `train`.

    Raises:
        UsageError: the scene has another revision, `steps` is less than before, or a checkpoint is damaged.
    """
    import dataclasses

    from simrecon_envs.training.models import check_device

    with folder.held():
        entry = folder.read_config()
        config = TrainConfig.from_json(entry["config"])
        if steps is not None and steps != config.steps:
            if steps < config.steps:
                raise UsageError(f"--steps {steps}: the run in {folder.path} was begun with {config.steps}")
            config = dataclasses.replace(config, steps=steps)
            entry |= {"config": config.to_json(), "total_steps": config.total_steps}
            write_json(folder.config_file, entry)
            folder.results_file.unlink(missing_ok=True)
        check_device(config.device)
        _, scene = resolve(config)
        if scene["revision"] != entry["scene"]["revision"]:
            raise UsageError(
                f"{folder.path}: was trained in revision {entry['scene']['revision']} of {config.scene}, which now has "
                f"revision {scene['revision']}; start a new run"
            )
        return _go(config, folder, entry, quiet=quiet, video=video)


def _go(config: TrainConfig, folder: RunFolder, entry: dict, *, quiet: bool, video: bool) -> dict[str, Any]:
    """Train the remaining steps, then evaluate."""
    done = _steps_done(folder)
    progress = Progress(config.total_steps, quiet=quiet)
    progress.say(_headline(config, entry["scene"], folder, done))
    try:
        if done < config.total_steps:
            _learn(config, folder, progress)
        return _finish(config, folder, entry, progress, video)
    except (Interrupted, KeyboardInterrupt):
        progress.clear()
        return {"interrupted": True, "folder": str(folder.path), "steps": _steps_done(folder)}


def _steps_done(folder: RunFolder) -> int:
    return max((steps for steps, _ in folder.checkpoints()), default=0)


def _learn(config: TrainConfig, folder: RunFolder, progress: Progress) -> None:
    """Train the remaining steps and save a checkpoint.

    Raises:
        Interrupted: a signal asked to stop; a checkpoint was saved.
        SimReconError: an environment's process died.
    """
    import torch
    from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat

    from simrecon_envs.training import models
    from simrecon_envs.training.callbacks import Stop, Tally, Watch

    torch.set_num_threads(1)  # small networks; reproducible sums
    checkpoints = folder.checkpoints()
    vec = make_several(config)
    try:
        if checkpoints:
            path = checkpoints[-1][1]
            model = models.load(config, path, vec)
            tally = Tally(**json.loads((path / "tally.json").read_text(encoding="utf-8")))
        else:
            model, tally = models.build(config, models.normalized(config, vec)), Tally()
        tensorboard = str(folder.path / "tensorboard")
        model.set_logger(Logger(tensorboard, [TensorBoardOutputFormat(tensorboard)]))
        stop = Stop()
        watch = Watch(folder, config.total_steps, tally, stop, progress)
        with stop.listening(progress.say):
            model.learn(
                config.total_steps - model.num_timesteps,
                callback=watch,
                log_interval=1 if config.algo == "ppo" else 20,
                reset_num_timesteps=False,
            )
        watch.save()
        progress.say(f"trained: {tally.steps:,} steps, {tally.episodes:,} episodes, {tally.seconds:.0f} s")
    except (EOFError, ConnectionError) as error:
        raise SimReconError(
            f"an environment's process ended unexpectedly ({error!r}), perhaps for lack of memory; use fewer --envs. "
            f"Continue from the last checkpoint: simrecon train {config.scene} --resume --out {folder.path}"
        ) from error
    finally:
        _close(vec)


def _finish(
    config: TrainConfig, folder: RunFolder, entry: dict, progress: Progress, video: bool
) -> dict[str, Any]:
    """Evaluate, record a video, and write the results."""
    from simrecon_envs.training.evaluate import evaluate, record
    from simrecon_envs.training.policy import TrainedPolicy

    policy = TrainedPolicy(folder.path, config.device)
    tally = json.loads((folder.checkpoints()[-1][1] / "tally.json").read_text(encoding="utf-8"))
    results: dict[str, Any] = {
        "schema": SCHEMA,
        "folder": str(folder.path),
        "scene": config.scene,
        "revision": entry["scene"]["revision"],
        "task": config.task,
        "instruction": entry["scene"]["instruction"],
        "task_note": entry["scene"]["task_note"],
        "algo": config.algo,
        "seed": config.seed,
        "training": tally | {"steps_per_s": tally["steps"] / max(tally["seconds"], 1e-6)},
        "evaluation": None,
        "video": None,
        "video_note": "",
    }
    if config.eval_episodes:
        began = time.perf_counter()
        results["evaluation"] = evaluate(
            config,
            policy,
            config.eval_episodes,
            lambda done, good: progress.evaluating(done, config.eval_episodes, good),
        )
        results["evaluation"]["seconds"] = time.perf_counter() - began
    if video:
        path = folder.path / "video.mp4"
        results["video_note"] = record(config, policy, path)
        results["video"] = None if results["video_note"] else str(path)
    else:
        results["video_note"] = "not asked for"
    write_json(folder.results_file, results)
    progress.clear()
    return results


def _close(vec: Any) -> None:
    """Close the environments, even if processes have died."""
    import contextlib

    with contextlib.suppress(EOFError, ConnectionError):
        vec.close()


def _headline(config: TrainConfig, scene: dict, folder: RunFolder, done: int) -> str:
    what = f"{scene['instruction']} ({config.scene}, {config.task}, {config.robot}, {config.control_mode})"
    how = (
        f"{config.algo.upper()}, {config.total_steps:,} steps, {config.envs} environments, seed {config.seed}"
    )
    lines = [what, how + (f", continuing at {done:,}" if done else ""), f"run folder: {folder.path}"]
    if scene["task_note"]:
        lines.insert(1, f"note: {scene['task_note']}")
    return "\n".join(lines)


def _name(config: TrainConfig) -> str:
    return f"{config.scene}-{config.task}-{config.algo}"
