"""Importing registers scenes without heavy imports; ids and specs conform to Gymnasium."""

import copy
import dataclasses
import json
import os
import pickle
import sqlite3
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest
from gymnasium.envs.registration import EnvSpec

import simrecon_envs
from registry import SceneNotFound, SceneRegistry, UsageError

_IMPORT = """
import sys, time, gymnasium
start = time.process_time()
import simrecon_envs
seconds = time.process_time() - start
ours = [name for name in gymnasium.registry if name.startswith("SimRecon/") and "-v" not in name]
unwanted = ("torch", "sapien", "mani_skill", "numba", "pandas", "scipy", "cv2", "reconstruction")
heavy = [name for name in unwanted if name in sys.modules]
print(len(ours), seconds, heavy)
"""


def _import_with(home: Path) -> tuple[int, float, str, str]:
    run = subprocess.run(
        [sys.executable, "-c", _IMPORT],
        env={**os.environ, "SIMRECON_HOME": str(home)},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    count, seconds, heavy = run.stdout.split(maxsplit=2)
    return int(count), float(seconds), heavy.strip(), run.stderr


def test_import_of_ten_thousand_scenes_is_fast_and_light(tmp_path: Path) -> None:
    root = tmp_path / "registry"
    SceneRegistry(root, create=True)
    with sqlite3.connect(root / "index.sqlite") as connection:
        columns = "scene_id, revision, schema_version, created_utc, source_file, source_sha256, n_objects"
        rows = [
            (f"scene{n:05d}", "0" * 16, "simrecon.scene/1", "2026-01-01T00:00:00+00:00", "v.mp4", "0" * 64, 3)
            for n in range(10_000)
        ]
        connection.executemany(f"INSERT INTO scenes ({columns}) VALUES (?, ?, ?, ?, ?, ?, ?)", rows)
    count, seconds, heavy, _ = _import_with(tmp_path)
    assert count == 10_000
    assert heavy == "[]"
    assert seconds < 0.3


def test_import_with_a_missing_registry_is_silent(tmp_path: Path) -> None:
    count, _, _, errors = _import_with(tmp_path / "nowhere")
    assert (count, errors) == (0, "")
    assert not (tmp_path / "nowhere").exists()


def test_import_with_a_damaged_registry_warns(tmp_path: Path) -> None:
    (tmp_path / "registry").mkdir()
    (tmp_path / "registry" / "index.sqlite").write_bytes(b"garbage" * 1000)
    count, _, _, errors = _import_with(tmp_path)
    assert count == 0
    assert "no scene was registered" in errors
    assert "damaged" in errors


def test_registering_again_picks_up_new_scenes_and_drops_removed_ones(
    scenes_root: Path, tmp_path: Path
) -> None:
    registry = SceneRegistry(tmp_path, create=True)
    bundle = SceneRegistry(scenes_root).get("bare").path
    registry.publish(bundle, "first")
    assert simrecon_envs.register_scenes(tmp_path) == ["SimRecon/first"]
    assert simrecon_envs.register_scenes(tmp_path) == ["SimRecon/first"]
    registry.publish(bundle, "second")
    registry.remove("first")
    assert simrecon_envs.register_scenes(tmp_path) == ["SimRecon/second"]
    assert "SimRecon/first" not in gym.registry
    assert "SimRecon/second" in gym.registry


def test_dropping_scenes_leaves_other_registries_alone(scenes_root: Path, tmp_path: Path) -> None:
    simrecon_envs.register_scenes(scenes_root)
    assert simrecon_envs.register_scenes(tmp_path / "empty") == []
    assert "SimRecon/room" in gym.registry


def test_spec_round_trips_through_json(scenes_root: Path) -> None:
    simrecon_envs.register_scenes(scenes_root)
    spec = gym.spec("SimRecon/room")
    assert spec.version is None
    text = spec.to_json()
    assert EnvSpec.from_json(text) == spec
    assert set(json.loads(text)["kwargs"]) == {"scene_id", "revision", "registry"}


def test_specs_of_scenes_are_those_that_gymnasium_would_make(scenes_root: Path) -> None:
    simrecon_envs.register_scenes(scenes_root)
    spec = gym.registry["SimRecon/room"]
    made = EnvSpec(
        id="SimRecon/room",
        entry_point="simrecon_envs.entry:SceneEnv",
        max_episode_steps=200,
        disable_env_checker=True,
        kwargs={
            "scene_id": "room",
            "revision": SceneRegistry(scenes_root).get("room").revision,
            "registry": str(scenes_root),
        },
        additional_wrappers=spec.additional_wrappers,
    )
    assert {field.name: getattr(spec, field.name) for field in dataclasses.fields(EnvSpec)} == vars(made)
    assert spec == made
    assert made == spec
    assert spec != dataclasses.replace(made, max_episode_steps=7)
    assert dataclasses.asdict(spec) == dataclasses.asdict(made)
    assert "id=SimRecon/room" in spec.pprint(disable_print=True)
    for copied in (copy.copy(spec), copy.deepcopy(spec), pickle.loads(pickle.dumps(spec))):
        assert type(copied) is EnvSpec
        assert copied == made
    changed = dataclasses.replace(spec, max_episode_steps=7)
    assert (changed.max_episode_steps, spec.max_episode_steps) == (7, 200)
    copied = copy.deepcopy(spec)
    copied.kwargs["task"] = "pick_box"
    assert spec == made
    spec.kwargs["seed"] = 3  # as of any entry of Gymnasium's registry, a change stays
    assert copy.deepcopy(gym.spec("SimRecon/room")).kwargs["seed"] == 3
    simrecon_envs.register_scenes(scenes_root)
    assert gym.spec("SimRecon/room") == made


def test_unknown_scene_lists_what_there_is_and_the_nearest(scenes_root: Path) -> None:
    expected = r"Did you mean 'SimRecon/room'\?.*SimRecon/bare, .*SimRecon/room, .*SimRecon/things"
    with pytest.raises(SceneNotFound, match=r"\?.*SimRecon/bare, SimRecon/room, .*SimRecon/things"):
        simrecon_envs.make("rooms", registry=scenes_root)
    simrecon_envs.register_scenes(scenes_root)
    for make in (gym.make, gym.spec, gym.make_vec):
        with pytest.raises(gym.error.NameNotFound, match=expected):
            make("SimRecon/rooms")


def test_ids_outside_our_namespace_are_gymnasiums(scenes_root: Path) -> None:
    assert gym.spec("CartPole-v1").id == "CartPole-v1"
    with pytest.raises(gym.error.NameNotFound, match="CartPoleX") as caught:
        gym.make("CartPoleX-v1")
    assert "SimRecon" not in str(caught.value)


def test_task_ids_are_found_without_being_listed(scenes_root: Path) -> None:
    simrecon_envs.register_scenes(scenes_root)
    spec = gym.spec("SimRecon/room-pick_box-v0")
    assert spec.kwargs["task"] == "pick_box"
    assert EnvSpec.from_json(spec.to_json()) == spec
    assert gym.spec("SimRecon/room-reach_box-v0").max_episode_steps == 100
    assert "SimRecon/room-pick_box-v0" not in gym.registry
    env = gym.make(spec)
    assert env.unwrapped.instruction == "Pick up the box."
    env.close()
    with pytest.raises(SceneNotFound, match="version of tasks is 0"):
        gym.make("SimRecon/room-pick_box-v3")
    with pytest.raises(UsageError, match=r"no task 'pick_bix'. Did you mean 'pick_box'.*Kinds: reach, pick"):
        gym.make("SimRecon/room-pick_bix-v0")


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("room-reach_box-v0", "reach_box SimRecon/room-reach_box-v0"),
        (
            "room-reach_box-v3",
            "EnvNotFound SimRecon/room-reach_box-v3 does not exist: the version of tasks is 0",
        ),
        (
            "roam",
            "EnvNotFound SimRecon/roam does not exist among the registered scenes. Did you mean 'SimRecon/room'?",
        ),
    ],
)
def test_gymnasium_imports_the_package_for_an_id(
    name: str, told: str, scenes_root: Path, tmp_path: Path
) -> None:
    (tmp_path / "registry").symlink_to(scenes_root)
    code = f"""
import gymnasium
try:
    env = gymnasium.make("simrecon_envs:SimRecon/{name}")
    print(env.unwrapped.task, env.spec.id)
except gymnasium.error.Error as error:
    print(type(error).__name__, error)
"""
    environment = {**os.environ, "SIMRECON_HOME": str(tmp_path)}
    run = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120
    )
    assert run.stdout.startswith(told), run.stderr


def test_scenes_are_filtered(scenes_root: Path) -> None:
    def found(*args: object, **kwargs: object) -> list[str]:
        return [r.scene_id for r in simrecon_envs.list_scenes(*args, registry=scenes_root, **kwargs)]

    assert found() == ["bare", "room", "things"]
    assert found("?oo*") == ["room"]
    assert found(min_movable=1) == ["room", "things"]
    assert found(max_objects=1) == ["bare"]
    assert found(labels=["Crate", "cup"]) == ["things"]
    assert found(status="unchecked") == found()
    assert found(where=lambda record: record.n_objects == 6) == ["room", "things"]
    with pytest.raises(UsageError, match="stable, unstable"):
        found(status="good")


def test_unknown_scene_of_an_empty_registry_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(SceneNotFound, match="simrecon reconstruct"):
        simrecon_envs.make("scene0001", registry=tmp_path)


def test_public_names_are_there() -> None:
    assert [name for name in simrecon_envs.__all__ if not hasattr(simrecon_envs, name)] == []
