"""Compiled kernels of the 2D Gaussian rasterizer: projection, tile binning, reduction, and their backward passes.

A splat (Huang et al., "2D Gaussian Splatting", 2024) is a disk with center p, unit tangents t_u, t_v and standard
deviations s_u, s_v. In camera space the 3x3 matrix H = [s_u t_u, s_v t_v, p] maps splat coordinates (u, v, 1) to
points. The ray d of a pixel meets the splat where (u, v, 1) is proportional to H^-1 d. As H^-1 p = (0, 0, 1), with
(dx, dy) the pixel's offset from the projected center

    W = 1 + wx dx + wy dy,   u = (ax dx + ay dy) / W,   v = (bx dx + by dy) / W,   z = zc / W,

exactly, with six coefficients per splat. `G` below is H^-1. Blending is in `blend_kernels`.

Kernels with `start, stop` process these rows and release the interpreter lock (see `threads.run_over`). There are no
races: a tile is one unit of work; values of a splat are written once per (splat, tile) entry and then summed in the
order of its entries. Results do not depend on the number of threads. All kernels are generic in the floating-point
type: float32 in use, float64 to check derivatives.
"""

import math

import numba
import numpy as np

TILE = 16  # pixels
# Columns of a projected splat.
XC, YC, ZC, AX, AY, BX, BY, WX, WY, OPACITY, REACH2, RED, GREEN, BLUE, NX, NY, NZ = range(17)
N_PROJECTED = 17
# Columns of the rendered image: sums over splats of alpha T times color, depth and normal; opacity; distortion; first
# and second moments of the places along the ray, relative to the first; place of the first splat; and the median depth.
N_FEATURES = 13
F_DEPTH, F_NORMAL, F_ALPHA, F_DISTORTION, F_MOMENT1, F_MOMENT2, F_FIRST, F_MEDIAN = 3, 4, 7, 8, 9, 10, 11, 12
# Columns of the per-splat gradients: by XC..OPACITY, color, normal; then sums of alpha T and of alpha T error.
N_SPLAT_GRADIENTS = 18
S_COLOR, S_NORMAL, S_CONTRIBUTION, S_ERROR = 10, 13, 16, 17
# Columns of the parameters: mean, quaternion, log scales, opacity logit, color (SH degree 0).
N_PARAMETERS = 13
P_QUATERNION, P_SCALE, P_OPACITY, P_COLOR = 3, 7, 9, 10
SH_C0 = 0.28209479177387814
_MIN_COSINE = 0.01  # between normal and ray; splats seen more edge-on are culled


@numba.njit(cache=True, inline="always")
def _rotation(quaternion):  # pragma: no cover - compiled
    """Return the nine entries, row by row, of the rotation matrix of a wxyz quaternion of any length."""
    w, x, y, z = float(quaternion[0]), float(quaternion[1]), float(quaternion[2]), float(quaternion[3])
    s = 1.0 / math.sqrt(max(w * w + x * x + y * y + z * z, 1e-30))
    w, x, y, z = w * s, x * s, y * s, z * s
    return (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


@numba.njit(cache=True)
def _splat_in_camera(parameters, rotation, translation, h):  # pragma: no cover - compiled
    """Fill h (3, 4): columns s_u t_u, s_v t_v, center and normal (towards the camera), in camera space.

    Returns -1 if the normal was flipped, else +1.
    """
    r = _rotation(parameters[P_QUATERNION:P_SCALE])
    su, sv = math.exp(parameters[P_SCALE]), math.exp(parameters[P_SCALE + 1])
    for i in range(3):
        a, b, c = rotation[i, 0], rotation[i, 1], rotation[i, 2]
        h[i, 0] = (a * r[0] + b * r[3] + c * r[6]) * su
        h[i, 1] = (a * r[1] + b * r[4] + c * r[7]) * sv
        h[i, 3] = a * r[2] + b * r[5] + c * r[8]
        h[i, 2] = a * parameters[0] + b * parameters[1] + c * parameters[2] + translation[i]
    if h[0, 3] * h[0, 2] + h[1, 3] * h[1, 2] + h[2, 3] * h[2, 2] > 0.0:
        for i in range(3):
            h[i, 3] = -h[i, 3]
        return -1.0
    return 1.0


@numba.njit(cache=True)
def _invert3(h, g):  # pragma: no cover - compiled
    """Invert the left 3x3 block of h into g."""
    g[0, 0] = h[1, 1] * h[2, 2] - h[1, 2] * h[2, 1]
    g[0, 1] = h[0, 2] * h[2, 1] - h[0, 1] * h[2, 2]
    g[0, 2] = h[0, 1] * h[1, 2] - h[0, 2] * h[1, 1]
    g[1, 0] = h[1, 2] * h[2, 0] - h[1, 0] * h[2, 2]
    g[1, 1] = h[0, 0] * h[2, 2] - h[0, 2] * h[2, 0]
    g[1, 2] = h[0, 2] * h[1, 0] - h[0, 0] * h[1, 2]
    g[2, 0] = h[1, 0] * h[2, 1] - h[1, 1] * h[2, 0]
    g[2, 1] = h[0, 1] * h[2, 0] - h[0, 0] * h[2, 1]
    g[2, 2] = h[0, 0] * h[1, 1] - h[0, 1] * h[1, 0]
    inverse = 1.0 / (h[0, 0] * g[0, 0] + h[0, 1] * g[1, 0] + h[0, 2] * g[2, 0])
    for i in range(3):
        for j in range(3):
            g[i, j] *= inverse


@numba.njit(cache=True)
def _pixel_box(h, intrinsics, reach2, width, height, box):  # pragma: no cover - compiled
    """Fill box with the pixel bounds x0, y0, x1, y1 (end exclusive) of the splat; return whether it has pixels.

    The exact bounds of the projected ellipse u^2 + v^2 = reach2 (Sigg et al. 2006; 2DGS eq. 8), united with those of
    the screen-space filter.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    zc = h[2, 2]
    around = math.sqrt(reach2 * 0.5)
    s = reach2 * (h[2, 0] * h[2, 0] + h[2, 1] * h[2, 1]) - zc * zc
    for axis in range(2):
        f = fx if axis == 0 else fy
        size = width if axis == 0 else height
        offset = f * h[axis, 2] / zc
        center = offset + (cx if axis == 0 else cy)
        if s >= 0.0:  # the ellipse reaches behind the camera: no bounds
            low, high = 0.0, float(size)
        else:
            # Rows of H relative to the projected center, to avoid cancellation.
            tu, tv = f * h[axis, 0] - offset * h[2, 0], f * h[axis, 1] - offset * h[2, 1]
            k = reach2 / s
            middle = k * (tu * h[2, 0] + tv * h[2, 1])
            extent = math.sqrt(max(middle * middle - k * (tu * tu + tv * tv), 0.0))
            low = center + min(middle - extent, -around)
            high = center + max(middle + extent, around)
        low, high = max(low, -1.0), min(high, size + 1.0)
        first, last = max(int(math.ceil(low - 0.5)), 0), min(int(math.floor(high - 0.5)) + 1, size)
        if first >= last:
            return False
        box[axis], box[axis + 2] = first, last
    return True


@numba.njit(cache=True, nogil=True)
def project(
    start, stop, parameters, rotation, translation, intrinsics, size, near, sigma_cutoff, alpha_min, splats, boxes
):  # fmt: skip  # pragma: no cover - compiled
    """Project the Gaussians start..stop to an image of `size` (width, height).

    Fills boxes (n, 4), pixel bounds with x1 = 0 if not visible, and splats (n, 17) of the visible ones.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    h, g = np.empty((3, 4)), np.empty((3, 3))
    for i in range(start, stop):
        p = parameters[i]
        boxes[i, 2] = 0
        z = rotation[2, 0] * p[0] + rotation[2, 1] * p[1] + rotation[2, 2] * p[2] + translation[2]
        opacity = 1.0 / (1.0 + math.exp(-p[P_OPACITY]))
        if z < near or opacity <= alpha_min:
            continue
        _splat_in_camera(p, rotation, translation, h)
        distance = math.sqrt(h[0, 2] * h[0, 2] + h[1, 2] * h[1, 2] + z * z)
        if -(h[0, 3] * h[0, 2] + h[1, 3] * h[1, 2] + h[2, 3] * z) < _MIN_COSINE * distance:
            continue
        reach2 = min(sigma_cutoff * sigma_cutoff, 2.0 * math.log(opacity / alpha_min))
        if not _pixel_box(h, intrinsics, reach2, size[0], size[1], boxes[i]):
            boxes[i, 2] = 0
            continue
        _invert3(h, g)
        s = splats[i]
        s[XC], s[YC], s[ZC] = fx * h[0, 2] / z + cx, fy * h[1, 2] / z + cy, z
        s[AX], s[AY] = g[0, 0] * z / fx, g[0, 1] * z / fy
        s[BX], s[BY] = g[1, 0] * z / fx, g[1, 1] * z / fy
        s[WX], s[WY] = g[2, 0] * z / fx, g[2, 1] * z / fy
        s[OPACITY], s[REACH2] = opacity, reach2
        for c in range(3):
            s[RED + c] = max(0.5 + SH_C0 * p[P_COLOR + c], 0.0)
            s[NX + c] = h[c, 3]


@numba.njit(cache=True)
def sort_by_depth(splats, boxes):  # pragma: no cover - compiled
    """Return the rows, int32 (k,), of the visible splats from near to far, by a stable radix sort of float32 depth."""
    n = 0
    for i in range(len(boxes)):
        n += boxes[i, 2] > 0
    rows, keys = np.empty(n, np.int32), np.empty(n, np.uint32)
    depth = np.empty(n, np.float32)
    k = 0
    for i in range(len(boxes)):
        if boxes[i, 2] > 0:
            rows[k], depth[k] = i, splats[i, ZC]
            k += 1
    keys[:] = depth.view(np.uint32)  # positive floats order as their bits do
    other_rows, other_keys = np.empty_like(rows), np.empty_like(keys)
    for shift in (0, 11, 22):
        counts = np.zeros(2049, np.int64)
        for i in range(n):
            counts[((keys[i] >> np.uint32(shift)) & np.uint32(2047)) + 1] += 1
        for b in range(2048):
            counts[b + 1] += counts[b]
        for i in range(n):
            b = (keys[i] >> np.uint32(shift)) & np.uint32(2047)
            at = counts[b]
            counts[b] += 1
            other_rows[at], other_keys[at] = rows[i], keys[i]
        rows, other_rows = other_rows, rows
        keys, other_keys = other_keys, keys
    return rows


@numba.njit(cache=True)
def bin_to_tiles(rows, boxes, tiles_x, tiles_y):  # pragma: no cover - compiled
    """Sort (splat, tile) entries by tile, near to far within each, by counting sort.

    Returns:
        tile_start (t + 1,), entries (e,): rank in `rows` of the splat, first (k + 1,) and positions (e,): the entries
        of rank r are positions[first[r]:first[r + 1]].
    """
    tile_start = np.zeros(tiles_x * tiles_y + 1, np.int64)
    first = np.zeros(len(rows) + 1, np.int64)
    for r in range(len(rows)):
        b = boxes[rows[r]]
        count = 0
        for ty in range(b[1] // TILE, (b[3] - 1) // TILE + 1):
            for tx in range(b[0] // TILE, (b[2] - 1) // TILE + 1):
                tile_start[ty * tiles_x + tx + 1] += 1
                count += 1
        first[r + 1] = first[r] + count
    for t in range(tiles_x * tiles_y):
        tile_start[t + 1] += tile_start[t]
    cursor = tile_start[:-1].copy()
    entries, positions = np.empty(first[-1], np.int32), np.empty(first[-1], np.int32)
    k = 0
    for r in range(len(rows)):
        b = boxes[rows[r]]
        for ty in range(b[1] // TILE, (b[3] - 1) // TILE + 1):
            for tx in range(b[0] // TILE, (b[2] - 1) // TILE + 1):
                tile = ty * tiles_x + tx
                entries[cursor[tile]] = r
                positions[k] = cursor[tile]
                cursor[tile] += 1
                k += 1
    return tile_start, entries, first, positions


@numba.njit(cache=True, nogil=True)
def gather(start, stop, splats, boxes, rows, near_splats, near_boxes):  # pragma: no cover - compiled
    """Copy the visible splats and boxes in depth order, for sequential memory access in the tiles."""
    for r in range(start, stop):
        for c in range(splats.shape[1]):
            near_splats[r, c] = splats[rows[r], c]
        for c in range(4):
            near_boxes[r, c] = boxes[rows[r], c]


@numba.njit(cache=True, nogil=True)
def reduce_entries(start, stop, entry_values, first, positions, rows, out):  # pragma: no cover - compiled
    """Sum the entry values (e, k) of each splat start..stop, in order, into out (n, k) at the Gaussians' rows."""
    columns = entry_values.shape[1]
    for r in range(start, stop):
        for c in range(columns):
            out[rows[r], c] = 0
        for i in range(first[r], first[r + 1]):
            for c in range(columns):
                out[rows[r], c] += entry_values[positions[i], c]


@numba.njit(cache=True, nogil=True)
def project_backward(
    start, stop, parameters, rows, rotation, translation, intrinsics, splats, splat_gradients, gradients, pose_gradients
):  # fmt: skip  # pragma: no cover - compiled
    """Backpropagate splat gradients (n, 18) of the visible splats start..stop to parameters (n, 13) and pose (k, 6).

    The pose gradient is by xi = (rho, phi) of world_from_camera exp(xi), translation and rotation in camera axes: a
    camera-space point x moves by -rho - phi x x. One kernel despite its length: all parts share the same locals.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    h, g, dg = np.empty((3, 4)), np.empty((3, 3)), np.zeros((3, 3))
    dh, dn, dr = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    for k in range(start, stop):
        i = rows[k]
        p, s, d, out = parameters[i], splats[k], splat_gradients[i], gradients[i]
        turned = _splat_in_camera(p, rotation, translation, h)
        _invert3(h, g)
        z = h[2, 2]
        dg[0, 0], dg[0, 1] = d[AX] * z / fx, d[AY] * z / fy
        dg[1, 0], dg[1, 1] = d[BX] * z / fx, d[BY] * z / fy
        dg[2, 0], dg[2, 1] = d[WX] * z / fx, d[WY] * z / fy
        dz = d[ZC]
        for c in range(6):  # the coefficients have a factor z
            dz += d[AX + c] * s[AX + c] / z
        # d(H^-1) = -H^-1 dH H^-1, hence dL/dH = -G^T (dL/dG) G^T; the third column of dL/dG is zero.
        for a in range(3):
            m0 = g[0, a] * dg[0, 0] + g[1, a] * dg[1, 0] + g[2, a] * dg[2, 0]
            m1 = g[0, a] * dg[0, 1] + g[1, a] * dg[1, 1] + g[2, a] * dg[2, 1]
            for b in range(3):
                dh[a, b] = -(m0 * g[b, 0] + m1 * g[b, 1])
        dh[0, 2] += d[XC] * fx / z
        dh[1, 2] += d[YC] * fy / z
        dh[2, 2] += dz - (d[XC] * (s[XC] - cx) + d[YC] * (s[YC] - cy)) / z
        for c in range(3):
            dn[c] = d[S_NORMAL + c]
        # Derivative by the pose: minus the sum of x cross dL/dx over all camera-space vectors x.
        for c in range(3):
            a, b = (c + 1) % 3, (c + 2) % 3
            pose_gradients[k, c] = -dh[c, 2]
            turn = h[a, 3] * dn[b] - h[b, 3] * dn[a]
            for j in range(3):
                turn += h[a, j] * dh[b, j] - h[b, j] * dh[a, j]
            pose_gradients[k, 3 + c] = -turn
        # Rotate the columns to world axes; then scales and rotation matrix.
        su, sv = math.exp(p[P_SCALE]), math.exp(p[P_SCALE + 1])
        d_su, d_sv = 0.0, 0.0
        for c in range(3):
            d_su += dh[c, 0] * h[c, 0]
            d_sv += dh[c, 1] * h[c, 1]
            a, b, e = rotation[0, c], rotation[1, c], rotation[2, c]
            out[c] = a * dh[0, 2] + b * dh[1, 2] + e * dh[2, 2]
            dr[c, 0] = (a * dh[0, 0] + b * dh[1, 0] + e * dh[2, 0]) * su
            dr[c, 1] = (a * dh[0, 1] + b * dh[1, 1] + e * dh[2, 1]) * sv
            dr[c, 2] = (a * dn[0] + b * dn[1] + e * dn[2]) * turned
        out[P_SCALE], out[P_SCALE + 1] = d_su, d_sv
        _quaternion_gradient(p[P_QUATERNION:P_SCALE], dr, out)
        out[P_OPACITY] = d[OPACITY] * s[OPACITY] * (1.0 - s[OPACITY])
        for c in range(3):
            out[P_COLOR + c] = SH_C0 * d[S_COLOR + c] if s[RED + c] > 0.0 else 0.0


@numba.njit(cache=True)
def _quaternion_gradient(quaternion, dr, out):  # pragma: no cover - compiled
    """Backpropagate the gradient by the rotation matrix to the quaternion (not normalized), into out[3:7]."""
    w, x, y, z = float(quaternion[0]), float(quaternion[1]), float(quaternion[2]), float(quaternion[3])
    s = 1.0 / math.sqrt(max(w * w + x * x + y * y + z * z, 1e-30))
    w, x, y, z = w * s, x * s, y * s, z * s
    dw = 2 * (x * (dr[2, 1] - dr[1, 2]) + y * (dr[0, 2] - dr[2, 0]) + z * (dr[1, 0] - dr[0, 1]))
    dx = 2 * (
        y * (dr[0, 1] + dr[1, 0]) + z * (dr[0, 2] + dr[2, 0]) + w * (dr[2, 1] - dr[1, 2])
        - 2 * x * (dr[1, 1] + dr[2, 2])
    )  # fmt: skip
    dy = 2 * (
        x * (dr[0, 1] + dr[1, 0]) + z * (dr[1, 2] + dr[2, 1]) + w * (dr[0, 2] - dr[2, 0])
        - 2 * y * (dr[0, 0] + dr[2, 2])
    )  # fmt: skip
    dzz = 2 * (
        x * (dr[0, 2] + dr[2, 0]) + y * (dr[1, 2] + dr[2, 1]) + w * (dr[1, 0] - dr[0, 1])
        - 2 * z * (dr[0, 0] + dr[1, 1])
    )  # fmt: skip
    along = dw * w + dx * x + dy * y + dzz * z
    out[P_QUATERNION] = (dw - w * along) * s
    out[P_QUATERNION + 1] = (dx - x * along) * s
    out[P_QUATERNION + 2] = (dy - y * along) * s
    out[P_QUATERNION + 3] = (dzz - z * along) * s
