"""Compare two surfaces by samples: Chamfer distance, F-score, normal consistency (CONTRACT section 4)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import KDTree

from reconstruction.core.types import Camera
from reconstruction.measure.visibility import seen_points

if TYPE_CHECKING:
    from reconstruction.measure.ground_truth import TrueEntity

COMPOSITION_POINTS, OBJECT_POINTS = 1_000_000, 50_000  # CONTRACT section 4
_SEED = 0


@dataclass(frozen=True)
class Samples:
    """Area-uniform samples of a surface."""

    points: np.ndarray  # float64 (n, 3)
    normals: np.ndarray  # float64 (n, 3) unit normals of the triangles


@dataclass(frozen=True)
class SurfaceScore:
    """Agreement of two surfaces: distances in centimetres, shares in percent."""

    cd_cm: float  # Chamfer distance: mean of the two mean nearest distances
    f: float  # F-score: harmonic mean of precision and recall
    nc: float  # normal consistency: mean of the two mean absolute cosines of nearest normals
    precision: float  # share of the estimated points within the bound
    recall: float  # share of the true points within the bound
    accuracy_cm: float  # mean distance from estimated to true
    completeness_cm: float  # mean distance from true to estimated


def sample(vertices: np.ndarray, faces: np.ndarray, count: int, seed: int = _SEED) -> Samples:
    """Sample a mesh area-uniformly; no samples if its area is zero."""
    corners = np.asarray(vertices, np.float64)[np.asarray(faces)]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(cross, axis=1)
    if not doubled.sum() > 0:
        return Samples(np.zeros((0, 3)), np.zeros((0, 3)))
    rng = np.random.default_rng(seed)
    cumulative = np.cumsum(doubled)
    face = np.searchsorted(cumulative, rng.random(count) * cumulative[-1], side="right")
    face = np.minimum(face, len(doubled) - 1)
    r1, r2 = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1 - r1, r1 * (1 - r2), r1 * r2], axis=1)
    points = np.einsum("nk,nkc->nc", weights, corners[face])
    return Samples(points, cross[face] / np.maximum(doubled[face], 1e-300)[:, None])


def sample_seen(
    vertices: np.ndarray,
    faces: np.ndarray,
    camera: Camera,
    world_from_camera: list[np.ndarray],
    count: int = COMPOSITION_POINTS,
    seed: int = _SEED,
) -> Samples:
    """Sample a mesh area-uniformly and keep the samples that some camera sees within 5 m; `count` is before that."""
    drawn = sample(vertices, faces, count, seed)
    seen = seen_points(drawn.points, vertices, faces, camera, world_from_camera)
    return Samples(drawn.points[seen], drawn.normals[seen])


def compare(estimated: Samples, true: Samples, bound_m: float) -> SurfaceScore | None:
    """Compare two sets of samples, with `bound_m` for the F-score; None if either is empty."""
    if not len(estimated.points) or not len(true.points):
        return None
    to_estimated, i = KDTree(estimated.points).query(true.points, workers=-1)
    to_true, j = KDTree(true.points).query(estimated.points, workers=-1)
    precision, recall = float((to_true < bound_m).mean()), float((to_estimated < bound_m).mean())
    cosines_true = np.abs(np.einsum("nc,nc->n", true.normals, estimated.normals[i]))
    cosines_estimated = np.abs(np.einsum("nc,nc->n", estimated.normals, true.normals[j]))
    return SurfaceScore(
        cd_cm=float(50 * (to_true.mean() + to_estimated.mean())),
        f=200 * precision * recall / max(precision + recall, 1e-12),
        nc=float(50 * (cosines_true.mean() + cosines_estimated.mean())),
        precision=100 * precision,
        recall=100 * recall,
        accuracy_cm=float(100 * to_true.mean()),
        completeness_cm=float(100 * to_estimated.mean()),
    )


def nearest_entities(
    points: np.ndarray, entities: Sequence["TrueEntity"], samples: int, bound_m: float
) -> np.ndarray:
    """Return the id (n,) of the true entity nearest to each point (n, 3) of the true world, 0 beyond `bound_m`.

    Objects are given by this many samples, base surfaces by twice as many.
    """
    clouds = [sample(e.mesh.vertices, e.mesh.faces, (1 + e.base) * samples).points for e in entities]
    ids = np.repeat([e.id for e in entities], [len(cloud) for cloud in clouds])
    distance, nearest = KDTree(np.concatenate(clouds)).query(points, workers=-1)
    return np.where(distance < bound_m, ids[np.minimum(nearest, len(ids) - 1)], 0)
