"""Places: a folder, memory, S3, an HTTP mirror. Pushing loses nothing with many writers; pulling trusts nothing."""

import http.server
import json
import os
import shutil
import subprocess
import sys
import threading
import time
import uuid
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import exchange_worker
import fsspec
import pytest

from registry import BundleError, EnvironmentMissing, SceneBundle, SceneNotFound, SceneRegistry, UsageError
from registry.exchange import list_place, open_place, pack_scene, pull_scene, push_scene
from registry.exchange.readme import write_readme
from registry.exchange.sharing import read_entry, revisions_of, write_catalog

pytestmark = pytest.mark.stage

ROOT = Path(__file__).parents[2]


@pytest.fixture(params=["folder", "memory", "s3"])
def address(request, tmp_path):
    """Return the address of an empty place."""
    name = uuid.uuid4().hex
    if request.param == "s3":
        request.getfixturevalue("s3")
        return f"s3://lab/{name}"
    return f"memory://{name}" if request.param == "memory" else str(tmp_path / "place")


@pytest.fixture
def mine(tmp_path) -> SceneRegistry:
    return SceneRegistry(tmp_path / "mine")


@pytest.fixture
def bundles(make_bundle):
    """Return two revisions of `room`, and a `hall`."""
    made = [make_bundle("room"), make_bundle("room", "newer"), make_bundle("hall")]
    return [SceneBundle.open(folder) for folder in made]


def test_pushed_scenes_are_listed_and_pulled(address, mine, bundles):
    place = open_place(address)
    assert list_place(place) == []
    with pytest.raises(SceneNotFound, match="has no scenes"):
        pull_scene(place, "room", mine)
    for bundle in bundles:
        assert push_scene(bundle, place).new
    assert not push_scene(bundles[1], place).new
    first, second, hall = (bundle.revision for bundle in bundles)
    assert [(s.scene_id, s.revision) for s in list_place(open_place(address))] == [
        ("hall", hall),
        ("room", second),
    ]
    assert [s.revision for s in revisions_of(place, "room")] == [first, second]
    assert [s.scene_id for s in list_place(place, "r*")] == ["room"]
    assert read_entry(place, list_place(place, "room")[0])["objects"] == 2

    assert pull_scene(place, "room", mine).record.revision == second
    assert not pull_scene(place, "room", mine).new
    with pytest.raises(UsageError, match=r"--as NAME, or replace yours with --replace"):
        pull_scene(place, f"room@{first}", mine)
    assert pull_scene(place, f"room@{first}", mine, scene_id="old_room").record.revision == first
    assert pull_scene(place, f"room@{first}", mine, replace=True).record.revision == first
    assert all(mine.verify(name).ok for name in mine.revisions())
    with pytest.raises(SceneNotFound, match=f"its revisions, the newest first: {second}, {first}"):
        pull_scene(place, "room@" + "0" * 16, mine, replace=True)
    with pytest.raises(SceneNotFound, match=r"Did you mean 'room'"):
        pull_scene(place, "roon", mine)
    with pytest.raises(UsageError, match="SCENE@REVISION"):
        pull_scene(place, "room@../..", mine)


def test_an_older_revision_can_be_made_current_again(address, bundles):
    place = open_place(address)
    for bundle in (bundles[0], bundles[1], bundles[0]):
        pushed = push_scene(bundle, place)
    assert pushed.new
    assert pushed.uploaded_bytes == 0
    assert list_place(place)[0].revision == bundles[0].revision


def test_a_lost_pack_is_uploaded_again(address, bundles, mine):
    place = open_place(address)
    pushed = push_scene(bundles[0], place)
    place.fs.rm(f"{place.root}/{pushed.shared.pack_key}")
    with pytest.raises(SceneNotFound, match="has no pack"):
        pull_scene(place, "room", mine)
    assert push_scene(bundles[0], place).uploaded_bytes > 0
    assert pull_scene(place, "room", mine).new


def test_one_of_many_creates_an_object(address):
    place = open_place(address)
    many = [1] if address.startswith("memory") else range(8)  # fsspec's memory looks first
    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(lambda number: place.create("ids/room", f"{number}".encode()), many))
    assert sum(made) == 1
    assert place.read("ids/room", 10) == f"{list(many)[made.index(True)]}".encode()
    assert not place.create("ids/room", b"later")
    assert abs(time.time() - place.modified_s("ids/room")) < 100
    assert place.read_many(["ids/room", "ids/none"], 10) == [place.read("ids/room", 10), None]
    place.remove(["ids/room", "ids/none"])
    assert place.keys("ids") == []
    assert place.create("ids/room", b"later")


def test_foreign_files_and_wrong_packs_are_not_trusted(address, bundles, mine, tmp_path):
    place = open_place(address)
    shared = push_scene(bundles[0], place).shared
    place.write("index/../x.json", b"{}") if "memory" not in address and "s3" not in address else None
    place.write("index/room/20990101T000000000000Z-zzzz.json", b"{}")
    place.write("index/Bad Name/20990101T000000000000Z-0123456789abcdef.json", b"{}")
    place.write("index/note.txt", b"hello")
    assert [s.revision for s in list_place(place)] == [shared.revision]
    place.upload(shared.pack_key, pack_scene(bundles[1], tmp_path / "wrong.simrecon").path)
    with pytest.raises(BundleError, match=f"expected room, {shared.revision}"):
        pull_scene(place, "room", mine)
    place.write(shared.pack_key, b"no pack")
    with pytest.raises(BundleError, match="no zip file"):
        pull_scene(place, "room", mine)
    place.write(shared.entry_key, b'{"format": "simrecon.entry/1", "objects": ' + b"[" * 60_000)
    assert read_entry(place, shared) == {}
    assert not mine.root.exists()


def test_the_readme_is_a_card_of_the_hub_and_never_overwrites_yours(address, bundles):
    yaml = pytest.importorskip("yaml")
    place = open_place(address)
    push_scene(bundles[0], place)
    assert write_readme(place)
    one = place.read("README.md", 1 << 20).decode()
    assert "# SimRecon/room" in one
    assert yaml.safe_load(one.split("---\n")[1])["license"] == "unknown"
    push_scene(bundles[2], place)
    assert write_readme(place)
    two = place.read("README.md", 1 << 20).decode()
    assert "](packs/hall/" in two
    assert "](packs/room/" in two
    assert yaml.safe_load(two.split("---\n")[1])["license_name"] == "see the card of each scene"
    place.write("README.md", b"# mine")
    assert not write_readme(place)
    assert place.read("README.md", 1 << 20) == b"# mine"


@pytest.mark.parametrize("catalog", [True, False])
def test_an_http_mirror_is_read_with_and_without_listings(tmp_path, bundles, mine, catalog):
    folder = tmp_path / "mirror"
    place = open_place(folder)
    for bundle in bundles:
        push_scene(bundle, place)
    if catalog:
        assert write_catalog(place) == 2

    class Handler(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *args: object) -> None:
            super().__init__(*args, directory=str(folder))

        def log_message(self, *_: object) -> None:
            pass

        def list_directory(self, path: str) -> object:
            if not catalog:
                return super().list_directory(path)
            self.send_error(404, "no listings here")
            return None

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        mirror = open_place(f"http://127.0.0.1:{server.server_port}")
        assert list_place(mirror) == list_place(place)
        assert revisions_of(mirror, "room") == revisions_of(place, "room")
        assert pull_scene(mirror, "room", mine).record.revision == bundles[1].revision
        assert pull_scene(mirror, f"room@{bundles[0].revision}", mine, scene_id="old").new
        with pytest.raises(SceneNotFound, match=r"There are: hall, room"):
            pull_scene(mirror, "kitchen", mine)
        with pytest.raises(UsageError, match="read-only"):
            push_scene(SceneBundle.open(bundles[0].root), mirror)
        if catalog:
            (folder / "catalog.json").write_text('{"format": "simrecon.catalog/1", "scenes": [1]}')
            with pytest.raises(BundleError, match=r"catalog\.json is damaged"):
                list_place(open_place(mirror.url))
    finally:
        server.shutdown()
        server.server_close()


def test_extras_and_protocols_are_named(monkeypatch):
    with pytest.raises(UsageError, match=r"nope://.*Places are"):
        open_place("nope://x/y")
    known = sys.modules["fsspec.registry"]._registry
    for protocol, extra, package in (
        ("s3", "s3", "s3fs"),
        ("gs", "gs", "gcsfs"),
        ("hf", "hub", "huggingface_hub"),
    ):
        monkeypatch.delitem(known, protocol, raising=False)
        monkeypatch.setitem(sys.modules, package, None)  # as if it were not installed
        with pytest.raises(EnvironmentMissing, match=rf"pip install 'simrecon\[{extra}\]'"):
            open_place(f"{protocol}://bucket/x")


def test_the_hub_is_opened_by_its_client():
    pytest.importorskip("huggingface_hub", reason="the extra hub is not installed")
    place = open_place("hf://datasets/me/my-rooms")
    assert (place.root, place.read_only) == ("datasets/me/my-rooms", False)


def test_a_bucket_that_does_not_exist_or_answers_is_an_error_of_one_line(s3, bundles, monkeypatch):
    with pytest.raises(UsageError, match=r"nobody-made-this/x: cannot upload.* Make the bucket"):
        push_scene(bundles[0], open_place("s3://nobody-made-this/x"))
    with pytest.raises(SceneNotFound, match="has no scenes"):
        pull_scene(open_place("s3://lab/empty"), "room")
    client = fsspec.get_filesystem_class("s3")
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    client.clear_instance_cache()  # a client keeps the address that it was made with
    with pytest.raises(EnvironmentMissing, match=r"s3://lab/dead: cannot list index/room: .*credentials"):
        push_scene(bundles[0], open_place("s3://lab/dead"))
    client.clear_instance_cache()


@pytest.mark.parametrize(
    ("kind", "processes", "each"),
    [
        ("folder", 3, 5),
        pytest.param("folder", 8, 25, marks=pytest.mark.end_to_end),
        pytest.param("s3", 8, 25, marks=pytest.mark.end_to_end),
    ],
)
def test_many_processes_push_and_lose_nothing(kind, processes, each, request, tmp_path, make_bundle):
    if kind == "s3":
        request.getfixturevalue("s3")
    address = f"s3://lab/{uuid.uuid4().hex}" if kind == "s3" else str(tmp_path / "place")
    # Four of five pushes are of scenes of one process, one is of a revision of a scene that all processes share.
    names = [f"p{n}_{k}" if k % 5 else "shared" for n in range(processes) for k in range(each)]
    bundles = [make_bundle(name, f"revision {number}") for number, name in enumerate(names)]
    running = [
        subprocess.Popen(
            [
                sys.executable,
                exchange_worker.__file__,
                address,
                *map(str, bundles[n * each : (n + 1) * each]),
            ],
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stderr=subprocess.PIPE,
            text=True,
        )
        for n in range(processes)
    ]
    for process in running:
        _, said = process.communicate(timeout=400)
        assert process.returncode == 0, said
    pushed = {(name, SceneBundle.open(b, check_hashes=False).revision) for name, b in zip(names, bundles)}
    place = open_place(address)
    found = {(s.scene_id, s.revision) for name in set(names) for s in revisions_of(place, name)}
    assert found == pushed
    assert len(found) == processes * each
    assert {s.scene_id for s in list_place(place)} == set(names)
    packs = {key.removesuffix(".simrecon") for key in place.keys("packs") if key.endswith(".simrecon")}
    assert packs == {f"{name}/{revision}" for name, revision in pushed}
    registry = SceneRegistry(tmp_path / "registry")
    for name, revision in sorted(pushed)[::7]:
        assert pull_scene(place, f"{name}@{revision}", registry, replace=True).record.revision == revision
    assert "# SimRecon scenes" in place.read("README.md", 1 << 20).decode()


def test_figures_of_the_listing_are_json(address, bundles):
    place = open_place(address)
    shared = push_scene(bundles[0], place, licence="CC0-1.0").shared
    entry = json.loads(place.read(shared.entry_key, 1 << 16))
    assert entry["licence"] == "CC0-1.0"
    assert entry["video"] == {"name": "video.mp4", "sha256": "ab" * 32}
    assert b"CC0-1.0" in place.read(f"packs/room/{shared.revision}.md", 1 << 16)


def test_a_full_disk_leaves_no_half_pack(tmp_path, bundles, monkeypatch):
    place = open_place(tmp_path / "place")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(EnvironmentMissing, match="No space left"):
        place.write("packs/room/x", b"data")
    monkeypatch.undo()
    assert not list(Path(place.root).rglob("*x*"))
    shutil.rmtree(place.root)
    assert push_scene(bundles[0], place).new
