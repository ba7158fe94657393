"""Bundles: round trip, content addresses, rejection of damaged or malicious ones."""

import json
import os

import numpy as np
import pytest

from registry import BundleError, SceneBundle, seal_bundle
from registry import bundle as bundle_module


def test_sealed_bundle_opens_with_what_was_sealed(make_staging, scene, glb_bytes):
    folder = make_staging(scene)
    bundle = SceneBundle.open(folder)
    assert bundle.scene == scene
    assert [o.label for o in bundle.objects] == ["table", "cup"]
    assert bundle.objects[1].world_from_object[2, 3] == 0.3
    assert bundle.objects[0].collision == ("objects/002/collision_000.obj",)
    assert bundle.objects[0].inertia.shape == (3, 3)
    assert bundle.base[0].label == "floor"
    assert bundle.base[0].observed
    np.testing.assert_array_equal(bundle.base[0].plane, [0, 0, 1, 0])
    assert [(e.child, e.relation, e.parent) for e in bundle.edges] == [
        (3, "supported_by", 2),
        (2, "supported_by", 1),
    ]
    assert bundle.cameras.world_from_camera.shape == (3, 4, 4)
    assert bundle.cameras.indices.tolist() == [0, 3, 9]
    assert bundle.resolve("objects/003/visual.glb").read_bytes() == glb_bytes()


def test_manifest_lists_every_other_file(make_staging):
    folder = make_staging()
    listed = json.loads((folder / "manifest.json").read_text())["files"]
    there = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    assert set(listed) == there - {"manifest.json"}


def test_revision_ignores_the_id_and_what_differs_between_equal_runs(make_staging, scene):
    first = SceneBundle.open(make_staging(scene)).revision
    scene["id"] = "kitchen"
    scene["report"]["timings_s"] = {"frames": 99.0}
    scene["report"]["peak_memory_mb"] = 1.0
    scene["report"]["volatile"] = {"host": "elsewhere"}
    assert SceneBundle.open(make_staging(scene)).revision == first
    assert len(first) == 16


@pytest.mark.parametrize("change", ["mass", "file", "config"])
def test_revision_follows_the_content(make_staging, scene, change):
    first = SceneBundle.open(make_staging(scene)).revision
    if change == "mass":
        scene["objects"][0]["mass_kg"] = 4.0
    if change == "config":
        scene["report"]["config"]["preset"] = "fast"
    folder = make_staging(scene, marker="other" if change == "file" else "")
    assert SceneBundle.open(folder).revision != first


def test_sealing_again_gives_the_same_bytes(make_staging, scene):
    folder = make_staging(scene)
    before = {name: (folder / name).read_bytes() for name in ("scene.json", "manifest.json")}
    seal_bundle(folder, scene)
    assert before == {name: (folder / name).read_bytes() for name in before}


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_sealing_refuses_what_json_cannot_say(tmp_path, write_files, scene, value):
    write_files(tmp_path)
    scene["report"]["physics"]["worst"] = value
    with pytest.raises(BundleError, match="finite"):
        seal_bundle(tmp_path, scene)


def test_sealing_refuses_a_missing_mesh(tmp_path, write_files, scene):
    write_files(tmp_path)
    (tmp_path / "objects/003/visual.glb").unlink()
    with pytest.raises(BundleError, match=r"objects\[1\].visual: .* is not in the bundle"):
        seal_bundle(tmp_path, scene)


@pytest.mark.parametrize(
    "path",
    [
        "../secret",
        "objects/../../secret",
        "/etc/passwd",
        "objects\\..\\..\\secret",
        "C:/secret",
        "~/secret",
        "",
        "objects//x",
        "./scene.json",
        "objects/\x00",
        "objects/absent.glb",
        "manifest.json",
    ],
)
def test_resolve_never_leaves_the_bundle(make_staging, path):
    bundle = SceneBundle.open(make_staging())
    with pytest.raises(BundleError):
        bundle.resolve(path)


def test_resolve_refuses_a_link_made_after_opening(make_staging, tmp_path):
    bundle = SceneBundle.open(make_staging())
    victim = bundle.root / "objects/003/visual.glb"
    victim.unlink()
    victim.symlink_to(tmp_path)
    with pytest.raises(BundleError, match="symbolic link"):
        bundle.resolve("objects/003/visual.glb")


def _flip_byte(folder):
    path = folder / "objects/002/collision_000.obj"
    data = bytearray(path.read_bytes())
    data[3] ^= 1
    path.write_bytes(bytes(data))


def _edit_scene(folder):
    path = folder / "scene.json"
    path.write_text(path.read_text().replace('"mass_kg": 3.5', '"mass_kg": 9.5'))


def _edit_manifest_hash(folder):
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["files"]["base/floor.glb"]["sha256"] = "0" * 64
    (folder / "manifest.json").write_text(json.dumps(manifest))


def _edit_revision(folder):
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["revision"] = "0" * 16
    (folder / "manifest.json").write_text(json.dumps(manifest))


def _deep(folder):
    (folder / "/".join("abcdefghijkl")).mkdir(parents=True)


TAMPERING = {
    "flipped byte": (_flip_byte, "SHA-256"),
    "longer file": (lambda f: (f / "base/floor.glb").write_bytes(b"x" * 999), "the manifest says"),
    "missing file": (lambda f: (f / "base/floor.glb").unlink(), "not in the folder"),
    "extra file": (lambda f: (f / "extra.bin").write_bytes(b"x"), "not in the manifest"),
    "edited scene": (_edit_scene, "scene.json does not match"),
    "edited manifest hash": (_edit_manifest_hash, "revision"),
    "edited revision": (_edit_revision, "revision"),
    "linked file": (lambda f: (f / "link.obj").symlink_to("/etc/passwd"), "symbolic link"),
    "linked folder": (lambda f: (f / "link").symlink_to("/etc"), "symbolic link"),
    "pipe": (lambda f: os.mkfifo(f / "pipe"), "not a plain file"),
    "deep folders": (_deep, "nested"),
    "backslash name": (lambda f: (f / "a\\b").write_bytes(b""), "not a plain relative path"),
    "no scene.json": (lambda f: (f / "scene.json").unlink(), "scene.json"),
    "no manifest": (lambda f: (f / "manifest.json").unlink(), "manifest.json is missing"),
    "manifest no JSON": (lambda f: (f / "manifest.json").write_text("{"), "not JSON"),
    "manifest is a list": (lambda f: (f / "manifest.json").write_text("[]"), "is not a"),
    "manifest bomb": (lambda f: (f / "manifest.json").write_text("[" * 100_000), "nested|not JSON"),
}


@pytest.mark.parametrize("kind", TAMPERING)
def test_tampering_is_found(make_staging, kind):
    folder = make_staging()
    tamper, message = TAMPERING[kind]
    tamper(folder)
    with pytest.raises(BundleError, match=message):
        SceneBundle.open(folder)


@pytest.mark.parametrize(
    ("limit", "value"), [("MAX_FILES", 5), ("MAX_FILE_BYTES", 60), ("MAX_TOTAL_BYTES", 500), ("MAX_DEPTH", 1)]
)
def test_limits_hold(make_staging, monkeypatch, limit, value):
    folder = make_staging()
    monkeypatch.setattr(bundle_module, limit, value)
    with pytest.raises(BundleError, match="more than"):
        SceneBundle.open(folder)


def test_a_huge_file_is_refused_before_it_is_read(make_staging):
    folder = make_staging()
    with (folder / "huge.bin").open("wb") as file:
        file.truncate(300 << 20)  # sparse: takes no space
    with pytest.raises(BundleError, match="256 MiB"):
        SceneBundle.open(folder)


@pytest.mark.parametrize("text", ['{"a": NaN}', '{"a": 1e999}', '{"a": 1, "a": 2}', "\xff", "{'a': 1}"])
def test_scene_json_is_strict(make_staging, text):
    folder = make_staging()
    data = text.encode("latin-1")
    (folder / "scene.json").write_bytes(data)
    manifest = json.loads((folder / "manifest.json").read_text())
    digest = bundle_module.hash_file(folder / "scene.json")
    manifest["files"]["scene.json"] = {"sha256": digest, "bytes": len(data)}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(BundleError, match=r"scene\.json"):
        SceneBundle.open(folder)


@pytest.mark.parametrize("uri", ["../../secret.bin", "/etc/passwd", "https://example.com/a.png"])
@pytest.mark.parametrize("group", ["buffers", "images"])
def test_a_glb_that_names_other_files_is_refused(tmp_path, write_files, scene, glb_bytes, group, uri):
    write_files(tmp_path)
    document = {"asset": {"version": "2.0"}, group: [{"uri": uri}]}
    (tmp_path / "base/floor.glb").write_bytes(glb_bytes(document))
    with pytest.raises(BundleError, match="names another file"):
        seal_bundle(tmp_path, scene)


def test_an_obj_that_names_other_files_is_refused(tmp_path, write_files, scene):
    write_files(tmp_path)
    path = tmp_path / "objects/002/collision_000.obj"
    path.write_text("mtllib ../../../secret.mtl\n" + path.read_text())
    with pytest.raises(BundleError, match="line 1: 'mtllib'"):
        seal_bundle(tmp_path, scene)


def test_an_absent_folder_says_so(tmp_path):
    with pytest.raises(BundleError, match="no such folder"):
        SceneBundle.open(tmp_path / "absent")
