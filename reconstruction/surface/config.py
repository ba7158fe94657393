"""Settings of the surface stage."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SurfaceConfig:
    """Settings of TSDF fusion, mesh extraction, free-space carving and plane fitting."""

    voxel_size_m: float = 0.008
    """Edge of a fusion voxel. It grows, with a note, if the scene would need more than `max_blocks`."""

    truncation_voxels: float = 4.0
    """Truncation distance of the TSDF, in voxels."""

    max_depth_m: float = 6.0
    """Larger depth makes no surface, since it is too uncertain. Its rays still carve free space."""

    completed_weight: float = 0.1
    """Fusion weight of a completed pixel relative to a measured one."""

    reference_depth_m: float = 1.5
    """Up to this depth pixels have full weight. Beyond, the weight falls with the square of the depth."""

    min_views: int = 2
    """Surface seen by fewer views is dropped."""

    flat_error_m: float = 0.0025
    """Blocks of 8x8x8 voxels whose surface is planar within this distance are sampled at every second voxel only."""

    max_blocks: int = 250_000
    """Largest number of blocks, which bounds time and mesh size. Beyond it voxels grow, with a note."""

    slab_blocks: int = 6_000
    """Blocks fused at once, 10 kB each; at least two layers of blocks. Bounds memory."""

    max_vertices: int = 150_000
    """Largest number of mesh vertices. Flat parts are decimated first."""

    min_component_m2: float = 0.002
    """Smaller connected components of the mesh are dropped."""

    space_voxel_m: float = 0.02
    """Edge of a voxel of the occupancy grid."""

    free_margin_m: float = 0.02
    """The ray of a measured pixel carves free space up to this distance before its depth."""

    completed_margin_m: float = 0.06
    """The same for completed pixels."""

    free_min_rays: int = 2
    """A voxel is free if at least this many views see through it, so that one outlier does not carve."""

    max_space_cells: int = 40_000_000
    """Largest number of voxels of the occupancy grid. Beyond it voxels grow, with a note."""

    min_wall_area_m2: float = 0.4
    """Smaller vertical planes are not walls."""

    min_wall_width_m: float = 0.7
    """Narrower vertical planes are not walls."""

    min_floor_area_m2: float = 0.1
    """With less up-facing surface near z = 0 no floor plane is fitted."""

    min_support_area_m2: float = 0.02
    """Smaller level surfaces are not support planes."""


SURFACE_PRESETS: dict[str, SurfaceConfig] = {
    "fast": SurfaceConfig(voxel_size_m=0.012, max_vertices=120_000, space_voxel_m=0.025),
    "default": SurfaceConfig(),
    "quality": SurfaceConfig(voxel_size_m=0.005, truncation_voxels=6.0, max_vertices=300_000),
}
