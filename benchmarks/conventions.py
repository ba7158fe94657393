"""Check every task, robot and observation mode of scenes with Gymnasium's and stable-baselines3's checkers.

Usage:
    python -m benchmarks.conventions SCENE... [--registry DIR] [--robots panda fetch] [--modes state rgb] --json FILE

What ManiSkill's environments do is checked, too: batched tensors, "success" in the info, states that can be set.
A case is one task of every kind that the scene has for the robot. The file is written after every case, and what it has
already is not run again.
"""

import argparse
import gc
import json
import sys
import time
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

from benchmarks.command import guarded
from benchmarks.machine import describe_machine
from registry import UsageError

MODES = ("state", "state_dict", "rgb", "depth", "rgbd", "segmentation", "pointcloud")
ROBOTS = ("panda", "fetch")
SMALL = {"width": 32, "height": 32}
PASSED, ABSENT, FAILED = "passed", "no such task", "failed"


def main() -> int:
    """Parse the arguments, check, print the counts; return 1 where a case failed."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.conventions",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scenes", nargs="+", help="ids of scenes")
    parser.add_argument("--registry", type=Path, default=None, help="the registry's folder")
    parser.add_argument("--robots", nargs="+", default=ROBOTS)
    parser.add_argument("--modes", nargs="+", default=MODES, choices=MODES)
    parser.add_argument("--json", type=Path, required=True, help="where the outcomes are kept")
    arguments = parser.parse_args()
    return guarded("benchmarks.conventions", lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    import torch

    import simrecon_envs.scene_env  # noqa: F401 - so that all that is needed is loaded
    from simrecon_envs.tasks import KINDS

    torch.set_num_threads(1)
    out = json.loads(arguments.json.read_text()) if arguments.json.exists() else {"cases": {}}
    out["machine"] = describe_machine()
    gc.freeze()  # what is loaded need not be gone through with every scene that is built anew
    cases = [
        (scene, task, robot, mode)
        for robot in arguments.robots
        for scene in arguments.scenes
        for mode in arguments.modes
        for task in (*KINDS, "none")
    ]
    for case in cases:
        key = " ".join(case)
        if out["cases"].get(key, {}).get("outcome") in (PASSED, ABSENT):
            continue
        out["cases"][key] = outcome(*case, registry=arguments.registry)
        print(key, out["cases"][key], flush=True)
        out["counts"] = _counts(out["cases"])
        arguments.json.write_text(json.dumps(out, indent=1))
    print(json.dumps(out["counts"], indent=1))
    return int(any(FAILED in count for count in out["counts"].values()))


def outcome(scene: str, task: str, robot: str, mode: str, registry: Path | None) -> dict[str, Any]:
    """Return how one case ended: `outcome`, what was checked or why it failed, and CPU seconds."""
    import simrecon_envs

    start = time.process_time()
    kwargs = {} if mode.startswith("state") else {"sensor_configs": SMALL}
    try:
        env = simrecon_envs.make_cpu(
            scene, registry=registry, robot_uids=robot, task=task, obs_mode=mode, **kwargs
        )
    except UsageError as error:
        return {"outcome": ABSENT, "what": str(error)}
    try:
        check_case(env)
        ended = {"outcome": PASSED, "what": env.unwrapped.task}
    except Exception as error:  # whatever a checker or an environment raises is what is looked for
        ended = {"outcome": FAILED, "what": f"{env.unwrapped.task}: {type(error).__name__}: {error}"}
    finally:
        env.close()
    return {**ended, "cpu_s": round(time.process_time() - start, 1)}


def check_case(env: Any) -> None:
    """Check an environment of `make_cpu`, and the batched one within.

    Raises:
        AssertionError: or whatever a checker raises: something is not as it should be.
    """
    from gymnasium.utils.env_checker import check_env
    from stable_baselines3.common.env_checker import check_env as sb3_check_env

    with warnings.catch_warnings():
        # The checkers advise against unbounded boxes and small pictures, which ManiSkill's observations are.
        warnings.simplefilter("ignore")
        check_env(env, skip_render_check=True)
        sb3_check_env(env, warn=False, skip_render_check=True)
    check_maniskill(env.env)


def check_maniskill(env: Any) -> None:
    """Check what users of ManiSkill rely on: torch, one row an environment, success, states.

    Raises:
        AssertionError: something is otherwise.
    """
    import torch

    obs, _ = env.reset(seed=0)
    _expect(env.observation_space.contains(_numpy(obs)), "the observation is within its space")
    obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
    success = [info["success"]] if env.unwrapped.task != "none" else []
    for value in (reward, terminated, truncated, *success):
        _expect(isinstance(value, torch.Tensor) and value.shape == (1,), "a tensor, one row an environment")
    _expect(0 <= float(reward) <= 1, "the reward is normalized")
    state = env.unwrapped.get_state()
    env.unwrapped.set_state(state)
    _expect(torch.allclose(env.unwrapped.get_state(), state, atol=1e-6), "the state is what was set")


def _expect(holds: bool, what: str) -> None:
    if not holds:
        raise AssertionError(f"not so: {what}")


def _numpy(obs: Any) -> Any:
    import numpy as np

    return {key: _numpy(value) for key, value in obs.items()} if isinstance(obs, dict) else np.asarray(obs)


def _counts(cases: dict[str, dict]) -> dict[str, dict[str, int]]:
    """Return how many cases ended how: of each robot, of each mode, and of all."""
    counts: dict[str, Counter] = {}
    for key, case in cases.items():
        _, _, robot, mode = key.split()
        for group in ("all", robot, mode):
            counts.setdefault(group, Counter())[case["outcome"]] += 1
    return {group: dict(count) for group, count in counts.items()}


if __name__ == "__main__":
    sys.exit(main())
