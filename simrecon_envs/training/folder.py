"""`RunFolder`: configuration, checkpoints and results of a run on disk. All files are written atomically.

config.json              configuration, versions, the scene's revision
checkpoints/step_.../    weights, optimizer, normalization statistics, random states, SAC's replay buffer
tensorboard/             for `tensorboard --logdir`
results.json, video.mp4  final evaluation
"""

import contextlib
import itertools
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from registry import UsageError, default_registry_root
from registry.locks import LockHeld, file_lock
from simrecon_envs.files import read_json

SCHEMA = "simrecon.training/1"
_KEPT = 2  # latest checkpoints; older ones are deleted


def runs_root() -> Path:
    """Return the default folder of runs: `runs` beside the default registry."""
    return default_registry_root().parent / "runs"


class RunFolder:
    """The folder of one run."""

    def __init__(self, path: Path | str) -> None:
        """Refer to a folder; nothing is read or written."""
        self.path = Path(path).expanduser().absolute()

    @classmethod
    def create(cls, path: Path | None, name: str) -> "RunFolder":
        """Create a folder: `path`, or the first free `name-N` in `runs_root()`.

        Raises:
            UsageError: `path` exists and is not an empty folder.
        """
        if path is not None:
            folder = cls(path)
            if folder.path.exists() and (not folder.path.is_dir() or any(folder.path.iterdir())):
                hint = ", or continue it with --resume" if folder.config_file.is_file() else ""
                raise UsageError(f"--out {path}: exists and is not an empty folder; name another one{hint}")
            folder.path.mkdir(parents=True, exist_ok=True)
            return folder
        runs_root().mkdir(parents=True, exist_ok=True)
        for number in itertools.count(1):
            folder = cls(runs_root() / f"{name}-{number}")
            with contextlib.suppress(FileExistsError):
                folder.path.mkdir()
                return folder
        raise AssertionError  # the numbers do not end

    @classmethod
    def open(cls, path: Path | str) -> "RunFolder":
        """Open the folder of an existing run.

        Raises:
            UsageError: the folder has no run.
        """
        folder = cls(path)
        if not folder.config_file.is_file():
            raise UsageError(f"{path}: there is no training run in this folder (config.json is missing)")
        return folder

    @classmethod
    def newest(cls, scene: str, task: str, *, usable: bool = False, **other: str) -> "RunFolder | None":
        """Return the latest run of a scene and a task in `runs_root()`; None where there is none.

        Args:
            scene: A scene's id.
            task: A task's name, or a kind of task.
            usable: Only runs with a checkpoint.
            **other: Other required values of the configuration, such as algo="ppo", robot="panda".
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
        """Return the configuration file."""
        return self.path / "config.json"

    @property
    def results_file(self) -> Path:
        """Return the results file; it exists when the run is done."""
        return self.path / "results.json"

    def read_config(self) -> dict[str, Any]:
        """Return the content of `config.json`.

        Raises:
            UsageError: the file is damaged, or of another schema version.
        """
        return read_json(self.config_file, "training run", SCHEMA)

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Lock the folder against other training processes.

        Raises:
            UsageError: another process holds the lock.
        """
        try:
            with file_lock(self.path / ".lock", blocking=False):
                yield
        except LockHeld as error:
            raise UsageError(f"{self.path}: another process trains here ({error.holder})") from error

    # ---- Checkpoints.

    def checkpoints(self) -> list[tuple[int, Path]]:
        """Return (steps, folder) of every complete checkpoint, the oldest first."""
        found = [p for p in (self.path / "checkpoints").glob("step_*") if p.name[5:].isdigit()]
        return sorted((int(path.name[5:]), path) for path in found)

    @contextlib.contextmanager
    def new_checkpoint(self, steps: int) -> Iterator[Path]:
        """Yield a temporary folder for a checkpoint; synchronize and rename it at the end; delete old checkpoints."""
        parent = self.path / "checkpoints"
        parent.mkdir(exist_ok=True)
        for left in parent.glob(".writing-*"):  # of a process that was killed; we hold the lock
            shutil.rmtree(left)
        partial = parent / f".writing-{steps}"
        partial.mkdir()
        try:
            yield partial
            for file in partial.iterdir():
                with file.open("rb") as handle:
                    os.fsync(handle.fileno())
            final = parent / f"step_{steps:09d}"
            if final.exists():
                shutil.rmtree(final)
            partial.replace(final)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
        for _, old in self.checkpoints()[:-_KEPT]:
            shutil.rmtree(old)
