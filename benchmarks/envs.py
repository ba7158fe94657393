"""Measure environments: import, make, reset, step rate, memory, and which tasks the scripts do.

Usage:
    python -m benchmarks.envs SCENE... [--registry DIR] [--robot panda] [--task pick] [--each-kind] [--tasks]

CPU time stands beside wall time, because a shared machine stretches only the latter. "Bare" is SAPIEN alone with the
same scene, robot and drive targets, so that the same happens: setting the targets, 12 time steps, reading the joints.
"""

import argparse
import json
import os
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil

from benchmarks.command import guarded
from benchmarks.machine import describe_machine, machine_line
from registry import SceneRegistry, UsageError

_IMPORT = "import time, gymnasium; t, c = time.perf_counter(), time.process_time(); import simrecon_envs; " \
    "print(time.perf_counter() - t, time.process_time() - c)"  # fmt: skip
_STEPS, _ROUNDS, _RESETS = 300, 6, 500
_MODES = ("pd_joint_delta_pos", "pd_ee_delta_pose")


def main() -> int:
    """Parse the arguments, measure, print."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.envs",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scenes", nargs="+", help="ids of scenes")
    parser.add_argument("--registry", type=Path, default=None, help="the registry's folder")
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--task", default="pick", help="what is stepped")
    parser.add_argument(
        "--each-kind",
        action="store_true",
        help="step one task of every kind, with joint and with hand control",
    )
    parser.add_argument(
        "--tasks", action="store_true", help="let the script do every task that is listed, too"
    )
    parser.add_argument("--seeds", type=int, default=2, help="how often each task is done")
    parser.add_argument("--json", type=Path, default=None, help="where to write the figures")
    arguments = parser.parse_args()
    return guarded("benchmarks.envs", lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    import torch

    torch.set_num_threads(1)
    out = {"machine": describe_machine(), "robot": arguments.robot, "import_10000": import_time(10_000)}
    print(machine_line(out["machine"]))
    print(f"import with 10,000 scenes: {_both(out['import_10000'])}")
    for scene in arguments.scenes:
        out[scene] = measure(scene, arguments.registry, arguments.robot, arguments.task)
        print(f"{scene}: " + ", ".join(f"{key} {value}" for key, value in out[scene].items()))
        if arguments.each_kind:
            out[scene]["kinds"] = kinds(scene, arguments.registry, arguments.robot)
        if arguments.tasks:
            out[scene]["tasks"] = tasks(scene, arguments.registry, arguments.robot, arguments.seeds)
            done = sum(sum(runs) for runs in out[scene]["tasks"].values())
            print(f"  scripts: {done} of {arguments.seeds * len(out[scene]['tasks'])} runs")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(out, indent=1))
    return 0


def import_time(count: int) -> tuple[float, float]:
    """Return the wall and CPU seconds of importing with a registry of so many scenes."""
    with tempfile.TemporaryDirectory() as home:
        root = Path(home) / "registry"
        SceneRegistry(root, create=True)
        columns = "scene_id, revision, schema_version, created_utc, source_file, source_sha256, n_objects"
        row = ("0" * 16, "simrecon.scene/1", "2026-01-01T00:00:00+00:00", "v.mp4", "0" * 64, 3)
        with sqlite3.connect(root / "index.sqlite") as index:
            rows = [(f"scene{number:05d}", *row) for number in range(count)]
            index.executemany(f"INSERT INTO scenes ({columns}) VALUES (?, ?, ?, ?, ?, ?, ?)", rows)
        env = {**os.environ, "SIMRECON_HOME": home}
        run = subprocess.run(
            [sys.executable, "-c", _IMPORT], env=env, capture_output=True, text=True, check=True
        )
    wall, cpu = map(float, run.stdout.split())
    return wall, cpu


def measure(scene: str, registry: Path | None, robot: str, task: str = "pick") -> dict:
    """Return the figures of one scene; times are (wall, CPU) seconds."""
    import simrecon_envs

    simrecon_envs.make(scene, registry=registry, robot_uids=robot).close()  # imports, and the robot's shape
    kwargs = {
        "robot_uids": robot,
        "control_mode": "pd_joint_delta_pos",
        "max_episode_steps": 10**9,
        "task": task,
    }
    made: list = []
    out = {"objects": SceneRegistry(registry).get(scene).n_objects}
    out["make"] = _timed(lambda: made.append(simrecon_envs.make(scene, registry=registry, **kwargs)))
    env = made[0]
    env.reset(seed=0)
    out["reset"] = _timed(lambda: env.reset(seed=1), 20)
    out |= _rate(env)
    process = psutil.Process()
    for number in range(50):
        env.reset(seed=number)
    before = process.memory_info().rss
    for number in range(_RESETS):
        env.reset(seed=number)
    out["growth_mb_500_resets"] = round((process.memory_info().rss - before) / 2**20, 2)
    env.close()
    return out


def kinds(scene: str, registry: Path | None, robot: str) -> dict[str, dict]:
    """Return the step rates of the easiest task of every kind that the scene has, by control mode."""
    import simrecon_envs
    from simrecon_envs.tasks import KINDS

    print(f"  steps a CPU second, and share of bare: {'joints':>18} {'hand':>14}")
    out = {}
    for kind in ("none", *KINDS):
        out[kind] = {}
        for mode in _MODES:
            try:
                env = simrecon_envs.make(
                    scene, registry=registry, task=kind, robot_uids=robot, control_mode=mode,
                    max_episode_steps=10**9,
                )  # fmt: skip
            except UsageError as error:
                print(f"  {kind}: {error}")
                break
            out[kind][mode] = {"task": env.unwrapped.task, **_rate(env)}
            env.close()
        else:
            rates = [f"{one['steps_per_cpu_s']:6} {one['share_of_bare']:.3f}" for one in out[kind].values()]
            print(f"  {env.unwrapped.task:44} {'   '.join(rates)}", flush=True)
    return out


def _rate(env: object) -> dict[str, float]:
    """Return how fast an environment steps; rounds of it and of SAPIEN alone take turns, the best of each counts."""
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(_STEPS)]
    targets = _targets(env, actions)
    rounds = [(_steps(env, actions), _bare_steps(env, targets)) for _ in range(_ROUNDS)]
    ours, bare = (min(pair[k] for pair in rounds) for k in range(2))
    return {"steps_per_cpu_s": round(_STEPS / ours), "share_of_bare": round(bare / ours, 3)}


def tasks(scene: str, registry: Path | None, robot: str, seeds: int) -> dict[str, list[bool]]:
    """Return which runs of the script of every listed task succeeded."""
    import simrecon_envs
    from simrecon_envs.oracle import CONTROL_MODE, Oracle

    out = {}
    for entry in simrecon_envs.list_tasks(scene, registry=registry, robot=robot):
        env = simrecon_envs.make(
            scene, registry=registry, task=entry.task, robot_uids=robot, control_mode=CONTROL_MODE,
            max_episode_steps=10**9,
        )  # fmt: skip
        runs = []
        for seed in range(seeds):
            env.reset(seed=seed)
            done = False
            for action in Oracle(env).actions():
                done = bool(env.step(action)[2])
                if done:
                    break
            runs.append(done)
        out[entry.task] = runs
        print(f"  {entry.task}: {sum(runs)} of {seeds} {env.unwrapped.task_note}", flush=True)
        env.close()
    return out


def _steps(env: object, actions: list) -> float:
    env.reset(seed=0)
    start = time.process_time()
    for action in actions:
        env.step(action)
    return time.process_time() - start


def _targets(env: object, actions: list) -> list[list[float]]:
    """Return which drive targets the actions give to the joints."""
    env.reset(seed=0)
    joints, targets = env.unwrapped.agent.robot._objs[0].get_active_joints(), []
    for action in actions:
        env.step(action)
        targets.append([float(joint.drive_target[0]) for joint in joints])
    return targets


def _bare_steps(env: object, targets: list[list[float]]) -> float:
    """Step SAPIEN alone; the robot does what the actions made it do."""
    env.reset(seed=0)
    scene = env.unwrapped.scene.sub_scenes[0]
    robot = env.unwrapped.agent.robot._objs[0]
    joints = robot.get_active_joints()
    start = time.process_time()
    for target in targets:
        for joint, value in zip(joints, target, strict=True):
            joint.set_drive_target(value)
        for _ in range(env.unwrapped._sim_steps_per_control):
            scene.step()
        np.concatenate([robot.get_qpos(), robot.get_qvel()])
    return time.process_time() - start


def _timed(call: Callable[[], object], count: int = 1) -> str:
    wall, cpu = time.perf_counter(), time.process_time()
    for _ in range(count):
        call()
    return _both(((time.perf_counter() - wall) / count, (time.process_time() - cpu) / count))


def _both(pair: tuple[float, float]) -> str:
    return f"{1000 * pair[0]:.0f} ms wall {1000 * pair[1]:.0f} ms CPU"


if __name__ == "__main__":
    sys.exit(main())
