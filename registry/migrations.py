# pyright: strict
"""Schema migrations of the index. The list is append-only: never edit a released step.

A step and the row that records it are one transaction, so an interrupted upgrade is repeated.
"""

import sqlite3
from collections.abc import Callable

from registry.errors import EnvironmentMissing


def m001_initial(connection: sqlite3.Connection) -> None:
    """Create the table of scenes."""
    connection.execute(
        """
        CREATE TABLE scenes (
            scene_id       TEXT PRIMARY KEY,
            revision       TEXT NOT NULL,
            schema_version TEXT NOT NULL,
            created_utc    TEXT NOT NULL,
            source_file    TEXT NOT NULL,
            source_sha256  TEXT NOT NULL,
            n_objects      INTEGER NOT NULL
        )
        """
    )


def m002_status_and_metrics(connection: sqlite3.Connection) -> None:
    """Add the columns that `simrecon list` shows, so that listing opens no bundle."""
    connection.execute("ALTER TABLE scenes ADD COLUMN status TEXT NOT NULL DEFAULT 'unchecked'")
    connection.execute("ALTER TABLE scenes ADD COLUMN metrics TEXT NOT NULL DEFAULT '{}'")


MIGRATIONS: tuple[Callable[[sqlite3.Connection], None], ...] = (m001_initial, m002_status_and_metrics)


def applied(connection: sqlite3.Connection) -> list[str]:
    """Return the names of the applied steps, in order."""
    known = connection.execute("SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = 'migrations'")
    if known.fetchone() is None:
        return []
    return [row[0] for row in connection.execute("SELECT name FROM migrations ORDER BY number")]


def pending(connection: sqlite3.Connection) -> list[Callable[[sqlite3.Connection], None]]:
    """Return the steps that are not applied yet, in order.

    Raises:
        EnvironmentMissing: A newer simrecon wrote this index.
    """
    names, ours = applied(connection), [step.__name__ for step in MIGRATIONS]
    if names != ours[: len(names)]:
        unknown = ", ".join(name for name in names if name not in ours) or ", ".join(names)
        raise EnvironmentMissing(
            f"registry index: it was written by a newer simrecon (steps {unknown}); "
            "upgrade with `pip install -U simrecon`, or use another --registry"
        )
    return list(MIGRATIONS[len(names) :])
