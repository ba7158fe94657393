"""Run the subcommands of `simrecon benchmark`; the parser is in `reconstruction/commands/benchmark.py`."""

import argparse
import json
import sys
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

from registry import UsageError
from simrecon_envs.benchmark.compare import Difference, compare_results
from simrecon_envs.benchmark.fetching import default_place, fetch_scenes
from simrecon_envs.benchmark.generate import GenerateConfig, generate_suite
from simrecon_envs.benchmark.policies import PolicySpec
from simrecon_envs.benchmark.records import Records
from simrecon_envs.benchmark.reporting import Reporter
from simrecon_envs.benchmark.results import Results, load_results
from simrecon_envs.benchmark.run import RunSettings, run_suite
from simrecon_envs.benchmark.suite import Suite, SuiteTask, load_suite
from simrecon_envs.files import absolute


def generate(arguments: argparse.Namespace) -> int:
    """Run `simrecon benchmark generate`."""
    if bool(arguments.scenes) == arguments.all:
        raise UsageError("name SCENEs or pass --all for all scenes of the registry, one of both")
    if arguments.lerobot is not None:
        from simrecon_envs.benchmark.demonstrations_lerobot import need_pyarrow

        need_pyarrow()  # fail before minutes of proving
    reporter = Reporter(arguments.quiet)
    config = GenerateConfig(
        kinds=arguments.kinds,
        robots=arguments.robots,
        per_scene=arguments.per_scene,
        seeds=arguments.seeds,
        seed=arguments.seed,
        test_share=arguments.test_share,
        randomize=_randomize(arguments.randomize),
    )
    records = Records(arguments.out)
    suite = generate_suite(
        arguments.scenes,
        config,
        registry=arguments.registry,
        jobs=arguments.jobs,
        records=records,
        reporter=reporter,
    )
    suite.save(arguments.out)
    records.clear()
    if arguments.json:
        print(json.dumps({"suite": str(arguments.out), "digest": suite.digest, **_counts(suite)}, indent=2))
    else:
        _print_suite(suite, arguments.out)
    if arguments.maniskill or arguments.lerobot:
        _record_demos(arguments, suite, list(suite.tasks), None, reporter)
    return 0


def run(arguments: argparse.Namespace) -> int:
    """Run `simrecon benchmark run`."""
    suite = load_suite(arguments.suite)
    tasks, selection = _choose(suite, arguments)
    reporter = Reporter(arguments.quiet)
    _fetch(tasks, arguments, reporter)
    settings = RunSettings(
        episodes=arguments.episodes,
        fresh=arguments.fresh_seeds,
        any_revision=arguments.any_revision,
        videos=absolute(arguments.videos),
        registry=absolute(arguments.registry),
        timeout_s=arguments.timeout or None,
    )
    policy = PolicySpec(arguments.policy, _pairs(arguments.policy_option, "--policy-option"))
    for warning in policy.warnings():
        print(f"warning: {warning}", file=sys.stderr)
    if arguments.videos is not None:
        from simrecon_envs.backends import choose_render_backend

        choose_render_backend("auto", None, "rgb_array")  # fail before the run if nothing can render
    out: Path | None = arguments.out
    records = Records(out) if out is not None else None
    results = run_suite(
        suite,
        tasks,
        policy,
        settings,
        jobs=arguments.jobs,
        records=records,
        reporter=reporter,
        suite_name=arguments.suite.name,
        selection=selection,
    )
    if out is not None and records is not None:
        results.save(out)
        records.clear()
    if arguments.json:
        print(json.dumps(results.summary(), indent=2))
    else:
        _print_results(results)
    return 0


def compare(arguments: argparse.Namespace) -> int:
    """Run `simrecon benchmark compare`."""
    first, second = load_results(arguments.first), load_results(arguments.second)
    found = compare_results(first, second)
    if arguments.json:
        print(json.dumps(_plain(found), indent=2))
        return 0
    whole: Difference = found["all"]
    print(f"{arguments.second} ({second.policy['name']}) minus {arguments.first} ({first.policy['name']}), "
          f"{whole.episodes} common episodes")  # fmt: skip
    print(f"success          {_percent(whole.success_first)} -> {_percent(whole.success_second)}: "
          f"{_points(whole.success, whole.success_interval)}; only A {whole.only_first}, only B {whole.only_second}, "
          f"McNemar p = {whole.p:.2g}")  # fmt: skip
    print(f"path efficiency  {_signed(whole.efficiency, whole.efficiency_interval, '.3f')}")
    print(f"steps, both done {_signed(whole.steps, whole.steps_interval, '.1f')}")
    for key in ("kind", "scene", "robot"):
        for value, one in found[key].items():
            print(f"  {key:<6} {value:<20} {one.episodes:>5} episodes  success "
                  f"{_points(one.success, one.success_interval)}")  # fmt: skip
    for note in found["notes"]:
        print(f"note: {note}")
    return 0


def demos(arguments: argparse.Namespace) -> int:
    """Run `simrecon benchmark demos`."""
    if not arguments.maniskill and not arguments.lerobot:
        raise UsageError("name an output folder: --maniskill DIR, --lerobot DIR, or both")
    suite = load_suite(arguments.suite)
    tasks, _ = _choose(suite, arguments)
    reporter = Reporter(arguments.quiet)
    _fetch(tasks, arguments, reporter)
    _record_demos(arguments, suite, tasks, arguments.episodes, reporter, arguments.any_revision)
    return 0


def _fetch(tasks: list[SuiteTask], arguments: argparse.Namespace, reporter: Reporter) -> None:
    """Pull missing scenes if a place is named."""
    place = arguments.fetch_from or default_place()
    if place is not None:
        fetch_scenes(tasks, place, arguments.registry, reporter)


def _record_demos(
    arguments: argparse.Namespace,
    suite: Suite,
    tasks: list[SuiteTask],
    episodes: int | None,
    reporter: Reporter,
    any_revision: bool = False,
) -> None:
    from simrecon_envs.benchmark.demonstrations import record_demonstrations

    found = record_demonstrations(
        suite,
        tasks,
        maniskill=arguments.maniskill,
        lerobot=arguments.lerobot,
        obs_mode=arguments.demo_obs,
        renderer=arguments.demo_renderer,
        episodes=episodes,
        registry=arguments.registry,
        any_revision=any_revision,
        reporter=reporter,
    )
    if arguments.json:
        print(json.dumps(found, indent=2))
        return
    print(f"{found['episodes']} demonstrations of {found['tasks']} tasks, {found['steps']} steps")
    for place in found["written"]:
        print(f"  {place}")
    for note in found["failed"]:
        print(f"note: {note}")


def _choose(suite: Suite, arguments: argparse.Namespace) -> tuple[list[SuiteTask], dict[str, Any]]:
    selection = {
        "split": arguments.split,
        "split_by": arguments.split_by,
        "tasks": arguments.tasks,
        "kinds": list(arguments.kinds),
        "robots": list(arguments.robots),
    }
    return suite.select(**selection), selection


def _randomize(text: str | None) -> dict[str, float] | str | None:
    if text is None or text in ("none", "all"):
        return text
    pairs = _pairs(text.split(","), "--randomize")
    try:
        return {key: float(value) for key, value in pairs.items()}
    except ValueError as error:
        raise UsageError(f"--randomize {text}: expected numbers ({error})") from None


def _pairs(texts: list[str], flag: str) -> dict[str, str]:
    out = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not key.strip() or not equals:
            raise UsageError(f"{flag} {text!r}: expected KEY=VALUE")
        out[key.strip()] = value.strip()
    return out


def _counts(suite: Suite) -> dict[str, Any]:
    return {
        "tasks": len(suite.tasks),
        "episodes": sum(len(task.oracle) for task in suite.tasks),
        "left_out": len(suite.left_out),
        "kinds": dict(Counter(task.kind for task in suite.tasks)),
        "scenes": dict(Counter(task.scene for task in suite.tasks)),
        "test": {
            "object": sum(task.object_side == "test" for task in suite.tasks),
            "scene": sum(task.scene_side == "test" for task in suite.tasks),
        },
    }


def _print_suite(suite: Suite, out: Path) -> None:
    counts = _counts(suite)
    print(f"{out}: {counts['tasks']} tasks, {counts['episodes']} episodes, digest {suite.digest}")
    for scene in counts["scenes"]:
        mine = [task for task in suite.tasks if task.scene == scene]
        kinds = ", ".join(f"{n} {kind}" for kind, n in Counter(task.kind for task in mine).items())
        print(f"  {scene:<20} {len(mine):>3} tasks: {kinds}")
    print(f"test side: {counts['test']['object']} tasks by object, {counts['test']['scene']} by scene; left out: "
          f"{counts['left_out']} candidates (the file has the reasons)")  # fmt: skip


def _print_results(results: Results) -> None:
    summary = results.summary()
    print(f"{'':<28}{'episodes':>9} {'success':>22} {'path efficiency':>20} {'seconds':>18}")
    print(_row(results.policy["name"], summary["all"]))
    for key in ("kind", "scene", "robot", "object_side", "scene_side"):
        for value, one in summary[key].items():
            print(_row(f"  {key.replace('_', ' ')} {value}", one))
    for note in results.notes:
        print(f"note: {note}")


def _row(name: str, one: dict[str, Any]) -> str:
    success = f"{_percent(one['success']['value'])} {_range(one['success']['interval'], 100, '.0f')}"
    efficiency = f"{_number(one['path_efficiency'], '.2f')}"
    return (
        f"{name:<28}{one['episodes']:>9} {success:>22} {efficiency:>20} {_number(one['seconds'], '.1f'):>18}"
    )


def _number(figure: dict[str, Any], form: str) -> str:
    if figure["value"] is None:
        return "-"
    return f"{figure['value']:{form}} {_range(figure['interval'], 1, form)}".strip()


def _range(interval: tuple[float, float] | None, times: float, form: str) -> str:
    return "" if interval is None else f"[{times * interval[0]:{form}}, {times * interval[1]:{form}}]"


def _percent(rate: float) -> str:
    return f"{100 * rate:.1f} %"


def _points(difference: float, interval: tuple[float, float] | None) -> str:
    return f"{100 * difference:+.1f} points {_range(interval, 100, '+.1f')}".strip()


def _signed(value: float | None, interval: tuple[float, float] | None, form: str) -> str:
    return "-" if value is None else f"{value:+{form}} {_range(interval, 1, '+' + form)}".strip()


def _plain(found: dict[str, Any]) -> dict[str, Any]:
    out: dict[str, Any] = {"all": asdict(found["all"]), "notes": found["notes"]}
    for key in ("kind", "scene", "robot"):
        out[key] = {value: asdict(one) for value, one in found[key].items()}
    return out
