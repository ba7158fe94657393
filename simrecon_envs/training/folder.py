"""A run's folder: its configuration, its checkpoints and its results. Whatever is in it is whole.

config.json              what was asked for, versions, the scene's revision
checkpoints/step_.../    weights and optimizer, statistics of normalization, random states, SAC's memory
tensorboard/             for `tensorboard --logdir`
results.json, video.mp4  the evaluation at the end
"""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from registry import UsageError, default_registry_root
from registry.locks import LockHeld, file_lock
from simrecon_envs.files import read_json

SCHEMA = "simrecon.training/1"
_KEPT = 2  # checkpoints


def runs_root() -> Path:
    """Return where runs are kept unless told otherwise: `runs` beside the default registry."""
    return default_registry_root().parent / "runs"


class RunFolder:
    """The folder of one run."""

    def __init__(self, path: Path | str) -> None:
        """Name a folder; nothing is read or written."""
        self.path = Path(path).expanduser().absolute()

    @classmethod
    def create(cls, path: Path | None, name: str) -> "RunFolder":
        """Make a new folder: `path`, or `name-N` among the runs.

        Raises:
            UsageError: `path` is there and holds something.
        """
        if path is not None:
            folder = cls(path)
            if folder.path.exists() and (not folder.path.is_dir() or any(folder.path.iterdir())):
                hint = ", or go on with it: --resume" if folder.config_file.is_file() else ""
                raise UsageError(f"--out {path}: exists and is not an empty folder; name another one{hint}")
            folder.path.mkdir(parents=True, exist_ok=True)
            return folder
        root, number = runs_root(), 1
        root.mkdir(parents=True, exist_ok=True)
        while True:
            try:
                (root / f"{name}-{number}").mkdir()
                return cls(root / f"{name}-{number}")
            except FileExistsError:
                number += 1

    @classmethod
    def open(cls, path: Path | str) -> "RunFolder":
        """Open a folder that a run wrote.

        Raises:
            UsageError: there is no run in it.
        """
        folder = cls(path)
        if not folder.config_file.is_file():
            raise UsageError(f"{path}: no training run is in there (config.json is missing)")
        return folder

    @classmethod
    def newest(cls, scene: str, task: str, *, usable: bool = False, **other: str) -> "RunFolder | None":
        """Return the last begun of the runs of a scene and a task (or kind of task).

        Args:
            scene: A scene's id.
            task: A task's name, or a kind of task.
            usable: Only of those with a checkpoint.
            **other: What else the configuration has to say, such as algo="ppo", robot="panda".
        """
        found = []
        for path in runs_root().glob("*"):
            with contextlib.suppress(UsageError, KeyError):
                entry = cls(path).read_config()
                config = entry["config"]
                same_task = task in (config["task"], config["task"].split("_")[0])
                same = all(config[key] == value for key, value in {"scene": scene, **other}.items())
                if same_task and same and (cls(path).checkpoints() or not usable):
                    found.append((entry["began"], path))
        return cls(max(found)[1]) if found else None

    @property
    def config_file(self) -> Path:
        """Return what was asked for."""
        return self.path / "config.json"

    @property
    def results_file(self) -> Path:
        """Return what came out; it is there when the run is done."""
        return self.path / "results.json"

    def read_config(self) -> dict[str, Any]:
        """Return what `config.json` holds.

        Raises:
            UsageError: it is damaged, or of another version.
        """
        return read_json(self.config_file, "training run", SCHEMA)

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Keep other processes from training into the same folder.

        Raises:
            UsageError: one does.
        """
        try:
            with file_lock(self.path / ".lock", blocking=False):
                yield
        except LockHeld as error:
            raise UsageError(f"{self.path}: another process trains here ({error.holder})") from error

    # ---- Checkpoints.

    def checkpoints(self) -> list[tuple[int, Path]]:
        """Return (steps, folder) of every whole checkpoint, the oldest first."""
        found = [p for p in (self.path / "checkpoints").glob("step_*") if p.name[5:].isdigit()]
        return sorted((int(path.name[5:]), path) for path in found)

    @contextlib.contextmanager
    def new_checkpoint(self, steps: int) -> Iterator[Path]:
        """Yield a folder to write a checkpoint into; it takes its place when all of it is on the disk."""
        parent = self.path / "checkpoints"
        parent.mkdir(exist_ok=True)
        for left in parent.glob(".writing-*"):  # by somebody who was killed: the folder is held by us
            shutil.rmtree(left)
        partial = parent / f".writing-{steps}"
        partial.mkdir()
        try:
            yield partial
            for file in partial.iterdir():
                with open(file, "rb") as handle:
                    os.fsync(handle.fileno())
            final = parent / f"step_{steps:09d}"
            if final.exists():
                shutil.rmtree(final)
            os.replace(partial, final)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
        for _, old in self.checkpoints()[:-_KEPT]:
            shutil.rmtree(old)
