"""Training is reproducible from its seed, resumes after any interruption, and refuses bad input with one error."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

import simrecon_envs
from reconstruction.cli import main
from registry import UsageError
from simrecon_envs.benchmark import Suite, SuiteTask, load_results
from simrecon_envs.benchmark.suite import OracleRun
from simrecon_envs.registration import env_id
from simrecon_envs.training import RunFolder, TrainConfig, load_policy, train, trained
from simrecon_envs.training.config import describe_settings, parse_settings
from simrecon_envs.training.environments import EpisodeInfo
from simrecon_envs.training.evaluate import FIRST_SEED
from simrecon_envs.training.run import resume

TINY = ("rollout_steps=60", "batch_size=30", "n_epochs=1", "horizon=20", "net_arch=16")


def _config(root: Path, **other: object) -> TrainConfig:
    given = {
        "steps": 120,
        "eval_episodes": 2,
        "registry": str(root),
        "settings": parse_settings("ppo", list(TINY)),
    }
    return TrainConfig(scene="things", **(given | other))


def _weights(folder: Path) -> dict[str, torch.Tensor]:
    return load_policy(folder)._network.state_dict()


@pytest.fixture(scope="module")
def done(scenes_root: Path, tmp_path_factory: pytest.TempPathFactory) -> dict:
    """Return the results of a tiny run, without a video."""
    return train(_config(scenes_root), tmp_path_factory.mktemp("runs") / "done", video=False)


def test_a_run_leaves_all_that_it_was_and_came_to(done: dict) -> None:
    folder = Path(done["folder"])
    assert json.loads((folder / "results.json").read_text()) == done
    entry = json.loads((folder / "config.json").read_text())
    assert entry["config"]["seed"] == 0
    assert entry["config"]["settings"]["rollout_steps"] == 60
    assert entry["config"]["control_mode"] == "pd_ee_delta_pos"
    assert entry["scene"]["revision"] == done["revision"]
    assert entry["versions"]["torch"] == torch.__version__.split("+")[0] or entry["versions"]["torch"]
    assert TrainConfig.from_json(entry["config"]).total_steps == done["training"]["steps"] == 120
    assert done["evaluation"]["seeds"] == [FIRST_SEED, FIRST_SEED + 1]
    assert done["training"]["episodes"] == 6
    low, high = done["evaluation"]["wilson_95"]
    assert low < high
    assert low <= done["evaluation"]["successes"] / 2 <= high
    assert RunFolder(folder).checkpoints()[-1][0] == 120


def test_tensorboard_has_success_and_return(done: dict) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(Path(done["folder"]) / "tensorboard")).Reload()
    assert {"rollout/success_rate", "rollout/ep_rew_mean"} <= set(events.Tags()["scalars"])
    assert [event.step for event in events.Scalars("rollout/ep_rew_mean")] == [60, 120]


def test_the_same_seed_gives_the_same_bits_and_another_other_ones(
    scenes_root: Path, tmp_path: Path, done: dict
) -> None:
    again = train(_config(scenes_root), tmp_path / "again", video=False)
    other = train(_config(scenes_root, seed=1, eval_episodes=0), tmp_path / "other", video=False)
    first, second, third = (_weights(Path(run["folder"])) for run in (done, again, other))
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert not all(torch.equal(first[name], third[name]) for name in first)
    assert done["evaluation"]["per_episode"] == again["evaluation"]["per_episode"]


def test_ctrl_c_leaves_a_checkpoint_and_resuming_makes_the_same_number_of_steps(
    scenes_root: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run"

    def interrupt() -> None:
        while not list((out / "checkpoints").glob("step_*")):
            time.sleep(0.005)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt, daemon=True)
    thread.start()
    found = train(_config(scenes_root, steps=300, eval_episodes=0), out, video=False)
    thread.join()
    assert found == {"interrupted": True, "folder": str(out), "steps": found["steps"]}
    assert 60 <= found["steps"] < 300
    assert found["steps"] % 60 == 0
    # A partial checkpoint of a killed process is ignored.
    (out / "checkpoints" / ".writing-999").mkdir()
    (out / "checkpoints" / ".writing-999" / "model.zip").write_bytes(b"half")
    on = resume(RunFolder.open(out), video=False)
    assert on["training"]["steps"] == 300
    assert on["training"]["episodes"] >= 15 - 1  # the interruption cuts off one episode
    assert [steps for steps, _ in RunFolder(out).checkpoints()][-1] == 300
    with pytest.raises(UsageError, match="was begun with 300"):
        resume(RunFolder.open(out), steps=240)


def test_sac_goes_on_with_its_memory(scenes_root: Path, tmp_path: Path) -> None:
    settings = parse_settings("sac", ["learning_starts=20", "batch_size=16", "horizon=20", "net_arch=16"])
    config = _config(scenes_root, algo="sac", steps=60, eval_episodes=0, settings=settings)
    found = train(config, tmp_path / "run", video=False)
    assert found["training"]["steps"] == 60
    longer = resume(RunFolder.open(tmp_path / "run"), steps=90, video=False)
    assert longer["training"]["steps"] == 90
    from simrecon_envs.training.models import SAC

    path = RunFolder(tmp_path / "run").checkpoints()[-1][1]
    model = SAC.load(path / "model.zip")
    model.load_replay_buffer(path / "replay.pkl")
    assert model.replay_buffer.size() == 90


def test_a_trained_policy_acts_wherever_its_observations_come_from(
    scenes_root: Path, done: dict, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    policy = load_policy(done["folder"])
    env = simrecon_envs.make("things", registry=scenes_root, **policy.env_kwargs)
    obs, _ = env.reset(seed=5)
    action = policy.act(obs)
    assert action.shape == (1, *env.unwrapped.single_action_space.shape)
    np.testing.assert_array_equal(policy(obs.numpy()[0]), action[0])
    np.testing.assert_array_equal(policy(obs), action)
    policy.reset()
    env.step(action)
    np.testing.assert_array_equal(trained(env, run=done["folder"]).act(obs), action)
    monkeypatch.setenv("SIMRECON_HOME", str(tmp_path))
    with pytest.raises(UsageError, match="simrecon train things --task reach_"):
        trained(env)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "things-1").symlink_to(done["folder"])
    np.testing.assert_array_equal(trained(env).act(obs), action)
    env.close()
    env = simrecon_envs.make("things", registry=scenes_root, task="reach")
    with pytest.raises(
        UsageError, match=r"trained with control_mode='pd_ee_delta_pos', .* 'pd_joint_delta_pos'"
    ):
        trained(env)
    env.close()


def test_a_run_goes_through_a_suite_as_it_was_trained(
    scenes_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = _config(
        scenes_root, task="pick", control_mode="pd_joint_delta_pos", steps=60, eval_episodes=0, seed=3
    )
    run = train(config, tmp_path / "runs" / "one", video=False)
    oracle = (OracleRun(seed=7, steps=10, path_m=0.3),)
    task = SuiteTask(
        name="things-it-panda", env_id=env_id("things", run["task"]), scene="things", revision=run["revision"],
        task=run["task"], kind="pick", robot="panda", instruction=run["instruction"], max_steps=20, objects=(),
        scene_side="train", object_side="train", oracle=oracle,
    )  # fmt: skip
    Suite(tasks=(task,)).save(tmp_path / "suite.json")
    monkeypatch.setenv("SIMRECON_HOME", str(tmp_path))
    command = ["benchmark", "run", str(tmp_path / "suite.json"), "--registry", str(scenes_root), "--quiet"]
    command += ["--policy", "simrecon_envs.training:trained"]
    found = {}
    for name, option in {"newest": [], "named": ["--policy-option", f"run={run['folder']}"]}.items():
        assert main([*command, *option, "--out", str(tmp_path / name)]) == 0
        found[name] = load_results(tmp_path / name)
        assert found[name].policy["options"] == {
            "obs_mode": "state", "control_mode": "pd_joint_delta_pos", "observe_objects": True
        }  # fmt: skip
    one, two = (replace(found[name].episodes[0], act_ms=0.0) for name in found)
    assert one == two
    assert one.success or one.steps == 20
    assert one.path_m > 0


class _Hover(gym.Env):
    """Succeeds at the third step; every step has reward 0.5."""

    observation_space = action_space = gym.spaces.Box(-1, 1, (1,))

    def reset(self, **_: object) -> tuple:
        self._steps = 0
        return np.zeros(1, np.float32), {"instruction": "Hover."}

    def step(self, action: np.ndarray) -> tuple:
        self._steps += 1
        won = self._steps == 3
        return np.zeros(1, np.float32), 0.5, won, False, {"success": won}


def test_success_pays_what_staying_would_and_the_told_return_is_the_environments_own() -> None:
    env = EpisodeInfo(_Hover(), bonus=0.9 / (1 - 0.9))
    env.reset()
    steps = [env.step(np.zeros(1)) for _ in range(3)]
    assert [reward for _, reward, *_ in steps] == [0.5, 0.5, pytest.approx(0.5 + 9)]
    assert steps[0][4] == {}
    assert steps[2][4]["is_success"] is True
    assert (steps[2][4]["episode"]["r"], steps[2][4]["episode"]["l"]) == (1.5, 3)


@pytest.mark.parametrize(
    ("algo", "text", "message"),
    [
        ("ppo", "learning_rat=1", "Did you mean 'learning_rate'\\?"),
        ("ppo", "tau=0.1", "ppo has no 'tau'.*rollout_steps"),
        ("ppo", "gamma=1.5", "a number between 0 and 0.9999"),
        ("ppo", "gamma=nan", "a number between"),
        ("sac", "net_arch=64,-1", "whole numbers with commas between 1"),
        ("sac", "buffer_size=1e5", "expected a whole number"),
        ("ppo", "success_bonus=1", "true or false"),
        ("ppo", "gamma", "expected name=value"),
    ],
)
def test_settings_that_cannot_be_are_refused(algo: str, text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        parse_settings(algo, [text])


def test_settings_and_steps() -> None:
    settings = parse_settings("ppo", ["learning_rate=3e-4", "net_arch=32,16", "success_bonus=false"])
    assert (settings.learning_rate, settings.net_arch, settings.success_bonus) == (3e-4, (32, 16), False)
    assert "learning_rate=0.001" in describe_settings("ppo")
    config = TrainConfig(scene="a", envs=3, steps=2500)
    assert (config.block, config.total_steps) == (999, 1998)  # never more than was asked for
    assert TrainConfig.from_json(json.loads(json.dumps(config.to_json()))) == config
    with pytest.raises(UsageError, match="less than the 1000 steps between two updates"):
        TrainConfig(scene="a", steps=10)


@pytest.mark.parametrize(("flag", "value"), [("--seed", "-1"), ("--steps", "0"), ("--envs", "0")])
def test_numbers_out_of_range_are_refused_at_parse(
    flag: str, value: str, capsys: pytest.CaptureFixture
) -> None:
    with pytest.raises(SystemExit) as refused:
        main(["train", "things", flag, value])
    assert refused.value.code == 2
    assert f"argument {flag}: '{value}' is not a whole number" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "SimRecon/nowhere does not exist"),
        (["things", "--task", "reach_moon"], "no task 'reach_moon'"),
        (["bare", "--task", "reach"], "no task 'reach'"),
        (["things", "--task", "navigate"], "does not drive"),
        (["things", "--control-mode", "telepathy"], "--control-mode telepathy: panda has pd_joint_delta_pos"),
        (["things", "--robot", "pandda"], "Did you mean 'panda'"),
        (["things", "--set", "lr=1"], "has no 'lr'"),
        (["things", "--randomize", "{"], "not JSON"),
        (["things", "--randomize", '{"wind": 1}'], "shift_m"),
        (["things", "--device", "abacus"], "expected cpu or cuda"),
        (["things", "--resume", "--seed", "2"], "--seed: --resume keeps the run's settings"),
        (["things", "--resume"], "no run of things, reach, ppo"),
        (["things", "--resume", "--out", "/nonexistent"], "no training run in this folder"),
        ([], "name a SCENE"),
    ],
)
def test_bad_input_is_one_clear_error(
    arguments: list[str],
    message: str,
    scenes_root: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("SIMRECON_HOME", str(tmp_path))
    registry = [] if "--resume" in arguments else ["--registry", str(scenes_root)]
    assert main(["train", *arguments, *registry]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert printed.err.startswith("simrecon train: ")
    assert printed.err.count("\n") == 1
    assert not list(tmp_path.glob("runs/*"))


def test_a_folder_in_use_is_not_written_over(
    scenes_root: Path, done: dict, capsys: pytest.CaptureFixture
) -> None:
    arguments = ["train", "things", "--registry", str(scenes_root), "--out", done["folder"]]
    assert main(arguments) == 2
    assert "exists and is not an empty folder" in capsys.readouterr().err
    with RunFolder(done["folder"]).held():
        assert main(["train", "things", "--resume", "--out", done["folder"]]) == 2
    assert "another process trains here" in capsys.readouterr().err


def test_the_command_prints_results_as_json(
    scenes_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SIMRECON_HOME", str(tmp_path))
    sets = [word for text in TINY for word in ("--set", text)]
    arguments = [
        "train",
        "things",
        "--registry",
        str(scenes_root),
        "--steps",
        "60",
        "--eval-episodes",
        "1",
        *sets,
    ]
    assert main([*arguments, "--envs", "1", "--no-video", "--json"]) == 0
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    assert Path(found["folder"]).parent == tmp_path / "runs"
    assert found["video_note"] == "not asked for"
    assert "run folder:" in printed.err
    assert main(["train", "things", "--resume", "--steps", "120", "--no-video", "--quiet"]) == 0
    printed = capsys.readouterr()
    assert "success: " in printed.out
    assert printed.err == ""


@pytest.mark.end_to_end
def test_a_killed_run_goes_on_to_the_same_number_of_steps(scenes_root: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    command = [sys.executable, "-m", "reconstruction.cli", "train", "things", "--registry", str(scenes_root)]
    command += [
        "--out",
        str(out),
        "--steps",
        "3000",
        "--envs",
        "2",
        "--set",
        "rollout_steps=100",
        "--no-video",
    ]
    process = subprocess.Popen([*command, "--eval-episodes", "0"], stderr=subprocess.DEVNULL)
    while not list((out / "checkpoints").glob("step_*")):
        assert process.poll() is None
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert RunFolder(out).checkpoints()[-1][0] < 3000
    assert resume(RunFolder.open(out), video=False)["training"]["steps"] == 3000


@pytest.mark.end_to_end
def test_reach_is_learned(scenes_root: Path, tmp_path: Path) -> None:
    config = TrainConfig(scene="things", steps=30_000, envs=2, registry=str(scenes_root))
    found = train(config, tmp_path / "run", video=False)
    assert found["evaluation"]["success_rate"] >= 0.9


@pytest.mark.end_to_end
@pytest.mark.render
def test_pictures_are_learned_from_and_the_end_is_filmed(scenes_root: Path, tmp_path: Path) -> None:
    settings = parse_settings(
        "ppo", ["rollout_steps=8", "batch_size=8", "n_epochs=1", "horizon=4", "image_px=36"]
    )
    config = _config(scenes_root, obs_mode="rgb", steps=8, eval_episodes=1, settings=settings)
    found = train(config, tmp_path / "run")
    assert found["training"]["steps"] == 8
    assert found["evaluation"]["episodes"] == 1
    assert Path(found["video"]).stat().st_size > 1000
    policy = load_policy(tmp_path / "run")
    env = simrecon_envs.make_cpu("things", registry=scenes_root, **policy.env_kwargs)
    assert env.action_space.contains(policy(env.reset(seed=0)[0]))
    env.close()
