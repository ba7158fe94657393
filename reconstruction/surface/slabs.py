"""Fuse a volume slab by slab, so that memory holds two slabs of the TSDF and the decimated mesh only.

Slabs are runs of block layers along the axis whose fullest layer is smallest. Each slab is fused, meshed and decimated,
then freed except for its halo, with which the next slab begins. Clusters of the decimation never cross a block
and have the same key in both slabs, so the meshes join without a seam.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.surface.config import SurfaceConfig
from reconstruction.surface.extract import RawMesh, extract_mesh
from reconstruction.surface.pixels import FusionViews
from reconstruction.surface.simplification import cluster_keys, merge_vertices, thinning_level
from reconstruction.surface.tsdf import BLOCK, BlockVolume, integrate, tile_reach


@dataclass(frozen=True)
class _Slab:
    """The mesh of one slab before decimation."""

    mesh: RawMesh  # vertices of the slab, then those of the halo
    own: int  # number of vertices of the slab
    layers: tuple[int, int]  # first and last layer of the slab's blocks


def fuse_slabs(
    views: FusionViews, blocks: np.ndarray, origin: np.ndarray, voxel_size: float, config: SurfaceConfig,
    progress: Progress,
) -> RawMesh:  # fmt: skip
    """Fuse all views into blocks (m, 3) and return the zero level set, decimated once at its flat parts."""
    axis = _best_axis(blocks)
    kept: list[tuple[RawMesh, np.ndarray, np.ndarray]] = []
    before = waiting = None
    span = (blocks.max(0) + 2) * BLOCK
    for slab in chain(_slabs(views, blocks, axis, origin, voxel_size, config, progress), (None,)):
        if waiting is not None:
            kept.append(_thinned(before, waiting, slab, axis, span))
        before, waiting = waiting, slab
    return _joined(kept)


def _best_axis(blocks: np.ndarray) -> int:
    return int(np.argmin([np.bincount(blocks[:, a]).max() for a in range(3)]))


def _slabs(
    views: FusionViews, blocks: np.ndarray, axis: int, origin: np.ndarray, voxel_size: float, config: SurfaceConfig,
    progress: Progress,
) -> Iterator[_Slab]:  # fmt: skip
    """Fuse and mesh one slab after the other; the halo of a slab is reused as the first layer of the next."""
    truncation = config.truncation_voxels * voxel_size
    reach = tile_reach(views, truncation)
    blocks = blocks[np.argsort(blocks[:, axis], kind="stable")]
    layer = blocks[:, axis]
    bounds = _layer_bounds(layer, config.slab_blocks)
    progress.start(len(bounds), "fusing depth")

    def fuse(part: np.ndarray) -> BlockVolume:
        return integrate(views, reach, part, origin, voxel_size, truncation, config.flat_error_m)

    halo: BlockVolume | None = None
    for low, high in bounds:
        inside = blocks[(layer >= low) & (layer <= high)]
        first_layer = inside[:, axis] == low
        volume = fuse(inside) if halo is None else halo.joined(fuse(inside[~first_layer]))
        own = len(volume.blocks)
        beyond = blocks[layer == high + 1]
        halo = fuse(beyond) if len(beyond) else None
        mesh, vertices = extract_mesh(
            volume.joined(halo) if halo is not None else volume, views, reach, own=own, axis=axis,
            min_views=config.min_views, min_weight=0.02 * config.completed_weight,
        )  # fmt: skip
        yield _Slab(mesh, vertices, (low, high))
        progress.advance()


def _layer_bounds(layer: np.ndarray, slab_blocks: int) -> list[tuple[int, int]]:
    """Return (first, last) layers of runs of about `slab_blocks` blocks, each of two layers or more except the last."""
    counts = np.bincount(layer)
    bounds, low, held = [], int(layer.min()), 0
    for number in range(low, len(counts)):
        held += int(counts[number])
        if held >= slab_blocks and number > low:
            bounds.append((low, number))
            low, held = number + 1, 0
    return [*bounds, (low, len(counts) - 1)] if low < len(counts) else bounds


def _thinned(
    before: _Slab | None, slab: _Slab, after: _Slab | None, axis: int, span: np.ndarray
) -> tuple[RawMesh, np.ndarray, np.ndarray]:
    """Return the slab's clustered vertices, their sorted keys, and its faces (f, 3) as keys."""
    mesh, own = slab.mesh, slab.own
    parts = [(mesh, np.arange(own)), (mesh, np.arange(own, len(mesh.vertices)))]
    # Flatness of a block depends on its neighbours in other slabs; the halo's vertices belong to the next slab.
    for other, low, high in (
        (before, slab.layers[0] - 1, slab.layers[0] - 1),
        (after, slab.layers[1] + 1, slab.layers[1] + 2),
    ):
        if other is not None:
            layer = other.mesh.cells[: other.own, axis] // BLOCK
            parts.append((other.mesh, np.flatnonzero((layer >= low) & (layer <= high))))
    counted = [part for n, part in enumerate(parts) if n != 1]
    cells, points, colors, pixels = (
        np.concatenate([getattr(m, name)[rows] for m, rows in counted])
        for name in ("cells", "vertices", "colors", "pixels")
    )
    level = thinning_level(cells, points, colors, pixels, mesh.cells, strength=0)
    keys = cluster_keys(mesh.cells, level, axis, span)
    merged, unique = merge_vertices(mesh, keys[:own])
    faces = keys[mesh.faces]
    alive = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    return merged, unique, faces[alive]


def _joined(pieces: list[tuple[RawMesh, np.ndarray, np.ndarray]]) -> RawMesh:
    keys = np.concatenate([unique for _, unique, _ in pieces])
    faces = np.concatenate([np.searchsorted(keys, face).astype(np.int32) for _, _, face in pieces])
    columns = ("vertices", "normals", "colors", "weights", "cells", "pixels")
    v, n, c, w, cells, pixels = (
        np.concatenate([getattr(mesh, name) for mesh, _, _ in pieces]) for name in columns
    )
    used = np.zeros(len(v), bool)
    used[faces] = True
    return RawMesh(v, faces, n, c, w, cells, pixels).subset(used, faces)
