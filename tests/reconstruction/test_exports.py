"""All export formats: bodies, folders, the command."""

import json
import shutil
import sys

import numpy as np
import pytest
from exports_room import BOOK, HANDLE, KNOB, MOVING, PICTURE, make_room

from reconstruction.cli import main
from reconstruction.exports import FORMATS, export_scene
from reconstruction.exports.scene import possible_inertia, read_scene, safe_name
from registry import SceneBundle, SceneRegistry, seal_bundle
from registry.errors import UsageError
from registry.rigid_groups import moving_ids, welded_to


@pytest.fixture(scope="module")
def registry(bundle, tmp_path_factory):
    root = tmp_path_factory.mktemp("exports_registry")
    folder = tmp_path_factory.mktemp("staged") / "bundle"
    shutil.copytree(bundle.root, folder)
    registry = SceneRegistry(root, create=True)
    registry.publish(folder, "room")
    return root


def test_what_hangs_moves_with_what_carries_it(bundle):
    assert moving_ids(bundle) == MOVING
    assert welded_to(bundle) == {KNOB: BOOK}  # the picture and the handle hang on what is static
    assert {PICTURE, HANDLE}.isdisjoint(MOVING)


@pytest.mark.parametrize(
    ("label", "name"),
    [("box", "box_7"), ("mug / cup", "mug_cup_7"), ("42", "thing_42_7"), ("鍋", "thing_7"), ("_", "thing_7")],
)
def test_names_are_fit_for_every_format(label, name):
    assert safe_name(label, 7) == name


def test_a_possible_inertia_is_kept_to_the_bit():
    tensor = np.array([[2.0, 0.1, 0.0], [0.1, 2.5, 0.2], [0.0, 0.2, 3.0]])
    kept, changed = possible_inertia(tensor)
    assert not changed
    np.testing.assert_array_equal(kept, tensor)


@pytest.mark.parametrize("moments", [(1.0, 1.0, 5.0), (1e-9, 2.0, 2.0), (0.1, 0.2, 0.9)])
def test_an_impossible_inertia_becomes_the_nearest_possible_one(moments):
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    fixed, changed = possible_inertia(turn @ np.diag(moments) @ turn.T)
    low, middle, high = np.linalg.eigvalsh(fixed)
    assert changed
    assert low + middle >= high
    assert high == pytest.approx(max(moments), rel=1e-3)


def test_a_bundle_without_inertia_gets_that_of_its_pieces(bundle, tmp_path):
    folder = tmp_path / "without"
    make_room(folder)
    scene = json.loads((folder / "scene.json").read_text())
    for item in scene["objects"]:
        del item["inertia"]
    (folder / "manifest.json").unlink()
    seal_bundle(folder, scene)
    bodies = {body.id: body for body in read_scene(SceneBundle.open(folder)).bodies}
    for item in bundle.objects:
        if item.id in (BOOK, KNOB, PICTURE):  # one piece each: nothing overlaps, nothing is flat
            np.testing.assert_allclose(bodies[item.id].inertia, item.inertia, rtol=1e-5, atol=1e-9)


def test_formats_gather_in_one_folder_and_a_new_revision_replaces_them(bundle, tmp_path):
    out = tmp_path / "new" / "room"
    export_scene(bundle, ["urdf"], out)
    result = export_scene(bundle, ["glb"], out)
    index = json.loads((out / "export.json").read_text())
    assert set(index["formats"]) == {"urdf", "glb"}
    assert result.files == len({name for files in index["formats"].values() for name in files})
    present = {str(p.relative_to(out)) for p in out.rglob("*") if p.is_file()}
    assert present == {name for files in index["formats"].values() for name in files} | {"export.json"}
    scene = json.loads((bundle.root / "scene.json").read_text())
    scene["objects"][1]["mass_kg"] = 0.35
    folder = tmp_path / "changed"
    make_room(folder)
    (folder / "manifest.json").unlink()
    seal_bundle(folder, scene)
    export_scene(SceneBundle.open(folder), ["glb"], out)
    assert {str(p.relative_to(out)) for p in out.rglob("*") if p.is_file()} == {"export.json", "scene.glb"}


def test_the_same_bundle_gives_the_same_bytes(bundle, tmp_path):
    pytest.importorskip("pxr", reason="needs simrecon[exports]")
    first, second = (export_scene(bundle, list(FORMATS), tmp_path / name).folder for name in "ab")
    for path in first.rglob("*"):
        if path.is_file():
            assert path.read_bytes() == (second / path.relative_to(first)).read_bytes(), path.name


def test_folders_of_others_are_left_alone(bundle, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UsageError, match="choose another --out"):
        export_scene(bundle, ["glb"], tmp_path)
    (tmp_path / "export.json").write_text(json.dumps({"scene": "room", "formats": {"glb": ["../notes.txt"]}}))
    with pytest.raises(UsageError, match="cannot be read"):
        export_scene(bundle, ["glb"], tmp_path)
    (tmp_path / "export.json").write_text(json.dumps({"scene": "kitchen", "formats": {}}))
    with pytest.raises(UsageError, match="'kitchen'"):
        export_scene(bundle, ["glb"], tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_the_command_writes_and_says_what_to_open(registry, tmp_path, capsys):
    arguments = ["export", "room", "--to", "mjcf,glb", "--out", str(tmp_path / "out")]
    assert main([*arguments, "--registry", str(registry)]) == 0
    said = capsys.readouterr().out
    assert str(tmp_path / "out" / "scene.xml") in said
    assert main([*arguments, "--registry", str(registry), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["files"]["glb"] == str(tmp_path / "out" / "scene.glb")


def test_without_usd_core_it_says_which_extra_to_install(registry, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)  # as where it is not installed
    out = tmp_path / "out"
    assert main(["export", "room", "--to", "usd", "--out", str(out), "--registry", str(registry)]) == 4
    assert "simrecon[exports]" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_an_unknown_scene_or_format_is_wrong_use(registry, tmp_path, capsys):
    out = ["--out", str(tmp_path / "out"), "--registry", str(registry)]
    assert main(["export", "attic", "--to", "glb", *out]) == 2
    with pytest.raises(SystemExit) as error:
        main(["export", "room", "--to", "fbx", *out])
    assert error.value.code == 2
    assert "fbx" in capsys.readouterr().err


@pytest.mark.parametrize("format_", ["mjcf", "urdf", "glb"])
def test_a_backdrop_is_exported_without_a_collision_shape(tmp_path, format_):
    bundle = make_room(tmp_path / "bundle", backdrop=True)
    done = export_scene(bundle, [format_], tmp_path / "out")
    text = done.main[format_].read_text(errors="replace")
    assert "backdrop_0" in text
    assert "backdrop_0_000" not in text
    assert not list((tmp_path / "out").glob("meshes/*backdrop*collision*"))
    if format_ == "glb":
        assert '"kind":"backdrop"' in text.replace(" ", "")
