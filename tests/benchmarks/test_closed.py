"""Meshes of scenes that are not closed once vertices in the same place are one."""

import json

import numpy as np
import pytest
import trimesh

from benchmarks.closed import main, open_edges


def saved(mesh, path):
    mesh.export(path)
    return path


def split(mesh):
    """Return a mesh whose triangles have corners of their own, as at texture seams."""
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    return trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_seams_are_no_openings_and_holes_are(tmp_path, suffix):
    ball = trimesh.creation.icosphere(1, 0.1)
    assert open_edges(saved(split(ball), tmp_path / f"closed{suffix}")) == 0
    torn = trimesh.Trimesh(ball.vertices, ball.faces[1:], process=False)
    assert open_edges(saved(torn, tmp_path / f"torn{suffix}")) == 3


def test_edges_of_four_triangles_and_turned_triangles_are_told(tmp_path):
    first, second = trimesh.creation.box((0.1, 0.1, 0.1)), trimesh.creation.box((0.1, 0.1, 0.1))
    second.apply_translation((0.1, 0.1, 0))  # they touch along one upright edge
    assert open_edges(saved(trimesh.util.concatenate([first, second]), tmp_path / "touch.glb")) == 1
    first.faces[0] = first.faces[0][::-1]
    assert open_edges(saved(first, tmp_path / "turned.glb")) == 3


def test_scenes_are_counted(tmp_path, capsys):
    home = tmp_path / "room" / "objects" / "001"
    home.mkdir(parents=True)
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    saved(box, home / "visual.glb")
    saved(box, home / "collision_000.obj")
    objects = [{"visual": "objects/001/visual.glb", "collision": ["objects/001/collision_000.obj"]}]
    (tmp_path / "room" / "scene.json").write_text(json.dumps({"objects": objects}))
    assert main([str(tmp_path)]) == 0
    assert "1 scenes: 1 visual meshes and 1 collision parts, 0 not closed" in capsys.readouterr().out
    saved(trimesh.Trimesh(box.vertices, box.faces[:-1], process=False), home / "visual.glb")
    assert main([str(tmp_path)]) == 1
    said = capsys.readouterr().out
    assert "visual.glb: 3 edges" in said
    assert "1 not closed" in said


def test_folders_without_scenes_are_an_error(tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert "no scene.json below" in capsys.readouterr().err
