"""Printed markers give metres: measured in generated films as phones make them, and printed in their true size."""

import re

import cv2
import numpy as np
import pytest

from reconstruction.cli import main
from reconstruction.core.types import Camera, PosedFrames, VideoSource
from reconstruction.world.marker_print import MarkerSheet, write_marker
from reconstruction.world.markers import measure_markers, printed_cells
from registry.errors import UsageError
from registry.geometry import rigid

pytestmark = pytest.mark.stage

CAMERA = Camera(640, 480, 533.0, 533.0, 320.0, 240.0)
CELL_PX = 16
PAPER_PX, WALL_PX = 32, 200


def paper_on_texture(rng: np.random.Generator, cells: np.ndarray) -> np.ndarray:
    """Return a printed marker with a white border on a blotchy surface, uint8."""
    print_px = np.pad(cells.repeat(CELL_PX, 0).repeat(CELL_PX, 1), PAPER_PX, constant_values=255)
    side = len(print_px) + 2 * WALL_PX
    surface = cv2.resize(
        rng.integers(60, 200, (40, 40), dtype=np.uint8), (side, side), interpolation=cv2.INTER_CUBIC
    )
    surface[WALL_PX:-WALL_PX, WALL_PX:-WALL_PX] = np.where(print_px > 0, 225, 35)
    return surface


def view_of(
    rng: np.random.Generator, distance: float, elevation: float, angle: float, flat: bool
) -> np.ndarray:
    """Return world_from_camera that looks about at the origin; the marker lies in z = 0 (or stands, y up)."""
    reach = distance * rng.uniform(0.93, 1.07)
    out, high = np.cos(elevation), np.sin(elevation)
    if flat:
        eye = reach * np.array([out * np.sin(angle), -out * np.cos(angle), high])
    else:
        eye = reach * np.array([out * np.sin(angle), high, out * np.cos(angle)])
    forward = rng.normal(0, 0.12 * distance, 3) * [1, 1, 0] - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0] if flat else [0, 1.0, 0])
    right /= np.linalg.norm(right)
    return rigid(np.stack([right, np.cross(forward, right), forward], axis=1), eye)


def photograph(rng: np.random.Generator, surface: np.ndarray, width_m: float, pose: np.ndarray) -> np.ndarray:
    """Return a phone's picture of the surface: blurred, noisy, compressed; uint8 (h, w)."""
    fine = 4
    lens = np.array(
        [
            [CAMERA.fx * fine, 0, CAMERA.cx * fine - 0.5],
            [0, CAMERA.fy * fine, CAMERA.cy * fine - 0.5],
            [0, 0, 1],
        ]
    )
    corners = width_m / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0.0]])
    pixels = (corners - pose[:3, 3]) @ pose[:3, :3] @ lens.T
    pixels = (pixels[:, :2] / pixels[:, 2:]).astype(np.float32)
    end = len(surface) - 0.5
    source = np.array([[-0.5, -0.5], [end, -0.5], [end, end], [-0.5, end]], np.float32)
    size = (CAMERA.width, CAMERA.height)
    warp = cv2.getPerspectiveTransform(source, pixels)
    image = cv2.warpPerspective(surface, warp, (size[0] * fine, size[1] * fine), borderValue=120)
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 0.9)) * rng.uniform(0.85, 1.1)
    image = np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
    quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(60, 90))]
    return cv2.imdecode(cv2.imencode(".jpg", image, quality)[1], cv2.IMREAD_GRAYSCALE)


def film_marker(seed: int) -> tuple[PosedFrames, float, str]:
    """Film a marker of 8 to 20 cm from 1 to 3 m, lying or hanging, with cameras as exact as the poses stage's."""
    rng = np.random.default_rng(seed)
    side, distance, count = rng.uniform(0.08, 0.20), rng.uniform(1.0, 3.0), int(rng.integers(10, 24))
    dictionary, flat = str(rng.choice(["DICT_APRILTAG_36h11", "DICT_5X5_100"])), seed % 2 == 0
    cells = printed_cells(dictionary, int(rng.integers(0, 90)))
    surface = paper_on_texture(rng, cells)
    width_m = len(surface) * side / (len(cells) * CELL_PX)
    elevation = np.radians(rng.uniform(25, 70) if flat else rng.uniform(-10, 25))
    angles = np.linspace(-0.5, 0.5, count) * rng.uniform(0.3, 1.0) + rng.uniform(-0.5, 0.5)
    images, poses = [], []
    for angle in angles:
        pose = view_of(rng, distance, elevation, angle, flat)
        images.append(photograph(rng, surface, width_m, pose))
        turn = cv2.Rodrigues(rng.normal(0, np.radians(0.02), 3))[0]
        poses.append(rigid(pose[:3, :3] @ turn, pose[:3, 3] + rng.normal(0, 0.0007, 3)))
    z, size = np.zeros, (CAMERA.height, CAMERA.width, 3)
    posed = PosedFrames(
        VideoSource("v", "0" * 64, *size[1::-1], 30.0, count, 1.0), CAMERA,
        np.repeat(np.stack(images)[..., None], 3, axis=3), np.arange(count, dtype=np.int32) + 1,
        np.arange(count) / 30.0, np.stack(poses), np.ones(count, np.float32), z((0, *size), np.uint8),
        z(0, np.int32), z(0), z((0, 4, 4)), z((0, 3)), z((0, 3), np.uint8), z(0, np.float32), z((0, 2), np.int32),
        count, True, 0.3,
    )  # fmt: skip
    return posed, side, dictionary


def errors_and_sigmas(seeds: range) -> np.ndarray:
    """Return (error, sigma), both relative, of every film (n, 2)."""
    out = []
    for seed in seeds:
        posed, side, dictionary = film_marker(seed)
        (found,) = measure_markers(posed, (dictionary,))
        out.append((found.side / side - 1, found.relative_sigma))
    return np.array(out)


def test_markers_as_phones_film_them_are_measured_within_half_a_percent() -> None:
    measured = errors_and_sigmas(range(1, 13, 4))  # 26 to 62 pixels wide
    assert np.abs(measured[:, 0]).max() < 0.005
    assert (np.abs(measured[:, 0]) < 3 * measured[:, 1]).all()
    assert measured[:, 1].max() < 0.005


@pytest.mark.end_to_end
def test_over_many_films_the_worst_is_within_a_percent_and_the_sigma_is_honest() -> None:
    measured = errors_and_sigmas(range(100, 136))
    error, sigma = np.abs(measured[:, 0]), measured[:, 1]
    assert error.max() < 0.01
    assert 0.5 < (error < sigma).mean() < 0.9
    assert (error < 2 * sigma).mean() > 0.88


# ---- The sheet to print.


def test_a_printed_sheet_holds_the_marker_in_its_true_size(tmp_path) -> None:
    from PIL import Image

    file = tmp_path / "marker.png"
    assert main(["marker", "--out", str(file), "--size", "0.12", "--id", "7"]) == 0
    with Image.open(file) as page:
        per_m = page.info["dpi"][0] / 0.0254
        pixels = np.asarray(page)
    assert pixels.shape[0] / per_m == pytest.approx(0.297, abs=0.001)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11))
    corners, ids, _ = detector.detectMarkers(pixels)
    assert ids.ravel().tolist() == [7]
    dark = np.flatnonzero(pixels[int(corners[0][0, :, 1].mean())] < 128)
    assert (dark.max() - dark.min() + 1) / per_m == pytest.approx(0.12, rel=1e-4)


def test_the_pdf_draws_the_same_cells_in_points(tmp_path) -> None:
    file = tmp_path / "marker.pdf"
    sheet = MarkerSheet("DICT_APRILTAG_36h11", 3, 0.15)
    write_marker(sheet, file)
    data = file.read_bytes()
    boxes = np.array(re.findall(rb"([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) re", data), float) * 0.0254 / 72
    assert np.ptp(np.concatenate([boxes[:, 0], boxes[:, 0] + boxes[:, 2]])) == pytest.approx(0.15, rel=1e-5)
    cells = np.full((8, 8), 255, np.uint8)
    at = np.rint((boxes[:, :2] - boxes[:, :2].min(axis=0)) / boxes[0, 2]).astype(int)
    cells[7 - at[:, 1], at[:, 0]] = 0
    np.testing.assert_array_equal(cells, printed_cells("DICT_APRILTAG_36h11", 3))
    start = int(re.search(rb"startxref\n(\d+)", data)[1])
    assert data[start:].startswith(b"xref")
    assert data.startswith(b"%PDF")
    assert data.endswith(b"%%EOF\n")


def test_a_sheet_that_cannot_be_is_explained(tmp_path) -> None:
    with pytest.raises(UsageError, match=r"an A4 sheet takes 0.02 to 0.158"):
        MarkerSheet("DICT_APRILTAG_36h11", 0, 0.4)
    with pytest.raises(UsageError, match="has 0 to 586"):
        MarkerSheet("DICT_APRILTAG_36h11", 587, 0.1)
    with pytest.raises(UsageError, match=r"\.pdf or \.png"):
        write_marker(MarkerSheet("DICT_APRILTAG_36h11", 0, 0.1), tmp_path / "marker.jpg")
