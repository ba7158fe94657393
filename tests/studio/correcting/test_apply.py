"""Apply: the command that made a scene is found again, runs in its own process, and says in one line why it fails."""

import json
import time
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rooms.small_room import SCENE

from reconstruction.cache import canonical_json, digest_input
from reconstruction.config import PRESET_NAMES, PipelineConfig
from reconstruction.made_by import note_made_by, read_made_by
from registry import SceneRegistry
from registry.errors import UsageError
from studio.correcting.apply import ApplyRun, ApplyState
from studio.correcting.origin import Origin, find_origin, options_of
from studio.correcting.session import Session
from studio.remembered import remember

_OPTIONS = (
    "depth.depth_side_px=640", "world.marker_size_m=0.1", "world.scale=camera-height=1.5", "gaussians.backend=cpu",
    "assembly.freeze_unstable=false", "assembly.search_shifts_m=0.004,0.02", "poses.import_path=a folder/model",
    "surface.voxel_size_m=0.0125", "instances.min_picture_m=0.31",
)  # fmt: skip


@settings(deadline=None, max_examples=40)
@given(st.sampled_from(PRESET_NAMES), st.sets(st.sampled_from(_OPTIONS)), st.integers(0, 3))
def test_the_recorded_options_make_the_same_config(preset: str, chosen: set[str], seed: int) -> None:
    config = PipelineConfig.from_preset(preset).with_seed(seed)
    for option in sorted(chosen):
        config = config.with_option(option)
    again = PipelineConfig()
    for option in options_of(json.loads(canonical_json(config))):
        again = again.with_option(option)
    assert again == config


def test_the_default_options_need_no_words() -> None:
    assert options_of(json.loads(canonical_json(PipelineConfig()))) == []


def test_options_of_other_versions_are_left_out() -> None:
    recorded = json.loads(canonical_json(PipelineConfig()))
    recorded["depth"]["gone"] = 3
    recorded["no_such_stage"] = {"a": 1}
    assert options_of(recorded) == []


def test_where_a_scene_was_made_is_noted(tmp_path: Path) -> None:
    film = tmp_path / "film.mp4"
    film.write_bytes(b"film")
    assert read_made_by(tmp_path, "room") is None
    note_made_by(tmp_path, "room", film, tmp_path / "fixes.yaml")
    found = read_made_by(tmp_path, "room")
    assert found is not None
    assert (found.video, found.overrides, found.folder) == (film, tmp_path / "fixes.yaml", Path.cwd())


@pytest.fixture
def scene(reconstructed):
    registry = SceneRegistry(reconstructed.registry)
    return registry, registry.load(SCENE)


@pytest.mark.stage
def test_a_missing_film_is_asked_for_and_another_one_refused(scene, tmp_path: Path) -> None:
    registry, bundle = scene
    with pytest.raises(UsageError, match="--video FILE"):
        find_origin(bundle, registry.root)
    other = tmp_path / "other.mp4"
    other.write_bytes(b"another film")
    with pytest.raises(UsageError, match="another film"):
        find_origin(bundle, registry.root, video=other)
    with pytest.raises(UsageError, match="no such file"):
        remember(registry.root, SCENE, video=tmp_path / "nowhere.mp4")


@pytest.mark.stage
def test_the_command_repeats_how_the_scene_was_made(scene, tmp_path: Path) -> None:
    registry, bundle = scene
    film = tmp_path / "film.mp4"
    film.write_bytes(b"a film")
    work = bundle.scene["report"]["volatile"]["work"]
    old, work["input_digest"] = work["input_digest"], digest_input(film)
    try:
        origin = find_origin(bundle, registry.root, video=film, work_dir=tmp_path)
    finally:
        work["input_digest"] = old
    command = origin.command(tmp_path / "fixes.yaml", require_stable=True, keep_results=3)
    assert command[:4] == ["reconstruct", str(film), "--scene", SCENE]
    assert "surface.voxel_size_m=0.016" in command
    assert command[-1] == "--require-stable"
    from reconstruction.cli import build_parser
    from reconstruction.commands.reconstruct import config_of

    parsed = build_parser().parse_args(command)
    assert json.loads(canonical_json(config_of(parsed))) == bundle.scene["report"]["config"]


def _origin(tmp_path: Path, scene: str = "room") -> Origin:
    film = tmp_path / "film.mp4"
    film.write_bytes(b"this is no film")
    return Origin(scene, tmp_path / "registry", film, tmp_path / "work", [], tmp_path)


@pytest.mark.stage
def test_a_failing_run_says_one_line_and_loses_nothing(tmp_path: Path) -> None:
    fixes = tmp_path / "fixes.yaml"
    fixes.write_text("- {id: 3, drop: true}\n")
    run = ApplyRun.start(_origin(tmp_path), fixes, tmp_path / "corrections")
    assert run.state().running
    state = run.wait(120)
    assert "film.mp4" in state.error
    assert "\n" not in state.error
    assert "Traceback" not in state.error
    assert ApplyRun.find("room", tmp_path / "corrections", tmp_path / "registry") is None
    assert fixes.read_text() == "- {id: 3, drop: true}\n"


@pytest.mark.stage
def test_a_run_is_found_again_is_alone_and_can_be_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow = tmp_path / "slow"
    slow.mkdir()
    (slow / "sitecustomize.py").write_text("import time\ntime.sleep(60)\n")
    monkeypatch.setattr("studio.correcting.apply._environment", lambda: {"PYTHONPATH": str(slow)})
    origin, folder = _origin(tmp_path), tmp_path / "corrections"
    first = ApplyRun.start(origin, tmp_path / "none.yaml", folder)
    found = ApplyRun.find("room", folder, origin.registry_root)
    assert found is not None
    assert found.pid == first.pid
    assert found.state().running
    with pytest.raises(UsageError, match="running already"):
        ApplyRun.start(origin, tmp_path / "none.yaml", folder)
    found.cancel()
    deadline = time.monotonic() + 10
    while first.state().running and time.monotonic() < deadline:
        time.sleep(0.05)
    assert "cancelled" in first.state().error
    assert ApplyRun.find("room", folder, origin.registry_root) is None


@pytest.mark.stage
def test_progress_is_read_from_the_log(tmp_path: Path) -> None:
    import os

    log = tmp_path / "log"
    log.write_text(
        "[1/10] frames: already done, reusing it\n[7/10] instances: ...\n[7/10] instances: 2.1 s, peak 1.0 GB\n"
        "[8/10] assets: ...\n[8/10] assets: assets 3/6, about 20 s left\n"
    )
    import psutil

    born = psutil.Process().create_time()
    record = tmp_path / "room.apply.json"
    record.write_text(json.dumps({"pid": os.getpid(), "born": born, "started": time.time(), "log": str(log)}))
    run = ApplyRun.find("room", tmp_path, tmp_path)
    assert run is not None
    state: ApplyState = run.state()
    assert (state.stage, state.done, state.reused, state.computed) == (
        "assets", pytest.approx(0.75), ("frames",), ("instances", "assets"),
    )  # fmt: skip


@pytest.mark.stage
def test_a_second_server_is_told(scene) -> None:
    registry, bundle = scene
    first = Session(registry, bundle)
    second = Session(registry, bundle)
    assert first.other == ""
    assert "pid" in second.other
    number = bundle.objects[0].id
    first.perform(first.acts.relabel(number, "one"))
    state = second.perform(second.acts.drop(number))
    assert [set(entry) - {"pixel"} for entry in state.entries[-2:]] == [{"relabel"}, {"drop"}]
    assert first.document.undo().entries == state.entries[:-1]
    second.document.undo()
    first.close()
    second.close()
    third = Session(registry, bundle)
    assert third.other == ""
    third.close()
