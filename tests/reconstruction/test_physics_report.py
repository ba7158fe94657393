"""The physics report in the commands: `simrecon verify --physics` and `--require-stable`."""

import json
import shutil
from types import SimpleNamespace

import mujoco
import pytest
from boxes import box, room
from exports_room import BOOK, HANDLE, KNOB, MUG, PICTURE, TABLE

from reconstruction.assembly import AssemblyConfig, assemble
from reconstruction.cli import main
from reconstruction.commands.scenes import describe_physics
from reconstruction.core.types import Edge, SceneGraph
from reconstruction.exports import export_scene
from reconstruction.publish.write import object_entry, publish_scene
from registry import SceneRegistry, seal_bundle
from registry.errors import SimReconError


@pytest.fixture(scope="module")
def verified(bundle, tmp_path_factory):
    """Output of `simrecon verify --physics --json` for the room of the export tests."""
    folder, root = tmp_path_factory.mktemp("staged") / "bundle", tmp_path_factory.mktemp("registry")
    shutil.copytree(bundle.root, folder)
    SceneRegistry(root, create=True).publish(folder, "room")
    return root


def test_verify_measures_the_published_scene_again(verified, capsys):
    assert main(["verify", "room", "--registry", str(verified), "--physics", "--json"]) == 0
    physics = json.loads(capsys.readouterr().out)["physics"]
    assert physics["stable_rate"] == physics["at_rest_rate"] == 1.0
    contacts = physics["contacts"]
    assert contacts["support_edges_real"] == contacts["support_edges"] == 5
    assert contacts["supports_without_edge"] == []
    assert {o["id"] for o in physics["fixed"]} >= {HANDLE, PICTURE} - {o["id"] for o in physics["objects"]}
    assert {TABLE, MUG, BOOK} <= {o["id"] for o in physics["objects"]}
    hung = {e["child"] for e in contacts["edges_without_contact"]}
    assert KNOB not in hung


def test_verify_says_it_in_words(verified, capsys):
    assert main(["verify", "room", "--registry", str(verified), "--physics"]) == 0
    said = capsys.readouterr().out
    assert "all files are intact" in said
    assert "physics: stable 100%" in said
    assert "edges are in contact" in said


def test_what_has_no_collision_shape_is_named_and_loads(bundle, tmp_path, capsys):
    folder = tmp_path / "bundle"
    shutil.copytree(bundle.root, folder)
    scene = json.loads((folder / "scene.json").read_text())
    (picture,) = (item for item in scene["objects"] if item["id"] == PICTURE)
    for path in picture["collision"]:
        (folder / path).unlink()
    picture |= {"collision": [], "dynamic": False}
    seal_bundle(folder, scene)
    root = tmp_path / "registry"
    SceneRegistry(root, create=True).publish(folder, "bare")
    assert main(["verify", "bare", "--registry", str(root), "--physics"]) == 0
    assert f"picture {PICTURE} has no collision shape" in capsys.readouterr().out
    exported = export_scene(SceneRegistry(root).load("bare"), ["mjcf"], tmp_path / "mjcf")
    assert mujoco.MjModel.from_xml_path(str(exported.main["mjcf"])).nbody > 8


def test_assembly_without_a_collision_shape_is_published_without_one(tmp_path):
    """An object whose collision parts the assembly removed gets none, not those of the asset."""
    assets = room(box(10, (1.2, 0.6, 0.9), (0, 0, 0)), box(11, (1.2, 0.6, 0.9), (0, 0, 0)))
    graph = SceneGraph(tuple(Edge(i, "supported_by", 1, 1.0, "") for i in (10, 11)))
    placed = assemble(assets, graph, AssemblyConfig()).placed
    entries = [object_entry(a, p, False, tmp_path) for a, p in zip(assets.objects, placed)]
    assert [len(entry["collision"]) for entry in entries] == [1, 0]
    assert not list((tmp_path / "objects" / "011").glob("collision*"))


def test_a_scene_that_does_not_rest_is_not_published(tmp_path):
    assets = room(box(10, (0.3, 0.2, 0.1), (0, 0, 0.3)), box(11, (0.1, 0.1, 0.1), (1, 0, -0.004)))
    graph = SceneGraph((Edge(10, "supported_by", 1, 1.0, ""), Edge(11, "supported_by", 10, 1.0, "")))
    scene = assemble(assets, graph, AssemblyConfig(method="in-situ"))
    lines = "\n".join(describe_physics(scene.physics_report))
    assert "11 supported_by 10: no contact" in lines
    assert "11 rests on 1: no edge" in lines
    assert "box_10 floats at the start" in lines
    registry = SceneRegistry(tmp_path / "registry", create=True)
    run = SimpleNamespace(results={"assembly": scene})
    with pytest.raises(SimReconError, match=r"box_10 does not stay put.*overlap by 4\.0 mm.*--overrides"):
        publish_scene(run, registry, "falls", require_stable=True)
    assert not registry.list()
