"""The training examples run, and give the same policy for the same seed."""

import importlib.util
import re
import runpy
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

import simrecon_envs

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def _module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(Path(name).stem, EXAMPLES / name)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _policy(
    name: str, root: Path, seed: int, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> str:
    """Run an example and return the hash that it prints."""
    arguments = ["--env-id", "things", "--registry", str(root), "--seed", str(seed)]
    arguments += ["--steps", "120", "--envs", "1", "--episodes", "1"]
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    printed = capsys.readouterr().out
    assert re.search(r"success: [01] of 1 episodes", printed)
    return re.search(r"policy ([0-9a-f]{16})", printed)[1]


@pytest.mark.parametrize("name", ["05_train_ppo.py", "07_ppo_single_file.py"])
def test_an_example_gives_the_same_policy_for_the_same_seed(
    name: str, scenes_root: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = (_policy(name, scenes_root, 3, capsys, monkeypatch) for _ in range(2))
    assert first == second


def test_advantages_stop_where_an_episode_does() -> None:
    single = _module("07_ppo_single_file.py")
    reward = torch.tensor([[1.0], [2.0], [0.0], [3.0]])
    value = torch.tensor([[0.5], [0.25], [4.0], [0.75]])
    no, last = torch.zeros(4, 1, dtype=torch.bool), torch.tensor([8.0])
    at_1 = torch.tensor([[False], [True], [False], [False]])
    ended = single.advantages(reward, value, last, at_1, no)
    assert ended[1, 0] == pytest.approx(2.0 - 0.25)  # success: the next value is 0
    cut = single.advantages(reward, value, last, no, at_1)
    assert cut[1, 0] == pytest.approx(2.0 + single.GAMMA * 4.0 - 0.25)  # truncated: the next value counts
    assert cut[0, 0] == pytest.approx(1.0 + 0.9 * 0.25 - 0.5 + 0.81 * float(cut[1, 0]))


def test_the_gpu_example_says_what_it_needs(
    scenes_root: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["08_ppo_gpu.py", "--env-id", "things", "--registry", str(scenes_root)])
    if torch.cuda.is_available():
        pytest.skip("CUDA is here")
    with pytest.raises(SystemExit, match="needs CUDA") as stopped:
        runpy.run_path(str(EXAMPLES / "08_ppo_gpu.py"), run_name="__main__")
    assert "simrecon train" in str(stopped.value)


def test_the_gpu_example_goes_with_maniskills_wrapper_over_the_end_of_an_episode(scenes_root: Path) -> None:
    gpu = _module("08_ppo_gpu.py")
    env = gpu.ManiSkillVectorEnv(
        simrecon_envs.make("things", registry=scenes_root, num_envs=1, task="pick", max_episode_steps=5),
        ignore_terminations=True,
        record_metrics=True,
    )
    torch.manual_seed(0)
    agent = gpu.Agent(env.single_observation_space.shape[0], env.single_action_space.shape[0])
    before = agent.actor[0].weight.clone()
    obs, _ = env.reset(seed=0)
    with torch.no_grad():
        data, obs, metrics = gpu.collect(agent, env, obs, 64)
        data["advantage"] = gpu.advantages(data)
        data["target"] = data["advantage"] + data["value"]
    assert data["cut"][:, 0].nonzero()[:, 0].tolist() == list(range(4, 64, 5))
    assert len(metrics) == 12
    assert {"success_once", "return"} <= set(metrics[0])
    optimizer = torch.optim.Adam(agent.parameters(), lr=1e-3)
    gpu.update(agent, optimizer, {key: part.flatten(0, 1) for key, part in data.items()})
    assert not torch.equal(agent.actor[0].weight, before)
    env.close()
