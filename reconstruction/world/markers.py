"""Detect and triangulate printed ArUco or AprilTag markers (OpenCV), and measure their sides in `sfm` units."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.types import PosedFrames
from reconstruction.world.marker_fit import Square, fit_square
from registry.errors import UsageError
from registry.geometry import invert_rigid

_MAX_REPROJECTION_PX = 2.0  # mean over the corners of a frame
_MAX_SIDE_SPREAD = 0.10  # of the four sides of a marker, relative
_MIN_ANGLE_DEG = 2.0  # largest parallax angle of a marker must exceed this
_LEAST_SIGMA = 0.0016  # relative error that the scatter between views does not show


@dataclass(frozen=True)
class MarkerSide:
    """The side of a marker that several frames show."""

    dictionary: str  # name of cv2.aruco
    id: int
    side: float  # of the black square, `sfm` units
    views: int  # number of frames used
    relative_sigma: float  # standard deviation of the side


def detect_markers(
    images: np.ndarray, dictionaries: tuple[str, ...], rows: np.ndarray
) -> dict[tuple[str, int], dict[int, np.ndarray]]:
    """Detect markers in rows of images uint8 (n, h, w, 3); return {(dictionary, id): {row: corners (4, 2) in pixels}}.

    Raises:
        UsageError: OpenCV has no such dictionary.
    """
    known = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
    found: dict[tuple[str, int], dict[int, np.ndarray]] = {}
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    for name in dictionaries:
        if name not in known:
            raise UsageError(f"marker dictionary {name!r} does not exist; choose among {', '.join(known)}")
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        detector = cv2.aruco.ArucoDetector(dictionary, parameters)
        for row in rows:
            gray = cv2.cvtColor(np.asarray(images[row]), cv2.COLOR_RGB2GRAY)
            corners, ids, _ = detector.detectMarkers(gray)
            flat = [] if ids is None else ids.ravel().tolist()
            for marker_id, quad in zip(flat, corners):
                # The same id twice in one image: two prints that cannot be told apart. Both are dropped.
                seen = found.setdefault((name, marker_id), {})
                seen[int(row)] = np.full((4, 2), np.nan) if int(row) in seen else quad[0] + 0.5
    for seen in found.values():
        for row in [r for r, quad in seen.items() if np.isnan(quad).any()]:
            del seen[row]
    return found


def measure_markers(posed: PosedFrames, dictionaries: tuple[str, ...]) -> list[MarkerSide]:
    """Measure every marker that two or more frames show; detections that are no squares in space are dropped."""
    sides = []
    found = detect_markers(posed.images, dictionaries, np.arange(len(posed.images)))
    for (name, marker_id), seen in sorted(found.items()):
        if len(seen) < 2:
            continue
        corners = _triangulate_quad(posed, seen)
        if corners is None:
            continue
        lengths = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
        flatness = abs(np.linalg.det(corners[1:] - corners[0])) / lengths.mean() ** 3
        diagonals = np.linalg.norm(corners[:2] - corners[2:], axis=1) / (np.sqrt(2) * lengths.mean())
        uneven = np.ptp(lengths) > _MAX_SIDE_SPREAD * lengths.mean()
        if uneven or flatness > 0.1 or abs(diagonals - 1).max() > 0.1:
            continue
        fitted = fit_square(posed, sorted(seen), Square.of_corners(corners), printed_cells(name, marker_id))
        if fitted is None:
            continue
        square, scatter, views = fitted
        sides.append(MarkerSide(name, marker_id, square.side, views, float(np.hypot(scatter, _LEAST_SIGMA))))
    return sides


def printed_cells(dictionary: str, marker_id: int) -> np.ndarray:
    """Return the cells, uint8 (n, n), of a marker with its black border, 0 or 255.

    Raises:
        UsageError: the dictionary has no such marker.
    """
    table = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    if not 0 <= marker_id < len(table.bytesList):
        raise UsageError(
            f"marker id {marker_id}: {dictionary.removeprefix('DICT_')} has 0 to {len(table.bytesList) - 1}"
        )
    return cv2.aruco.generateImageMarker(table, marker_id, table.markerSize + 2)


def _triangulate_quad(posed: PosedFrames, seen: dict[int, np.ndarray]) -> np.ndarray | None:
    """Triangulate corners (4, 3), dropping frames with the largest error; None if fewer than two agree."""
    rows = sorted(seen)
    keep = list(rows)
    for _ in range(len(rows)):
        projections = posed.camera.matrix @ invert_rigid(posed.world_from_camera[keep])[:, :3]
        pixels = np.stack([seen[r] for r in keep])
        corners = np.stack([_triangulate(projections, pixels[:, k]) for k in range(4)])
        homogeneous = np.einsum("nij,kj->nki", projections, np.column_stack([corners, np.ones(4)]))
        if (homogeneous[..., 2] <= 0).any():
            return None
        error = np.linalg.norm(homogeneous[..., :2] / homogeneous[..., 2:] - pixels, axis=-1).mean(axis=1)
        if error.max() <= _MAX_REPROJECTION_PX:
            return corners if _parallax_deg(posed, keep, corners) >= _MIN_ANGLE_DEG else None
        del keep[int(error.argmax())]
        if len(keep) < 2:
            return None
    return None


def _parallax_deg(posed: PosedFrames, rows: list[int], corners: np.ndarray) -> float:
    rays = corners.mean(axis=0) - posed.world_from_camera[rows, :3, 3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return float(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))


def _triangulate(projections: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return the point (3,) seen at `pixels` (n, 2) through `projections` (n, 3, 4), by the direct linear transform."""
    rows = pixels[:, :, None] * projections[:, 2:3] - projections[:, :2]
    _, _, vt = np.linalg.svd(rows.reshape(-1, 4) / np.linalg.norm(rows.reshape(-1, 4), axis=1, keepdims=True))
    return vt[-1, :3] / vt[-1, 3]
