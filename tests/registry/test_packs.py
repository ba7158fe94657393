"""Packs: the same bytes for the same scene; what is added is what was packed; ids are never taken over silently."""

import copy
import http.server
import json
import threading
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import fsspec
import pytest
import yaml

from registry import BundleError, EnvironmentMissing, SceneBundle, SceneRegistry, UsageError
from registry.exchange import add_scene, licence_of, pack_scene, scene_card

pytestmark = pytest.mark.stage


@pytest.fixture
def mine(tmp_path) -> SceneRegistry:
    return SceneRegistry(tmp_path / "mine")


@pytest.fixture
def theirs(tmp_path) -> SceneRegistry:
    return SceneRegistry(tmp_path / "theirs")


@pytest.fixture
def pack(mine, make_bundle, tmp_path):
    mine.publish(make_bundle("room"), "room")
    return pack_scene(mine.load("room"), tmp_path / "room.simrecon").path


@pytest.fixture
def other_pack(make_bundle, tmp_path):
    return pack_scene(SceneBundle.open(make_bundle("room", "other")), tmp_path / "other.simrecon").path


@pytest.fixture
def served(tmp_path):
    """Return the address of a read-only HTTP server of `tmp_path`."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        def __init__(self, *args: object) -> None:
            super().__init__(*args, directory=str(tmp_path))

        def log_message(self, *_: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


def test_the_same_bundle_gives_the_same_bytes(pack, make_bundle, tmp_path):
    again = pack_scene(SceneBundle.open(make_bundle("room")), tmp_path / "again.simrecon")
    assert again.path.read_bytes() == pack.read_bytes()
    assert [path.name for path in tmp_path.glob(".*")] == []


def test_a_pack_is_a_plain_zip_with_true_hashes(pack, mine):
    import hashlib

    with zipfile.ZipFile(pack) as archive:
        assert archive.testzip() is None
        assert archive.namelist()[:3] == ["README.md", "manifest.json", "scene.json"]
        manifest = json.loads(archive.read("manifest.json"))
        for name, entry in manifest["files"].items():
            assert hashlib.sha256(archive.read(name)).hexdigest() == entry["sha256"]
        assert set(archive.namelist()) == {*manifest["files"], "README.md", "manifest.json"}
    assert manifest["revision"] == mine.get("room").revision


def test_a_licence_travels_and_keeps_the_revision(mine, theirs, pack, tmp_path):
    licensed = pack_scene(mine.load("room"), tmp_path / "licensed.simrecon", licence="CC-BY-4.0")
    assert licensed.path.read_bytes() != pack.read_bytes()
    added = add_scene(licensed.path, theirs)
    assert added.licence == "CC-BY-4.0" == licence_of(theirs.load("room").scene)
    assert added.record.revision == mine.get("room").revision
    back = pack_scene(theirs.load("room"), tmp_path / "back.simrecon")
    assert back.path.read_bytes() == licensed.path.read_bytes()
    with pytest.raises(UsageError, match="--licence is empty"):
        pack_scene(mine.load("room"), tmp_path / "none.simrecon", licence=" ")


def test_added_is_what_was_packed(mine, theirs, pack):
    added = add_scene(pack, theirs)
    assert (added.new, added.env_id, added.licence) == (True, "SimRecon/room", "not stated")
    assert theirs.verify("room").ok
    assert theirs.load("room").scene == mine.load("room").scene
    assert theirs.load("room").files == mine.load("room").files
    assert not add_scene(pack, theirs).new


def test_a_damaged_scene_is_repaired_by_adding_it_again(theirs, pack):
    record = add_scene(pack, theirs).record
    (record.path / "base" / "floor_000.obj").write_text("v 0 0 0\n")
    assert not theirs.verify("room").ok
    assert add_scene(pack, theirs).new
    assert theirs.verify("room").ok


def test_another_revision_needs_a_name_or_replace(theirs, pack, other_pack):
    first = add_scene(pack, theirs).record
    with pytest.raises(UsageError, match=r"--as NAME, or replace yours with --replace"):
        add_scene(other_pack, theirs)
    assert theirs.get("room") == first
    named = add_scene(other_pack, theirs, scene_id="room_2")
    assert theirs.load("room_2").scene["id"] == "room_2"
    replaced = add_scene(other_pack, theirs, replace=True)
    assert replaced.record.revision == named.record.revision != first.revision
    assert theirs.verify("room").ok
    assert theirs.verify("room_2").ok
    with pytest.raises(UsageError, match="small letters"):
        add_scene(pack, theirs, scene_id="../x")


def test_adding_at_once_agrees_on_one_scene(theirs, pack, other_pack):
    def add(file: Path) -> str:
        try:
            return "new" if add_scene(file, theirs).new else "there"
        except UsageError:
            return "taken"

    with ThreadPoolExecutor(8) as pool:
        said = list(pool.map(add, [pack] * 4 + [other_pack] * 4))
    assert sorted(said) == ["new", *["taken"] * 4, *["there"] * 3]
    assert theirs.verify("room").ok


def test_folders_and_urls_are_added_like_files(theirs, pack, make_bundle, served):
    memory = fsspec.filesystem("memory")
    memory.pipe("/packs/room.simrecon", pack.read_bytes())
    sources = [pack.as_uri(), f"{served}/room.simrecon", "memory://packs/room.simrecon", make_bundle("room")]
    found = {add_scene(s, theirs, scene_id=f"s{n}").record.revision for n, s in enumerate(sources)}
    assert len(found) == 1
    assert all(theirs.verify(f"s{n}").ok for n in range(len(sources)))


def test_missing_sources_are_named(theirs, tmp_path, served):
    (tmp_path / "none.txt").write_text("none")
    for source in (tmp_path / "none.simrecon", f"{served}/none.simrecon", "memory://none", "zzz://a/b"):
        with pytest.raises(UsageError, match=r"none|zzz"):
            add_scene(source, theirs)
    with pytest.raises(EnvironmentMissing, match=r"cannot download it.*docs/sharing.md#credentials") as error:
        add_scene("http://user:secret@127.0.0.1:9/room.simrecon?token=secret", theirs)
    assert "secret" not in str(error.value)
    with pytest.raises(BundleError) as error:
        add_scene(f"{served}/none.txt?token=secret", theirs)
    assert str(error.value).startswith(f"pack {served}/none.txt: 4 bytes are no zip file")
    assert not theirs.root.exists()


def test_a_server_that_never_ends_is_cut_off(theirs, served, pack, monkeypatch):
    monkeypatch.setattr("registry.exchange.adding.MAX_PACK_BYTES", 1000)
    with pytest.raises(BundleError, match="more than 1000 bytes"):
        add_scene(f"{served}/room.simrecon", theirs)


def test_a_folder_that_is_damaged_is_refused_before_the_registry_is_touched(theirs, make_bundle):
    folder = make_bundle("room")
    (folder / "base" / "floor_000.obj").write_text("v 0 0 1\n")
    with pytest.raises(BundleError, match="bytes"):
        add_scene(folder, theirs)
    assert not theirs.root.exists()


def test_a_damaged_scene_is_not_packed(mine, pack, tmp_path):
    path = mine.get("room").path / "base" / "floor_000.obj"
    path.write_bytes(path.read_bytes().replace(b"v 1", b"v 2"))
    with pytest.raises(BundleError, match="SHA-256"):
        pack_scene(mine.load("room"), tmp_path / "damaged.simrecon")
    assert not list(tmp_path.glob("*damaged*"))
    with pytest.raises(EnvironmentMissing, match="choose another -o"):
        pack_scene(mine.load("room"), pack / "below_a_file.simrecon")


HOSTILE = (
    "<script>alert(1)</script> [x](http://evil) | `a` \x1b[31m\n# head\u202e\ndone: ![i](http://evil/i.png)"
)


def test_cards_show_foreign_texts_as_texts(scene):
    scene["source"]["file"] = f"/home/alice/secret folder/{HOSTILE.replace('/', '')}"
    scene["objects"][0]["label"] = HOSTILE
    scene["report"]["volatile"] = {
        "licence": f'my "own": {HOSTILE}',
        "created_utc": "2026-11-26T08:00:00+00:00",
    }
    revision = "0123456789abcdef"
    card = scene_card(scene, revision)
    assert "alice" not in card
    assert all(character.isprintable() or character == "\n" for character in card)
    _, head, body = card.split("---\n", 2)
    front = yaml.safe_load(head)
    assert front["license"] == "other"
    assert front["license_name"].startswith('my "own"')
    assert set(front) == {"license", "license_name", "pretty_name", "task_categories", "tags"}
    outside = "".join(part for n, part in enumerate(body.split("`")) if n % 2 == 0)
    assert "<script>" not in outside
    assert "evil" not in outside
    assert body.count("\n# ") == 1
    assert "reconstructed | 2026-11-26" in body
    assert scene_card(scene, revision) == card


def test_cards_state_licence_figures_and_the_warning(scene):
    plain = scene_card(scene, "0" * 16)
    assert "license: unknown" in plain
    assert "not stated" in plain
    assert "photographs of a real room" in plain
    assert "faces" in plain
    assert "stay at rest for 10 s | 100 %" in plain
    assert "video.mp4" in plain
    assert "ab" * 32 in plain
    known = copy.deepcopy(scene)
    known["report"]["volatile"] = {"licence": "CC BY 4.0"}
    assert "license: cc-by-4.0" in scene_card(known, "0" * 16)
    known["report"] |= {"volatile": "x", "physics": {"stable_rate": "x", "floating_rate": None}}
    assert "rest for 10 s" not in scene_card(known, "0" * 16)
