"""A packed scene on a fresh machine is an environment in two lines; suites pull the scenes that are missing."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest

import simrecon_envs
from reconstruction.cli import main
from registry import SceneRegistry, UsageError, open_registry, registry_folder
from registry.exchange import open_place, pack_scene, push_scene
from simrecon_envs.benchmark.fetching import fetch_scenes
from simrecon_envs.benchmark.reporting import Reporter
from simrecon_envs.benchmark.run import RunSettings, check_revisions

ROOT = Path(__file__).parents[2]


@pytest.fixture
def pack(scenes_root, tmp_path):
    return pack_scene(SceneRegistry(scenes_root).load("room"), tmp_path / "room.simrecon").path


@pytest.fixture
def place(scenes_root, tmp_path):
    """Return a folder with all scenes of `scenes_root`."""
    opened = open_place(tmp_path / "place")
    registry = SceneRegistry(scenes_root)
    for scene in registry.revisions():
        push_scene(registry.load(scene), opened)
    return tmp_path / "place"


def test_two_lines_make_an_environment_on_a_fresh_machine(pack, tmp_path):
    lines = (
        "import gymnasium as gym, simrecon_envs\n"
        f"env = gym.make(simrecon_envs.add({str(pack)!r}), obs_mode='state')\n"
    )
    code = f"{lines}env.reset(seed=0)\nenv.step(env.action_space.sample())\nprint(env.spec.id)\n"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "SIMRECON_HOME": str(tmp_path / "fresh")}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[-1] == "SimRecon/room"
    assert list(SceneRegistry(tmp_path / "fresh" / "registry").revisions()) == ["room"]


def test_added_scenes_are_registered_at_once(pack, tmp_path):
    name = simrecon_envs.add(pack, name="added_room", registry=tmp_path / "registry")
    assert name == "SimRecon/added_room"
    spec = gym.spec(name)
    assert spec.kwargs["scene_id"] == "added_room"
    assert simrecon_envs.add(pack, name="added_room", registry=tmp_path / "registry") == name
    with pytest.raises(UsageError, match="there is no such file"):
        simrecon_envs.add(tmp_path / "none.simrecon", registry=tmp_path / "registry")
    simrecon_envs.register_scenes()
    del gym.registry[name]


def test_scenes_of_a_registry_at_an_address_are_environments(scenes_root, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("SIMRECON_HOME", str(tmp_path / "publisher"))
    address = f"file://{tmp_path / 'lab'}"
    local, shared = SceneRegistry(scenes_root), open_registry(address)
    for scene in ("bare", "room"):
        shared.publish(local.load(scene).root, f"lab_{scene}")

    monkeypatch.setenv("SIMRECON_HOME", str(tmp_path / "user"))
    assert simrecon_envs.register_scenes(address) == ["SimRecon/lab_bare", "SimRecon/lab_room"]
    copy = registry_folder(address)
    assert not (copy / "scenes").exists()
    env = gym.make("SimRecon/lab_room", obs_mode="state")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
    assert [folder.name for folder in (copy / "scenes").iterdir()] == ["lab_room"]  # only what was opened
    assert [record.scene_id for record in simrecon_envs.list_scenes(registry=address)] == [
        "lab_bare",
        "lab_room",
    ]

    for verb in (["show", "lab_room"], ["verify", "lab_room"], ["remove", "lab_room", "--yes"], ["list"]):
        assert main([*verb, "--registry", address]) == 0
    listed = capsys.readouterr().out.splitlines()[-1]
    assert listed.startswith("SimRecon/lab_bare")
    assert main(["registry", "rebuild", "--registry", address]) == 0
    assert "1 scenes" in capsys.readouterr().out
    simrecon_envs.register_scenes(address)
    assert "SimRecon/lab_room" not in gym.registry
    monkeypatch.setenv("SIMRECON_REGISTRY", address)
    env = simrecon_envs.make("lab_bare", obs_mode="state")
    assert env.unwrapped.scene_id == "lab_bare"
    env.close()
    del gym.registry["SimRecon/lab_bare"]
    shutil.rmtree(tmp_path / "lab")  # importing asks no place
    simrecon_envs.registration.register_default_scenes()
    assert "SimRecon/lab_bare" in gym.registry
    with pytest.raises(SystemExit) as refused:
        main(["list", "--registry", "s3://key:secret@host/x"])
    assert refused.value.code == 2
    assert "secret" not in capsys.readouterr().err
    for name in ("bare", "room"):
        gym.registry.pop(f"SimRecon/lab_{name}", None)


def test_a_suite_names_what_is_missing_and_pulls_it(suite, place, tmp_path):
    tasks, root = list(suite.tasks), tmp_path / "empty"
    revision = suite.revisions["things"]
    settings = RunSettings(registry=str(root))
    with pytest.raises(UsageError, match=rf"simrecon pull PLACE things@{revision}`, or --fetch-from PLACE"):
        check_revisions(tasks, settings)
    assert fetch_scenes(tasks, place, root, Reporter(quiet=True)) == [f"things@{revision}"]
    assert check_revisions(tasks, settings) == []
    assert fetch_scenes(tasks, tmp_path / "unused", root, Reporter(quiet=True)) == []


def test_a_place_without_the_revision_is_an_error_that_names_both(suite, scenes_root, tmp_path):
    opened = open_place(tmp_path / "place")
    push_scene(SceneRegistry(scenes_root).load("bare"), opened)
    with pytest.raises(UsageError, match=r"1 of 1 missing scenes could not be pulled.*There are: bare"):
        fetch_scenes(list(suite.tasks), opened.url, tmp_path / "empty", Reporter(quiet=True))


def test_another_revision_is_never_replaced_by_fetching(suite, scenes_root, place, tmp_path):
    root = tmp_path / "mine"
    registry = SceneRegistry(root, create=True)
    registry.publish(SceneRegistry(scenes_root).get("bare").path, "things")  # another scene under that id
    mine = registry.get("things").revision
    tasks = list(suite.tasks)
    assert fetch_scenes(tasks, place, root, Reporter(quiet=True)) == []
    with pytest.raises(UsageError, match=r"simrecon pull PLACE things@\w+ --replace`, which replaces yours"):
        check_revisions(tasks, RunSettings(registry=str(root)))
    assert registry.get("things").revision == mine


@pytest.mark.parametrize("by", ["flag", "variable"])
def test_benchmark_run_fetches_from_a_place(by, suite_file, place, tmp_path, monkeypatch, capsys):
    words = ["benchmark", "run", str(suite_file), "--policy", "still", "--episodes", "1", "--json"]
    words += ["--registry", str(tmp_path / "empty"), "--quiet"]
    if by == "flag":
        words += ["--fetch-from", str(place)]
    else:
        monkeypatch.setenv("SIMRECON_SCENES_FROM", str(place))
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out)["all"]["episodes"] > 0
    assert list(SceneRegistry(tmp_path / "empty").revisions()) == ["things"]
