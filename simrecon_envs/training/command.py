"""Run `simrecon train` from parsed arguments; print the results as text or JSON."""

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

from registry import UsageError
from simrecon_envs.files import absolute
from simrecon_envs.registration import NAMESPACE
from simrecon_envs.training.config import (
    TrainConfig,
    describe_settings,
    parse_randomize,
    parse_settings,
)
from simrecon_envs.training.folder import RunFolder

_MOST_ENVS = 8  # default of --envs on machines with many cores
# Arguments that --resume takes from the run and does not accept.
_FIXED = (
    "robot",
    "obs_mode",
    "control_mode",
    "envs",
    "seed",
    "randomize",
    "device",
    "registry",
    "eval_episodes",
)


def run(arguments: argparse.Namespace) -> int:
    """Train or resume; return the exit code."""
    if arguments.list_settings:
        _print(
            f"hyperparameters of {arguments.algo}, for --set name=value:\n{describe_settings(arguments.algo)}"
        )
        return 0
    if arguments.scene is None:
        raise UsageError("name a SCENE; `simrecon list` shows what there is")
    from simrecon_envs.training import run as runner

    shown = {"quiet": arguments.quiet, "video": not arguments.no_video}
    if arguments.resume:
        folder = _find(arguments)
        results = runner.resume(folder, steps=arguments.steps, **shown)
    else:
        results = runner.train(_config(arguments), arguments.out, **shown)
    if arguments.json:
        _print(json.dumps(results, indent=2))
    if results.get("interrupted"):
        _tell_interrupted(arguments, results)
        return 130
    if not arguments.json:
        _print(_summary(results))
    return 0


def _config(arguments: argparse.Namespace) -> TrainConfig:
    """Return the configuration of a new run from the arguments and the defaults of the command."""
    given = {
        name: getattr(arguments, name)
        for name in ("robot", "obs_mode", "control_mode", "seed", "eval_episodes", "device", "steps", "envs")
        if getattr(arguments, name) is not None
    }
    given.setdefault("envs", min(_cores(), _MOST_ENVS))
    if arguments.steps == 0:
        raise UsageError("--steps 0: expected a whole number of at least 1")
    if arguments.randomize is not None:
        given["randomize"] = parse_randomize(arguments.randomize)
    return TrainConfig(
        scene=arguments.scene.removeprefix(NAMESPACE + "/"),
        task=arguments.task,
        algo=arguments.algo,
        registry=absolute(arguments.registry),
        settings=parse_settings(arguments.algo, arguments.set),
        **given,
    )


def _find(arguments: argparse.Namespace) -> RunFolder:
    """Return the run to resume.

    Raises:
        UsageError: there is none, or an argument contradicts it.
    """
    other = [name for name in _FIXED if getattr(arguments, name) is not None]
    if other or arguments.set:
        option = "--" + (other[0].replace("_", "-") if other else "set")
        raise UsageError(
            f"{option}: --resume keeps the run's settings; leave the option out, or start a new run without --resume"
        )
    scene = arguments.scene.removeprefix(NAMESPACE + "/")
    if arguments.out is not None:
        folder = RunFolder.open(arguments.out)
        config = folder.read_config()["config"]
        if config["scene"] != scene:
            raise UsageError(f"--out {arguments.out}: is a run in {config['scene']}, not in {scene}")
        return folder
    folder = RunFolder.newest(scene, arguments.task, algo=arguments.algo)
    if folder is None:
        raise UsageError(
            f"no run of {scene}, {arguments.task}, {arguments.algo} to resume; name its folder with --out, or "
            "leave out --resume"
        )
    return folder


def _tell_interrupted(arguments: argparse.Namespace, results: dict[str, Any]) -> None:
    command = f"simrecon train {arguments.scene} --resume --out {results['folder']}"
    sys.stderr.write(f"interrupted; {results['steps']:,} steps are saved. Continue with:\n  {command}\n")


def _summary(results: dict[str, Any]) -> str:
    lines = []
    if results["evaluation"] is not None:
        found = results["evaluation"]
        low, high = found["wilson_95"]
        median = found["steps_to_success_median"]
        lines.append(
            f"success: {found['successes']} of {found['episodes']} episodes ({found['success_rate']:.0%}; "
            f"95 % interval {low:.0%} to {high:.0%})"
            + (f", within {median / 20:.1f} s (median)" if median is not None else "")
        )
    if results["video"] is not None:
        lines.append(f"video:   {results['video']}")
    else:
        lines.append(f"video:   none: {results['video_note']}")
    folder = Path(results["folder"])
    lines.append(f"results: {folder / 'results.json'}")
    lines.append(f"curves:  tensorboard --logdir {folder / 'tensorboard'}")
    lines.append(f"use it:  simrecon_envs.training.load_policy({str(folder)!r})")
    return "\n".join(lines)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _print(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()
