"""Extract the zero level set of a block TSDF as a triangle mesh by surface nets.

Surface nets put one vertex into each crossed cell and one quad around each crossed edge. They need no case table, share
vertices across blocks, and give half the triangles of marching cubes. A cell counts only if all eight corners were
observed, so the mesh has borders at unobserved space.

A volume may be one slab of a larger one, followed by a halo: the first layer of blocks of the next slab. Cells of the
halo that touch the slab make vertices in both slabs. Each face belongs to one slab only.
"""

from dataclasses import dataclass

import numba
import numpy as np

from reconstruction.surface.pixels import FusionViews
from reconstruction.surface.tsdf import BLOCK, BlockVolume, block_visible


@dataclass(frozen=True)
class RawMesh:
    """A triangle mesh in world space with per-vertex attributes of the fusion."""

    vertices: np.ndarray  # float32 (v, 3) metres
    faces: np.ndarray  # int32 (f, 3), counter-clockwise seen from free space
    normals: np.ndarray  # float32 (v, 3) unit, towards free space
    colors: np.ndarray  # uint8 (v, 3) RGB
    weights: np.ndarray  # float32 (v,) number of views
    cells: np.ndarray  # int32 (v, 3) cell of the vertex in the voxel grid
    pixels: np.ndarray  # float32 (v,) pixel footprint of the nearest view that sees the vertex, in voxels

    def subset(self, keep_vertex: np.ndarray, faces: np.ndarray) -> "RawMesh":
        """Return the mesh of the vertices in a mask (v,) and of those `faces` (f, 3), in old indices, among them."""
        new = np.cumsum(keep_vertex) - 1
        inside = keep_vertex[faces].all(1)
        pick = np.flatnonzero(keep_vertex)
        return RawMesh(
            self.vertices[pick], new[faces[inside]].astype(np.int32), self.normals[pick], self.colors[pick],
            self.weights[pick], self.cells[pick], self.pixels[pick],
        )  # fmt: skip


@numba.njit(cache=True)
def _corner(blocks, index, b, i, j, l):  # pragma: no cover - compiled
    """Return block row (-1: none) and local index of voxel (i, j, l) of block b; indices may reach the next block."""
    di, dj, dl, row = 0, 0, 0, np.int64(b)
    if i >= BLOCK:
        di, i = 1, i - BLOCK
    if j >= BLOCK:
        dj, j = 1, j - BLOCK
    if l >= BLOCK:
        dl, l = 1, l - BLOCK
    if di or dj or dl:
        x, y, z = blocks[b, 0] + di, blocks[b, 1] + dj, blocks[b, 2] + dl
        if x >= index.shape[0] or y >= index.shape[1] or z >= index.shape[2]:
            return np.int64(-1), i, j, l
        row = np.int64(index[x, y, z])
    return row, i, j, l


@numba.njit(cache=True, parallel=True)
def _cells(
    blocks, index, distance, weight, views, min_weight, min_views, own, axis, out_code
):  # pragma: no cover - compiled
    """Fill out_code with the sign bits of each cell's corners if it is crossed and fully observed, else 0."""
    for b in numba.prange(blocks.shape[0]):
        for i in range(BLOCK):
            for j in range(BLOCK):
                for l in range(BLOCK):
                    # In the halo only the cells that touch the slab have all corners.
                    if b >= own and (i if axis == 0 else (j if axis == 1 else l)) > 0:
                        continue
                    code, valid, support = 0, True, 0
                    for c in range(8):
                        bb, x, y, z = _corner(
                            blocks, index, b, i + (c & 1), j + (c >> 1 & 1), l + (c >> 2 & 1)
                        )
                        if bb < 0 or weight[bb, x, y, z] <= min_weight:
                            valid = False
                            break
                        support = max(support, views[bb, x, y, z])
                        if distance[bb, x, y, z] < 0.0:
                            code |= 1 << c
                    if valid and code != 0 and code != 255 and support >= min_views:
                        out_code[b, i, j, l] = code


@numba.njit(cache=True, parallel=True)
def _vertices(
    blocks, index, distance, views, code, first, origin, shift, voxel, out_v, out_n, out_w, out_cell
):  # pragma: no cover - compiled
    """Fill one vertex per crossed cell: the mean of its edge crossings, the normal, the views, and the cell."""
    for b in numba.prange(blocks.shape[0]):
        row = first[b]
        d = np.empty(8)
        for i in range(BLOCK):
            for j in range(BLOCK):
                for l in range(BLOCK):
                    if code[b, i, j, l] == 0:
                        continue
                    support = 0
                    for c in range(8):
                        bb, x, y, z = _corner(
                            blocks, index, b, i + (c & 1), j + (c >> 1 & 1), l + (c >> 2 & 1)
                        )
                        d[c] = distance[bb, x, y, z]
                        support = max(support, views[bb, x, y, z])
                    px, py, pz, count = 0.0, 0.0, 0.0, 0
                    for c in range(8):
                        for a in range(3):
                            o = c | (1 << a)
                            if o == c or (d[c] < 0.0) == (d[o] < 0.0):
                                continue
                            t = d[c] / (d[c] - d[o])
                            px += (c & 1) + (t if a == 0 else 0.0)
                            py += (c >> 1 & 1) + (t if a == 1 else 0.0)
                            pz += (c >> 2 & 1) + (t if a == 2 else 0.0)
                            count += 1
                    px, py, pz = px / count, py / count, pz / count
                    # Gradient of the trilinear interpolation; the distance grows towards free space.
                    gx = gy = gz = 0.0
                    for c in range(8):
                        wx = px if c & 1 else 1.0 - px
                        wy = py if c >> 1 & 1 else 1.0 - py
                        wz = pz if c >> 2 & 1 else 1.0 - pz
                        gx += (wy * wz if c & 1 else -wy * wz) * d[c]
                        gy += (wx * wz if c >> 1 & 1 else -wx * wz) * d[c]
                        gz += (wx * wy if c >> 2 & 1 else -wx * wy) * d[c]
                    length = np.sqrt(gx * gx + gy * gy + gz * gz) + 1e-12
                    ci = (blocks[b, 0] + shift[0]) * BLOCK + i
                    cj = (blocks[b, 1] + shift[1]) * BLOCK + j
                    cl = (blocks[b, 2] + shift[2]) * BLOCK + l
                    out_v[row, 0] = origin[0] + (ci + 0.5 + px) * voxel
                    out_v[row, 1] = origin[1] + (cj + 0.5 + py) * voxel
                    out_v[row, 2] = origin[2] + (cl + 0.5 + pz) * voxel
                    out_n[row, 0], out_n[row, 1], out_n[row, 2] = gx / length, gy / length, gz / length
                    out_w[row] = support
                    out_cell[row, 0], out_cell[row, 1], out_cell[row, 2] = ci, cj, cl
                    row += 1


@numba.njit(cache=True, parallel=True)
def _paint(
    first, voxel, trunc, poses, k, depth, weight, slope, reach, color, vertices, normals, out, out_pixels
):  # pragma: no cover - compiled
    """Average the color of each vertex over the views that see it, mainly at its front; find the nearest view."""
    n, h, w = depth.shape
    fx, fy, cx, cy = k
    for b in numba.prange(len(first) - 1):
        r0, r1 = first[b], first[b + 1]
        if r0 == r1:
            continue
        center = np.zeros(3)
        for r in range(r0, r1):
            for a in range(3):
                center[a] += vertices[r, a] / (r1 - r0)
        radius = 0.0
        for r in range(r0, r1):
            for a in range(3):
                radius = max(radius, 1.8 * abs(vertices[r, a] - center[a]))
        total, nearest = np.zeros((r1 - r0, 4)), np.full(r1 - r0, np.inf)
        for v in range(n):
            m = poses[v]
            if not block_visible(center, radius, m, k, (h, w), reach[v]):
                continue
            z_of, weight_of, slope_of, color_of = depth[v], weight[v], slope[v], color[v]
            for r in range(r0, r1):
                p = vertices[r]
                x = m[0, 0] * p[0] + m[0, 1] * p[1] + m[0, 2] * p[2] + m[0, 3]
                y = m[1, 0] * p[0] + m[1, 1] * p[1] + m[1, 2] * p[2] + m[1, 3]
                z = m[2, 0] * p[0] + m[2, 1] * p[1] + m[2, 2] * p[2] + m[2, 3]
                if z <= trunc:
                    continue
                pu, pv = fx * x / z + cx, fy * y / z + cy
                if pu < 0.0 or pv < 0.0 or pu >= w or pv >= h:
                    continue
                ix, iy = int(pu), int(pv)
                q = weight_of[iy, ix]
                s = abs(z_of[iy, ix] - z) * slope_of[iy, ix] / 255.0
                if q <= 0.0 or s >= trunc:
                    continue
                nearest[r - r0] = min(nearest[r - r0], z)
                facing = 0.0
                for a in range(3):
                    facing -= normals[r, a] * (m[0, a] * x + m[1, a] * y + m[2, a] * z)
                q = q * (1.0 - s / trunc) * (1.0 if facing > 0.0 else 0.01) + 1e-6
                total[r - r0, 3] += q
                for a in range(3):
                    total[r - r0, a] += q * color_of[iy, ix, a]
        for r in range(r0, r1):
            out_pixels[r] = nearest[r - r0] / (fx * voxel)
            for a in range(3):
                out[r, a] = np.uint8(total[r - r0, a] / max(total[r - r0, 3], 1e-9) + 0.5)


@numba.njit(cache=True, parallel=True)
def _quads(
    blocks, index, code, vertex_row, own, first, fill, out_count, out_faces
):  # pragma: no cover - compiled
    """Count, or with `fill` write from `first` on, two triangles between the four cells around each crossed edge."""
    for b in numba.prange(own):
        count = first[b] if fill else 0
        ring = np.empty(4, np.int64)
        for i in range(BLOCK):
            for j in range(BLOCK):
                for l in range(BLOCK):
                    bits = code[b, i, j, l]
                    if bits == 0:
                        continue
                    # Edges at the far corner (7) of this cell; the other three cells lie in + direction.
                    for axis in range(3):
                        inside = (bits >> 7 & 1) == 1
                        other = (bits >> (7 ^ (1 << axis)) & 1) == 1
                        if inside == other:
                            continue
                        complete = True
                        a, c = (axis + 1) % 3, (axis + 2) % 3
                        for q in range(4):
                            fa, fc = (1 if q == 1 or q == 2 else 0), (1 if q >= 2 else 0)
                            di = (fa if a == 0 else 0) + (fc if c == 0 else 0)
                            dj = (fa if a == 1 else 0) + (fc if c == 1 else 0)
                            dl = (fa if a == 2 else 0) + (fc if c == 2 else 0)
                            bb, x, y, z = _corner(blocks, index, b, i + di, j + dj, l + dl)
                            if bb < 0 or code[bb, x, y, z] == 0:
                                complete = False
                                break
                            ring[q] = vertex_row[bb, x, y, z]
                        if not complete:
                            continue
                        if fill:
                            # Choose the winding that faces free space.
                            second, fourth = (ring[1], ring[3]) if other else (ring[3], ring[1])
                            out_faces[count, 0], out_faces[count, 1], out_faces[count, 2] = (
                                ring[0],
                                second,
                                ring[2],
                            )
                            out_faces[count + 1, 0], out_faces[count + 1, 1] = ring[0], ring[2]
                            out_faces[count + 1, 2] = fourth
                        count += 2
        out_count[b] = count - (first[b] if fill else 0)


def extract_mesh(
    volume: BlockVolume, views: FusionViews, reach: np.ndarray, *, own: int, axis: int, min_views: int,
    min_weight: float,
) -> tuple[RawMesh, int]:  # fmt: skip
    """Extract the zero level set of a slab and its halo.

    Args:
        volume: the blocks of the slab, then those of its halo.
        views: color the vertices.
        reach: of `tile_reach`, for the views.
        own: number of blocks of the slab.
        axis: along which slabs follow each other, 0 to 2.
        min_views: smallest number of views, at one corner of a cell at least.
        min_weight: each corner of a cell must have more weight.

    Returns:
        The mesh, and the number of vertices of the slab; they come first, those of the halo follow.
    """
    low = volume.blocks.min(0)
    blocks = (volume.blocks - low).astype(np.int32)
    index = np.full(blocks.max(0) + 1, -1, np.int32)
    index[tuple(blocks.T)] = np.arange(len(blocks), dtype=np.int32)
    code = np.zeros(volume.distance.shape, np.uint8)
    _cells(
        blocks, index, volume.distance, volume.weight, volume.views, min_weight, min_views, own, axis, code
    )
    crossed = np.count_nonzero(code.reshape(len(code), -1), axis=1)
    first = np.concatenate([[0], np.cumsum(crossed)]).astype(np.int64)
    total = int(first[-1])
    vertices, normals = np.empty((total, 3), np.float32), np.empty((total, 3), np.float32)
    weights, cells = np.empty(total, np.float32), np.empty((total, 3), np.int32)
    _vertices(
        blocks, index, volume.distance, volume.views, code, first, volume.origin, low.astype(np.int32),
        volume.voxel_size, vertices, normals, weights, cells,
    )  # fmt: skip
    colors, pixels = np.zeros((total, 3), np.uint8), np.zeros(total, np.float32)
    _paint(
        first, volume.voxel_size, volume.truncation, views.camera_from_world, views.camera.intrinsics, views.depth,
        views.weight, views.slope, reach, views.color, vertices, normals, colors, pixels,
    )  # fmt: skip
    # Vertices are numbered in the memory order of `code`.
    vertex_row = (np.cumsum(code.reshape(-1) != 0, dtype=np.int32) - 1).reshape(code.shape)
    counts, none = np.zeros(own, np.int64), np.empty((0, 3), np.int32)
    _quads(blocks, index, code, vertex_row, own, counts, False, counts, none)
    face_first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    faces = np.empty((int(face_first[-1]), 3), np.int32)
    _quads(blocks, index, code, vertex_row, own, face_first, True, counts, faces)
    return RawMesh(vertices, faces, normals, colors, weights, cells, pixels), int(first[own])
