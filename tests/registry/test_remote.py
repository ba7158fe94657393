"""A registry at an address: whole or not at all, nothing lost among machines, rebuilt from its packs."""

import contextlib
import datetime
import json
import multiprocessing
import os
import signal
import time
import uuid
from pathlib import Path

import pytest

from registry import (
    BundleError,
    EnvironmentMissing,
    SceneBundle,
    SceneNotFound,
    SceneRegistry,
    UsageError,
    default_registry_root,
    open_registry,
    registry_folder,
)
from registry.exchange import open_place, push_scene
from registry.exchange.remote import RemoteRegistry
from registry.exchange.sharing import SharedScene, entries_of

pytestmark = pytest.mark.stage


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("SIMRECON_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("SIMRECON_REGISTRY", raising=False)
    return tmp_path / "home"


@pytest.fixture(params=["file", "memory", "s3"])
def address(request, tmp_path):
    """Return an address where nothing is yet."""
    name = uuid.uuid4().hex
    if request.param == "s3":
        request.getfixturevalue("s3")
        return f"s3://lab/{name}"
    return f"memory://{name}" if request.param == "memory" else f"file://{tmp_path / 'place'}"


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """Return a function that opens an address as another machine would: with a home of its own."""

    def opened(address: str, name: str) -> SceneRegistry:
        with monkeypatch.context() as patch:
            patch.setenv("SIMRECON_HOME", str(tmp_path / name))
            registry = open_registry(address)
        return registry

    return opened


def test_a_registry_at_an_address_is_used_like_one_in_a_folder(address, machine, make_bundle):
    here, there = machine(address, "here"), machine(address, "there")
    assert (here.list(), here.revisions()) == ([], {})
    with pytest.raises(SceneNotFound, match="the registry is empty"):
        here.get("room")
    one, two = make_bundle("room", "one"), make_bundle("room", "two")
    first = here.publish(one, "room")
    here.publish(one, "hall")  # under another id
    assert there.revisions() == {"hall": first.revision, "room": first.revision}
    local = SceneRegistry(here.root.parents[2] / "local")
    expected = local.publish(one, "room")
    for mine in (here.get("room"), there.get("room"), there.list()[1]):
        same = ("scene_id", "revision", "n_objects", "status", "metrics", "source_sha256", "source_file")
        assert [getattr(mine, name) for name in same] == [getattr(expected, name) for name in same]
        assert abs(time.time() - _seconds(mine.created_utc)) < 100
    assert not there.get("room").path.exists()  # nothing is downloaded before it is opened
    bundle = there.load("room", check_hashes=True)
    assert bundle.root == there.get("room").path
    assert (bundle.scene["id"], bundle.revision) == ("room", first.revision)
    assert there.load("hall").scene["id"] == "hall"

    second = there.publish(two, "room")
    assert here.load("room").revision == second.revision != first.revision
    assert here.verify("room").ok
    with pytest.raises(SceneNotFound, match="Did you mean 'room'"):
        here.get("roon")
    here.remove("room")
    assert there.revisions() == {"hall": first.revision}
    with pytest.raises(SceneNotFound):
        there.load("room")
    assert not here.get("hall").path.with_name("room").exists()
    assert [key for key in here.place.keys("") if "room" in key] == []
    assert there.publish(two, "room").revision == second.revision
    assert here.load("room").revision == second.revision


def _seconds(text: str) -> float:
    return datetime.datetime.fromisoformat(text).timestamp()


def test_what_was_listed_last_is_known_without_asking(address, machine, make_bundle, monkeypatch):
    here, there = machine(address, "here"), machine(address, "there")
    record = here.publish(make_bundle("room"), "room")
    assert there.revisions(known_only=True) == {}
    assert there.revisions() == {"room": record.revision}
    here.publish(make_bundle("hall"), "hall")
    with monkeypatch.context() as patch:
        patch.setattr(there, "place", None)  # any question would fail
        assert there.revisions(known_only=True) == {"room": record.revision}
    there.list()
    assert there.revisions(known_only=True).keys() == {"hall", "room"}
    (there.root / "listed.json").write_text('{"../x": "0123456789abcdef", "room": "../y"}')
    assert there.revisions(known_only=True) == {}


def test_publishing_the_current_revision_again_changes_nothing(address, make_bundle):
    registry = open_registry(address)
    bundle = make_bundle("room")
    registry.publish(bundle, "room")
    before = sorted(registry.place.keys(""))
    registry.publish(bundle, "room")
    assert sorted(registry.place.keys("")) == before


def test_a_damaged_copy_is_downloaded_again_and_a_damaged_pack_is_said(address, machine, make_bundle):
    here, there = machine(address, "here"), machine(address, "there")
    record = here.publish(make_bundle("room"), "room")
    (record.path / "scene.json").write_text("{}")
    assert here.load("room").revision == record.revision
    key = SharedScene("room", "", record.revision).pack_key
    here.place.write(key, here.place.read(key, 1 << 20)[:-7])
    report = here.verify("room")
    assert not report.ok
    assert "room" in report.problems[0]
    with pytest.raises(BundleError):
        there.load("room")
    assert here.load("room").revision == record.revision  # the copy is whole
    here.place.remove([key])
    assert "is gone" in there.verify("room").problems[0]
    assert "is gone" in there.rebuild()[1][0]
    here.publish(record.path, "room")  # mends it
    assert there.load("room").revision == record.revision


def test_the_index_is_rebuilt_from_the_packs(address, machine, make_bundle):
    here = machine(address, "here")
    for name in ("room", "hall", "attic"):
        here.publish(make_bundle(name, name), name)
    before = here.list()
    here.place.remove([shared.entry_key for shared in entries_of(here.place)])
    here.place.write("packs/bad/" + "0" * 16 + ".simrecon", b"no pack")
    here.place.write("packs/notes.txt", b"mine")
    assert here.revisions() == {}
    there = machine(address, "there")
    records, problems = there.rebuild()
    assert {r.scene_id: (r.revision, r.metrics) for r in records} == {
        r.scene_id: (r.revision, r.metrics) for r in before
    }
    assert len(problems) == 1
    assert "scene bad: " in problems[0]
    assert all(there.verify(name).ok for name in there.revisions())
    assert there.rebuild()[0] == records  # again: nothing to do


def test_the_rest_of_a_killed_push_stays_unseen(address, machine, make_bundle):
    registry = machine(address, "here")
    first = registry.publish(make_bundle("room", "one"), "room")
    second = make_bundle("room", "two")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("registry.exchange.sharing.write_entry", _interrupted)
        with pytest.raises(KeyboardInterrupt):
            registry.publish(second, "room")
    assert registry.get("room").revision == first.revision
    registry.rebuild()
    assert registry.load("room").revision == first.revision


def _interrupted(*_: object) -> None:
    raise KeyboardInterrupt


def test_automatic_ids_are_given_once(address, machine, make_bundle):
    here, there = machine(address, "here"), machine(address, "there")
    here.publish(make_bundle("scene0004"), "scene0004")
    with here.reserve_next_id() as one, there.reserve_next_id() as two:
        assert (one, two) == ("scene0005", "scene0006")
    with there.reserve_next_id() as three:  # neither was published
        assert three == "scene0007"
    assert here.next_free_id() == "scene0008"
    assert not here.place.create("ids/scene0007", b"")
    assert here.revisions().keys() == {"scene0004"}


def test_entries_of_older_versions_and_of_strangers(address, make_bundle):
    registry = open_registry(address)
    shared = push_scene(SceneBundle.open(make_bundle("room")), open_place(address)).shared
    entry = json.loads(registry.place.read(shared.entry_key, 1 << 16))
    del entry["row"]
    registry.place.write(shared.entry_key, json.dumps(entry).encode())
    record = registry.get("room")
    assert (record.n_objects, record.status, record.metrics) == (2, "unchecked", {})
    push_scene(SceneBundle.open(make_bundle("hall")), open_place(address))
    for bad in (
        {"row": {"source_file": "a\x1b[2J"}},
        {"row": {"status": "<script>"}},
        {"row": []},
        {"row": {"metrics": {"stable_rate": "x"}}},
        {"objects": -1},
        {"video": None},
    ):
        bad_key = f"index/attic/20990101T000000000000Z-{uuid.uuid4().hex[:16]}.json"
        registry.place.write(bad_key, json.dumps(entry | bad).encode())
        records, problems = registry.list_with_problems()
        assert [r.scene_id for r in records] == ["hall", "room"]
        assert len(problems) == 1
        assert problems[0].startswith("scene attic: ")
        assert problems[0].isprintable()
        with pytest.raises(BundleError, match="scene attic"):
            registry.get("attic")
        registry.place.remove([bad_key])


# ---- Several machines. Each process has a home of its own.


def _publish(address: str, home: str, folders: list[tuple[str, Path]], start) -> None:
    os.environ["SIMRECON_HOME"] = home
    registry = open_registry(address)
    start.wait()
    for scene_id, folder in folders:
        registry.publish(folder, scene_id)


@pytest.mark.parametrize("kind", ["file", pytest.param("s3", marks=pytest.mark.end_to_end)])
def test_machines_publish_at_once_and_lose_nothing(kind, request, tmp_path, make_bundle, machine):
    if kind == "s3":
        request.getfixturevalue("s3")
    address = f"s3://lab/{uuid.uuid4().hex}" if kind == "s3" else f"file://{tmp_path / 'place'}"
    spawn = multiprocessing.get_context("spawn")
    start = spawn.Barrier(4)
    work = [
        [
            (name, make_bundle(name, f"{m} {k}"))
            for k, name in enumerate(["shared", f"m{m}", "shared", f"n{m}"])
        ]
        for m in range(4)
    ]
    processes = [
        spawn.Process(target=_publish, args=(address, str(tmp_path / f"home{m}"), work[m], start))
        for m in range(4)
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
        assert process.exitcode == 0
    registry = machine(address, "judge")
    published = {(name, SceneBundle.open(folder).revision) for rows in work for name, folder in rows}
    assert {(s.scene_id, s.revision) for s in entries_of(registry.place)} == published
    assert set(registry.revisions().items()) <= published
    assert registry.revisions().keys() == {name for name, _ in published}
    assert all(registry.verify(name).ok for name in registry.revisions())


def _remove_and_publish(address: str, home: str, folder: Path, seconds: float, act: str) -> None:
    os.environ["SIMRECON_HOME"] = home
    registry = open_registry(address)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if act == "publish":
            registry.publish(folder, "room")
            continue
        with contextlib.suppress(SceneNotFound):
            registry.remove("room")


def test_a_scene_that_is_removed_while_it_is_published_is_there_whole_or_not(tmp_path, make_bundle, machine):
    address, folder = f"file://{tmp_path / 'place'}", make_bundle("room")
    spawn = multiprocessing.get_context("spawn")
    acts = ["publish", "publish", "remove", "remove"]
    for turn in range(3):
        args = [
            (address, str(tmp_path / f"{act}{n}"), folder, 1.0 + 0.1 * turn, act)
            for n, act in enumerate(acts)
        ]
        processes = [spawn.Process(target=_remove_and_publish, args=each) for each in args]
        for process in processes:
            process.start()
        for process in processes:
            process.join()
            assert process.exitcode == 0
        registry = machine(address, f"judge{turn}")
        for name in registry.revisions():
            assert registry.verify(name).ok
        registry.publish(folder, "room")
        assert registry.verify("room").ok


def test_a_killed_publish_is_there_or_not(tmp_path, make_bundle, machine):
    address = f"file://{tmp_path / 'place'}"
    folders = [("room", make_bundle("room", f"{k}")) for k in range(300)]
    spawn = multiprocessing.get_context("spawn")
    start = spawn.Barrier(2)
    process = spawn.Process(target=_publish, args=(address, str(tmp_path / "victim"), folders, start))
    process.start()
    start.wait()
    time.sleep(0.7)
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    registry = machine(address, "victim")
    assert registry.verify("room").ok
    assert registry.load("room", check_hashes=True).revision in {
        SceneBundle.open(f).revision for _, f in folders
    }
    assert registry.publish(folders[-1][1], "room").revision == registry.get("room").revision


# ---- Addresses.


def test_addresses_folders_and_the_default(home, tmp_path, monkeypatch):
    assert registry_folder("x/y") == Path("x/y")
    assert registry_folder(None) == default_registry_root() == home / "registry"
    copy = registry_folder("s3://lab/scenes/")
    assert copy == registry_folder("s3://lab/scenes") != registry_folder("s3://lab/scenes2")
    assert copy.is_relative_to(home / "registries")
    monkeypatch.setenv("SIMRECON_REGISTRY", "memory://lab")
    assert isinstance(open_registry(), RemoteRegistry)
    assert open_registry().address == "memory://lab"
    assert (
        open_registry(default_registry_root()).address == "memory://lab"
    )  # the folder stands for the address
    with pytest.raises(UsageError, match="copy of memory://lab"):
        SceneRegistry()
    monkeypatch.setenv("SIMRECON_REGISTRY", str(tmp_path / "mine"))
    assert type(open_registry()) is SceneRegistry
    for bad in ("s3://key:secret@host/x", "https://host/x?token=1"):
        with pytest.raises(UsageError, match="no user, password or query"):
            open_registry(bad)
    with pytest.raises(UsageError, match="nope://"):
        open_registry("nope://x")


def test_a_folder_from_someone_else_reaches_no_network(tmp_path):
    theirs = tmp_path / "theirs" / "registries" / "lab"
    (theirs / "registry").mkdir(parents=True)
    (theirs / "address").write_text("s3://theirs/bucket")
    assert type(open_registry(theirs / "registry")) is SceneRegistry


def test_a_mirror_is_read_and_an_unreachable_place_is_said(tmp_path, make_bundle, monkeypatch):
    with pytest.raises(EnvironmentMissing, match="http://127"):
        open_registry("http://127.0.0.1:1/x").get("room")
    with pytest.raises(UsageError, match="read-only"):
        open_registry("http://127.0.0.1:1/x").place.create("ids/scene0001", b"")
