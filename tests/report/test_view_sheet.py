"""`simrecon show SCENE --views`: contact sheets of the views, written to the work folder."""

import json
import shutil

import cv2
import numpy as np
import pytest

from benchmarks.avo import gradient_error
from reconstruction.cli import main
from reconstruction.views import AvoConfig, make_target, prepare_scene

pytestmark = pytest.mark.stage

QUICK = [
    "--set",
    "avo.views=1",
    "--set",
    "avo.steps=2",
    "--set",
    "avo.side_px=48",
    "--set",
    "avo.scan_side_px=32",
]


@pytest.fixture(scope="module")
def home(reconstructed, tmp_path_factory):
    """A copy of the scene with its work folder, which the command modifies."""
    target = tmp_path_factory.mktemp("views") / "home"
    shutil.copytree(reconstructed.home, target)
    return target


def command(home, out, *more: str) -> list[str]:
    place = ["--registry", str(home / "registry"), "--out", str(out)]
    return ["show", "small_room", "--views", *place, *QUICK, *more]


def test_every_thing_is_on_the_sheets_and_the_views_are_kept(home, tmp_path, capsys):
    assert main(command(home, tmp_path / "first", "--json")) == 0
    said = json.loads(capsys.readouterr().out)
    scene = json.loads(next((home / "registry").glob("scenes/small_room/*/scene.json")).read_text())
    assert {thing["id"] for thing in said["things"]} == {item["id"] for item in scene["objects"]}
    assert all(len(thing["views"]) <= 1 for thing in said["things"])
    assert any(view["visibility"] > 0.5 for thing in said["things"] for view in thing["views"])
    sheets = [cv2.imread(file) for file in said["files"]]
    assert sheets
    assert sum(sheet.shape[0] for sheet in sheets) > 200 * len(said["things"])
    (kept,) = (home / "work").glob("*/*_views-*")
    before = (kept / "manifest.json").stat().st_mtime_ns
    assert main(command(home, tmp_path / "second")) == 0
    assert "visible in its views" in capsys.readouterr().out
    assert [p.name for p in (home / "work").glob("*/*_views-*")] == [kept.name]
    assert (kept / "manifest.json").stat().st_mtime_ns == before  # nothing was computed again
    for file in (tmp_path / "first").iterdir():
        assert file.read_bytes() == (tmp_path / "second" / file.name).read_bytes()


def test_what_is_wrong_is_said(home, tmp_path, capsys):
    assert main(["show", "small_room", "--registry", str(home / "registry"), "--set", "avo.views=1"]) == 2
    assert "--set needs --views" in capsys.readouterr().err
    assert main(command(home, tmp_path, "--set", "depth.depth_side_px=64")) == 2
    assert "takes options of avo only" in capsys.readouterr().err
    assert main(command(home, tmp_path, "--work-dir", str(tmp_path / "elsewhere"))) == 2
    assert "does not exist; reconstruct the scene again" in capsys.readouterr().err


def test_the_gradient_is_that_of_what_is_computed_on_fitted_gaussians(reconstructed):
    _, stages = reconstructed.open()
    gaussians, _ = stages.refined_in_world()
    found, config = stages.get("instances"), AvoConfig(side_px=64)
    scene = prepare_scene(gaussians, stages.get("surface"), found, stages.get("poses").camera)
    targets = [make_target(scene, item.id, config) for item in found.objects]
    errors = [gradient_error(scene, target, config, (1e-6, 3e-6, 1e-5)) for target in targets if target]
    assert len(errors) >= 2
    assert np.max(errors) < 0.03
