"""Stage 5: fuse depth maps into a surface mesh, its planes and an occupancy grid."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.core.types import Camera, DepthMaps, PosedFrames, SpaceGrid, Surface
from reconstruction.surface.config import SurfaceConfig
from registry.errors import InputError

if TYPE_CHECKING:
    from reconstruction.surface.extract import RawMesh
    from reconstruction.surface.pixels import FusionViews

_BOX_MARGIN_M = 0.05  # around the observed box


def _points(depth: np.ndarray, camera: Camera, world_from_camera: np.ndarray, max_depth: float) -> np.ndarray:
    """Return the world points (m, 3) of every fourth pixel with depth."""
    z = depth[:, 2::4, 2::4]
    v, y, x = np.nonzero((z > 0) & (z <= max_depth))
    local = camera.unproject(x * 4 + 2.5, y * 4 + 2.5, z[v, y, x].astype(np.float64))
    return np.einsum("nij,nj->ni", world_from_camera[v, :3, :3], local) + world_from_camera[v, :3, 3]


def _observed_box(
    posed: PosedFrames, depth: DepthMaps, config: SurfaceConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest corner (3,) of a box around depth (0.05-99.95 % range) and cameras."""
    points = _points(depth.depth, depth.camera, posed.world_from_camera, config.max_depth_m)
    if len(points) < 100:
        raise InputError(
            f"surface: only {len(points)} depth samples within {config.max_depth_m:g} m. "
            "The depth stage measured almost nothing. Film again with more light, texture and sideways motion."
        )
    low, high = np.percentile(points, [0.05, 99.95], axis=0)
    # Cameras count as observed: the space around them is free.
    centers = posed.world_from_camera[:, :3, 3]
    low, high = np.minimum(low, centers.min(0)), np.maximum(high, centers.max(0))
    low, high = low - _BOX_MARGIN_M, high + _BOX_MARGIN_M
    # A floor at z = 0 needs a margin of grid below it.
    if low[2] < 0.1:
        low[2] = min(low[2], -_BOX_MARGIN_M)
    return low, high


def _fuse_blocks(
    posed: PosedFrames,
    views: "FusionViews",
    low: np.ndarray,
    high: np.ndarray,
    config: SurfaceConfig,
    progress: Progress,
) -> tuple["RawMesh", float]:
    """Fuse the views in blocks, with voxels grown until blocks are few enough; return the mesh and the voxel's edge."""
    from reconstruction.surface.slabs import fuse_slabs
    from reconstruction.surface.tsdf import BLOCK, surface_blocks

    voxel = config.voxel_size_m
    while True:
        nx, ny, nz = (int(s) for s in np.ceil((high - low) / (BLOCK * voxel)).astype(int) + 1)
        shape = (nx, ny, nz)
        # Bound the dense grid of block marks, one byte each, too.
        if np.prod(shape, dtype=np.int64) <= 40 * config.max_blocks:
            truncation = config.truncation_voxels * voxel
            blocks = surface_blocks(views, posed.world_from_camera, low, shape, voxel, truncation)
            if len(blocks) <= config.max_blocks:
                break
        voxel *= 1.25
    if voxel > config.voxel_size_m:
        progress.note(
            f"surface: voxels of {voxel * 1000:.1f} mm instead of {config.voxel_size_m * 1000:.1f} mm, "
            f"since the scene is large ({' x '.join(f'{s:.1f}' for s in high - low)} m)"
        )
    return fuse_slabs(views, blocks, low, voxel, config, progress), voxel


def _space(
    views: "FusionViews",
    low: np.ndarray,
    high: np.ndarray,
    mesh: "RawMesh",
    config: SurfaceConfig,
    progress: Progress,
) -> SpaceGrid:
    """Return the occupancy grid of the box, with voxels grown until they are few enough."""
    from reconstruction.surface.free_space import carve_space, mark_surface

    voxel = config.space_voxel_m
    cells = np.prod((high - low) / voxel)
    if cells > config.max_space_cells:
        voxel *= float((cells / config.max_space_cells) ** (1 / 3))
        progress.note(f"surface: free-space voxels of {voxel * 100:.1f} cm, since the scene is large")
    nx, ny, nz = (int(s) for s in np.ceil((high - low) / voxel).astype(int))
    space = carve_space(
        views, low, (nx, ny, nz), voxel, margin=config.free_margin_m, completed_margin=config.completed_margin_m,
        min_rays=config.free_min_rays,
    )  # fmt: skip
    mark_surface(space, mesh.vertices, mesh.faces)
    return space


def fuse_surface(
    posed: PosedFrames, depth: DepthMaps, config: SurfaceConfig, *, progress: Progress = NO_PROGRESS
) -> Surface:
    """Fuse depth maps into the visible surface, its planes and an occupancy grid.

    TSDF fusion (Curless and Levoy 1996) in sparse blocks, surface nets, space carving, plane fitting.

    Args:
        posed: keyframes in world space, metres.
        depth: their depth maps, metres.
        config: settings.
        progress: receives steps and notes.

    Raises:
        InputError: there is too little depth, or no surface that enough views agree on.
    """
    from reconstruction.surface.pixels import prepare_views
    from reconstruction.surface.planes import find_planes
    from reconstruction.surface.simplification import drop_small_components, thin

    low, high = _observed_box(posed, depth, config)
    views = prepare_views(
        depth, posed.world_from_camera, posed.images, reference_depth=config.reference_depth_m,
        max_depth=config.max_depth_m, completed_weight=config.completed_weight,
    )  # fmt: skip
    mesh, voxel_size = _fuse_blocks(posed, views, low, high, config, progress)
    mesh, dropped = drop_small_components(mesh, config.min_component_m2)
    if dropped:
        progress.note(
            f"surface: {dropped} connected components below {config.min_component_m2 * 1e4:.0f} cm2 dropped"
        )
    space = _space(views, low, high, mesh, config, progress)
    mesh = thin(mesh, config.max_vertices)
    if len(mesh.faces) == 0:
        raise InputError(
            "surface: no two views agree on any surface. Camera poses or depth maps are inconsistent. Film again, "
            "more slowly, with overlap between neighbouring views."
        )
    if len(mesh.vertices) > config.max_vertices:
        progress.note(
            f"surface: the mesh has {len(mesh.vertices)} vertices, more than max_vertices = {config.max_vertices}"
        )
    surface = Surface(
        mesh.vertices, mesh.faces, mesh.normals, mesh.colors, mesh.weights, float(voxel_size), space
    )
    return replace(surface, planes=find_planes(surface, config, posed.world_from_camera[:, :3, 3]))
