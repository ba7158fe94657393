"""What users may write after `--scale`, markers of known size in view, and the metric depth seam."""

import builtins

import cv2
import numpy as np
import pytest

from reconstruction.core.types import Camera, DepthMaps
from reconstruction.world import WorldConfig, parse_scale, settle_object_height
from reconstruction.world.markers import measure_markers
from reconstruction.world.metric_depth import load_backend, metres_per_unit
from registry.errors import EnvironmentMissing, InputError, UsageError
from registry.geometry import rigid

CAMERA = Camera(320, 240, 300.0, 300.0, 160.0, 120.0)


@pytest.mark.parametrize(
    ("text", "kind", "value_m"),
    [
        ("camera-height=1.5", "camera-height", 1.5),
        (" camera-height = 1.5 m", "camera-height", 1.5),
        ("distance:40,100,200,300.5,210=1.2", "distance", 1.2),
        ("object:3.height=0.74", "object", 0.74),
        ("object:12.height=.5m", "object", 0.5),
    ],
)
def test_good_texts_are_understood(text, kind, value_m):
    request = parse_scale(text)
    assert (request.kind, request.value_m) == (kind, value_m)


def test_all_parts_of_a_distance_and_an_object_are_kept():
    request = parse_scale("distance:40,100,200,300.5,210=1.2")
    assert (request.frame, request.pixels) == (40, (100.0, 200.0, 300.5, 210.0))
    assert parse_scale("object:3.height=0.74").object_id == 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1.5", "no '='"),
        ("camera-height=", "not a positive length"),
        ("camera-height=-1", "not a positive length"),
        ("camera-height=nan", "not a positive length"),
        ("camera-height=1e999", "not a positive length"),
        ("camera-height=150", "The unit is metres"),
        ("camera-height=74cm", "74 cm is 0.74"),
        ("distance:40,100,200,300=1", "FRAME,X1,Y1,X2,Y2"),
        ("distance:a,1,2,30,4=1", "FRAME,X1,Y1,X2,Y2"),
        ("distance:4,1,2,1,2=1", "coincide"),
        ("object:mug.height=1", "'object:mug.height' is not one of the possible forms"),
        ("object:3.width=1", "is not one of the possible forms"),
        ("height=1", "is not one of the possible forms"),
    ],
)
def test_bad_texts_are_taught(text, message):
    with pytest.raises(UsageError) as caught:
        parse_scale(text)
    assert message in str(caught.value)
    assert "--scale camera-height=1.5" in str(caught.value)


def test_the_config_refuses_a_bad_text_before_any_work():
    with pytest.raises(UsageError):
        WorldConfig(scale="tall")
    with pytest.raises(UsageError):
        WorldConfig(marker_size_m=-1)


def _film_marker(dictionary: str, marker_id: int, side: float, count: int, make_frames):
    """Draw a marker that lies on the plane z = 0, from several sides."""
    table = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    pattern = cv2.aruco.generateImageMarker(table, marker_id, 200)
    pattern = cv2.copyMakeBorder(pattern, 50, 50, 50, 50, cv2.BORDER_CONSTANT, value=255)
    images, poses = [], []
    for angle in np.linspace(-0.6, 0.6, count):
        eye = np.array([1.2 * side * np.sin(angle) * 3, -1.5 * side, 4 * side])
        forward = -eye / np.linalg.norm(eye)
        right = np.cross(forward, [0, 1.0, 0])
        right /= np.linalg.norm(right)
        pose = rigid(np.stack([right, np.cross(forward, right), forward], axis=1), eye)
        # Corners of the bordered picture in OpenCV's pixel coordinates (centres at whole numbers).
        plane = 0.75 * side * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0.0]])
        points = (plane - eye) @ pose[:3, :3]
        pixels = points[:, :2] / points[:, 2:] * CAMERA.fx + [CAMERA.cx - 0.5, CAMERA.cy - 0.5]
        source = np.array([[-0.5, -0.5], [299.5, -0.5], [299.5, 299.5], [-0.5, 299.5]], np.float32)
        warp = cv2.getPerspectiveTransform(source, pixels.astype(np.float32))
        gray = cv2.warpPerspective(pattern, warp, (320, 240), flags=cv2.INTER_AREA, borderValue=150)
        images.append(np.repeat(gray[..., None], 3, axis=2))
        poses.append(pose)
    return make_frames(np.stack(images), np.stack(poses))


@pytest.fixture
def make_frames():
    """Return a function that makes PosedFrames of images and cameras."""
    from reconstruction.core.types import PosedFrames, VideoSource

    def make(images: np.ndarray, poses: np.ndarray) -> PosedFrames:
        n, z = len(images), np.zeros
        source = VideoSource("v", "0" * 64, 320, 240, 30.0, n, 1.0)
        return PosedFrames(
            source, CAMERA, images, np.arange(n, dtype=np.int32) + 1, np.arange(n) / 30.0, poses,
            np.ones(n, np.float32), z((0, 240, 320, 3), np.uint8), z(0, np.int32), z(0), z((0, 4, 4)),
            z((0, 3)), z((0, 3), np.uint8), z(0, np.float32), z((0, 2), np.int32), n, True, 0.3,
        )  # fmt: skip

    return make


@pytest.mark.parametrize("dictionary", ["DICT_APRILTAG_36h11", "DICT_5X5_100"])
@pytest.mark.parametrize("side", [0.1, 3.0])
def test_a_marker_is_measured_within_a_percent(make_frames, dictionary, side):
    posed = _film_marker(dictionary, 7, side, 6, make_frames)
    (found,) = measure_markers(posed, (dictionary,))
    assert found.id == 7
    assert found.views >= 4
    assert found.side == pytest.approx(side, rel=0.01)
    assert abs(found.side / side - 1) < 3 * found.relative_sigma


def test_a_marker_seen_once_or_without_parallax_gives_nothing(make_frames):
    posed = _film_marker("DICT_5X5_100", 7, 0.1, 1, make_frames)
    assert measure_markers(posed, ("DICT_5X5_100",)) == []
    still = make_frames(np.repeat(posed.images, 3, axis=0), np.repeat(posed.world_from_camera, 3, axis=0))
    assert measure_markers(still, ("DICT_5X5_100",)) == []


def test_a_screen_that_shows_a_moving_marker_gives_nothing(make_frames):
    posed = _film_marker("DICT_5X5_100", 7, 0.1, 6, make_frames)
    shuffled = make_frames(posed.images, posed.world_from_camera[[3, 5, 0, 4, 1, 2]])
    assert measure_markers(shuffled, ("DICT_5X5_100",)) == []


def test_an_unknown_dictionary_is_a_usage_error(make_frames):
    posed = _film_marker("DICT_5X5_100", 7, 0.1, 2, make_frames)
    with pytest.raises(UsageError, match="DICT_APRILTAG_36h11"):
        measure_markers(posed, ("DICT_9X9",))


# ---- An object of known height.


@pytest.mark.parametrize("grows", [1.0, 0.6, 1.5])
def test_an_object_that_does_not_grow_with_the_scale_still_ends_at_its_height(grows):
    asked = []

    def height_at(measured_m: float) -> float:
        asked.append(measured_m)
        return 0.6 * (0.74 / measured_m) ** grows

    divisor, error = settle_object_height(0.6, 0.74, height_at, tolerance=0.015, passes=4)
    assert error <= 0.015
    assert abs(height_at(divisor) / 0.74 - 1) == pytest.approx(error)
    assert len(asked) <= 5


def test_the_best_pass_is_kept_where_none_is_good_enough():
    heights = iter([0.70, 0.72, 0.80])
    divisor, error = settle_object_height(0.6, 0.74, lambda _: next(heights), tolerance=0.015, passes=3)
    assert error == pytest.approx(0.02 / 0.74)
    assert divisor == pytest.approx(0.6 * 0.70 / 0.74)


# ---- The metric depth seam.


class Ruler:
    """A backend that knows the truth up to a per-image error."""

    name = "ruler"

    def __init__(self, factor: float) -> None:
        self.factor = factor

    def predict(self, image: np.ndarray, camera: Camera) -> np.ndarray:
        return np.full((camera.height, camera.width), self.factor * image[0, 0, 0] / 100, np.float32)


def test_metric_depth_gives_metres_per_unit(make_frames):
    values = np.array([98, 100, 100, 103, 100], np.uint8)
    images = np.broadcast_to(values[:, None, None, None], (5, 240, 320, 3))
    posed = make_frames(images, np.broadcast_to(np.eye(4), (5, 4, 4)))
    depth = np.full((5, 60, 80), 2.0, np.float32)
    maps = DepthMaps(CAMERA.resized(80, 60), depth, np.full(depth.shape, 2, np.uint8))
    per_unit, sigma = metres_per_unit(Ruler(3.0), posed, maps)
    assert per_unit == pytest.approx(1.5)
    assert 0.05 < sigma < 0.2
    empty = DepthMaps(maps.camera, 0 * depth, np.zeros(depth.shape, np.uint8))
    with pytest.raises(InputError, match="ruler"):
        metres_per_unit(Ruler(3.0), posed, empty)


def test_no_backend_is_loaded_unless_asked_for():
    assert load_backend(WorldConfig()) is None


def test_a_missing_library_names_the_extra(monkeypatch):
    real_import = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name == "transformers":
            raise ImportError("No module named 'transformers'", name="transformers")
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(EnvironmentMissing, match=r"simrecon\[models\]"):
        load_backend(WorldConfig(metric_depth="transformers"))
