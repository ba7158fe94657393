"""The GLB export: valid glTF, named nodes with extras, correct poses."""

import json
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh
from blender import blender_python
from exports_room import FREE, KNOB, names, world_box
from gltf_validator import gltf_issues

from reconstruction.exports import export_scene
from registry.geometry import GLTF_FROM_WORLD, transform_points

pytestmark = pytest.mark.stage


@pytest.fixture(scope="module")
def file(bundle, tmp_path_factory):
    return export_scene(bundle, ["glb"], tmp_path_factory.mktemp("glb_out") / "room").main["glb"]


def _corners(box):
    return np.array([[box[i][0], box[j][1], box[k][2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


def test_every_node_is_where_and_how_large_the_bundle_says(bundle, file):
    scene = trimesh.load(file)
    found = {}
    for node in scene.graph.nodes_geometry:
        pose, geometry = scene.graph[node]
        found[node] = scene.geometry[geometry].copy().apply_transform(pose).bounds
    assert set(found) == set(names(bundle).values())
    for item in (*bundle.base, *bundle.objects):
        wanted = transform_points(GLTF_FROM_WORLD, _corners(world_box(bundle, item)))
        np.testing.assert_allclose(
            found[names(bundle)[item.id]], [wanted.min(axis=0), wanted.max(axis=0)], atol=1e-6
        )


def test_looks_are_the_textures_of_the_bundle(bundle, file):
    scene = trimesh.load(file)
    for item in bundle.objects:
        own = trimesh.load(bundle.resolve(item.visual), force="mesh", process=False)
        geometry = scene.geometry[scene.graph[names(bundle)[item.id]][1]]
        picture, wanted = (m.visual.material.baseColorTexture for m in (geometry, own))
        np.testing.assert_array_equal(np.asarray(picture), np.asarray(wanted))


def test_nodes_carry_their_facts(bundle, file):
    raw = file.read_bytes()
    document = json.loads(raw[20 : 20 + struct.unpack("<I", raw[12:16])[0]])
    facts = {node["extras"]["id"]: node["extras"] for node in document["nodes"]}
    edges = {edge.child: edge for edge in bundle.edges}
    for item in bundle.objects:
        assert facts[item.id]["label"] == item.label
        assert facts[item.id]["mass_kg"] == item.mass_kg
        assert facts[item.id]["dynamic"] == (item.id in FREE | {KNOB})
        assert facts[item.id]["relation"] == edges[item.id].relation
        assert facts[item.id]["parent"] == edges[item.id].parent
    assert {facts[item.id]["kind"] for item in bundle.base} == {"base"}


def test_files_of_others_keep_their_own_nodes(bundle, file, tmp_path):
    """The nodes of a .glb with two nodes and no texture become children of the named node."""
    from dataclasses import replace

    from reconstruction.exports.glb import write_glb_scene
    from reconstruction.exports.scene import read_scene

    other = trimesh.Scene([trimesh.creation.box((1, 1, 1)), trimesh.creation.icosphere(radius=0.7)])
    (tmp_path / "other.glb").write_bytes(other.export(file_type="glb"))
    scene = read_scene(bundle)
    first = scene.bodies[2]
    changed = replace(scene, bodies=(*scene.bodies[:2], replace(first, visual=tmp_path / "other.glb")))
    write_glb_scene(changed, tmp_path)
    loaded = trimesh.load(tmp_path / "scene.glb")
    pose = loaded.graph[first.name][0]
    assert len(loaded.geometry) == 4
    np.testing.assert_allclose(
        pose[:3, 3], GLTF_FROM_WORLD[:3, :3] @ first.world_from_object[:3, 3], atol=1e-6
    )


def test_khronos_validator_finds_nothing(file):
    ((_, issues),) = gltf_issues([file]).items()
    assert [issue for issue in issues if issue["severity"] < 2] == []


@pytest.fixture(scope="module")
def in_blender(file):
    """Blender reads the file, in a separate Python, since its wheel needs an older NumPy."""
    python = blender_python()
    if python is None:
        pytest.skip("Blender as a module is not installed (tools/setup_blender.sh)")
    script = Path(__file__).with_name("blender_scene.py")
    run = subprocess.run([python, script, file], capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr
    (line,) = [line for line in run.stdout.splitlines() if line.startswith("SCENE ")]
    return json.loads(line.removeprefix("SCENE "))


@pytest.mark.end_to_end
def test_blender_has_every_thing_at_its_place_in_metres(bundle, in_blender):
    assert set(in_blender["objects"]) == set(names(bundle).values())
    assert in_blender["metres_a_unit"] == 1.0
    for item in (*bundle.base, *bundle.objects):
        found = in_blender["objects"][names(bundle)[item.id]]
        pose = getattr(item, "world_from_object", np.eye(4))
        np.testing.assert_allclose(found["matrix"], pose, atol=1e-5)  # +z up again
        np.testing.assert_allclose([found["low"], found["high"]], world_box(bundle, item), atol=1e-5)


@pytest.mark.end_to_end
def test_blender_has_looks_and_facts(bundle, in_blender):
    for item in bundle.objects:
        found = in_blender["objects"][names(bundle)[item.id]]
        own = trimesh.load(bundle.resolve(item.visual), force="mesh", process=False)
        assert found["faces"] == len(own.faces)
        assert found["uv_layers"] == 1
        (material,) = found["materials"]
        assert material["name"] == names(bundle)[item.id]
        wanted = np.asarray(own.visual.material.baseColorTexture)[::-1, :, :3]
        pixels = np.reshape(material["pixels"], (*material["size"][::-1], 4))
        np.testing.assert_allclose(255 * pixels[..., :3], wanted, atol=0.5)
        assert found["properties"]["mass_kg"] == pytest.approx(item.mass_kg)
        assert found["properties"]["label"] == item.label
        assert found["properties"]["id"] == item.id
