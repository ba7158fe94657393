"""What later stages make of a room's depth: corrected depth maps, the fused mesh, its superpoints and true entities."""

import numpy as np

from reconstruction.types import DepthMaps, PosedFrames
from synthetic.film import FilmSet

_SAMPLES = 400_000
_ARTIFACT_M = 0.02  # farther from every true surface: what only occlusion borders and wrong matches made


def measure_surface(
    film_set: FilmSet, posed: PosedFrames, maps: DepthMaps, mesh: bool
) -> dict[str, np.ndarray]:
    """Return arrays by name: Gaussians' depth; beside it the mesh with its superpoints and true ids.

    Args:
        film_set: The true room, metres.
        posed: Frames in world space, metres.
        maps: Their depth.
        mesh: Whether to fuse it.
    """
    from reconstruction.gaussians import GaussiansConfig, make_gaussians
    from reconstruction.instances.superpoints import superpoints
    from reconstruction.surface import SurfaceConfig, fuse_surface
    from reconstruction.surface.mesh_graph import MeshGraph

    scene = make_gaussians(posed, maps, GaussiansConfig())
    out = {"gaussians_depth": scene.depth.depth.astype(np.float16)}
    if not mesh:
        return out
    surface = fuse_surface(scene.posed(posed), scene.depth, SurfaceConfig())
    return out | {
        "mesh_vertices": surface.vertices,
        "mesh_faces": surface.faces,
        "mesh_colors": surface.colors,
        "mesh_superpoints": superpoints(MeshGraph.from_surface(surface)),
        "mesh_true_ids": true_ids(film_set, surface.vertices),
    }


def true_ids(film_set: FilmSet, points: np.ndarray) -> np.ndarray:
    """Return the entity uint16 (n,) whose true surface is nearest to each point (n, 3), metres; 0 beyond 2 cm."""
    from scipy.spatial import cKDTree

    corners = film_set.vertices[film_set.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    rng = np.random.default_rng(0)
    face = rng.choice(len(area), _SAMPLES, p=area / area.sum())
    # Small things get samples, too: a face each.
    face = np.concatenate([face, np.arange(len(area))])
    share = rng.dirichlet((1, 1, 1), len(face))
    samples = np.einsum("nk,nkj->nj", share, corners[face])
    distance, nearest = cKDTree(samples).query(points, distance_upper_bound=_ARTIFACT_M)
    known = np.isfinite(distance)
    return np.where(known, film_set.face_entity[face[np.where(known, nearest, 0)]], 0).astype(np.uint16)
