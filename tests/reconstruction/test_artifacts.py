"""Artifacts survive a round trip bit for bit."""

import json
from dataclasses import replace

import numpy as np
import pytest

from reconstruction.core import artifacts
from reconstruction.core.types import (
    AssembledScene,
    Camera,
    DepthMaps,
    DistortedCamera,
    Edge,
    PlacedObject,
    PosedFrames,
    SceneGraph,
    SpaceGrid,
    Surface,
)
from registry.errors import BundleError


def _assembled() -> AssembledScene:
    rng = np.random.default_rng(3)
    placed = tuple(
        PlacedObject(
            id=i, world_from_object=rng.normal(size=(4, 4)), dynamic=bool(i % 2), moved_m=0.1 * i, turned_deg=0.0,
            repair="", stable=True,
        )
        for i in range(3)
    )  # fmt: skip
    graph = SceneGraph(edges=(Edge(1, "supported_by", 0, 0.5, "contact"),))
    return AssembledScene(
        placed=placed, graph=graph, physics_report={"stable_rate": 1.0, "objects": {"1": [1, 2.5]}}
    )


def test_nested_dataclasses_round_trip(tmp_path):
    value = _assembled()
    artifacts.save(value, tmp_path / "a")
    again = artifacts.load(AssembledScene, tmp_path / "a")
    assert again.graph == value.graph
    assert again.physics_report == value.physics_report
    for left, right in zip(value.placed, again.placed, strict=True):
        assert np.array_equal(left.world_from_object, right.world_from_object)
        assert left.dynamic is right.dynamic
        assert left.moved_m == right.moved_m


def test_arrays_keep_dtype_shape_and_bits(tmp_path):
    rng = np.random.default_rng(0)
    value = DepthMaps(
        camera=Camera(320, 240, 300.5, 301.5, 160, 120),
        depth=rng.random((20, 240, 320), dtype=np.float32),
        confidence=rng.integers(0, 3, (20, 240, 320), dtype=np.uint8),
    )
    artifacts.save(value, tmp_path / "d")
    again = artifacts.load(DepthMaps, tmp_path / "d")
    assert again.camera == value.camera
    assert again.depth.dtype == np.float32
    assert np.array_equal(again.depth, value.depth)
    assert np.array_equal(again.confidence, value.confidence)
    assert isinstance(again.depth, np.memmap), "a large array must not be read whole"
    stored = {path: path.read_bytes() for path in (tmp_path / "d").iterdir()}
    for array in (again.depth, again.confidence):
        assert array.flags.writeable, "small and large arrays are of one type for compiled kernels"
        array[:] = 0
    assert stored == {path: path.read_bytes() for path in (tmp_path / "d").iterdir()}


@pytest.mark.parametrize(
    ("depth", "confidence", "message"),
    [
        (
            np.zeros((2, 3, 4)),
            np.zeros((2, 3, 4), np.uint8),
            r"DepthMaps\.depth: expected float32 .*got float64",
        ),
        (np.zeros((3, 4), np.float32), np.zeros((3, 4), np.uint8), r"DepthMaps\.depth: expected .*\(3, 4\)"),
        (np.zeros((2, 3, 4), np.float32), np.zeros((5, 3, 4), np.uint8), r"DepthMaps\.confidence: .*n = 2"),
    ],
)
def test_wrong_arrays_are_refused_by_class_and_field(depth, confidence, message):
    with pytest.raises(ValueError, match=message):
        DepthMaps(Camera(4, 3, 1, 1, 1, 1), depth, confidence)


def test_non_finite_plain_numbers_are_refused(tmp_path):
    grid = SpaceGrid(np.zeros(3), float("nan"), np.zeros((1, 1, 1), np.uint8))
    empty = np.zeros((0, 3), np.float32)
    surface = Surface(
        empty,
        np.zeros((0, 3), np.int32),
        empty,
        np.zeros((0, 3), np.uint8),
        np.zeros(0, np.float32),
        0.01,
        grid,
    )
    with pytest.raises(ValueError, match="JSON"):
        artifacts.save(surface, tmp_path / "s")


def test_what_another_version_wrote_is_refused_in_one_sentence(tmp_path):
    artifacts.save(_assembled(), tmp_path / "a")
    data = json.loads((tmp_path / "a" / "data.json").read_text())
    del data["placed"][0]["repair"]
    (tmp_path / "a" / "data.json").write_text(json.dumps(data))
    with pytest.raises(BundleError, match="PlacedObject is of another version"):
        artifacts.load(AssembledScene, tmp_path / "a")


def test_posed_frames_keep_the_camera_of_the_recording(small_capture, tmp_path):
    recording = DistortedCamera("RADIAL", 320, 240, np.array([300.0, 160.5, 119.5, -0.1, 0.02]))
    for name, distorted in (("with", recording), ("without", None)):
        artifacts.save(replace(small_capture.posed, distorted=distorted), tmp_path / name)
    again = artifacts.load(PosedFrames, tmp_path / "with").distorted
    assert (again.model, again.width, again.height) == ("RADIAL", 320, 240)
    assert np.array_equal(again.params, recording.params)
    assert artifacts.load(PosedFrames, tmp_path / "without").distorted is None
