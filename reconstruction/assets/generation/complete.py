"""A generated mesh in the place of the embedded completion, if it agrees with what was seen."""

from dataclasses import dataclass

import numpy as np

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.generation.base import GenerationError
from reconstruction.assets.generation.fetch import Fetched
from reconstruction.assets.generation.filling import filled_share
from reconstruction.assets.generation.meshes import GeneratedMesh, read_generated
from reconstruction.assets.generation.solidify import closed_solid
from reconstruction.assets.registration import FreeDepth, Registration, SeenSurface, register
from reconstruction.assets.solid import Solid, manifold_of
from reconstruction.assets.volume import ObjectFrame, ObjectVolume
from reconstruction.core.types import SpaceGrid
from registry.geometry import transform_points

_BELIEVED_SHARE = 0.3  # of the points; if fewer are kept, all count
_FREE = 1  # state of a cell of the scene's space grid


@dataclass(frozen=True)
class SurfaceColors:
    """Colors of a surface, to be looked up by place and facing."""

    points: np.ndarray  # float64 (n, 3)
    normals: np.ndarray  # float64 (n, 3)
    colors: np.ndarray  # uint8 (n, 3) RGB


@dataclass(frozen=True)
class Attempt:
    """What came of generating one object."""

    how: str  # who made it and how well it fits, or why it is not used; for the asset's provenance
    body: Solid | None = None  # in the grid frame; None where it is not used
    colors: SurfaceColors | None = None  # in world space
    rejected: bool = False  # a mesh was made, and disagrees with what was seen


def generated_shape(
    number: int, fetched: Fetched, frame: ObjectFrame, volume: ObjectVolume, space: SpaceGrid | None,
    config: AssetsConfig, *, furniture: bool,
) -> Attempt | None:  # fmt: skip
    """Return the solid of a generated mesh in its place, or why there is none; None where none was asked for.

    Args:
        number: The object.
        fetched: What the generator made.
        frame: Where the object stands and what was seen of it.
        volume: What is known of the space around it.
        space: What is known of the rest of the room.
        config: Bounds for what disagrees.
        furniture: The object counts as furniture.
    """
    if number not in fetched.meshes:
        reason = fetched.refused.get(number)
        return None if reason is None else Attempt(f"no mesh by {fetched.by}: {reason}")
    try:
        mesh = read_generated(fetched.meshes[number], config.seed)
    except GenerationError as error:
        return Attempt(f"{fetched.by} rejected: {error}", rejected=True)
    seen = believed_surface(frame, volume)
    free = free_space(frame, volume, space)
    fit = register(mesh.points, mesh.normals, seen, free)
    fault = fit.fault(config.generator_missed, config.generator_intruding)
    if fault:
        return Attempt(f"{fetched.by} rejected: {fault}", rejected=True)
    placed = mesh.moved(fit.scale, fit.rotation, fit.translation)
    body = closed_solid(placed, config, config.faces_furniture if furniture else config.faces_small)
    manifold = None if body is None else manifold_of(body)
    if manifold is None:
        return Attempt(f"{fetched.by} rejected: its mesh cannot be closed to a solid", rejected=True)
    filled, most = filled_share(manifold, free, fit.near_m), config.generator_filling
    if filled > most:
        fault = f"{filled:.0%} of its volume fills what rays passed through (at most {most:.0%} may)"
        return Attempt(f"{fetched.by} rejected: {fault}", rejected=True)
    return Attempt(_description(fetched.by, fit), body, _colors(placed, frame))


def believed_surface(frame: ObjectFrame, volume: ObjectVolume) -> SeenSurface:
    """Return the seen points that the object's volume keeps as surface: seen by enough frames, and within outlines."""
    cell = np.floor((frame.points - volume.origin) / volume.voxel_m).astype(np.int64)
    inside = np.all((cell >= 0) & (cell < volume.seen.shape), axis=1)
    kept = inside.copy()
    kept[inside] = volume.seen[tuple(cell[inside].T)]
    if kept.mean() < _BELIEVED_SHARE:
        kept[:] = True
    return SeenSurface(frame.points[kept], frame.normals[kept], 0.0 if frame.on_support else None)


def free_space(frame: ObjectFrame, volume: ObjectVolume, space: SpaceGrid | None) -> FreeDepth:
    """Return how deep points of the grid frame are in space that rays passed through.

    Within the object's volume it is measured; beyond it, in the coarser grid of the room, free is deep.
    """
    from scipy.ndimage import distance_transform_edt

    depth = distance_transform_edt(volume.free) * volume.voxel_m
    shape = np.array(volume.free.shape)
    beyond = float(shape.max()) * volume.voxel_m

    def look(points: np.ndarray) -> np.ndarray:
        cell = np.floor((points - volume.origin) / volume.voxel_m).astype(np.int64)
        inside = np.all((cell >= 0) & (cell < shape), axis=1)
        out = np.zeros(len(points))
        out[inside] = depth[tuple(cell[inside].T)]
        if space is not None and not inside.all():
            world = transform_points(frame.world_from_grid, points[~inside])
            out[~inside] = np.where(space.lookup(world) == _FREE, beyond, 0.0)
        return out

    return look


def _description(by: str, fit: Registration) -> str:
    return (
        f"generated by {by}, registered {1000 * fit.distance_m:.1f} mm from what was seen "
        f"({fit.missed:.0%} missed, {fit.intruding:.0%} in free space)"
    )


def _colors(mesh: GeneratedMesh, frame: ObjectFrame) -> SurfaceColors | None:
    if mesh.colors is None:
        return None
    rotation = frame.world_from_grid[:3, :3]
    return SurfaceColors(
        transform_points(frame.world_from_grid, mesh.points), mesh.normals @ rotation.T, mesh.colors
    )
