"""Index: migrations, nested transactions, rejection of a newer schema and of a damaged file."""

import sqlite3
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from registry import BundleError, EnvironmentMissing, SceneRegistry, db, migrations
from registry.index_rows import are_revisions, are_scene_ids, is_revision
from registry.schema import is_scene_id

V1_DUMP = Path(__file__).with_name("registry_v1.sql")


def _store_v1(root: Path) -> None:
    root.mkdir()
    connection = sqlite3.connect(root / "index.sqlite")
    connection.executescript(V1_DUMP.read_text())
    connection.close()


def test_a_stored_v1_index_is_upgraded_and_keeps_its_scenes(tmp_path):
    _store_v1(tmp_path / "registry")
    records = SceneRegistry(tmp_path / "registry").list()
    assert [(r.scene_id, r.n_objects, r.status, r.metrics) for r in records] == [
        ("kitchen", 4, "unchecked", {}),
        ("scene0007", 9, "unchecked", {}),
    ]
    assert SceneRegistry(tmp_path / "registry").next_free_id() == "scene0008"
    connection = sqlite3.connect(tmp_path / "registry" / "index.sqlite")
    assert migrations.applied(connection) == [step.__name__ for step in migrations.MIGRATIONS]
    assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    connection.close()


def test_upgraded_and_fresh_indexes_have_the_same_columns(tmp_path):
    _store_v1(tmp_path / "old")
    SceneRegistry(tmp_path / "old").list()
    SceneRegistry(tmp_path / "new", create=True)

    def columns(name: str) -> list:
        connection = sqlite3.connect(tmp_path / name / "index.sqlite")
        found = connection.execute("PRAGMA table_info(scenes)").fetchall()
        connection.close()
        return found

    assert columns("old") == columns("new")
    assert [c[1] for c in columns("new")] == list(db.SceneRow.__dataclass_fields__)


def test_a_failed_migration_leaves_nothing(tmp_path, monkeypatch):
    def m003_half(connection):
        connection.execute("CREATE TABLE half (x)")
        raise sqlite3.OperationalError("killed here")

    _store_v1(tmp_path / "registry")
    with monkeypatch.context() as patch:
        patch.setattr(migrations, "MIGRATIONS", (*migrations.MIGRATIONS, m003_half))
        with pytest.raises(EnvironmentMissing, match="killed here"):
            SceneRegistry(tmp_path / "registry").list()
    assert len(SceneRegistry(tmp_path / "registry").list()) == 2
    connection = sqlite3.connect(tmp_path / "registry" / "index.sqlite")
    assert connection.execute("SELECT count(*) FROM sqlite_master WHERE name = 'half'").fetchone() == (0,)
    connection.close()


def test_a_newer_index_is_refused(tmp_path):
    SceneRegistry(tmp_path / "registry", create=True)
    connection = sqlite3.connect(tmp_path / "registry" / "index.sqlite")
    with connection:
        connection.execute("INSERT INTO migrations (name, applied_utc) VALUES ('m999_future', '')")
    connection.close()
    with pytest.raises(EnvironmentMissing, match=r"newer simrecon.*m999_future"):
        SceneRegistry(tmp_path / "registry").list()


def test_a_damaged_index_says_how_to_recover(tmp_path):
    SceneRegistry(tmp_path / "registry", create=True)
    (tmp_path / "registry" / "index.sqlite").write_bytes(b"this is no database" * 500)
    with pytest.raises(BundleError, match="simrecon registry rebuild"):
        SceneRegistry(tmp_path / "registry").list()


def test_transactions_nest(tmp_path):
    connection = sqlite3.connect(tmp_path / "x.sqlite", isolation_level=None)
    connection.execute("CREATE TABLE t (x)")
    with db.atomic(connection):
        connection.execute("INSERT INTO t VALUES (1)")
        with pytest.raises(sqlite3.OperationalError), db.atomic(connection):  # noqa: PT012
            connection.execute("INSERT INTO t VALUES (2)")
            connection.execute("no SQL")
        with db.atomic(connection):
            connection.execute("INSERT INTO t VALUES (3)")
    with pytest.raises(sqlite3.OperationalError), db.atomic(connection):  # noqa: PT012
        connection.execute("INSERT INTO t VALUES (4)")
        connection.execute("no SQL")
    assert connection.execute("SELECT x FROM t").fetchall() == [(1,), (3,)]
    connection.close()


TEXTS = st.text(alphabet="a0_f\n A\x00\u0661", max_size=18)


@given(
    st.lists(
        st.one_of(TEXTS, st.from_regex(r"[a-z0-9_]{1,64}|[0-9a-f]{16}", fullmatch=True), st.integers()),
        max_size=4,
    )
)
def test_many_values_are_checked_as_each_is(values):
    assert are_scene_ids(values) == all(map(is_scene_id, values))
    assert are_revisions(values) == all(map(is_revision, values))


def test_revisions_leave_out_malformed_rows_and_are_ordered(tmp_path):
    index = db.Index(tmp_path / "index.sqlite")
    rest = ("ab" * 8, "simrecon.scene/1", db.utc_text(), "v.mp4", "ab" * 32, 1, "stable", {})
    index.put(*(db.SceneRow(name, *rest) for name in ("room", "attic", "hall")))
    assert list(index.revisions()) == ["attic", "hall", "room"]
    assert index.revisions(ordered=False) == index.revisions()
    with sqlite3.connect(index.path) as connection:
        connection.execute("UPDATE scenes SET scene_id = 'a' || char(10) || 'b' WHERE scene_id = 'hall'")
        connection.execute("UPDATE scenes SET revision = '../room' WHERE scene_id = 'room'")
    assert list(index.revisions()) == list(index.revisions(ordered=False)) == ["attic"]
