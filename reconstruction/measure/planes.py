"""Score the planes of the surface stage against the true ones: floor, walls and tops of supports."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.types import Surface, SurfacePlane
from reconstruction.measure.alignment import Alignment
from reconstruction.measure.ground_truth import GroundTruth, TrueEntity
from reconstruction.measure.surfaces import sample
from reconstruction.measure.visibility import seen_points, spread_poses
from reconstruction.surface.base_planes import plane_axes
from registry.geometry import split_similarity

_MIN_SEEN_M2 = {"floor": 0.4, "wall": 0.4, "support": 0.05}  # least visible area of an evaluated plane
_SAMPLES_PER_M2, _FEWEST_SAMPLES = 2000.0, 400
_LEVEL_DEG = 5.0  # tolerance of horizontal and vertical
_SAME_DEG, _SAME_M = 2.0, 0.003  # tolerances of triangles of one patch
_OVER_FLOOR_M = 0.03  # lower supports are part of the floor, such as rugs
# A match: greatest angle and offset, least share of the true points inside the outline, tolerance of its border.
_MATCH_DEG, _MATCH_M, _MATCH_SHARE, _BORDER_M = 10.0, 0.01, 0.5, 0.02


@dataclass(frozen=True)
class TruePlane:
    """A planar patch of a true mesh that is partly visible to the true cameras."""

    label: str  # "floor" | "wall" | "support"
    entity: int
    plane: np.ndarray  # float64 (4,), normal towards free space
    points: np.ndarray  # float64 (k, 3) area-uniform samples visible to some true camera
    seen_m2: float  # visible area


def planes_figures(
    surface: Surface, alignment: Alignment, truth: GroundTruth
) -> dict[str, float | int] | None:
    """Return the share of true planes found and their median angle and offset errors; None without true meshes.

    A match has the same label, is within 10 degrees and 1 cm, and its outline contains half of the visible points.
    """
    if not truth.entities:
        return None
    wanted = true_planes(truth)
    errors: list[tuple[str, tuple[float, float] | None]] = [
        (true.label, _best_error(true, surface.planes, alignment)) for true in wanted
    ]
    out: dict[str, float | int] = {"asked": len(wanted)}
    matched = [error for _, error in errors if error is not None]
    if wanted:
        out["found_share"] = len(matched) / len(wanted)
    for label in _MIN_SEEN_M2:
        of_kind = [error is not None for kind, error in errors if kind == label]
        if of_kind:
            out |= {f"{label}_asked": len(of_kind), f"{label}_found_share": float(np.mean(of_kind))}
    if matched:
        angle, offset = np.median(matched, axis=0)
        out |= {"angle_median_deg": float(angle), "offset_median_mm": float(1000 * offset)}
    return out


def true_planes(truth: GroundTruth) -> list[TruePlane]:
    """Extract the visible planar patches of floor, walls and supports (horizontal, facing up) from the true meshes.

    Patches count from a visible area of 0.4 m2 (floor, wall) or 0.05 m2 (support).
    """
    patches = [patch for entity in truth.entities for patch in _patches(entity, truth.up)]
    samples = []
    for _, _, _, triangles, area in patches:
        corners = np.arange(3 * len(triangles)).reshape(-1, 3)
        count = max(_FEWEST_SAMPLES, round(_SAMPLES_PER_M2 * area))
        samples.append(sample(triangles.reshape(-1, 3), corners, count).points)
    if not samples:
        return []
    seen = seen_points(np.concatenate(samples), *truth.mesh, truth.camera, spread_poses(truth.poses))
    ends = np.cumsum([len(points) for points in samples])
    out = []
    for (label, entity, plane, _, area), points, mark in zip(patches, samples, np.split(seen, ends[:-1])):
        seen_m2 = area * float(mark.mean())
        if seen_m2 >= _MIN_SEEN_M2[label]:
            out.append(TruePlane(label, entity, plane, points[mark], seen_m2))
    floors = [true for true in out if true.label == "floor"]
    return [t for t in out if t.label != "support" or not any(_is_on_floor(t, floor) for floor in floors)]


def _is_on_floor(support: TruePlane, floor: TruePlane) -> bool:
    return float(np.median(support.points @ floor.plane[:3] + floor.plane[3])) < _OVER_FLOOR_M


def _patches(entity: TrueEntity, up: np.ndarray) -> list[tuple[str, int, np.ndarray, np.ndarray, float]]:
    """Group coplanar triangles greedily; return (label, id, plane, triangles (f, 3, 3), area) of large patches."""
    label = entity.label if entity.base else "support"
    if label not in _MIN_SEEN_M2:
        return []
    triangles = np.asarray(entity.mesh.vertices, np.float64)[np.asarray(entity.mesh.faces)]
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    areas = 0.5 * np.linalg.norm(cross, axis=1)
    normals = cross / np.maximum(2 * areas, 1e-300)[:, None]
    rise = normals @ up
    level = np.cos(np.radians(_LEVEL_DEG))
    left = (np.abs(rise) < np.sqrt(1 - level**2)) if label == "wall" else rise > level
    left &= areas > 1e-9
    out = []
    while areas[left].sum() >= _MIN_SEEN_M2[label]:
        seed = int(np.argmax(np.where(left, areas, 0.0)))
        plane = np.append(normals[seed], -normals[seed] @ triangles[seed, 0])
        near = np.abs(triangles @ plane[:3] + plane[3]).max(axis=1) < _SAME_M
        one = left & near & (normals @ plane[:3] > np.cos(np.radians(_SAME_DEG)))
        one[seed] = True
        left &= ~one
        area = float(areas[one].sum())
        if area >= _MIN_SEEN_M2[label]:
            out.append((label, entity.id, plane, triangles[one], area))
    return out


def _best_error(
    true: TruePlane, found: tuple[SurfacePlane, ...], alignment: Alignment
) -> tuple[float, float] | None:
    """Return the angle (degrees) and offset (metres) of the match with the smallest offset; None if missed."""
    _, rotation, _ = split_similarity(alignment.true_from_estimated)
    best = None
    for candidate in found:
        if candidate.label != true.label:
            continue
        normal = rotation @ candidate.surface.plane[:3]
        angle = float(np.degrees(np.arccos(np.clip(normal @ true.plane[:3], -1, 1))))
        polygon = alignment.to_true(candidate.surface.polygon)
        plane = np.append(normal, -normal @ polygon[0])
        offset = abs(float(np.median(true.points @ normal + plane[3])))
        if angle > _MATCH_DEG or offset > _MATCH_M or (best is not None and offset >= best[1]):
            continue
        if _inside(true.points, polygon, plane).mean() >= _MATCH_SHARE:
            best = (angle, offset)
    return best


def _inside(points: np.ndarray, polygon: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """Return which points (n, 3), at most 4000, project into a polygon on a plane, with a tolerance of 2 cm."""
    axes = np.stack(plane_axes(plane), axis=1)
    outline = np.ascontiguousarray(polygon @ axes, np.float32)
    distance = [cv2.pointPolygonTest(outline, (float(u), float(v)), True) for u, v in points[:4000] @ axes]
    return np.array(distance) > -_BORDER_M
