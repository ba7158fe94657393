"""Independent reference of the contract's geometry metrics: exact rays instead of rasterization, other samples."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from reconstruction.measure.surfaces import compare, sample_seen
from reconstruction.measure.visibility import seen_points
from registry.geometry import rigid

pytestmark = pytest.mark.end_to_end

pytest.importorskip("embreex", reason="the reference casts exact rays with embreex (pip install embreex)")
POINTS = 300_000


def seen_by_rays(mesh: trimesh.Trimesh, points: np.ndarray, truth) -> np.ndarray:
    """Return which points on a mesh are visible to some true camera within 5 m."""
    rays = trimesh.ray.ray_pyembree.RayMeshIntersector(mesh)
    k, seen = truth.camera, np.zeros(len(points), bool)
    for pose in truth.poses:
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        depth = np.maximum(local[:, 2], 1e-9)
        u, v = k.fx * local[:, 0] / depth + k.cx, k.fy * local[:, 1] / depth + k.cy
        distance = np.linalg.norm(local, axis=1)
        inside = (local[:, 2] > 0) & (u >= 0) & (u < k.width) & (v >= 0) & (v < k.height) & (distance <= 5)
        asked = np.flatnonzero(inside & ~seen)
        directions = (points[asked] - pose[:3, 3]) / distance[asked, None]
        origins = np.broadcast_to(pose[:3, 3], directions.shape)
        hits, rows, _ = rays.intersects_location(origins, directions, multiple_hits=False)
        first = np.full(len(asked), np.inf)
        first[rows] = np.linalg.norm(hits - pose[:3, 3], axis=1)
        seen[asked[first >= distance[asked] - 1e-3]] = True
    return seen


def reference(found: trimesh.Trimesh, true: trimesh.Trimesh, truth) -> dict[str, float]:
    sides = []
    for seed, mesh in enumerate((found, true)):
        points, face = trimesh.sample.sample_surface(mesh, POINTS, seed=100 + seed)
        seen = seen_by_rays(mesh, points, truth)
        sides.append((points[seen], mesh.face_normals[face[seen]]))
    (a, na), (b, nb) = sides
    (da, ia), (db, ib) = KDTree(b).query(a), KDTree(a).query(b)
    precision, recall = (da < 0.05).mean(), (db < 0.05).mean()
    return {
        "cd_cm": 50 * (da.mean() + db.mean()),
        "f_5cm": 200 * precision * recall / (precision + recall),
        "nc": 50 * (np.abs((na * nb[ia]).sum(1)).mean() + np.abs((nb * na[ib]).sum(1)).mean()),
    }


def test_geometry_agrees_within_one_percent(truth):
    """Independent samples of one surface have the sample spacing as distance."""
    moved = {
        "carton": rigid(translation=np.array([0.12, -0.1, 0.05])),
        "shelf": rigid(translation=np.array([0.25, -0.2, 0.0])),
        "table": rigid(translation=np.array([0.0, -0.15, 0.1])),
    }
    kept = [e for e in truth.room.entities if e.name not in ("book", "tin")]
    true = trimesh.util.concatenate([e.mesh() for e in truth.room.entities])
    found = trimesh.util.concatenate(
        [e.mesh().apply_transform(moved[e.name]) if e.name in moved else e.mesh() for e in kept]
    )
    sides = [
        sample_seen(mesh.vertices, mesh.faces, truth.camera, list(truth.poses), POINTS, seed)
        for seed, mesh in enumerate((found, true))
    ]
    score = compare(*sides, 0.05)
    wanted = reference(found, true, truth)
    assert score.cd_cm == pytest.approx(wanted["cd_cm"], rel=0.01)
    assert score.f == pytest.approx(wanted["f_5cm"], rel=0.01)
    assert score.nc == pytest.approx(wanted["nc"], rel=0.01)
    assert 1 < score.cd_cm < 10  # the faults are large: 1 % of the figure is far above chance
    assert 70 < score.f < 97


def test_seen_points_agree_with_exact_rays(truth):
    mesh = trimesh.util.concatenate([e.mesh() for e in truth.room.entities])
    points, _ = trimesh.sample.sample_surface(mesh, 40_000, seed=7)
    drawn = seen_points(points, mesh.vertices, mesh.faces, truth.camera, list(truth.poses))
    cast = seen_by_rays(mesh, points, truth)
    assert 0.1 < cast.mean() < 0.9
    assert (drawn != cast).mean() < 0.02
