"""How well the surface stage's planes agree with the true ones: floor, walls and support tops of the true meshes."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.types import Surface, SurfacePlane
from reconstruction.measure.alignment import Alignment
from reconstruction.measure.ground_truth import GroundTruth, TrueEntity
from reconstruction.measure.scene import joined
from reconstruction.measure.surfaces import sample
from reconstruction.measure.visibility import seen_points, spread_poses
from reconstruction.surface.base_planes import plane_axes
from registry.geometry import split_similarity

_MIN_SEEN_M2 = {"floor": 0.4, "wall": 0.4, "support": 0.05}
_SAMPLES_PER_M2, _FEWEST_SAMPLES = 2000.0, 400
_LEVEL_DEG, _SAME_DEG, _SAME_M = 5.0, 2.0, 0.003  # what is level; what is one patch
_OVER_FLOOR_M = 0.03
_MATCH_DEG, _MATCH_M, _MATCH_SHARE, _BORDER_M = 10.0, 0.01, 0.5, 0.02


@dataclass(frozen=True)
class TruePlane:
    """A planar patch of the truth that the true cameras saw some of."""

    label: str  # "floor" | "wall" | "support"
    entity: int
    plane: np.ndarray  # float64 (4,), n towards free space
    points: np.ndarray  # float64 (k, 3) area-uniform, those that some true camera sees
    seen_m2: float


def planes_figures(
    surface: Surface, alignment: Alignment, truth: GroundTruth
) -> dict[str, float | int] | None:
    """Share of the true planes found, and their angle and offset errors; None where the truth has no meshes.

    A true plane is found by a plane of its kind within 10 degrees and 1 cm whose outline holds half of its seen points.
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
    """Return what was seen of the true floor, walls and support tops.

    A floor or wall counts from 0.4 m2 seen; a support is a level up-facing patch of which 0.05 m2 are seen.
    """
    patches = [patch for entity in truth.entities for patch in _patches(entity, truth.up)]
    vertices, faces = joined([e.mesh for e in truth.entities])
    samples = []
    for _, _, _, triangles, area in patches:
        corners = np.arange(3 * len(triangles)).reshape(-1, 3)
        count = max(_FEWEST_SAMPLES, round(_SAMPLES_PER_M2 * area))
        samples.append(sample(triangles.reshape(-1, 3), corners, count).points)
    if not samples:
        return []
    poses = spread_poses(list(truth.world_from_camera.values()))
    seen = seen_points(np.concatenate(samples), vertices, faces, truth.camera, poses)
    ends = np.cumsum([len(points) for points in samples])
    out = []
    for (label, entity, plane, _, area), points, mark in zip(patches, samples, np.split(seen, ends[:-1])):
        seen_m2 = area * float(mark.mean())
        if seen_m2 >= _MIN_SEEN_M2[label]:
            out.append(TruePlane(label, entity, plane, points[mark], seen_m2))
    floors = [true for true in out if true.label == "floor"]
    return [t for t in out if t.label != "support" or not any(_lies_on(t, floor) for floor in floors)]


def _lies_on(support: TruePlane, floor: TruePlane) -> bool:
    """Tell a rug from a support."""
    return float(np.median(support.points @ floor.plane[:3] + floor.plane[3])) < _OVER_FLOOR_M


def _patches(entity: TrueEntity, up: np.ndarray) -> list[tuple[str, int, np.ndarray, np.ndarray, float]]:
    """Return (label, id, plane, triangles (f, 3, 3), area) of an entity's planar patches that may count."""
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
    """Return (angle in degrees, offset in metres) of the nearest plane that covers the true one; None: missed."""
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
    """Tell which points (n, 3) lie over a polygon on a plane, or within 2 cm of it."""
    axes = np.stack(plane_axes(plane), axis=1)
    outline = np.ascontiguousarray(polygon @ axes, np.float32)
    distance = [cv2.pointPolygonTest(outline, (float(u), float(v)), True) for u, v in points[:4000] @ axes]
    return np.array(distance) > -_BORDER_M
