"""Configuration of the assets stage."""

from dataclasses import dataclass, replace
from typing import Literal

LEAST_HULLS = 6  # convex pieces of each object, whatever the scene's budget


@dataclass(frozen=True)
class AssetsConfig:
    """How objects are completed, textured and given physics."""

    voxel_min_m: float = 0.002
    """Finest voxel of an object's volume, metres."""
    cells_along_longest: int = 72
    """Voxels along the longest side of a small object; furniture is limited by `max_voxels`."""
    max_voxels: int = 1_100_000
    """Memory and time limit of one object's volume; larger objects get coarser voxels."""
    min_points: int = 60
    """Objects with fewer depth pixels in all frames become boxes."""
    min_thickness_m: float = 0.004
    """Least thickness of surface that was seen from one side only (two voxels at least), metres."""
    flat_thickness_m: float = 0.025
    """Least thickness of objects flat on a wall, metres: that of a framed picture."""
    symmetry: bool = True
    """Complete by rotation and mirror symmetry where the seen surface agrees."""
    enclosed_directions: int = 3
    """An unknown voxel is solid if seen surface encloses it in this many of 8 horizontal directions."""
    faces_small: int = 4000
    """Face budget of an object below `furniture_m`."""
    faces_furniture: int = 9000
    """Face budget of a larger object."""
    furniture_m: float = 0.5
    """Longest side from which an object counts as furniture: unseen space below overhangs stays empty."""
    faces_structure: int = 24_000
    """Face budget of the structure."""
    texture_min_px: int = 128
    """Smallest side of an object's square texture."""
    texture_max_px: int = 1024
    """Largest side of an object's or base surface's square texture."""
    texture_frames: int = 14
    """Most frames that one texture is blended from."""
    base_texel_m: float = 0.008
    """Texel size of floor and walls, coarser where `texture_max_px` is reached."""
    hulls_small: int = 20
    """Most convex pieces of a small object's collision shape."""
    hulls_furniture: int = 28
    """Most convex pieces of furniture."""
    hulls_ring: int = 32
    """Most convex pieces of the walls of a container, which are cut by vertical and horizontal planes."""
    hulls_scene: int = 800
    """Convex pieces of all objects together; when they run out, the last objects get fewer, but 6 each."""
    hulls_structure: int = 500
    """Most convex plates of the structure's collision shape."""
    convex_enough: float = 0.93
    """Solids that fill this share of their convex hull collide as that hull."""
    dent_share: float = 0.12
    """So do solids with dents shallower than this share of their middle extent (noise) …"""
    dent_limit_m: float = 0.012
    """… and than this, metres."""
    collision_faces: int = 400
    """Faces of the decimated mesh that is decomposed."""
    coacd_threshold: float = 0.1
    """Concavity at which CoACD stops cutting; 0.6 of it for hollow objects."""
    hull_vertices: int = 48
    """Most vertices of one convex piece (PhysX allows 255)."""
    physics: Literal["table", "vlm"] | str = "table"
    """Source of materials and masses: `table` by label, color and size; `vlm` asks an OpenAI-compatible endpoint
    (see `SIMRECON_VLM_URL`) about each object, and the table decides where there is no usable answer."""
    physics_model: str = ""
    """For `vlm`: the model's name at the endpoint; empty is `SIMRECON_VLM_MODEL`."""
    seed: int = 0
    """Seed of the decomposition, and of a generator."""
    generator: Literal["none", "rodin", "hunyuan3d", "trellis", "sam3d"] | str = "none"
    """Generator that completes objects from pictures (docs/generation.md): a service (rodin costs credits), Hunyuan3D's
    own server, or a model on this machine. Meshes that disagree with the video are rejected for the own completion."""
    generator_url: str = ""
    """Address of the service; empty: Rodin's own; SIMRECON_HUNYUAN3D_URL or http://localhost:8081 for hunyuan3d."""
    generator_model: str = ""
    """Rodin's tier (Gen-2), TRELLIS' weights (a name or a folder), or the pipeline.yaml of SAM 3D Objects; for
    hunyuan3d only a name that keeps cached meshes of several models apart."""
    generator_views: int = 1
    """Most pictures of an object that the generator gets (hunyuan3d and sam3d take one)."""
    generator_texture: bool = True
    """Let hunyuan3d texture the mesh, too (a Hunyuan3D-2 server does so with --enable_tex alone)."""
    generator_poll: bool = False
    """Ask hunyuan3d by /send and /status, for proxies that cut long requests."""
    generator_budget: float = 0.0
    """Credits that one run may spend; objects beyond it are not sent, with a note."""
    generator_timeout_s: float = 900.0
    """Time limit of one object's generation, seconds."""
    generator_max_mb: float = 100.0
    """Largest mesh file that is accepted, MB."""
    generator_missed: float = 0.15
    """A mesh is rejected if a larger share of the seen points is farther from it than 1 cm and 3 % of the object."""
    generator_intruding: float = 0.1
    """A mesh is rejected if a larger share of its surface is deeper than that in free space."""
    generator_filling: float = 0.05
    """A mesh is rejected if a larger share of its volume, deeper than that inside the mesh, is free space: one that
    fills the space below a table, or a bowl."""

    def with_hulls(self, most: int) -> "AssetsConfig":
        """Return the config with at most `most` convex pieces for one object, but `LEAST_HULLS` at least."""
        most = max(most, LEAST_HULLS)
        return replace(
            self,
            hulls_small=min(self.hulls_small, most),
            hulls_furniture=min(self.hulls_furniture, most),
            hulls_ring=min(self.hulls_ring, most),
        )


ASSETS_PRESETS = {
    "fast": AssetsConfig(
        cells_along_longest=56, max_voxels=500_000, faces_small=2500, faces_furniture=6000,
        faces_structure=12_000, texture_max_px=512,
        texture_frames=8, base_texel_m=0.015, hulls_small=12,
        hulls_furniture=20, hulls_ring=16, hulls_structure=200,
    ),
    "default": AssetsConfig(),
    "quality": AssetsConfig(
        cells_along_longest=96, max_voxels=2_500_000, faces_small=6000, faces_furniture=15000, texture_frames=24,
        base_texel_m=0.006, hulls_small=24, hulls_furniture=32,
    ),
}  # fmt: skip
