"""Demonstrations: ManiSkill's tools read and replay them; LeRobot datasets have all fields of the format."""

import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import simrecon_envs
from reconstruction.cli import main
from registry import EnvironmentMissing
from simrecon_envs.benchmark import demonstrations_lerobot
from simrecon_envs.benchmark.demonstrations import record_demonstrations
from simrecon_envs.benchmark.suite import Suite

# Columns and files of format 3.0 that LeRobot's reader (0.4.4) requires.
NUMBERS = ("frame_index", "episode_index", "index", "task_index")
TYPES = {"float32": "float", "int64": "int64", "bool": "bool"}
STATISTICS = {"min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"}


@pytest.fixture(scope="module")
def written(suite: Suite, scenes_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the suite's demonstrations in both formats."""
    folder = tmp_path_factory.mktemp("demos")
    suite.save(folder / "suite.json")
    found = record_demonstrations(suite, list(suite.tasks), maniskill=folder / "maniskill", lerobot=folder / "lerobot",
                                  registry=scenes_root)  # fmt: skip
    assert (found["tasks"], found["episodes"], found["failed"]) == (3, 6, [])
    assert found["steps"] == sum(run.steps for task in suite.tasks for run in task.oracle)
    return folder


def test_maniskill_reads_the_trajectories_and_they_replay(
    suite: Suite, written: Path, scenes_root: Path
) -> None:
    from mani_skill.trajectory.dataset import ManiSkillTrajectoryDataset
    from mani_skill.trajectory.utils import dict_to_list_of_dicts

    task = next(task for task in suite.tasks if task.kind == "pick")
    file = written / "maniskill" / task.name / "trajectory.h5"
    data = ManiSkillTrajectoryDataset(str(file))
    assert len(data) == sum(run.steps for run in task.oracle)
    assert data.success.sum() == 2
    assert data[0]["action"].shape == (7,)
    assert str(scenes_root) not in file.with_suffix(".json").read_text()
    simrecon_envs.register_scenes(scenes_root)
    env = gym.make(data.env_id, **data.env_kwargs)  # as ManiSkill's replay_trajectory does
    for episode in data.episodes:
        trajectory = data.data[f"traj_{episode['episode_id']}"]
        env.reset(**episode["reset_kwargs"])
        for action in trajectory["actions"][:]:
            *_, info = env.step(action)
        assert bool(info["success"])
        last = dict_to_list_of_dicts(trajectory["env_states"])[-1]
        now = env.unwrapped.get_state_dict()
        for name, state in last["actors"].items():
            np.testing.assert_array_equal(now["actors"][name][0].numpy(), state)
    env.close()


def test_the_lerobot_dataset_has_the_fields_of_its_format(suite: Suite, written: Path) -> None:
    import pyarrow.parquet as pq

    folder = written / "lerobot" / "panda"
    info = json.loads((folder / "meta/info.json").read_text())
    frames = sum(run.steps for task in suite.tasks for run in task.oracle)
    assert (info["codebase_version"], info["robot_type"], info["fps"]) == ("v3.0", "panda", 20)
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (6, frames, 3)
    assert (info["splits"], info["video_path"]) == ({"train": "0:6"}, None)
    data = pq.read_table(folder / info["data_path"].format(chunk_index=0, file_index=0))
    assert set(data.column_names) == set(info["features"])
    for name, feature in info["features"].items():
        kind = data.schema.field(name).type
        if feature["shape"] != [1]:
            assert str(kind).startswith("fixed_size_list<")
            assert str(kind).endswith(f"[{feature['shape'][0]}]")
            assert len(feature["names"]) == feature["shape"][0]
        else:
            assert str(kind) == TYPES[feature["dtype"]]
            assert (feature["dtype"] == "int64") == (name in NUMBERS)
    assert data["index"].to_pylist() == list(range(frames))
    tasks = pq.read_table(folder / "meta/tasks.parquet")
    assert set(tasks["__index_level_0__"].to_pylist()) == {task.instruction for task in suite.tasks}
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["__index_level_0__"]
    stats = json.loads((folder / "meta/stats.json").read_text())
    assert set(stats) == set(info["features"])
    assert all(set(one) == STATISTICS for one in stats.values())
    actions = np.array(data["action"].to_pylist())
    np.testing.assert_allclose(stats["action"]["mean"], actions.mean(0), atol=1e-6)
    rows = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    first = 0
    for number, row in enumerate(rows):
        assert (row["episode_index"], row["dataset_from_index"]) == (number, first)
        first = row["dataset_to_index"]
        mine = data.slice(row["dataset_from_index"], row["length"])
        assert set(mine["episode_index"].to_pylist()) == {number}
        assert row["tasks"] == [tasks["__index_level_0__"][mine["task_index"][0].as_py()].as_py()]
        assert (
            mine["next.success"].to_pylist()
            == mine["next.done"].to_pylist()
            == [False] * (row["length"] - 1) + [True]
        )
        np.testing.assert_allclose(mine["timestamp"].to_numpy(), np.arange(row["length"]) / 20, atol=1e-6)
        assert row["stats/action/count"] == [row["length"]]
    assert first == frames


def test_what_is_there_is_not_overwritten(
    written: Path, scenes_root: Path, capsys: pytest.CaptureFixture
) -> None:
    common = ["benchmark", "demos", str(written / "suite.json"), "--registry", str(scenes_root), "--quiet"]
    for flag, folder in (("--lerobot", "lerobot"), ("--maniskill", "maniskill")):
        assert main([*common, flag, str(written / folder)]) == 2
        assert "choose another folder" in capsys.readouterr().err


def test_a_missing_pyarrow_is_one_error_that_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "pyarrow", None)  # makes the import fail
    with pytest.raises(EnvironmentMissing, match=r"pip install 'simrecon\[lerobot\]'"):
        demonstrations_lerobot.need_pyarrow()


@pytest.mark.render
@pytest.mark.end_to_end
def test_pictures_become_videos(suite: Suite, scenes_root: Path, tmp_path: Path) -> None:
    import av
    import pyarrow.parquet as pq

    tasks = suite.select(kinds=["reach"])[:1]
    record_demonstrations(
        suite, tasks, lerobot=tmp_path / "set", obs_mode="rgb", episodes=1, registry=scenes_root
    )
    folder = tmp_path / "set" / "panda"
    info = json.loads((folder / "meta/info.json").read_text())
    feature = info["features"]["observation.images.base_camera"]
    row = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()[0]
    video = folder / info["video_path"].format(
        video_key="observation.images.base_camera",
        chunk_index=row["videos/observation.images.base_camera/chunk_index"],
        file_index=row["videos/observation.images.base_camera/file_index"],
    )
    with av.open(str(video)) as container:
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(pictures) == row["length"] == tasks[0].oracle[0].steps
    assert list(pictures[0].shape) == feature["shape"]
    assert pictures[0].std() > 5
