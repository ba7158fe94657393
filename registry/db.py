# pyright: strict
"""Index of the registry: a SQLite file with one row per scene. All SQL is here and in `registry.migrations`.

A connection lives for one operation (opening takes well below a millisecond): none is shared by threads or inherited
by a fork. The index is a cache; all of its content can be rebuilt from the bundles.
"""

import contextlib
import datetime
import json
import os
import shutil
import sqlite3
import sys
from collections.abc import Generator
from pathlib import Path
from typing import Any, TypeAlias

from registry import migrations
from registry.errors import BundleError, EnvironmentMissing
from registry.index_rows import SceneRow, are_revisions, are_scene_ids, check_schema, is_revision, row_of
from registry.locks import file_lock
from registry.plain_text import plain
from registry.schema import is_scene_id

_BUSY_TIMEOUT_S = 60.0  # SQLite waits for another writer up to this
_COLUMNS = (
    "scene_id, revision, schema_version, created_utc, source_file, source_sha256, n_objects, status, metrics"
)
_INSERT = f"INSERT OR REPLACE INTO scenes ({_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)"
_MAX_ROWS, _MAX_VALUE_BYTES = 2_000_000, 4 << 20
_SUFFIXES = ("", "-wal", "-shm", "-journal")
REPAIR = "rebuild it with `simrecon registry rebuild`"
StoredRows: TypeAlias = dict[Any, tuple[Any, ...]]  # {scene id: columns of its row}, as they are stored

__all__ = ["REPAIR", "Index", "SceneRow", "StoredRows", "atomic", "utc_text"]


def utc_text(timestamp: float | None = None) -> str:
    """Format a POSIX timestamp (seconds; None for now) as ISO 8601 UTC with a resolution of one second."""
    now = datetime.datetime.now(datetime.timezone.utc)
    moment = now if timestamp is None else datetime.datetime.fromtimestamp(timestamp, datetime.timezone.utc)
    return moment.isoformat(timespec="seconds")


class Index:
    """`<registry>/index.sqlite`. An absent index reads as empty and is created by the first write.

    The file may come from someone else: rows are checked when they are read, and views and triggers are refused.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def exists(self) -> bool:
        """Return whether the index file exists."""
        return self.path.is_file()

    def rows(self) -> list[SceneRow]:
        """Return all valid rows, ordered by scene id."""
        return self.read()[0]

    def read(self) -> tuple[list[SceneRow], list[str]]:
        """Return all valid rows, ordered by scene id, and one line about each malformed row."""
        found: list[SceneRow] = []
        problems: list[str] = []
        for values in self._select(_COLUMNS):
            try:
                found.append(row_of(values))
            except BundleError as error:
                problems.append(f"{error}; {REPAIR}")
        return found, problems

    def revisions(self, ordered: bool = True) -> dict[str, str]:
        """Return {scene id: current revision} of the valid rows; reads only these two columns.

        Args:
            ordered: By scene id; otherwise in any order, which is faster.
        """
        # Not ordered by SQLite, which would look up each row by its id.
        pairs = self._select("scene_id, revision", f"LIMIT {_MAX_ROWS}")
        if not are_scene_ids([key for key, _ in pairs]) or not are_revisions([value for _, value in pairs]):
            pairs = [pair for pair in pairs if is_scene_id(pair[0]) and is_revision(pair[1])]
        found: dict[str, str] = dict(pairs)
        return {key: found[key] for key in sorted(found)} if ordered else found

    def row(self, scene_id: str) -> SceneRow | None:
        """Return the row of a scene, or None.

        Raises:
            BundleError: The row is malformed.
        """
        found = self._select(_COLUMNS, "WHERE scene_id = ?", (scene_id,))
        try:
            return row_of(found[0]) if found else None
        except BundleError as error:
            raise BundleError(f"{error}; {REPAIR}") from error

    def has(self, scene_id: str) -> bool:
        """Return whether a scene has a row, valid or not."""
        return bool(self._select("1", "WHERE scene_id = ?", (scene_id,)))

    def is_empty(self) -> bool:
        """Return whether there is no row."""
        return not self._select("1", "LIMIT 1")

    def put(self, *rows: SceneRow) -> None:
        """Insert or replace the rows of scenes in one transaction."""
        with self.writing() as connection, atomic(connection):
            connection.executemany(_INSERT, [_values(row) for row in rows])

    def delete(self, scene_id: str) -> None:
        """Delete the row of a scene."""
        with self.writing() as connection, atomic(connection):
            connection.execute("DELETE FROM scenes WHERE scene_id = ?", (scene_id,))

    def create(self) -> None:
        """Create the index if it is absent and apply pending migrations."""
        with self.writing():
            pass

    def stored(self) -> StoredRows | None:
        """Return {scene id: columns} of all rows, valid or not; None if the index is absent or unreadable."""
        try:
            return {row[0]: row for row in self._select(_COLUMNS)} if self.exists() else None
        except BundleError:
            return None

    def merge(self, before: StoredRows | None, found: dict[str, SceneRow]) -> None:
        """Replace the rows by what a search of the folders found, in one transaction.

        A row that changed since `before` was read stays as it is, and so does the absence of one that was removed: a
        publisher or remover was faster. An unreadable or absent index is written anew and put in place as a whole, the
        old file is kept as `index.damaged-TIME.sqlite`: readers see the old state or the new, never an empty index.

        Args:
            before: Result of `stored` before the search.
            found: A row for each scene found.
        """
        with self._translated("write"), file_lock(self._lock):
            try:
                if self.exists():
                    with self._opened() as connection, atomic(connection):
                        self._merge_into(connection, before or {}, found)
                    return
            except BundleError:
                pass
            except sqlite3.DatabaseError as error:
                if isinstance(error, sqlite3.OperationalError):
                    raise
            self._write_anew(found)

    def _merge_into(
        self, connection: sqlite3.Connection, before: StoredRows, found: dict[str, SceneRow]
    ) -> None:
        now = {row[0]: row for row in connection.execute(f"SELECT {_COLUMNS} FROM scenes")}
        for key in now.keys() | found.keys():
            if now.get(key) != before.get(key):
                continue
            if key in found:
                connection.execute(_INSERT, _values(found[key]))
            else:
                connection.execute("DELETE FROM scenes WHERE scene_id IS ?", (key,))

    def _write_anew(self, found: dict[str, SceneRow]) -> None:
        fresh = Index(self.path.with_name("index.rebuilding.sqlite"))
        for suffix in _SUFFIXES:
            fresh.path.with_name(fresh.path.name + suffix).unlink(missing_ok=True)
        with fresh._opened() as connection, atomic(connection):
            connection.executemany(_INSERT, [_values(row) for row in found.values()])
        stamp = f"{self.path.stem}.damaged-{utc_text().replace(':', '').replace('+0000', 'Z')}"
        for suffix in _SUFFIXES[1:]:  # a log that is left here would be applied to the new file
            part = self.path.with_name(self.path.name + suffix)
            if part.exists() or part.is_symlink():
                part.replace(self.path.with_name(f"{stamp}{self.path.suffix}{suffix}"))
        if self.path.exists() or self.path.is_symlink():
            kept = self.path.with_name(f"{stamp}{self.path.suffix}")
            kept.unlink(missing_ok=True)
            try:
                os.link(self.path, kept, follow_symlinks=False)
            except OSError:  # a file system without hard links
                shutil.copy2(self.path, kept, follow_symlinks=False)
        fresh.path.replace(self.path)

    @property
    def _lock(self) -> Path:
        return self.path.parent / "locks" / ".index.lock"

    @contextlib.contextmanager
    def writing(self) -> Generator[sqlite3.Connection, None, None]:
        """Open the index for writing, under a lock file: create it, switch it to WAL mode and migrate it.

        The lock file is necessary because SQLite's busy handler covers neither the switch to WAL nor the last close.
        """
        with self._translated("write"), file_lock(self._lock), self._opened() as connection:
            yield connection

    @contextlib.contextmanager
    def _opened(self) -> Generator[sqlite3.Connection, None, None]:
        """Open for writing; the caller holds the lock file."""
        connection = self._connect(f"{self.path.absolute().as_uri()}?mode=rwc")
        try:
            check_schema(connection, self.path)
            if connection.execute("PRAGMA journal_mode").fetchone()[0] != "wal":
                connection.execute("PRAGMA journal_mode = WAL")
            connection.execute("PRAGMA synchronous = FULL")
            _migrate(connection)
            yield connection
        finally:
            connection.close()

    def _select(self, columns: str, rest: str = "", values: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        """Return columns of all rows, or of those that `rest` selects, ordered by scene id."""
        if not self.exists():
            return []
        query = f"SELECT {columns} FROM scenes {rest or f'ORDER BY scene_id LIMIT {_MAX_ROWS}'}"
        with self._reading() as connection:
            try:
                return connection.execute(query, values).fetchall()
            except sqlite3.OperationalError as error:
                if "UTF-8" not in str(error):
                    raise
                connection.text_factory = (
                    _decoded  # a text that is not UTF-8 makes its row malformed, no other
                )
                return connection.execute(query, values).fetchall()

    @contextlib.contextmanager
    def _reading(self) -> Generator[sqlite3.Connection, None, None]:
        uri = self.path.absolute().as_uri()
        with self._translated("read"):
            connection = self._connect(f"{uri}?mode=ro")
            try:
                try:
                    check_schema(connection, self.path)
                except sqlite3.OperationalError:
                    # WAL's side files cannot be created in a read-only folder. It has no writers, so it is immutable.
                    connection.close()
                    connection = self._connect(f"{uri}?mode=ro&immutable=1")
                    check_schema(connection, self.path)
                if migrations.pending(connection):
                    connection.close()
                    self.create()
                    connection = self._connect(f"{uri}?mode=ro")
                yield connection
            finally:
                connection.close()

    def _connect(self, uri: str) -> sqlite3.Connection:
        if self.path.is_symlink():
            raise BundleError(f"registry: the index {self.path} is a symbolic link; remove it, and {REPAIR}")
        connection = sqlite3.connect(uri, uri=True, timeout=_BUSY_TIMEOUT_S, isolation_level=None)
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute("PRAGMA trusted_schema = OFF")
        if sys.version_info >= (3, 11):
            connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_VALUE_BYTES)
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
                f"registry: the index {self.path} is damaged ({plain(str(error))}); the scenes are intact in their "
                f"folders: {REPAIR}"
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


def _decoded(data: bytes) -> str:
    return data.decode("utf-8", "surrogateescape")


def _values(row: SceneRow) -> tuple[Any, ...]:
    metrics = json.dumps(row.metrics, sort_keys=True, allow_nan=False)
    return tuple({**vars(row), "metrics": metrics}.values())
