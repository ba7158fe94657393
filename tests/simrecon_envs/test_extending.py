"""docs/extending.md: its code blocks run, and what they add can be used without changing the packages."""

import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest
import torch

import simrecon_envs
from registry import UsageError
from simrecon_envs.oracle import CONTROL_MODE, Oracle
from simrecon_envs.tasks import KINDS, Task, register_task

ROOT = Path(__file__).resolve().parents[2]


def code_of(section: str) -> str:
    """Return the first Python code block of a section of docs/extending.md."""
    text = (ROOT / "docs/extending.md").read_text(encoding="utf-8").partition(f"## {section}\n")[2]
    found = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    assert found is not None, section
    return found[1]


@pytest.fixture
def my_tasks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write my_tasks.py into an importable folder and return the folder; `KINDS` is restored afterwards."""
    (tmp_path / "my_tasks.py").write_text(code_of("Add a task"), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(KINDS, "hoist", Task)
    monkeypatch.delitem(KINDS, "hoist")
    monkeypatch.delitem(sys.modules, "my_tasks", raising=False)
    return tmp_path


def test_a_new_kind_of_task_is_listed_made_solved_and_not_solved_by_waiting(
    my_tasks: Path, scenes_root: Path
) -> None:
    importlib.import_module("my_tasks")
    entries = simrecon_envs.list_tasks("things", registry=scenes_root, kinds="hoist")
    assert ("hoist_cube", "Lift the cube by 20 cm.") in {(entry.task, entry.instruction) for entry in entries}
    simrecon_envs.register_scenes(scenes_root)
    env = gym.make("SimRecon/things-hoist_cube-v0", control_mode=CONTROL_MODE, reward_mode="dense")
    scene = env.unwrapped
    assert scene.task_note == ""
    obs, _ = env.reset(seed=0)
    assert env.observation_space.contains(obs.numpy())
    for _ in range(5):
        _, waiting, terminated, _, info = env.step(torch.zeros(env.action_space.shape))
        assert not bool(terminated)
        assert float(info["below_m"]) == pytest.approx(0.20, abs=2e-3)
    env.reset(seed=0)
    for action in Oracle(env).actions():
        _, reward, terminated, _, info = env.step(action)
        if bool(terminated):
            break
    assert bool(info["success"])
    assert float(reward) == scene.task_object.max_reward > float(waiting)
    assert float(scene.measures.position(scene.target_id)[0, 2]) >= scene.task_object.target_height_m
    env.close()


def test_at_the_height_but_not_held_is_no_success(my_tasks: Path, scenes_root: Path) -> None:
    from mani_skill.utils.structs.pose import Pose

    importlib.import_module("my_tasks")
    env = simrecon_envs.make("things", registry=scenes_root, task="hoist_cube")
    env.reset(seed=0)
    actor = env.unwrapped.builder.objects[env.unwrapped.target_id].actor
    actor.set_pose(Pose.create_from_pq(torch.tensor([[0.3, 0.62, 0.7]])))
    info = env.step(None)[-1]
    assert float(info["below_m"]) < 0
    assert not bool(info["success"])
    env.close()


@pytest.mark.parametrize("code", ["import my_tasks", "import simrecon_envs.tasks"])
def test_an_installed_package_adds_its_kind_to_every_process(code: str, my_tasks: Path) -> None:
    info = my_tasks / "my_tasks-0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my_tasks\nVersion: 0.1\n")
    (info / "entry_points.txt").write_text("[simrecon.tasks]\nmy_tasks = my_tasks\n")
    code += "; from simrecon_envs.tasks import KINDS; print(KINDS['hoist'].__module__)"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(my_tasks), str(ROOT)])}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert run.stdout == "my_tasks\n", run.stderr


@pytest.mark.parametrize(
    ("name", "why"),
    [("pick", "is taken by simrecon_envs.tasks.pick.Pick"), ("two_words", "one lower-case word")],
)
def test_a_name_that_is_taken_or_cannot_be_is_refused(name: str, why: str) -> None:
    with pytest.raises(UsageError, match=why):
        register_task(type("Other", (Task,), {"kind": name}))
    assert KINDS["pick"].__name__ == "Pick"
