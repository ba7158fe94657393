"""JSON files that are written whole or not at all, records of what was done, and versions."""

import hashlib
import json
import os
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from registry import EnvironmentMissing, UsageError

PACKAGES = ("simrecon", "mani_skill", "sapien", "gymnasium", "torch", "numpy")


def read_json(path: Path, what: str) -> Any:
    """Read a JSON file.

    Raises:
        UsageError: it is absent or no JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UsageError(f"{what} {path}: there is no such file") from None
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise UsageError(f"{what} {path}: this is no JSON: {error}") from error


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file in place of the old one.

    Raises:
        EnvironmentMissing: the folder cannot be written.
    """
    partial = path.with_name(f".{path.name}-{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(json.dumps(value, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        os.replace(partial, path)
    except OSError as error:
        raise EnvironmentMissing(f"cannot write {path}: {error.strerror}; choose another --out") from error
    finally:
        partial.unlink(missing_ok=True)


class Records:
    """What was done so far, one file a piece of work, in a folder beside the result; so that a killed run goes on."""

    def __init__(self, out: Path) -> None:
        self.folder = out.with_name(f".{out.name}.records")

    def get(self, key: Any) -> dict | None:
        """Return the record of a piece of work; None where it is absent or was cut off."""
        try:
            return json.loads(self._file(key).read_text(encoding="utf-8"))
        except (FileNotFoundError, json.JSONDecodeError):
            return None

    def put(self, key: Any, record: dict) -> None:
        """Keep a record."""
        write_json(self._file(key), record)

    def clear(self) -> None:
        """Remove all records: the result is written."""
        if self.folder.is_dir():
            for file in self.folder.iterdir():
                file.unlink()
            self.folder.rmdir()

    def _file(self, key: Any) -> Path:
        text = json.dumps(key, sort_keys=True)
        return self.folder / f"{hashlib.sha256(text.encode()).hexdigest()[:24]}.json"


def versions() -> dict[str, str]:
    """Return the versions of what decides how an episode goes; `source` is the digest of this package's files."""
    found = {}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "source tree"
    return {**found, "source": source_digest()}


def source_digest() -> str:
    """Return a digest of the environments' source, which a version does not tell apart between releases."""
    root = Path(__file__).resolve().parent.parent
    digest = hashlib.sha256()
    for file in sorted(root.rglob("*.py")):
        parts = file.relative_to(root).parts
        if parts[0].startswith("training"):
            continue  # learners see environments, not the other way round
        digest.update("/".join(parts).encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]
