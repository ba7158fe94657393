"""Registries that someone else made: nothing outside of them is touched, and a lost index is said and repaired."""

import contextlib
import json
import multiprocessing
import os
import random
import shutil
import signal
import sqlite3
import threading
import time

import hostile
import pytest

from reconstruction.cli import main
from registry import BundleError, EnvironmentMissing, SceneNotFound, SceneRegistry
from registry.plain_text import is_plain

pytestmark = pytest.mark.stage

FORK = multiprocessing.get_context("fork")
REVISION = "0123456789abcdef"


@pytest.fixture
def reg(tmp_path, make_staging) -> SceneRegistry:
    """Return a registry with the scenes `kitchen` and `bedroom`."""
    found = SceneRegistry(tmp_path / "registry")
    found.publish(make_staging(), "kitchen")
    found.publish(make_staging(marker="b"), "bedroom")
    return found


@pytest.fixture
def victim(tmp_path):
    """Return a folder outside of the registry that looks like a scene."""
    folder = tmp_path / "victim"
    (folder / REVISION).mkdir(parents=True)
    (folder / ".publishing-1-a").mkdir()
    (folder / REVISION / "precious.txt").write_text("keep")
    (folder / "file.txt").write_text("keep")
    return folder


def _tree(folder) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else b"" for p in folder.rglob("*")}


def _sql(reg, *statements) -> None:
    connection = sqlite3.connect(reg.root / "index.sqlite")
    with connection:
        for statement in statements:
            connection.execute(statement)
    connection.close()


ROWS = {
    "revision is a path": ("revision", "../../victim"),
    "revision is absolute": ("revision", "/etc"),
    "revision is too long": ("revision", "0" * 17),
    "revision is a number": ("revision", 12),
    "file with an escape": ("source_file", "a\x1b[2J.mp4"),
    "file with a newline": ("source_file", "a\nSimRecon/fake"),
    "file not UTF-8": ("source_file", b"\xff\xfe"),
    "date with an escape": ("created_utc", "\x9b2J"),
    "count is a text": ("n_objects", "many"),
    "count is negative": ("n_objects", -1),
    "status": ("status", "wonderful"),
    "metrics no JSON": ("metrics", "{"),
    "metrics a list": ("metrics", "[]"),
    "metrics NaN": ("metrics", '{"stable_rate": NaN}'),
    "rate is a text": ("metrics", '{"stable_rate": "x"}'),
    "rate of 7": ("metrics", '{"stable_rate": 7}'),
    "metrics with an escape": ("metrics", '{"scale_method": "\\u001b[2J"}'),
}


@pytest.mark.parametrize("kind", ROWS)
def test_a_malformed_row_harms_nothing_and_hides_no_other(reg, victim, capsys, kind):
    before = _tree(victim)
    column, value = ROWS[kind]
    connection = sqlite3.connect(reg.root / "index.sqlite")
    with connection:
        if isinstance(value, bytes):
            connection.execute(
                f"UPDATE scenes SET {column} = CAST(? AS TEXT) WHERE scene_id = 'kitchen'", (value,)
            )
        else:
            connection.execute(f"UPDATE scenes SET {column} = ? WHERE scene_id = 'kitchen'", (value,))
    connection.close()
    where = ["--registry", str(reg.root)]
    assert main(["list", *where]) == 0
    said = capsys.readouterr()
    assert "SimRecon/bedroom" in said.out
    assert "kitchen" in said.err
    assert "registry rebuild" in said.err
    assert all(is_plain(line) for line in (said.out + said.err).split("\n"))
    assert len(said.err.strip().split("\n")) == 1
    for verb in ("show", "verify"):
        assert main([verb, "kitchen", *where]) == 1
        said = capsys.readouterr()
        assert len(said.err.strip().split("\n")) == 1
        assert is_plain(said.err.strip())
    assert main(["remove", "kitchen", "--yes", *where]) in (0, 1)
    reg.remove("bedroom")
    assert _tree(victim) == before


def test_rebuilding_repairs_malformed_rows(reg, capsys):
    before = reg.revisions()
    _sql(reg, "UPDATE scenes SET revision = '../x' WHERE scene_id = 'kitchen'")
    _sql(reg, "INSERT INTO scenes SELECT '../y', revision, schema_version, created_utc, source_file, source_sha256, "
              "n_objects, status, metrics FROM scenes LIMIT 1")  # fmt: skip
    assert main(["registry", "rebuild", "--registry", str(reg.root), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"scenes": before, "left_out": []}
    assert all(reg.verify(key).ok for key in before)


@pytest.mark.parametrize("name", ["scenes", "scenes/kitchen", "locks", "index.sqlite"])
def test_a_link_in_a_registry_leads_nowhere(reg, make_staging, victim, name):
    path = reg.root / name
    target = victim / "file.txt" if name == "index.sqlite" else victim
    shutil.move(path, path.with_name("away"))
    path.symlink_to(target)
    before = _tree(victim)
    for act in (
        lambda: reg.publish(make_staging(marker="c"), "kitchen"),
        lambda: reg.remove("kitchen"),
        lambda: reg.load("kitchen"),
        reg.rebuild,
    ):
        with contextlib.suppress(BundleError, EnvironmentMissing, SceneNotFound):
            act()
    assert _tree(victim) == before


@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_a_lock_that_is_no_file_is_refused(reg, make_staging, victim, kind):
    lock = reg.lock_path("kitchen", "publish")
    lock.unlink()
    lock.symlink_to(victim / "file.txt") if kind == "link" else os.mkfifo(lock)
    with pytest.raises(BundleError, match=r"symbolic link|not a plain file"):
        reg.publish(make_staging(marker="c"), "kitchen")
    assert (victim / "file.txt").read_text() == "keep"


ENDLESS = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x FROM c"
TABLES = {
    "endless view": ("ALTER TABLE scenes RENAME TO old", f"CREATE VIEW scenes AS {ENDLESS}"),
    "trigger": ("CREATE TRIGGER t AFTER DELETE ON scenes BEGIN DELETE FROM scenes; END",),
    "computed column": ("ALTER TABLE scenes ADD COLUMN big AS (zeroblob(1000000))",),
}


@pytest.mark.parametrize("kind", TABLES)
def test_an_index_with_more_than_tables_is_refused_and_rebuilt(reg, make_staging, kind):
    before = reg.revisions()
    _sql(reg, *TABLES[kind])
    start = time.monotonic()
    for act in (
        reg.list,
        reg.revisions,
        lambda: reg.load("kitchen"),
        lambda: reg.publish(make_staging(), "x"),
    ):
        with pytest.raises(BundleError, match="registry rebuild"):
            act()
    assert time.monotonic() - start < 2
    reg.rebuild()
    assert reg.revisions() == before


# ---- A lost or emptied index.


@pytest.mark.parametrize("kind", ["lost", "emptied", "damaged"])
def test_a_lost_index_is_said_and_rebuilt(reg, capsys, kind):
    before = {r.scene_id: (r.revision, r.metrics) for r in reg.list()}
    if kind == "emptied":
        _sql(reg, "DELETE FROM scenes")
    else:
        for path in reg.root.glob("index.sqlite*"):
            path.unlink()
    if kind == "damaged":
        (reg.root / "index.sqlite").write_bytes(b"no database" * 1000)
    where = ["--registry", str(reg.root)]
    for verb in (["list"], ["show", "kitchen"], ["verify", "kitchen"], ["remove", "kitchen", "--yes"]):
        assert main([*verb, *where]) == 1
        assert "simrecon registry rebuild" in capsys.readouterr().err
    assert main(["registry", "rebuild", *where]) == 0
    assert "2 scenes" in capsys.readouterr().out
    assert {r.scene_id: (r.revision, r.metrics) for r in reg.list()} == before


@pytest.mark.parametrize("kind", ["lost", "emptied"])
def test_the_next_publication_brings_the_others_back(reg, make_staging, kind):
    before = reg.revisions()
    if kind == "lost":
        (reg.root / "index.sqlite").unlink()
    else:
        _sql(reg, "DELETE FROM scenes")
    reg.publish(make_staging(marker="c"), "attic")
    assert reg.revisions().items() >= before.items()
    assert "attic" in reg.revisions()


def test_rebuilding_names_damaged_folders_and_keeps_them(reg, capsys):
    record = reg.get("kitchen")
    (record.path / "base/floor.glb").write_bytes(b"broken")
    assert main(["registry", "rebuild", "--registry", str(reg.root)]) == 1
    said = capsys.readouterr().out
    assert "left out: scene kitchen" in said
    assert "1 scenes" in said
    assert record.path.exists()


def test_what_happens_during_a_rebuild_counts(reg, make_staging, monkeypatch):
    search = reg._rows_from_folders

    def slow(before):
        found = search(before)
        other = SceneRegistry(reg.root)
        other.publish(make_staging(marker="new"), "attic")
        other.publish(make_staging(marker="newer"), "kitchen")
        other.remove("bedroom")
        return found

    monkeypatch.setattr(reg, "_rows_from_folders", slow)
    reg.rebuild()
    assert sorted(reg.revisions()) == ["attic", "kitchen"]
    assert all(reg.verify(key).ok for key in reg.revisions())


@pytest.mark.parametrize("kind", ["intact", "damaged"])
def test_readers_never_see_an_empty_registry_during_a_rebuild(reg, kind):
    expected, seen, end = reg.revisions(), [], threading.Event()

    def read():
        other = SceneRegistry(reg.root)
        while not end.is_set():
            try:
                seen.append(other.revisions())
            except BundleError:
                seen.append(None)

    reader = threading.Thread(target=read)
    reader.start()
    for _ in range(15):
        if kind == "damaged":
            (reg.root / "broken").write_bytes(b"no database" * 1000)
            (reg.root / "broken").replace(reg.root / "index.sqlite")
        reg.rebuild()
    end.set()
    reader.join()
    assert len(seen) > 15
    assert all(found == expected or (found is None and kind == "damaged") for found in seen)


def test_a_first_publication_is_not_taken_for_a_lost_index(tmp_path, make_staging, monkeypatch):
    reg = SceneRegistry(tmp_path / "fresh", create=True)
    seen = []
    put = reg._index.put
    monkeypatch.setattr(
        reg._index, "put", lambda row: (seen.append(SceneRegistry(reg.root).list()), put(row))
    )
    reg.publish(make_staging(), "scene0001")
    assert seen == [[]]


def test_a_folder_without_permission_is_not_called_damaged(make_staging, reg):
    record = reg.get("kitchen")
    if os.geteuid() != 0:
        (record.path / "scene.json").chmod(0)
        with pytest.raises(EnvironmentMissing, match="may not read"):
            reg.load("kitchen")
        return
    for folder in (reg.root, *reg.root.parents):
        if folder.stat().st_uid == os.geteuid() and str(folder) != "/":
            folder.chmod(folder.stat().st_mode | 0o011)
    (record.path / "scene.json").chmod(0o600)
    child = os.fork()
    if child == 0:
        os.seteuid(65534)
        try:
            reg.load("kitchen")
        except EnvironmentMissing as error:
            os._exit(0 if "may not read" in str(error) else 2)
        except BaseException:
            os._exit(3)
        os._exit(4)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


# ---- Killed at any moment.


def _loop(root, act, staging, ready):
    reg = SceneRegistry(root)
    ready.set()
    for number in range(10_000):
        if act == "publish":
            reg.publish(staging[number % len(staging)], f"scene{number % 3:04d}")
        else:
            reg.rebuild()


@pytest.mark.parametrize("act", ["publish", "rebuild"])
def test_a_kill_at_any_moment_leaves_a_registry_that_verifies(reg, make_staging, act):
    stagings = [make_staging(marker=str(k)) for k in range(3)]
    chance = random.Random(7)
    for number in range(60):
        if act == "rebuild" and number % 3 == 0:
            (reg.root / "index.sqlite").write_bytes(b"no database" * 100)
        ready = FORK.Event()
        child = FORK.Process(target=_loop, args=(reg.root, act, stagings, ready))
        child.start()
        assert ready.wait(20)
        time.sleep(chance.uniform(0, 0.1))
        os.kill(child.pid, signal.SIGKILL)
        child.join()
        try:
            found = reg.revisions()
        except BundleError:
            assert act == "rebuild"  # not yet repaired, and said so
            reg.rebuild()
            found = reg.revisions()
        assert {"kitchen", "bedroom"} <= found.keys()
        if number % 10 == 9:
            assert all(reg.verify(key).ok for key in found)
    reg.publish(make_staging(marker="last"), "last")
    reg.rebuild()
    assert all(reg.verify(key).ok for key in reg.revisions())
    assert not list((reg.root / "scenes").glob("*/.publishing-*"))


def test_a_damaged_bundle_is_said_in_one_line_by_every_verb(reg, make_staging, scene, capsys):
    record = reg.get("kitchen")
    hostile.put(scene, "report.physics.stable_rate", "x")
    hostile.reseal(record.path, json.dumps(scene))
    where = ["--registry", str(reg.root)]
    for verb in (["show", "kitchen"], ["verify", "kitchen"], ["report", "kitchen"]):
        assert main([*verb, *where]) != 0
        said = capsys.readouterr()
        assert "stable_rate" in said.out + said.err
        assert "Traceback" not in said.out + said.err
    assert main(["list", *where]) == 0
    assert "bedroom" in capsys.readouterr().out


def test_a_scene_of_unknown_scale_is_shown(reg, make_staging, scene, capsys):
    scene["scale"] = {"method": "unknown", "uncertainty": None}
    reg.publish(make_staging(scene), "attic")
    assert main(["show", "attic", "--registry", str(reg.root)]) == 0
    assert "1 sigma unknown" in capsys.readouterr().out
