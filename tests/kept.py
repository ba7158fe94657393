"""Keep results of slow fixtures on disk: shared by the processes of a test run, and by later runs of the same code.

Results are made anew when any file of the project's packages or of the test's own folder changes. They lie in
`.pytest_cache/kept`, which may be deleted at any time.
"""

import hashlib
import pickle
import shutil
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from registry.locks import file_lock

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("reconstruction", "registry", "simrecon_envs", "synthetic", "priors", "benchmarks")
T = TypeVar("T")


def kept_folder(make: Callable[[Path], Any]) -> Path:
    """Return a folder that `make(folder)` filled, in this run or an earlier one; tests must not write to it.

    Args:
        make: Function of a test module or conftest. One process at a time calls it; an error leaves nothing behind.
    """
    return _kept(make, *_place(make))


def kept(make: Callable[[], T]) -> T:
    """Return the result of `make()`, pickled in this run or an earlier one; see `kept_folder`."""

    def write(folder: Path) -> None:
        (folder / "result.pkl").write_bytes(pickle.dumps(make(), protocol=5))

    return pickle.loads((_kept(write, *_place(make)) / "result.pkl").read_bytes())


def _place(make: Callable[..., Any]) -> tuple[str, Path]:
    """Return the name of a fixture's function and the folder of its file."""
    file = Path(make.__code__.co_filename).resolve()
    return f"{file.relative_to(ROOT).with_suffix('')}/{make.__name__}".replace("/", "."), file.parent


def _kept(make: Callable[[Path], Any], name: str, tests: Path) -> Path:
    final = ROOT / ".pytest_cache" / "kept" / name / _digest(tests)
    with file_lock(final.parent.parent / f"{name}.lock"):
        if not final.is_dir():
            shutil.rmtree(final.parent, ignore_errors=True)
            part = final.with_suffix(".part")
            part.mkdir(parents=True)
            make(part)
            part.rename(final)
    return final


@lru_cache
def _digest(tests: Path) -> str:
    """Return a digest of all files of the project's packages and of a folder of tests."""
    digest = hashlib.sha256()
    for folder in (*(ROOT / package for package in PACKAGES), tests):
        for file in sorted(
            file for file in folder.rglob("*") if file.is_file() and "__pycache__" not in file.parts
        ):
            digest.update(f"{file.relative_to(folder)}\0".encode())
            digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:16]
