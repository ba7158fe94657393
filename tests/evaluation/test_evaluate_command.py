"""`simrecon evaluate`: table and JSON."""

import json

import pytest
from truth_bundle import write_bundle

from reconstruction.cli import main
from reconstruction.measure import GroundTruth
from registry import SceneRegistry
from registry.errors import UsageError

pytestmark = pytest.mark.stage


@pytest.fixture(scope="module")
def registry(truth, tmp_path_factory):
    """A registry with the truth as a scene."""
    root = tmp_path_factory.mktemp("home") / "registry"
    staging = tmp_path_factory.mktemp("staging") / "bundle"
    write_bundle(truth, staging)
    SceneRegistry(root, create=True).publish(staging, "room")
    return root


def test_table_and_file(registry, truth, tmp_path, capsys):
    out = tmp_path / "figures.json"
    command = ["evaluate", "room", "--registry", str(registry), "--ground-truth", str(truth.folder)]
    assert main([*command, "--json", str(out), "--video", str(truth.frames), "--quiet"]) == 0
    printed = capsys.readouterr().out
    assert printed.index("object_recall_25") < printed.index("cd_cm")  # recall stands first
    assert "carton" in printed
    assert "left out" in printed  # the stages' results are not there, and it says so
    data = json.loads(out.read_text(), parse_constant=lambda name: pytest.fail(f"{name} is not strict JSON"))
    assert data["schema"] == "simrecon.evaluation/1"
    assert data["metrics"]["object_recall_50"] == 1
    assert {o["name"] for o in data["objects"]} >= {"table", "carton", "tin"}


def test_json_on_stdout_is_only_json(registry, capsys):
    assert main(["evaluate", "room", "--registry", str(registry), "--json", "-"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["ground_truth"] is None
    assert data["metrics"]["stable_rate"] == 1
    assert "psnr_db" in data["left_out"]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--ground-truth", "/nowhere"], "no such folder"),
        (["--json", "/nowhere/x.json"], "does not exist"),
        (["--video", "/nowhere.mp4"], "no such video"),
    ],
)
def test_wrong_use_is_one_clear_line(registry, flags, message, capsys):
    assert main(["evaluate", "room", "--registry", str(registry), *flags]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error


def test_unknown_scene(registry, capsys):
    assert main(["evaluate", "nothing", "--registry", str(registry)]) == 2
    assert "nothing" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("scene.json", "{", "not JSON"),
        ("scene.json", "{}", "malformed"),
        ("other.txt", "x", "holds neither"),
    ],
)
def test_malformed_truth(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(UsageError, match=message):
        GroundTruth.load(tmp_path)


def test_a_parent_that_does_not_exist_is_malformed(truth, tmp_path):
    data = json.loads((truth.folder / "scene.json").read_text())
    data["entities"][-1]["parent"] = "nobody"
    (tmp_path / "scene.json").write_text(json.dumps(data))
    with pytest.raises(UsageError, match="nobody"):
        GroundTruth.load(tmp_path)


def test_oracle_flags_are_checked_before_anything_runs(truth, tmp_path, capsys):
    video = tmp_path / "video.mp4"
    video.write_bytes(b"")
    assert main(["reconstruct", str(video), "--oracle", "surface", "--ground-truth", str(truth.folder)]) == 2
    assert "oracles for" in capsys.readouterr().err
    assert main(["reconstruct", str(video), "--ground-truth", str(truth.folder)]) == 2
    assert "simrecon evaluate" in capsys.readouterr().err
