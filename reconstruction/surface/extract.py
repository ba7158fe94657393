"""The zero level of a block volume as a mesh: one vertex per crossed cell (surface nets), one quad per crossed edge.

Surface nets need no case table, share vertices across blocks by construction and give evenly spaced vertices with
half the triangles of marching cubes. A cell counts only if all its eight corners were observed, so the mesh ends
where knowledge ends instead of closing over it.
"""

from dataclasses import dataclass

import numba
import numpy as np

from reconstruction.surface.tsdf import BLOCK, BlockVolume


@dataclass(frozen=True)
class RawMesh:
    """A mesh in world space with what the volume knows of each vertex."""

    vertices: np.ndarray  # float32 (v, 3)
    faces: np.ndarray  # int32 (f, 3), counter-clockwise seen from free space
    normals: np.ndarray  # float32 (v, 3), towards free space
    colors: np.ndarray  # uint8 (v, 3)
    weights: np.ndarray  # float32 (v,) views
    cells: np.ndarray  # int32 (v, 3) cell of the vertex, in voxels

    def subset(self, keep_vertex: np.ndarray, faces: np.ndarray) -> "RawMesh":
        """Return the mesh with only the marked vertices and the given faces (of old indices) among them."""
        new = np.cumsum(keep_vertex) - 1
        inside = keep_vertex[faces].all(1)
        pick = np.flatnonzero(keep_vertex)
        return RawMesh(
            self.vertices[pick], new[faces[inside]].astype(np.int32), self.normals[pick], self.colors[pick],
            self.weights[pick], self.cells[pick],
        )  # fmt: skip


@numba.njit(cache=True)
def _corner(blocks, index, b, i, j, l):  # pragma: no cover - compiled
    """Return block row and local index of voxel (i, j, l) relative to block b; indices reach one block further."""
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
    blocks, index, distance, weight, views, min_weight, min_views, out_code
):  # pragma: no cover - compiled
    """Per cell: the sign bits of its corners if it is crossed and observed all around, else 0."""
    for b in numba.prange(blocks.shape[0]):
        for i in range(BLOCK):
            for j in range(BLOCK):
                for l in range(BLOCK):
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
    blocks, index, distance, views, color, code, first, origin, voxel, out_v, out_n, out_c, out_w, out_cell
):  # pragma: no cover - compiled
    """Fill in one vertex per crossed cell: the mean of its edge crossings, the gradient there, colour and views."""
    for b in numba.prange(blocks.shape[0]):
        row = first[b]
        d = np.empty(8)
        for i in range(BLOCK):
            for j in range(BLOCK):
                for l in range(BLOCK):
                    if code[b, i, j, l] == 0:
                        continue
                    support, tone, amount = 0, np.zeros(3), 0.0
                    for c in range(8):
                        bb, x, y, z = _corner(
                            blocks, index, b, i + (c & 1), j + (c >> 1 & 1), l + (c >> 2 & 1)
                        )
                        d[c] = distance[bb, x, y, z]
                        support = max(support, views[bb, x, y, z])
                        if views[bb, x, y, z] > 0:
                            q = 1.0 / (abs(d[c]) + 0.05)
                            amount += q
                            for a in range(3):
                                tone[a] += q * color[bb, x, y, z, a]
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
                    ci, cj, cl = blocks[b, 0] * BLOCK + i, blocks[b, 1] * BLOCK + j, blocks[b, 2] * BLOCK + l
                    out_v[row, 0] = origin[0] + (ci + 0.5 + px) * voxel
                    out_v[row, 1] = origin[1] + (cj + 0.5 + py) * voxel
                    out_v[row, 2] = origin[2] + (cl + 0.5 + pz) * voxel
                    out_n[row, 0], out_n[row, 1], out_n[row, 2] = gx / length, gy / length, gz / length
                    for a in range(3):
                        out_c[row, a] = np.uint8(tone[a] / max(amount, 1e-9) + 0.5)
                    out_w[row] = support
                    out_cell[row, 0], out_cell[row, 1], out_cell[row, 2] = ci, cj, cl
                    row += 1


@numba.njit(cache=True)
def _quads(blocks, index, code, vertex_row, out_faces):  # pragma: no cover - compiled
    """Join the four cells around every crossed edge by two triangles; return how many triangles were written."""
    count = 0
    for b in range(blocks.shape[0]):
        for i in range(BLOCK):
            for j in range(BLOCK):
                for l in range(BLOCK):
                    bits = code[b, i, j, l]
                    if bits == 0:
                        continue
                    # Edges that meet at the far corner (7) of this cell: the other three cells lie in + direction.
                    for axis in range(3):
                        inside = (bits >> 7 & 1) == 1
                        other = (bits >> (7 ^ (1 << axis)) & 1) == 1
                        if inside == other:
                            continue
                        ring = np.empty(4, np.int64)
                        complete = True
                        for q in range(4):
                            a, c = (axis + 1) % 3, (axis + 2) % 3
                            step = [0, 0, 0]
                            if q == 1 or q == 2:
                                step[a] = 1
                            if q >= 2:
                                step[c] = 1
                            bb, x, y, z = _corner(blocks, index, b, i + step[0], j + step[1], l + step[2])
                            if bb < 0 or code[bb, x, y, z] == 0:
                                complete = False
                                break
                            ring[q] = vertex_row[bb, x, y, z]
                        if not complete:
                            continue
                        if not other:  # inside lies ahead on the axis: free space is behind
                            ring[1], ring[3] = ring[3], ring[1]
                        for a, c in ((1, 2), (2, 3)):
                            out_faces[count, 0] = ring[0]
                            out_faces[count, 1] = ring[a]
                            out_faces[count, 2] = ring[c]
                            count += 1
    return count


def extract_mesh(volume: BlockVolume, *, min_views: int, min_weight: float) -> RawMesh:
    """Return the zero level where every corner of a cell has more than `min_weight` and one `min_views` views."""
    code = np.zeros(volume.distance.shape, np.uint8)
    _cells(
        volume.blocks, volume.index, volume.distance, volume.weight, volume.views, min_weight, min_views, code
    )
    per_block = np.count_nonzero(code.reshape(len(code), -1), axis=1)
    first = np.concatenate([[0], np.cumsum(per_block)]).astype(np.int64)
    total = int(first[-1])
    vertices, normals = np.empty((total, 3), np.float32), np.empty((total, 3), np.float32)
    colors, weights = np.empty((total, 3), np.uint8), np.empty(total, np.float32)
    cells = np.empty((total, 3), np.int32)
    _vertices(
        volume.blocks, volume.index, volume.distance, volume.views, volume.color, code, first, volume.origin,
        volume.voxel_size, vertices, normals, colors, weights, cells,
    )  # fmt: skip
    # Rows were numbered block by block in memory order, which is what a running count over `code` gives.
    vertex_row = (np.cumsum(code.reshape(-1) != 0) - 1).astype(np.int32).reshape(code.shape)
    faces = np.empty((6 * total, 3), np.int32)
    faces = faces[: _quads(volume.blocks, volume.index, code, vertex_row, faces)]
    return RawMesh(vertices, np.ascontiguousarray(faces), normals, colors, weights, cells)
