# pyright: strict
"""Index of the registry: a SQLite file with one row per scene. All SQL is here and in `registry.migrations`.

A connection lives for one operation (opening takes well below a millisecond): none is shared by threads or inherited
by a fork. The index is a cache; all of its content can be rebuilt from the bundles.
"""

import contextlib
import datetime
import json
import sqlite3
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from registry import migrations
from registry.errors import BundleError, EnvironmentMissing
from registry.locks import file_lock

_BUSY_TIMEOUT_S = 60.0  # SQLite waits for another writer up to this
_COLUMNS = (
    "scene_id, revision, schema_version, created_utc, source_file, source_sha256, n_objects, status, metrics"
)


@dataclass(frozen=True)
class SceneRow:
    """A row of the index; the fields are the columns, in order. `SceneRecord` adds the path."""

    scene_id: str
    revision: str
    schema_version: str
    created_utc: str  # ISO 8601, seconds, with offset
    source_file: str
    source_sha256: str
    n_objects: int
    status: str  # "stable" | "unstable" | "unchecked"
    metrics: dict[str, Any]  # JSON values


def utc_text(timestamp: float | None = None) -> str:
    """Format a POSIX timestamp (seconds; None for now) as ISO 8601 UTC with a resolution of one second."""
    now = datetime.datetime.now(datetime.timezone.utc)
    moment = now if timestamp is None else datetime.datetime.fromtimestamp(timestamp, datetime.timezone.utc)
    return moment.isoformat(timespec="seconds")


class Index:
    """`<registry>/index.sqlite`. An absent index reads as empty and is created by the first write."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def exists(self) -> bool:
        """Return whether the index file exists."""
        return self.path.is_file()

    def rows(self) -> list[SceneRow]:
        """Return all rows, ordered by scene id."""
        if not self.exists():
            return []
        with self._reading() as connection:
            query = f"SELECT {_COLUMNS} FROM scenes ORDER BY scene_id"
            return [_row(values) for values in connection.execute(query)]

    def revisions(self) -> dict[str, str]:
        """Return {scene id: current revision}, ordered by scene id; reads only these two columns."""
        if not self.exists():
            return {}
        with self._reading() as connection:
            return dict(connection.execute("SELECT scene_id, revision FROM scenes ORDER BY scene_id"))

    def row(self, scene_id: str) -> SceneRow | None:
        """Return the row of a scene, or None."""
        if not self.exists():
            return None
        with self._reading() as connection:
            query = f"SELECT {_COLUMNS} FROM scenes WHERE scene_id = ?"
            found = connection.execute(query, (scene_id,)).fetchone()
            return None if found is None else _row(found)

    def put(self, *rows: SceneRow) -> None:
        """Insert or replace the rows of scenes in one transaction."""
        with self.writing() as connection, atomic(connection):
            connection.executemany(
                f"INSERT OR REPLACE INTO scenes ({_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
                [_values(row) for row in rows],
            )

    def delete(self, scene_id: str) -> None:
        """Delete the row of a scene."""
        with self.writing() as connection, atomic(connection):
            connection.execute("DELETE FROM scenes WHERE scene_id = ?", (scene_id,))

    def create(self) -> None:
        """Create the index if it is absent and apply pending migrations."""
        with self.writing():
            pass

    def replace_all(self, rows: list[SceneRow]) -> None:
        """Replace the whole content; an index that cannot be read is renamed to `index.damaged-TIME.sqlite` first."""
        try:
            with self.writing() as connection, atomic(connection):
                connection.execute("DELETE FROM scenes")
        except BundleError:
            stamp = utc_text().replace(":", "").replace("+0000", "Z")
            for suffix in ("", "-wal", "-shm"):
                part = self.path.with_name(self.path.name + suffix)
                if part.exists():
                    name = f"{self.path.stem}.damaged-{stamp}{self.path.suffix}{suffix}"
                    part.replace(self.path.with_name(name))
        self.put(*rows)

    @contextlib.contextmanager
    def writing(self) -> Generator[sqlite3.Connection, None, None]:
        """Open the index for writing, under a lock file: create it, switch it to WAL mode and migrate it.

        The lock file is necessary because SQLite's busy handler covers neither the switch to WAL nor the last close.
        """
        with self._translated("write"), file_lock(self.path.parent / "locks" / ".index.lock"):
            connection = self._connect(f"{self.path.absolute().as_uri()}?mode=rwc")
            try:
                if connection.execute("PRAGMA journal_mode").fetchone()[0] != "wal":
                    connection.execute("PRAGMA journal_mode = WAL")
                connection.execute("PRAGMA synchronous = FULL")
                _migrate(connection)
                yield connection
            finally:
                connection.close()

    @contextlib.contextmanager
    def _reading(self) -> Generator[sqlite3.Connection, None, None]:
        uri = self.path.absolute().as_uri()
        with self._translated("read"):
            connection = self._connect(f"{uri}?mode=ro")
            try:
                try:
                    steps = migrations.pending(connection)
                except sqlite3.OperationalError:
                    # WAL's side files cannot be created in a read-only folder. It has no writers, so it is immutable.
                    connection.close()
                    connection = self._connect(f"{uri}?mode=ro&immutable=1")
                    steps = migrations.pending(connection)
                if steps:
                    connection.close()
                    self.create()
                    connection = self._connect(f"{uri}?mode=ro")
                yield connection
            finally:
                connection.close()

    def _connect(self, uri: str) -> sqlite3.Connection:
        connection = sqlite3.connect(uri, uri=True, timeout=_BUSY_TIMEOUT_S, isolation_level=None)
        connection.execute("PRAGMA foreign_keys = ON")
        return connection

    @contextlib.contextmanager
    def _translated(self, verb: str) -> Generator[None, None, None]:
        """Convert SQLite errors into EnvironmentMissing or BundleError."""
        try:
            yield
        except sqlite3.OperationalError as error:
            raise EnvironmentMissing(
                f"registry: cannot {verb} the index {self.path}: {error}. Check free disk space and "
                "permissions, or choose another folder with --registry"
            ) from error
        except sqlite3.DatabaseError as error:
            raise BundleError(
                f"registry: the index {self.path} is damaged ({error}); the scenes are intact in their "
                "folders: recover it with `registry.SceneRegistry(root).rebuild_index()`"
            ) from error


@contextlib.contextmanager
def atomic(connection: sqlite3.Connection) -> Generator[None, None, None]:
    """Run the block in one transaction, or in a savepoint if a transaction is open."""
    nested = connection.in_transaction
    connection.execute("SAVEPOINT nested" if nested else "BEGIN IMMEDIATE")
    try:
        yield
    except BaseException:
        if nested:
            connection.execute("ROLLBACK TO nested")
            connection.execute("RELEASE nested")
        elif connection.in_transaction:
            connection.execute("ROLLBACK")
        raise
    connection.execute("RELEASE nested" if nested else "COMMIT")


def _migrate(connection: sqlite3.Connection) -> None:
    if not migrations.pending(connection):
        return
    with atomic(connection):
        connection.execute(
            "CREATE TABLE IF NOT EXISTS migrations "
            "(number INTEGER PRIMARY KEY, name TEXT UNIQUE NOT NULL, applied_utc TEXT NOT NULL)"
        )
    for step in migrations.pending(connection):
        with atomic(connection):
            step(connection)
            values = (step.__name__, utc_text())
            connection.execute("INSERT INTO migrations (name, applied_utc) VALUES (?, ?)", values)


def _row(values: tuple[Any, ...]) -> SceneRow:
    try:
        metrics = json.loads(values[-1])
    except ValueError as error:
        raise sqlite3.DatabaseError(f"the metrics of {values[0]} are not JSON: {error}") from error
    return SceneRow(*values[:-1], metrics=metrics)


def _values(row: SceneRow) -> tuple[Any, ...]:
    metrics = json.dumps(row.metrics, sort_keys=True, allow_nan=False)
    return tuple({**vars(row), "metrics": metrics}.values())
