"""Contact sheets show every object, need the bundle only, and give valid anchors."""

import json
import shutil
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
import yaml

from reconstruction.cli import main
from reconstruction.editing.addresses import parse_address
from reconstruction.editing.anchors import Footage, Pointer
from reconstruction.editing.overrides import Overrides
from reconstruction.measure.report.contact_page import overrides_template, write_contact_sheets
from reconstruction.measure.report.contact_sheet import ContactSheet, anchor_text, frame_sheet
from reconstruction.poses.lens import Lens
from registry.errors import UsageError

pytestmark = pytest.mark.stage


@pytest.fixture(scope="module")
def sheet(reconstructed) -> ContactSheet:
    return ContactSheet.of(reconstructed.open()[0])


def colored(picture: np.ndarray, color: tuple[int, int, int], reach: int = 40) -> np.ndarray:
    return (np.abs(picture.astype(int) - color).max(axis=2) < reach).any()


def test_every_thing_is_outlined_and_numbered_where_its_anchor_is(sheet):
    source = sheet.scene["source"]
    assert len(sheet.objects) >= 3
    for number, item in sheet.objects.items():
        frame = sheet.frame_of(number)
        assert frame is not None
        picture = frame_sheet(sheet, frame)
        height, width = frame.image.shape[:2]
        scale = 1120 / max(height, width)
        x = item["anchor"]["x"] / source["width"] * width * scale
        y = item["anchor"]["y"] / source["height"] * height * scale
        around = picture[max(0, int(y) - 60) : int(y) + 60, max(0, int(x) - 60) : int(x) + 60]
        assert colored(around, sheet.colors[number])
        legend = picture[:, round(width * scale) :]
        assert colored(legend, sheet.colors[number], reach=12)


def pointer_into(stages) -> Pointer:
    """Return the lookup of anchors after a run."""
    posed, depth = stages.in_world()
    surface = stages.get("surface")
    lens = Lens.of(stages.get("poses"))
    return Pointer(stages.get("instances"), surface, Footage(posed, depth, lens, surface))


def test_later_stages_take_clicks_too(sheet, reconstructed):
    """Overrides by pixel: a mass, and a parent on another object or the floor."""
    _, stages = reconstructed.open()
    pointer, assets, graph = pointer_into(stages), stages.get("assets"), stages.get("scene_graph")
    small, other = list(sheet.objects.values())[-2:]
    clicks = [{"pixel": item["anchor"]} for item in (small, other)]
    heavy = Overrides([{**clicks[0], "mass_kg": 7.5}]).apply_to_assets(assets, pointer)
    changed = [a.id for a, b in zip(heavy.objects, assets.objects) if a.physics.mass_kg != b.physics.mass_kg]
    assert changed == [small["id"]]
    moved = Overrides([{**clicks[0], "parent": clicks[1]}]).apply_to_graph(graph, assets, pointer)
    edge = next(e for e in moved.edges if e.child == small["id"])
    assert (edge.parent, edge.evidence) == (other["id"], "user")
    floor = next(b for b in pointer.found.base if b.label == "floor")
    shown = np.argwhere(np.asarray(pointer.found.id_maps[0]) == floor.id)
    row, column = shown[len(shown) // 2]
    height, width = pointer.found.id_maps.shape[1:]
    frame = int(pointer.footage.posed.indices[0])
    there = {"frame": frame, "x": column + 0.5, "y": row + 0.5, "size": [width, height]}
    there = {key: value if isinstance(value, list) else float(value) for key, value in there.items()}
    moved = Overrides([{**clicks[0], "parent": {"pixel": there}}]).apply_to_graph(graph, assets, pointer)
    assert next(e for e in moved.edges if e.child == small["id"]).parent == floor.id
    with pytest.raises(UsageError, match="shows the floor"):
        Overrides([{"pixel": there, "mass_kg": 1.0}]).apply_to_assets(assets, pointer)


def test_anchors_mean_the_things_that_they_stand_beside(sheet, reconstructed):
    pointer = pointer_into(reconstructed.open()[1])
    for number, item in sheet.objects.items():
        address = parse_address(yaml.safe_load("{" + anchor_text(item) + "}"), "")
        assert address.kind == "pixel"
        assert pointer.thing(address).id == number


def test_the_same_bundle_gives_the_same_files(sheet, tmp_path):
    first = [p.read_bytes() for p in write_contact_sheets(sheet, tmp_path / "a")]
    assert first == [p.read_bytes() for p in write_contact_sheets(sheet, tmp_path / "b")]


def test_the_command_needs_the_bundle_only(reconstructed, tmp_path, capsys):
    """Without the work folder the page is well formed and refers to each image."""
    home = tmp_path / "home"
    shutil.copytree(reconstructed.registry, home / "registry")
    out, template = tmp_path / "sheets", tmp_path / "fixes.yaml"
    command = ["show", "small_room", "--registry", str(home / "registry"), "--instances", "--out", str(out)]
    assert main([*command, "--overrides-template", str(template)]) == 0
    printed = capsys.readouterr().out
    scene = reconstructed.open()[0].scene
    for item in scene["objects"]:
        assert anchor_text(item) in printed
    page = (out / "index.html").read_text()
    named = []
    parser = HTMLParser()
    parser.handle_starttag = lambda tag, attributes: named.append(dict(attributes).get("src"))
    parser.feed(page)
    pictures = sorted(p.name for p in out.glob("*.jpg"))
    assert sorted(n for n in named if n) == pictures
    assert all(cv2.imread(str(out / name)) is not None for name in pictures)
    assert main([*command, "--json"]) == 0
    things = json.loads(capsys.readouterr().out)["things"]
    assert {t["id"]: t["anchor"] for t in things} == {o["id"]: o["anchor"] for o in scene["objects"]}
    assert main([*command, "--overrides-template", str(template)]) == 2  # never over a file of the user's
    assert "not overwritten" in capsys.readouterr().err


def test_the_template_is_a_file_of_overrides(sheet, tmp_path):
    path = tmp_path / "fixes.yaml"
    path.write_text(overrides_template(sheet))
    assert Overrides.load(path).entries == []
    lines = [line[2:] for line in path.read_text().splitlines() if line.startswith("# - {pixel: {frame")]
    path.write_text("\n".join(lines))
    assert len(Overrides.load(path).entries) == len(sheet.objects)


def test_a_bundle_of_before_says_what_to_do(reconstructed):
    bundle, _ = reconstructed.open()
    bundle.scene.pop("instances")
    with pytest.raises(UsageError, match="no frames for contact sheets"):
        ContactSheet.of(bundle)


def test_the_report_shows_the_same_frames_and_anchors(sheet, page):
    for frame in sheet.frames:
        assert f"instances in frame {frame.index}" in page
    for item in sheet.objects.values():
        assert anchor_text(item) in page
