"""What later stages make of a room's depth: corrected depth maps, the fused mesh, its superpoints and true entities."""

import numpy as np

from reconstruction.core.types import DepthMaps, PosedFrames
from synthetic.film import FilmSet

_SAMPLES = 2_000_000  # of the true surface
_ARTIFACT_M, _ARTIFACT_SHARE = (
    0.02,
    0.02,
)  # distance to the true surface, and the same over the distance to a camera


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
    from reconstruction.core.mesh_graph import MeshGraph
    from reconstruction.gaussians import GaussiansConfig, make_gaussians
    from reconstruction.instances.superpoints import superpoints
    from reconstruction.surface import SurfaceConfig, fuse_surface

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
        "mesh_true_ids": true_ids(film_set, surface.vertices, posed.world_from_camera[:, :3, 3]),
    }


def true_ids(film_set: FilmSet, points: np.ndarray, eyes: np.ndarray) -> np.ndarray:
    """Return the entity uint16 (v,) whose true surface is nearest to each point (v, 3), metres.

    0 where that is farther than 2 cm and than 2 % of the distance to the nearest of the cameras' centers (n, 3):
    surface that only occlusion borders and wrong matches made.
    """
    from scipy.spatial import cKDTree

    corners = film_set.vertices[film_set.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    rng = np.random.default_rng(0)
    # Small things get samples, too: a face each.
    face = np.r_[rng.choice(len(area), _SAMPLES, p=area / area.sum()), np.arange(len(area))]
    share = rng.dirichlet((1, 1, 1), len(face))
    samples = np.einsum("nk,nkj->nj", share, corners[face])
    distance, nearest = cKDTree(samples).query(points)
    allowed = np.maximum(_ARTIFACT_M, _ARTIFACT_SHARE * cKDTree(eyes).query(points)[0])
    return np.where(distance <= allowed, film_set.face_entity[face[nearest]], 0).astype(np.uint16)
