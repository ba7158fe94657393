"""Settings of the surface stage."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SurfaceConfig:
    """How depth maps become one surface and a map of free space."""

    voxel_size_m: float = 0.008
    """Edge of a fusion voxel. Made larger, with a note, where the scene would need more than `max_blocks`."""

    truncation_voxels: float = 4.0
    """Half width of the band around a surface in which signed distances are averaged."""

    max_depth_m: float = 6.0
    """Depth beyond this is too uncertain to make a surface; its rays still free the space before it."""

    completed_weight: float = 0.1
    """Weight of a completed pixel beside a measured one, so that guesses never erase measurements."""

    reference_depth_m: float = 1.5
    """Pixels nearer than this have full weight; beyond, it falls with the square of the depth."""

    min_views: int = 2
    """Surface that fewer views saw is dropped."""

    flat_error_m: float = 0.0025
    """Blocks of 8x8x8 voxels whose surface is a plane within this are sampled at every other voxel only."""

    max_blocks: int = 250_000
    """Bound on the blocks, and so on time and on the mesh before it is thinned; larger voxels, with a note, beyond."""

    slab_blocks: int = 6_000
    """How many blocks are fused at once, 10 kB each, and at least two layers of the scene; the rest waits its turn."""

    max_vertices: int = 150_000
    """Bound on the mesh. Flat parts are thinned first."""

    min_component_m2: float = 0.002
    """Connected pieces of surface smaller than this are dropped."""

    space_voxel_m: float = 0.02
    """Edge of a voxel of the free-space grid."""

    free_margin_m: float = 0.02
    """A measured ray frees space up to this much before its surface."""

    completed_margin_m: float = 0.06
    """The same for completed pixels."""

    free_min_rays: int = 2
    """Space is free if at least this many views looked through it, so that one outlier does not carve."""

    max_space_cells: int = 40_000_000
    """Bound on the free-space grid; its voxels grow, with a note, beyond it."""

    min_wall_area_m2: float = 0.4
    """Smaller vertical planes are not walls."""

    min_wall_width_m: float = 0.7
    """Narrower vertical planes are not walls."""

    min_floor_area_m2: float = 0.1
    """With less up-facing surface near z = 0 the floor counts as not observed."""

    min_support_area_m2: float = 0.02
    """Level surface smaller than this is not handed on as a support."""


SURFACE_PRESETS: dict[str, SurfaceConfig] = {
    "fast": SurfaceConfig(voxel_size_m=0.012, max_vertices=120_000, space_voxel_m=0.025),
    "default": SurfaceConfig(),
    "quality": SurfaceConfig(voxel_size_m=0.005, truncation_voxels=6.0, max_vertices=300_000),
}
