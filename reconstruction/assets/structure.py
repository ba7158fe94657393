"""The structure as an asset: its part of the fused surface, textured from the frames, with plates that collide."""

from dataclasses import replace

import numpy as np

from reconstruction.assets import texture
from reconstruction.assets.collision.plates import plate_parts
from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.solid import decimate
from reconstruction.assets.views import ScenePixels
from reconstruction.core.types import DepthMaps, InstanceSet, PosedFrames, StructureAsset, Surface

_AGGRESSIVENESS = 4  # of the decimation, as of objects
_NOISE_SIGMAS = 3.0


def build_structure(
    posed: PosedFrames, depth: DepthMaps, surface: Surface, found: InstanceSet, pixels: ScenePixels,
    config: AssetsConfig,
) -> StructureAsset | None:  # fmt: skip
    """Return the structure of a scene, None where there is none.

    The surface is kept as it was seen, open, and never completed: it is many things.

    Args:
        posed: keyframes in world space.
        depth: their depth maps, metres.
        surface: the fused surface.
        found: the instances, with the structure's vertices.
        pixels: ids and depth of the keyframes' pixels.
        config: budgets of faces, texels and convex parts.
    """
    faces = np.asarray(surface.faces)
    faces = faces[(found.vertex_instance[faces] == found.structure).all(axis=1)]
    if not found.structure or not len(faces):
        return None
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = np.asarray(surface.vertices, np.float64)[used], faces.reshape(-1, 3).astype(np.int32)
    parts = plate_parts(vertices, faces, config)
    if not parts:
        return None
    if len(faces) > config.faces_structure:
        vertices, faces = decimate(vertices, faces, config.faces_structure, _AGGRESSIVENESS)
    mapping, faces, uvs = texture.unwrap(vertices, faces)
    vertices = vertices[mapping]
    nearest = np.linalg.norm(posed.world_from_camera[:, :3, 3] - vertices.mean(axis=0), axis=1).min()
    tolerance = float(surface.voxel_size_m + _NOISE_SIGMAS * pixels.noise_relative * nearest)
    most = replace(config, texture_frames=2 * config.texture_frames)  # it fills the room
    baked = texture.bake_object(
        vertices, faces, uvs, found.structure, posed, depth.camera, pixels, most, tolerance
    )
    visual = texture.textured(vertices, faces, uvs, baked.texture)
    return StructureAsset(found.structure, visual, parts, baked.seen_share)
