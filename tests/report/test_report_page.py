"""The page of a small room: complete, self-contained, deterministic, with reasons for missing content."""

import base64
import html
import json
import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from reconstruction.cli import main
from reconstruction.measure.evaluate import evaluate_scene
from reconstruction.measure.ground_truth import GroundTruth
from reconstruction.measure.outlines import measure_outlines
from reconstruction.measure.report import pictures
from reconstruction.measure.report.collect import Gathered
from reconstruction.measure.report.outline_section import outline_section
from reconstruction.measure.report.page import build_page
from reconstruction.measure.report.truth import Truth
from reconstruction.measure.stage_results import StageResults

pytestmark = pytest.mark.stage

SECTIONS = [
    "cameras", "depth", "gaussians", "surface", "instances", "objects", "graph", "assembly", "kept-out", "physics",
    "cost", "notes",
]  # fmt: skip


def images(page: str) -> list[np.ndarray]:
    """Decode all images of a page."""
    found = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', page)
    return [cv2.imdecode(np.frombuffer(base64.b64decode(x), np.uint8), cv2.IMREAD_COLOR) for x in found]


def left_out(page: str) -> list[str]:
    return [html.unescape(text) for text in re.findall(r'<p class="left-out">([^<]+)</p>', page)]


def test_nothing_is_left_out_and_all_sections_are_there(page):
    assert left_out(page) == []
    assert re.findall(r'<section id="([\w-]+)"', page) == SECTIONS
    for name in SECTIONS:
        assert f'href="#{name}"' in page


def test_every_picture_shows_something(page):
    pixels = images(page)
    assert len(pixels) > 40
    for image in pixels:
        assert image.std() > 3


def test_it_asks_nothing_of_the_network(page, page_with_truth):
    for text in (page, page_with_truth):
        asked = re.findall(r'(?:src|href|xlink:href)="([^"]*)"', text)
        assert {x.split(":")[0] if x.startswith("data:") else x[:1] for x in asked} == {"data", "#"}
        addresses = set(re.findall(r"https?://[^\s\"'<>)]+", re.sub(r"base64,[^\"]+", "", text)))
        assert addresses <= {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}
        assert "@import" not in text
        assert "url(h" not in text


def test_ids_of_inline_plots_do_not_clash(page):
    ids = re.findall(r'\sid="([^"]+)"', page)
    assert len(ids) == len(set(ids))
    assert {x[1:] for x in re.findall(r'xlink:href="([^"]+)"', page)} <= set(ids)


def test_it_says_what_the_bundle_says(page, reconstructed):
    bundle, _ = reconstructed.open()
    text = html.unescape(re.sub(r"base64,[^\"]+", "", page))
    assert "SimRecon/small_room" in text
    for item in bundle.scene["objects"]:
        assert f"{item['label']} {item['id']}" in text
        assert f"{item['mass_kg']:.2f} kg" in text
        assert text.count(f'id="object-{item["id"]}"') == 1
    assert "surface.voxel_size_m" in text  # the one option that is not the default
    assert "1.5 s" in text
    assert "900 MB" in text  # the assembly stage's peak


def test_notes_cannot_become_markup(page):
    assert "<b>a note</b>" not in page
    assert html.escape("<b>a note</b> & more", quote=False) in page


def test_a_bundle_alone_gives_a_page_and_its_text_cannot_become_markup(reconstructed):
    bundle, _ = reconstructed.open()
    bundle.scene["source"]["file"] = '"><script>alert(1)</script>.mp4'
    for item in bundle.scene["objects"]:
        item["label"] = "</svg><script>alert(2)</script> $\\x"
    gone = ("poses", "depth", "world", "gaussians", "surface", "instances", "assets")
    page = build_page(bundle, StageResults({}, dict.fromkeys(gone, "<script>alert(3)</script>")))
    assert "<script>alert" not in page
    assert len(left_out(page)) >= 6
    assert len(images(page)) >= len(bundle.scene["objects"]) + 4


def test_gone_stage_results_are_named_and_the_rest_is_shown(reconstructed, tmp_path):
    bundle, _ = reconstructed.open()
    kept = tmp_path / "work"
    shutil.copytree(reconstructed.home / "work", kept)
    (folder,) = kept.iterdir()
    for stage in ("depth", "gaussians", "instances"):
        (gone,) = folder.glob(f"*_{stage}-*")
        shutil.rmtree(gone)
    page = build_page(bundle, StageResults.find(bundle, tmp_path / "registry"))
    said = " ".join(left_out(page))
    assert "Depth and normals left out" in said
    assert "Outlines on frames left out" in said
    assert "surface left out" not in said
    assert re.findall(r'<section id="([\w-]+)"', page) == SECTIONS


def test_a_bundle_of_someone_else_gives_a_page(reconstructed):
    """A bundle with the required fields only: no notes, assembly, world and held-out flags."""
    bundle, _ = reconstructed.open()
    scene = bundle.scene
    scene.pop("world")
    scene["report"] = {
        "physics": {}, "timings_s": {}, "peak_memory_mb": 1.0, "backends": {}, "config": {},
    }  # fmt: skip
    for item in scene["objects"]:
        item.pop("assembly")
        item["views"] = []
    for frame in scene["cameras"]["frames"]:
        frame.pop("held_out")
    assert "The report card left out" in " ".join(left_out(build_page(bundle, StageResults({}, {}))))


@pytest.mark.parametrize("kept", ["base", "nothing"])
def test_a_scene_without_objects_gives_a_page(reconstructed, kept):
    bundle, _ = reconstructed.open()
    bundle.scene["objects"], bundle.scene["graph"]["edges"] = [], []
    bundle.scene["report"]["physics"]["objects"] = []
    if kept == "nothing":
        bundle.scene["base"] = []
    page = build_page(bundle, StageResults({}, {}))
    assert re.findall(r'<section id="([\w-]+)"', page) == SECTIONS


def test_with_the_truth_there_are_error_maps_and_figures(page, page_with_truth, reconstructed):
    assert re.findall(r'<section id="([\w-]+)"', page_with_truth) == ["truth", *SECTIONS]
    assert len(images(page_with_truth)) > len(images(page)) + 12
    for text in (
        "camera error",
        "depth error of frame",
        "true instances in frame",
        "error of the scene",
        "error of the surface",
        "distance from the truth to the scene",
    ):
        assert text in page_with_truth


def test_outlines_are_drawn_over_the_kept_frames(reconstructed, tmp_path):
    """The true outline of the table in a held-out frame matches the scene and is drawn on the video frame."""
    g = gathered(reconstructed)
    index, pose = int(g.posed.held_out_indices[0]), g.posed.held_out_world_from_camera[0]
    _, ids = g.truth.frame(index, pose, g.camera)
    table = next(e for e in g.truth.known.entities if e.name == "table")
    border = max(cv2.findContours((ids == table.id).astype(np.uint8), 0, 1)[0], key=len)[:, 0] + 0.5
    thing = {"name": "table", "polygon": border.tolist()}
    frame = {"index": index, "width": g.camera.width, "height": g.camera.height, "things": [thing]}
    labels = tmp_path / "labels.json"
    labels.write_text(json.dumps({"frames": [frame], "things": {"table": {"parent": "floor"}}}))
    scores = measure_outlines(g.bundle, g.meshes, labels, g.stages)
    assert scores.things[0]["iou"] > 0.6
    assert scores.things[0]["parent_right"]
    shown = next(b for b in outline_section(replace(g, outlines=scores)).blocks if b.kind == "pictures")
    assert [item.caption for item in shown.items] == [f"frame {index}"]


def gathered(reconstructed):
    bundle, stages = reconstructed.open()
    return Gathered(bundle, stages, Truth.of(bundle, GroundTruth.load(reconstructed.truth)))


def test_depth_errors_are_those_of_the_depth(reconstructed):
    """The depth is nearly true; scaled by 1.02, its median error is 2 % of the distance."""
    g = gathered(reconstructed)
    _, errors = pictures.depth_rows(g, 3)
    assert max(errors) < 0.004
    stages = g.stages
    scene = stages.get("gaussians")
    wrong = replace(scene.depth, depth=scene.depth.depth * np.float32(1.02))
    stages._loaded["gaussians"] = replace(scene, depth=wrong)
    _, errors = pictures.depth_rows(Gathered(g.bundle, stages, g.truth), 3)
    typical = [float(np.median(d[d > 0])) for d in np.asarray(g.depth.depth)]
    assert min(errors) > 0.015 * min(typical)
    assert max(errors) < 0.025 * max(typical)


def test_surface_errors_are_those_of_the_surface(reconstructed):
    """A floor moved by 3 cm along its normal has an error of 3 cm."""
    g = gathered(reconstructed)
    surface = g.surface
    floor = np.asarray(surface.vertices)[np.abs(np.asarray(surface.normals)[:, 2]) > 0.99]
    assert np.median(g.truth.distance(floor)) < 0.006
    assert np.median(g.truth.distance(floor + np.array([0, 0, 0.03]))) == pytest.approx(0.03, abs=0.006)


def test_the_command_writes_the_same_page_again(page, reconstructed, tmp_path, capsys):
    out = tmp_path / "page.html"
    assert main(["report", "small_room", "--out", str(out), "--registry", str(reconstructed.registry)]) == 0
    assert out.read_text(encoding="utf-8") == page
    assert out.stat().st_size < 8e6
    assert str(out) in capsys.readouterr().out


def test_a_stored_evaluation_is_shown_and_one_of_another_scene_refused(reconstructed, tmp_path, capsys):
    stored = dict(reconstructed.evaluation)
    stored["metrics"] = {**stored["metrics"], "cd_cm": 123.4}
    registry = shutil.copytree(
        reconstructed.registry, tmp_path / "registry"
    )  # without stage results: quicker
    figures, out = tmp_path / "figures.json", tmp_path / "page.html"
    figures.write_text(json.dumps(stored))
    command = ["report", "small_room", "--out", str(out), "--registry", str(registry)]
    command += ["--evaluation", str(figures)]
    assert main(command) == 0
    assert "123.4 cm" in out.read_text()
    figures.write_text(json.dumps({**stored, "revision": "0" * 16}))
    assert main(command) == 2
    assert "evaluate it again" in capsys.readouterr().err
    figures.write_text("[]")
    assert main(command) == 2


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["no_such_scene"], "no_such_scene"),
        (["small_room", "--out", "nowhere/page.html"], "nowhere/page.html"),
        (["small_room", "--ground-truth", "nowhere"], "nowhere"),
    ],
)
def test_wrong_use_is_said_in_one_line(reconstructed, capsys, arguments, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["report", *arguments, "--registry", str(reconstructed.registry)]) == 2
    assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_truth_of_cameras_alone_leaves_error_maps_out(reconstructed, tmp_path):
    """With true cameras but no meshes, the page names the missing error maps instead of drawing blank ones."""
    known = json.loads((reconstructed.truth / "scene.json").read_text())
    known.pop("entities")
    (tmp_path / "cameras.json").write_text(json.dumps(known))
    bundle, stages = reconstructed.open()
    evaluation = evaluate_scene(bundle, tmp_path, stages=stages, composition_points=1000).to_json()
    page = build_page(bundle, stages, tmp_path, evaluation)
    said = " ".join(left_out(page))
    assert "The depth's error map left out" in said
    assert "The surface's error map left out" in said
    assert "depth error of frame" not in page
    assert "camera error" in page
    for image in images(page):
        assert image.std() > 3


def test_a_page_of_the_studio_beside_the_report_is_linked(reconstructed, tmp_path):
    from reconstruction.measure.report.page import find_room_page

    bundle, _ = reconstructed.open()
    mark = '<!doctype html><html><head><meta name="simrecon-scene" content="{}">'
    (tmp_path / "other.html").write_text(mark.format("another"))
    assert find_room_page(tmp_path, bundle.scene["id"]) is None
    (tmp_path / "my room.html").write_text(mark.format(bundle.scene["id"]))
    found = find_room_page(tmp_path, bundle.scene["id"])
    assert found == "my room.html"
    assert 'href="my%20room.html"' in build_page(bundle, StageResults({}, {}), room_page=found)
    assert "walk around" not in build_page(bundle, StageResults({}, {}))
