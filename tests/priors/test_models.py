"""Models of others in generated rooms: places, looks, sizes; tables that cannot be read."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from priors import dataset
from priors.rooms import MODELS_TABLE, Sources, draw_film
from registry.errors import InputError
from synthetic.furniture import Workshop
from synthetic.model_library import read_records, use_models
from synthetic.shapes import COARSE

pytestmark = pytest.mark.stage

TABLE = """
models:
  desk: {file: desk/textured.obj, use: table, label: desk, scale: 0.01}
  print: {file: desk/textured.obj, use: wall, label: picture, scale: 0.005, hangs_m: [1.0, 1.2]}
  elsewhere: {file: elsewhere/textured.obj, use: thing, label: cup}
"""
HALVES = (255, 0)  # of red: the left half of the picture, and its right half


def write_box(file: Path, size: tuple[float, float, float]) -> None:
    """Write a closed box whose sides all show one picture, red on its left."""
    box = trimesh.creation.box(size)
    box.unmerge_vertices()
    corners = box.vertices.reshape(-1, 3, 3)
    axis = np.abs(box.face_normals).argmax(1)
    uv = np.concatenate(
        [(c[:, np.delete(np.arange(3), a)] / np.delete(size, a)) + 0.5 for c, a in zip(corners, axis)]
    )
    image = np.zeros((64, 64, 3), np.uint8)
    image[:, :32, 2], image[:, 32:, 2] = HALVES
    file.parent.mkdir(parents=True)
    cv2.imwrite(str(file.parent / "look.png"), image)
    lines = [f"v {x} {y} {z}" for x, y, z in box.vertices] + [f"vt {u} {v}" for u, v in uv]
    lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in face) for face in box.faces]
    file.write_text("mtllib textured.mtl\nusemtl look\n" + "\n".join(lines) + "\n")
    (file.parent / "textured.mtl").write_text("newmtl look\nmap_Kd somewhere/else/look.png\n")


@pytest.fixture
def library(tmp_path):
    write_box(tmp_path / "desk" / "textured.obj", (120, 60, 75))
    (tmp_path / "table.yaml").write_text(TABLE)
    yield use_models(tmp_path / "table.yaml", tmp_path)
    use_models(None, None)


def made(library, key: str, step_m: float = COARSE):
    return library.kind(key).make(Workshop(np.random.default_rng(3), step_m), "x/")


def test_only_models_whose_files_are_there_are_used(library):
    assert sorted(library.records) == ["desk", "print"]
    assert library.keys("table") == ["models_desk"]
    assert library.kind("chair") is None


def test_a_desk_carries_things_on_its_whole_top(library):
    desk = made(library, "models_desk")
    np.testing.assert_allclose(desk.size, (1.2, 0.6, 0.75), atol=1e-6)
    (place,) = desk.places
    assert place.height_m == pytest.approx(0.75)
    assert np.isinf(place.headroom_m)
    np.testing.assert_allclose(np.ptp(place.area, axis=0), (1.2, 0.6), atol=1e-6)


def test_what_hangs_has_its_back_on_the_wall_and_carries_nothing(library):
    hung = made(library, "models_print")
    points = np.concatenate([p.vertices for part in hung.parts for p in part])
    assert points[:, 1].max() == pytest.approx(0, abs=1e-9)
    assert points[:, 2].min() == pytest.approx(0)
    assert not hung.places


def test_a_picture_found_by_its_name_lies_where_the_file_says(library):
    desk = made(library, "models_desk", step_m=0.05)
    (part,) = desk.parts
    (patch,) = part
    assert len(patch.faces) > 24  # divided, so that light can vary over it
    look = desk.textures[patch.texture]
    share = patch.uvs_m / (look.width_m, look.height_m)
    top = patch.normals[:, 2] > 0.9
    # On the top, u runs along x: red where x < 0.
    red = look.pixels[
        np.clip(((1 - share[:, 1]) * 63).astype(int), 0, 63),
        np.clip((share[:, 0] * 63).astype(int), 0, 63),
        0,
    ]
    away = np.abs(patch.vertices[:, 0]) > 0.1
    assert (red[top & away] > 100).tolist() == (patch.vertices[top & away, 0] < 0).tolist()
    # One metre of texture is about one metre of surface: 1.2 x 0.6 x 0.75 m boxes show it at .55 to 1.2 m.
    assert 0.6 < look.width_m < 1.0


def test_a_sheet_is_seen_from_both_sides(tmp_path):
    (tmp_path / "sheet.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 0 1\nv 0 0 1\nf 1 2 3\nf 1 3 4\n")
    (tmp_path / "table.yaml").write_text("models: {sheet: {file: sheet.obj, use: thing, label: sheet}}")
    library = use_models(tmp_path / "table.yaml", tmp_path)
    try:
        normals = np.concatenate([p.normals for part in made(library, "models_sheet").parts for p in part])
    finally:
        use_models(None, None)
    assert set(np.round(normals[:, 1]).tolist()) == {-1.0, 1.0}


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("models: {a: {file: a.obj, use: lamp, label: a}}", "use lamp, there are thing"),
        ("models: {a: {file: a.obj, use: thing, label: a}}", "none of the 1 files"),
        ("models: {a: {path: a.obj}}", "not a table of models"),
        ("- a", "not a table of models"),
    ],
)
def test_a_table_that_cannot_be_used_is_told(tmp_path, table, message):
    (tmp_path / "table.yaml").write_text(table)
    with pytest.raises(InputError, match=message):
        read_records(tmp_path / "table.yaml", tmp_path)


def test_a_room_is_furnished_with_models(tmp_path):
    for record in ("blue_cup", "yellow_cup", "soap", "poker_1"):
        file = f"ChenEating716+pybullet-URDF-models/urdf_models/models/{record}/textured.obj"
        assert file in MODELS_TABLE.read_text()
        write_box(tmp_path / file, (0.09, 0.07, 0.08))
    sources = Sources(models=tmp_path)
    names = [e.name for number in range(3) for e in draw_film("models", number, sources).room.entities]
    assert any(name.startswith("models_") for name in names)
    assert not any(e.name.startswith("models_") for e in draw_film("train", 20001).room.entities)


def test_rooms_with_models_need_a_folder_of_models():
    with pytest.raises(InputError, match="--models"):
        draw_film("models", 0)


def test_commands_say_at_once_that_models_are_missing(tmp_path, capsys):
    for words in ([], ["--models", str(tmp_path)]):
        with pytest.raises(SystemExit):
            dataset.main([str(tmp_path / "out"), "--split", "models", *words])
        assert "docs/priors.md" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_mesh_with_too_many_triangles_is_refused(tmp_path):
    trimesh.creation.icosphere(6).export(tmp_path / "ball.obj")
    (tmp_path / "table.yaml").write_text("models: {ball: {file: ball.obj, use: thing, label: ball}}")
    library = use_models(tmp_path / "table.yaml", tmp_path)
    try:
        with pytest.raises(InputError, match="81920 triangles, expected 1 to 25000"):
            made(library, "models_ball")
    finally:
        use_models(None, None)
