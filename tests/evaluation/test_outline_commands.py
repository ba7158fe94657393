"""`simrecon evaluate` and `simrecon report` with labels."""

import base64
import html
import json
import re

import cv2
import numpy as np
import pytest
from outline_drawing import FRAMES, draw
from truth_bundle import Change, write_bundle

from reconstruction.cli import main
from reconstruction.commands.truth import split_truth
from reconstruction.measure import evaluate_scene
from reconstruction.measure.outlines import measure_outlines
from reconstruction.measure.report.collect import Gathered
from reconstruction.measure.report.outline_section import outline_section
from reconstruction.measure.scene import placed_meshes
from reconstruction.measure.stage_results import StageResults
from registry import SceneRegistry
from registry.errors import UsageError

pytestmark = pytest.mark.stage


@pytest.fixture(scope="module")
def registry(truth, tmp_path_factory):
    """A registry with the truth without its carton as a scene."""
    root = tmp_path_factory.mktemp("home") / "registry"
    staging = tmp_path_factory.mktemp("staging") / "bundle"
    write_bundle(truth, staging, Change(missing=("carton",)))
    SceneRegistry(root, create=True).publish(staging, "room")
    return root


@pytest.fixture
def labels(truth, tmp_path):
    return draw(truth).contract(tmp_path / "labels.json")


def test_evaluate_prints_and_writes_the_figures(registry, labels, tmp_path, capsys):
    out = tmp_path / "figures.json"
    command = ["evaluate", "room", "--registry", str(registry), "--ground-truth", str(labels), "--quiet"]
    assert main([*command, "--json", str(out)]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"outline_recall_25 +0\.\d\d", printed)
    assert re.search(r"carton +missed", printed)
    data = json.loads(out.read_text())
    assert data["labels"] == str(labels)
    assert data["ground_truth"] is None
    assert data["outlines"]["frames"] == list(FRAMES)
    missed = [item["name"] for item in data["outlines"]["things"] if not item["found_25"]]
    assert missed == ["carton"]
    things = len(data["outlines"]["things"])
    assert data["metrics"]["outline_recall_50"] == pytest.approx((things - 1) / things)
    assert data["metrics"]["outline_precision_50"] == 1
    assert data["left_out"]["cameras, geometry, objects, graph"] == "labels have outlines only"


def test_a_folder_and_labels_are_measured_together(registry, truth, labels, perfect):
    bundle = SceneRegistry(registry).load("room")
    found = evaluate_scene(bundle, truth.folder, labels=labels, composition_points=20_000)
    assert found.metrics["outline_precision_25"] == 1
    assert found.metrics["object_precision_25"] == 1
    assert (found.ground_truth, found.labels) == (str(truth.folder), str(labels))
    assert "outline_recall_25" not in perfect.metrics
    assert perfect.left_out["outlines"] == "no labels were given"


def test_truth_is_told_from_labels(truth, labels, tmp_path):
    folder = draw(truth).labelme(tmp_path / "labelme")
    missing = tmp_path / "missing.json"
    assert split_truth([]) == (None, None)
    assert split_truth([labels, truth.folder]) == (truth.folder, labels)
    assert split_truth([folder, truth.folder.parent]) == (truth.folder.parent, folder)
    assert split_truth([missing]) == (None, missing)
    with pytest.raises(UsageError, match="both files of labels"):
        split_truth([labels, folder])
    with pytest.raises(UsageError, match="both folders"):
        split_truth([truth.folder, truth.folder.parent])


@pytest.mark.parametrize("verb", ["evaluate", "report"])
def test_wrong_labels_are_one_clear_line(registry, labels, tmp_path, verb, capsys):
    data = json.loads(labels.read_text())
    data["frames"][1]["index"] = 700
    labels.write_text(json.dumps(data))
    out = ["--out", str(tmp_path / "page.html")] if verb == "report" else []
    command = [verb, "room", "--registry", str(registry), "--ground-truth", str(labels), "--quiet", *out]
    assert main(command) == 2
    error = capsys.readouterr().err
    assert "frame 700 does not exist" in error
    assert str(labels) in error
    assert "Traceback" not in error


def test_report_shows_outlines_over_ids(registry, labels, tmp_path):
    out = tmp_path / "page.html"
    command = ["report", "room", "--registry", str(registry), "--ground-truth", str(labels), "--quiet"]
    assert main([*command, "--out", str(out)]) == 0
    page = html.unescape(re.sub(r"base64,[^\"]+", "", out.read_text()))
    assert 'id="outlines"' in page
    for index in FRAMES:
        assert f"outlines over ids in frame {index}" in page
    assert "missed: carton" in page
    assert 'id="truth"' not in page


def test_the_drawn_lines_say_what_was_found(registry, truth, labels):
    """Red lines for missed objects only, gray ones for ignored ones only."""
    data = json.loads(labels.read_text())
    data["ignore"] = ["table"]
    bundle, stages = SceneRegistry(registry).load("room"), StageResults({}, {})
    labels.write_text(json.dumps(data))
    scores = measure_outlines(bundle, placed_meshes(bundle), labels, stages)
    g = Gathered(bundle, stages, outlines=scores)
    section = outline_section(g)
    pictures = next(block for block in section.blocks if block.kind == "pictures").items
    assert len(pictures) == len(FRAMES)
    seen = set()
    for item, index in zip(pictures, FRAMES):
        pixels = np.frombuffer(base64.b64decode(item.src.split(",")[1]), np.uint8)
        image = cv2.imdecode(pixels, cv2.IMREAD_COLOR)[..., ::-1].astype(int)
        for name, polygon in draw(truth).frames[index]:
            column, row = (polygon * item.width / truth.camera.width).astype(int).T
            inside = (row < item.height) & (column < item.width)
            red, green, _ = np.median(image[row[inside], column[inside]], axis=0)
            wanted = {"carton": "missed", "table": "ignored"}.get(name, "found")
            if len(polygon) > 40:
                seen.add(wanted)
                assert wanted == (
                    "missed" if red > green + 60 else "found" if green > red + 40 else "ignored"
                ), name
    assert seen == {"missed", "ignored", "found"}
    table = next(block for block in section.blocks if block.kind == "table")
    verdicts = {row[0].text: row[1].text for row in table.rows}
    assert verdicts["carton"] == "missed"
    assert "table" not in verdicts
    assert outline_section(Gathered(bundle, stages)) is None
