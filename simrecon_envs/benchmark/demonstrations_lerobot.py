"""Write demonstrations as a LeRobot dataset, format v3.0: Parquet, JSON and, for images, MP4.

    data/chunk-000/file-000.parquet            one row per frame
    meta/info.json, stats.json, tasks.parquet  features, their statistics, instructions
    meta/episodes/chunk-000/file-000.parquet   one row per episode: position, statistics
    videos/KEY/chunk-000/file-NNN.mp4          one per episode and camera

`observation.state` holds joint positions, `observation.environment_state` the rest of the state (hand, goal, objects).
The length of the latter depends on the task; it is written only if all tasks have the same.
"""

import contextlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from registry import EnvironmentMissing, UsageError
from simrecon_envs.benchmark.demonstration import Demonstration
from simrecon_envs.files import write_json
from simrecon_envs.rollout import open_video

VERSION = "v3.0"
_CHUNK = 1000  # files per folder
_EPISODES_A_FILE = 500
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_OUTCOMES = {"reward": "float32", "success": "bool", "done": "bool"}
_COUNTERS = {"timestamp": "float32", "frame_index": "int64", "episode_index": "int64", "index": "int64",
             "task_index": "int64"}  # fmt: skip


def need_pyarrow() -> Any:
    """Import and return pyarrow.

    Raises:
        EnvironmentMissing: it is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise EnvironmentMissing(
            "a LeRobot dataset needs pyarrow, which is not installed: pip install 'simrecon[lerobot]'"
        ) from error
    return pyarrow


def check_folder(folder: Path) -> None:
    """Check that a folder is absent or empty.

    Raises:
        UsageError: it is not.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder} exists and is not empty; choose another folder for the dataset")


class LeRobotWriter:
    """Writes the dataset of one robot: videos with `add`, everything else with `close`."""

    def __init__(self, folder: Path, first: Demonstration) -> None:
        """Take the features from the first demonstration (which is not added)."""
        self._folder = folder
        self._robot, self._fps = first.robot, first.fps
        self._joints, self._actions = first.joint_names, first.actions.shape[1]
        self._pictures = {name: picture.shape for name, picture in _pictures(first.observations[0]).items()}
        self._tasks: dict[str, int] = {}
        self._episodes: list[dict[str, Any]] = []
        self._columns: list[dict[str, np.ndarray]] = []
        self._stats: list[dict[str, dict[str, np.ndarray]]] = []
        self._frames = 0

    def add(self, demonstration: Demonstration) -> None:
        """Add an episode.

        Raises:
            UsageError: its joints or cameras differ from the first demonstration's.
        """
        shapes = {name: p.shape for name, p in _pictures(demonstration.observations[0]).items()}
        if (demonstration.joint_names, shapes) != (self._joints, self._pictures):
            raise UsageError(
                f"{demonstration.task}: its joints or cameras are not those of the dataset's first task"
            )
        number, count = len(self._episodes), len(demonstration.actions)
        task = self._tasks.setdefault(demonstration.instruction, len(self._tasks))
        columns = _columns(demonstration, number, self._frames, task)
        stats = {key: _statistics(values) for key, values in columns.items()}
        row: dict[str, Any] = {
            "episode_index": number,
            "tasks": [demonstration.instruction],
            "length": count,
            "data/chunk_index": number // _EPISODES_A_FILE // _CHUNK,
            "data/file_index": number // _EPISODES_A_FILE % _CHUNK,
            "dataset_from_index": self._frames,
            "dataset_to_index": self._frames + count,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
            "simrecon_task": demonstration.task,
            "simrecon_seed": demonstration.seed,
        }
        for name in self._pictures:
            frames = np.stack([_pictures(obs)[name] for obs in demonstration.observations])
            row |= self._write_video(name, number, frames)
            stats[name] = _picture_statistics(frames)
        self._frames += count
        self._episodes.append(row)
        self._columns.append(columns)
        self._stats.append(stats)

    def close(self) -> Path:
        """Write tables and metadata; return the folder."""
        pa = need_pyarrow()
        keys = [
            key for key in self._columns[0] if len({_width(columns, key) for columns in self._columns}) == 1
        ]
        features = self._features(keys)
        for first in range(0, len(self._columns), _EPISODES_A_FILE):
            part = self._columns[first : first + _EPISODES_A_FILE]
            number = first // _EPISODES_A_FILE
            arrays = {
                key: _arrow(pa, np.concatenate([columns[key] for columns in part]), features[key])
                for key in keys
            }
            self._write_table(pa, pa.table(arrays), _file("data", number))
        tasks = pa.table({"task_index": pa.array(list(self._tasks.values()), pa.int64()),
                          "__index_level_0__": pa.array(list(self._tasks))})  # fmt: skip
        self._write_table(pa, _with_index(tasks), "meta/tasks.parquet")
        self._write_table(pa, self._episode_table(pa, features), _file("meta/episodes", 0))
        write_json(self._folder / "meta/stats.json", _plain(self._whole_statistics(features)))
        write_json(self._folder / "meta/info.json", self._info(features))
        return self._folder

    def _features(self, keys: list[str]) -> dict[str, dict[str, Any]]:
        features: dict[str, dict[str, Any]] = {
            "action": _feature("float32", [self._actions], _numbered("action", self._actions)),
            "observation.state": _feature("float32", [len(self._joints)], list(self._joints)),
        }
        if "observation.environment_state" in keys:
            width = _width(self._columns[0], "observation.environment_state")
            features["observation.environment_state"] = _feature(
                "float32", [width], _numbered("value", width)
            )
        features |= {f"next.{key}": _feature(dtype) for key, dtype in _OUTCOMES.items()}
        for name, shape in self._pictures.items():
            height, width, channels = shape
            features[name] = _feature("video", shape, ["height", "width", "channels"]) | {
                "info": {
                    "video.height": height,
                    "video.width": width,
                    "video.channels": channels,
                    "video.codec": "h264",
                    "video.pix_fmt": "yuv420p",
                    "video.is_depth_map": False,
                    "video.fps": self._fps,
                    "has_audio": False,
                }
            }
        return features | {key: _feature(dtype) for key, dtype in _COUNTERS.items()}

    def _info(self, features: dict[str, dict[str, Any]]) -> dict[str, Any]:
        return {
            "codebase_version": VERSION,
            "robot_type": self._robot,
            "total_episodes": len(self._episodes),
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": _CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self._fps,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
            if self._pictures
            else None,
            "features": features,
        }

    def _write_video(self, name: str, episode: int, frames: np.ndarray) -> dict[str, Any]:
        chunk, file = divmod(episode, _CHUNK)
        with open_video(
            self._folder / f"videos/{name}/chunk-{chunk:03d}/file-{file:03d}.mp4", self._fps
        ) as add:
            for frame in frames:
                add(frame)
        where = f"videos/{name}"
        return {f"{where}/chunk_index": chunk, f"{where}/file_index": file, f"{where}/from_timestamp": 0.0,
                f"{where}/to_timestamp": len(frames) / self._fps}  # fmt: skip

    def _episode_table(self, pa: Any, features: dict) -> Any:
        rows = []
        for row, stats in zip(self._episodes, self._stats, strict=True):
            flat = {f"stats/{key}/{name}": value.tolist() for key in stats if key in features
                    for name, value in stats[key].items()}  # fmt: skip
            rows.append({**row, **flat})
        return pa.Table.from_pylist(rows)

    def _whole_statistics(self, features: dict) -> dict[str, dict[str, np.ndarray]]:
        out = {}
        for key in features:
            if key in self._columns[0]:
                out[key] = _statistics(np.concatenate([columns[key] for columns in self._columns]))
            else:
                out[key] = _merged([stats[key] for stats in self._stats])
        return out

    def _write_table(self, pa: Any, table: Any, name: str) -> None:
        path = self._folder / name
        partial = path.with_name(f".{path.name}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            pa.parquet.write_table(table, partial, compression="snappy")
            partial.replace(path)
        except OSError as error:
            raise EnvironmentMissing(f"cannot write {path}: {error.strerror or error}") from error
        finally:
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)


def _columns(demonstration: Demonstration, episode: int, first: int, task: int) -> dict[str, np.ndarray]:
    count = len(demonstration.actions)
    observations = demonstration.observations
    columns = {
        "action": demonstration.actions,
        "observation.state": np.stack([np.float32(obs["agent"]["qpos"]) for obs in observations]),
    }
    beside = [_flat({k: v for k, v in obs.items() if k in ("agent", "extra")}) for obs in observations]
    if beside[0].size:
        columns["observation.environment_state"] = np.stack(beside)
    number = np.arange(count)
    done = np.zeros(count, bool)
    done[-1] = True
    return columns | {
        "next.reward": demonstration.rewards,
        "next.success": demonstration.success,
        "next.done": done,
        "timestamp": np.float32(number / demonstration.fps),
        "frame_index": number.astype(np.int64),
        "episode_index": np.full(count, episode, np.int64),
        "index": (first + number).astype(np.int64),
        "task_index": np.full(count, task, np.int64),
    }


def _flat(obs: dict[str, Any], name: str = "") -> np.ndarray:
    """Return all values except joint positions as one vector."""
    parts = []
    for key, value in obs.items():
        path = f"{name}/{key}"
        if isinstance(value, dict):
            parts.append(_flat(value, path))
        elif path != "/agent/qpos":
            parts.append(np.float32(value).ravel())
    return np.concatenate(parts) if parts else np.zeros(0, np.float32)


def _pictures(obs: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return {feature name: RGB image uint8 (h, w, 3)}."""
    cameras = obs.get("sensor_data", {})
    return {f"observation.images.{name}": data["rgb"] for name, data in cameras.items() if "rgb" in data}


def _statistics(values: np.ndarray) -> dict[str, np.ndarray]:
    """Return the statistics of a feature over its rows, per component."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    out = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0),
           "count": np.array([len(rows)])}  # fmt: skip
    return out | {name: np.quantile(rows, share, axis=0) for name, share in _QUANTILES.items()}


def _picture_statistics(frames: np.ndarray) -> dict[str, np.ndarray]:
    """Return statistics per channel (3, 1, 1), over every 16th pixel, values in [0, 1]."""
    values = frames[:, ::4, ::4].reshape(-1, 3) / 255.0
    out = {name: value.reshape(3, 1, 1) for name, value in _statistics(values).items() if name != "count"}
    return out | {"count": np.array([len(frames)])}


def _merged(stats: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Merge the episodes' statistics, weighted by length; quantiles are averaged."""
    counts = np.array([one["count"][0] for one in stats], np.float64)

    def mean_of(values: list[np.ndarray]) -> np.ndarray:
        return np.average(np.stack(values), axis=0, weights=counts)

    mean = mean_of([one["mean"] for one in stats])
    spread = mean_of([one["std"] ** 2 + (one["mean"] - mean) ** 2 for one in stats])
    out = {"min": np.min([one["min"] for one in stats], axis=0), "max": np.max([one["max"] for one in stats], axis=0),
           "mean": mean, "std": np.sqrt(spread), "count": np.array([int(counts.sum())])}  # fmt: skip
    return out | {name: mean_of([one[name] for one in stats]) for name in _QUANTILES}


def _width(columns: dict[str, np.ndarray], key: str) -> int:
    return columns[key].reshape(len(columns[key]), -1).shape[1] if key in columns else 0


def _arrow(pa: Any, values: np.ndarray, feature: dict[str, Any]) -> Any:
    if feature["shape"] == [1]:
        return pa.array(values)
    flat = pa.array(np.ascontiguousarray(values, np.float32).ravel())
    return pa.FixedSizeListArray.from_arrays(flat, feature["shape"][0])


def _with_index(table: Any) -> Any:
    """Declare the texts as the index of a pandas data frame, as LeRobot expects for tasks."""
    column = {"name": None, "field_name": "__index_level_0__", "pandas_type": "unicode", "numpy_type": "object",
              "metadata": None}  # fmt: skip
    task = {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64",
            "metadata": None}  # fmt: skip
    pandas = {"index_columns": ["__index_level_0__"], "column_indexes": [], "columns": [task, column],
              "pandas_version": "2.0.0"}  # fmt: skip
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})


def _plain(stats: dict[str, dict[str, np.ndarray]]) -> dict[str, dict[str, list]]:
    return {key: {name: value.tolist() for name, value in one.items()} for key, one in stats.items()}


def _feature(dtype: str, shape: Sequence[int] = (1,), names: list[str] | None = None) -> dict[str, Any]:
    return {"dtype": dtype, "shape": list(shape), "names": names}


def _numbered(name: str, count: int) -> list[str]:
    return [f"{name}_{number}" for number in range(count)]


def _file(folder: str, number: int) -> str:
    return f"{folder}/chunk-{number // _CHUNK:03d}/file-{number % _CHUNK:03d}.parquet"
