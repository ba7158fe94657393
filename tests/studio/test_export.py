"""The self-contained page, without a browser: its meshes and names, and the replayed assembly."""

import base64
import re

import msgspec
import pytest
import zstandard
from hostile_text import HOSTILE
from made_scenes import BOOK, KNOB, TABLE

from studio.export import MAX_BYTES, export_html, write_export


def recording_of(html):
    """Return the messages of a page, as (time, message)."""
    data = base64.b64decode(re.search(r'__VISER_EMBED_DATA__="([^"]+)"', html).group(1))
    raw = zstandard.ZstdDecompressor().decompressobj().decompress(data[8:])
    length = int.from_bytes(raw[:8], "little")
    return msgspec.msgpack.decode(raw[8 : 8 + length])


@pytest.fixture(scope="module")
def html(made_registry):
    return export_html(made_registry, "room")


def test_all_meshes_and_names_are_in_the_page(html, made_registry):
    messages = [m for _, m in recording_of(html)["messages"]]
    names = {m.get("name") for m in messages}
    bundle = made_registry.load("room")
    for item in bundle.objects:
        assert f"/objects/{item.id}/mesh" in names
        assert f"/objects/{item.id}/name" in names
    assert {f"/room/{b.id}" for b in bundle.base} <= names


def test_the_assembly_ends_with_every_object_shown_at_its_pose(html, made_registry):
    recording = recording_of(html)
    shown, position, appeared = {}, {}, {}
    for time, message in recording["messages"]:
        if message["type"] == "SetSceneNodeVisibilityMessage":
            shown[message["name"]] = message["visible"]
            if message["visible"]:
                appeared.setdefault(message["name"], time)
        elif message["type"] == "SetPositionMessage":
            position[message["name"]] = message["position"]
    bundle = made_registry.load("room")
    for item in bundle.objects:
        name = f"/objects/{item.id}"
        assert shown[name]
        assert position[name] == pytest.approx(item.world_from_object[:3, 3], abs=1e-5)
    assert appeared[f"/objects/{TABLE}"] < appeared[f"/objects/{BOOK}"] < appeared[f"/objects/{KNOB}"]
    assert recording["durationSeconds"] > appeared[f"/objects/{KNOB}"] + 1


def test_the_page_asks_for_nothing(html):
    outside = re.sub(r'__VISER_EMBED_DATA__="[^"]+"', "", html)
    assert not re.findall(r"""<(?:script|link|img)[^>]+(?:src|href)=["']?https?:""", outside)
    assert "<title>room</title>" in html


def test_a_hostile_scene_is_exported_as_text(made_registry, tmp_path):
    path = tmp_path / "hostile.html"
    assert write_export(made_registry, "hostile", path) == path.stat().st_size < MAX_BYTES
    assert HOSTILE not in path.read_text(encoding="utf-8")
    labels = [
        m
        for _, m in recording_of(path.read_text(encoding="utf-8"))["messages"]
        if m["type"] == "LabelMessage"
    ]
    assert labels
    assert all("\x07" not in m["props"]["text"] and "\u202e" not in m["props"]["text"] for m in labels)
