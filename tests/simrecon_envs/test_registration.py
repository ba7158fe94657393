"""Importing registers scenes, fast and light; ids and specs behave as Gymnasium wants them."""

import json
import os
import sqlite3
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest
from gymnasium.envs.registration import EnvSpec

import simrecon_envs
from registry import SceneNotFound, SceneRegistry

_IMPORT = """
import sys, time, gymnasium
start = time.process_time()
import simrecon_envs
seconds = time.process_time() - start
ours = [name for name in gymnasium.registry if name.startswith("SimRecon/")]
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


def test_import_of_a_thousand_scenes_is_fast_and_light(tmp_path: Path) -> None:
    root = tmp_path / "registry"
    SceneRegistry(root, create=True)
    with sqlite3.connect(root / "index.sqlite") as connection:
        columns = "scene_id, revision, schema_version, created_utc, source_file, source_sha256, n_objects"
        rows = [
            (f"scene{n:04d}", "0" * 16, "simrecon.scene/1", "2026-01-01T00:00:00+00:00", "v.mp4", "0" * 64, 3)
            for n in range(1000)
        ]
        connection.executemany(f"INSERT INTO scenes ({columns}) VALUES (?, ?, ?, ?, ?, ?, ?)", rows)
    count, seconds, heavy, _ = _import_with(tmp_path)
    assert count == 1000
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


def test_unknown_scene_lists_what_there_is_and_the_nearest(scenes_root: Path) -> None:
    with pytest.raises(SceneNotFound, match=r"Did you mean SimRecon/room\?.*SimRecon/bare, SimRecon/room"):
        simrecon_envs.make("rooms", registry=scenes_root)
    simrecon_envs.register_scenes(scenes_root)
    with pytest.raises(gym.error.NameNotFound, match="Did you mean: `room`"):
        gym.make("SimRecon/rooms")


def test_unknown_scene_of_an_empty_registry_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(SceneNotFound, match="simrecon reconstruct"):
        simrecon_envs.make("scene0001", registry=tmp_path)


def test_public_names_are_there() -> None:
    assert [name for name in simrecon_envs.__all__ if not hasattr(simrecon_envs, name)] == []
