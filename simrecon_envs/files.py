"""Read and atomically write JSON files; collect the package versions that results depend on."""

import hashlib
import json
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from registry import EnvironmentMissing, UsageError
from registry.files import write_whole

_MOST_BYTES = 1 << 30
PACKAGES = ("simrecon", "mani_skill", "sapien", "gymnasium", "torch", "numpy")


def read_json(path: Path, what: str, schema: str) -> dict[str, Any]:
    """Read a JSON object and check its schema.

    Args:
        path: The file.
        what: Name of its content in errors, such as "suite".
        schema: Expected value of its key "schema".

    Raises:
        UsageError: The file is absent, not JSON, or of another schema.
    """
    try:
        with path.open("rb") as stream:
            data = stream.read(_MOST_BYTES + 1)
        if len(data) > _MOST_BYTES:
            raise ValueError(f"it is larger than {_MOST_BYTES >> 20} MB")
        body = json.loads(data.decode("utf-8-sig"), parse_constant=_no_number, object_pairs_hook=_unique)
    except FileNotFoundError:
        raise UsageError(f"{what} {path}: there is no such file") from None
    except OSError as error:
        raise UsageError(f"{what} {path}: cannot be read ({error.strerror})") from error
    except RecursionError:
        raise UsageError(f"{what} {path}: this is no JSON: it is nested too deeply") from None
    except ValueError as error:
        raise UsageError(f"{what} {path}: this is no JSON: {error}") from error
    found = body.get("schema") if isinstance(body, dict) else type(body).__name__
    if found != schema:
        raise UsageError(
            f"{what} {path}: expected the schema {schema!r}, found {str(found)[:80]!r}; if another version of simrecon "
            "wrote it, make it again with this one"
        )
    return body


def _no_number(name: str) -> Any:
    raise ValueError(f"{name} is no number of JSON")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the pairs of a JSON object as a dict. Raises ValueError where a key comes twice."""
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"the key {next(key for key in keys if keys.count(key) > 1)[:80]!r} comes twice")
    return found


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically: through a temporary file that replaces the old one.

    Raises:
        EnvironmentMissing: The folder cannot be written.
    """
    text = json.dumps(value, indent=1, allow_nan=False) + "\n"
    try:
        write_whole(path, text.encode())
    except OSError as error:
        raise EnvironmentMissing(
            f"cannot write {path}: {error.strerror}; make room there, or choose another --out"
        ) from error


def absolute(path: Path | str | None) -> str | None:
    """Return the absolute path, for use in other processes; None stays None."""
    return None if path is None else str(Path(path).expanduser().absolute())


def versions(*more: str) -> dict[str, str]:
    """Return the versions of the packages that episodes depend on, and of `more` packages.

    "source" is a digest of this package's files.
    """
    found = {}
    for package in (*PACKAGES, *more):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "source tree" if package == "simrecon" else "not installed"
    return {**found, "source": _source_digest()}


def _source_digest() -> str:
    """Return a digest of the environments' source, which changes between releases of the same version."""
    root = Path(__file__).resolve().parent
    digest = hashlib.sha256()
    for file in sorted(root.rglob("*.py")):
        parts = file.relative_to(root).parts
        if parts[0] == "training":
            continue  # environments do not depend on learners
        digest.update("/".join(parts).encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]
