"""Compiled kernels that draw 2D Gaussians (Huang et al., "2D Gaussian Splatting", 2024): forward only, float32, CPU.

The geometry is that of the rasterizer that fits them (`reconstruction/gaussians/kernels.py`): in camera
space H = [s_u t_u, s_v t_v, p] maps splat coordinates (u, v, 1) to points, and the ray of a pixel at (dx, dy) from the
projected center meets the splat at

    W = 1 + wx dx + wy dy,   u = (ax dx + ay dy) / W,   v = (bx dx + by dy) / W,   z = zc / W.

Two things are made for a simulator: every Gaussian belongs to a body, which has its own camera_from_body (a moved
thing costs nothing), and every pixel has a depth limit, behind which only Gaussians of the pixel's own body count.

Kernels with `start, stop` process these rows and release the interpreter lock. They share no outputs, so the image does
not depend on the number of threads. They are compiled at the first call and cached on disk.
"""

import math

import numba
import numpy as np

TILE_X, TILE_Y = 64, 16  # pixels; a tile's planes fit into a processor's second cache
_CHUNK = 16  # pixels of a row that are computed at once, in vector registers
# Columns of a Gaussian in its body's space: center, s_u t_u, s_v t_v, opacity, squared reach (standard deviations).
CENTER, TANGENT_U, TANGENT_V, OPACITY, REACH2 = 0, 3, 6, 9, 10
N_COLUMNS = 11
# Columns of a projected splat; a row is one cache line.
XC, YC, ZC, AX, AY, BX, BY, WX, WY, ALPHA, REACH, RED, GREEN, BLUE, SPAN = range(15)
N_PROJECTED = 16
# Planes of the image: sum of weight times color (3) and depth; transmittance.
RED_SUM, GREEN_SUM, BLUE_SUM, DEPTH_SUM, LIGHT = range(5)
N_PLANES = 5
# Further planes of a tile: depth limit, body, Gaussian (exact below 2^24), column.
_LIMIT, _OWNER, _FRONT, _LANES = 5, 6, 7, 8
_MIN_COSINE = 0.01  # between normal and ray; splats seen more edge-on are culled
_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)
_HALF = np.float32(0.5)
_ALPHA_MAX = np.float32(0.99)
_STOP = np.float32(1 / 255)  # transmittance below which a pixel is finished: no 8-bit color changes any more
_FAST = {"contract", "arcp", "nsz", "reassoc", "afn"}
# exp(-rho / 2) = exp(x)^16 with x = -rho / 32, by the Taylor polynomial of exp(x): relative error 6e-5 for rho < 7.
_STEP, _E2, _E3, _E4 = np.float32(-1 / 32), np.float32(1 / 2), np.float32(1 / 6), np.float32(1 / 24)
# Depth of a splat where the screen-space filter determines it: its plane's, within these factors of the center's.
_FLAT_LOW, _FLAT_HIGH = np.float32(1 / 1.1), np.float32(1 / 0.9)


def compiled(**options):
    """Return a decorator that compiles a kernel at its first call and caches it where a folder is writable."""

    def decorate(function):
        try:
            return numba.njit(cache=True, error_model="numpy", **options)(function)
        except RuntimeError:  # "no locator available": no writable cache folder
            return numba.njit(error_model="numpy", **options)(function)

    return decorate


@compiled(inline="always")
def _bounds(focal, along, principal, u, v, uz, vz, k, around, size):
    """Return the first and last (exclusive) pixel of a splat along one image axis.

    Exact bounds of the projected ellipse u^2 + v^2 = reach^2, united with those of the screen-space filter.
    `along` is the center's offset from the principal point, u and v are the tangents' components along the axis.
    """
    tu, tv = focal * u - along * uz, focal * v - along * vz
    middle = k * (tu * uz + tv * vz)
    extent = math.sqrt(max(middle * middle - k * (tu * tu + tv * tv), 0.0))
    center = along + principal
    low = max(center + min(middle - extent, -around), -1.0)
    high = min(center + max(middle + extent, around), size + 1.0)
    return max(int(math.ceil(low - 0.5)), 0), min(int(math.floor(high - 0.5)) + 1, size)


@compiled(nogil=True)
def project(
    start, stop, rows, bodies, colors, camera_from_body, intrinsics, width, height, near, splats, boxes
):
    """Project the Gaussians start..stop.

    Args:
        start: First row.
        stop: Row after the last one.
        rows: float32 (n, 11) Gaussians, columns above.
        bodies: int32 (n,) row of each Gaussian's body.
        colors: float32 (n, 3).
        camera_from_body: float64 (b, 3, 4), OpenCV camera axes.
        intrinsics: float64 (4,) fx, fy, cx, cy in pixels.
        width: Of the image, pixels.
        height: Of the image, pixels.
        near: Depth of the near plane, metres.
        splats: Output, float32 (n, 16).
        boxes: Output, int32 (n, 4): pixel bounds x0, y0, x1, y1 (exclusive); x1 = 0 if the splat is not visible.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for i in range(start, stop):
        boxes[i, 2] = 0
        m, g = camera_from_body[bodies[i]], rows[i]
        x, y, z = float(g[0]), float(g[1]), float(g[2])
        pz = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        if pz < near:
            continue
        px = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
        py = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
        x, y, z = float(g[3]), float(g[4]), float(g[5])
        ux = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z
        uy = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z
        uz = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z
        x, y, z = float(g[6]), float(g[7]), float(g[8])
        vx = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z
        vy = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z
        vz = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z
        reach2 = float(g[REACH2])
        around = math.sqrt(reach2 * 0.5)
        inverse_z = 1.0 / pz
        along_x, along_y = fx * px * inverse_z, fy * py * inverse_z
        s = reach2 * (uz * uz + vz * vz) - pz * pz
        if s >= 0.0:  # it reaches behind the camera: no bounds
            x0, y0, x1, y1 = 0, 0, width, height
        else:
            k = reach2 / s
            x0, x1 = _bounds(fx, along_x, cx, ux, vx, uz, vz, k, around, width)
            if x0 >= x1:
                continue
            y0, y1 = _bounds(fy, along_y, cy, uy, vy, uz, vz, k, around, height)
            if y0 >= y1:
                continue
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        det = nx * px + ny * py + nz * pz
        if det * det < _MIN_COSINE * _MIN_COSINE * (nx * nx + ny * ny + nz * nz) * (
            px * px + py * py + pz * pz
        ):
            continue
        boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = x0, y0, x1, y1
        f = pz / det
        rx, ry = f / fx, f / fy
        q = splats[i]
        q[XC], q[YC], q[ZC] = along_x + cx - 0.5, along_y + cy - 0.5, pz
        q[AX], q[AY] = (vy * pz - vz * py) * rx, (vz * px - vx * pz) * ry
        q[BX], q[BY] = (py * uz - pz * uy) * rx, (pz * ux - px * uz) * ry
        q[WX], q[WY] = nx * rx, ny * ry
        q[ALPHA], q[REACH] = g[OPACITY], g[REACH2]
        q[RED], q[GREEN], q[BLUE] = colors[i, 0], colors[i, 1], colors[i, 2]


@compiled()
def sort_by_depth(splats, boxes):
    """Return the rows, int32 (k,), of the visible splats from near to far: a stable radix sort by 22 bits of depth."""
    n = 0
    for i in range(len(boxes)):
        n += boxes[i, 2] > 0
    rows, depth = np.empty(n, np.int32), np.empty(n, np.float32)
    k = 0
    for i in range(len(boxes)):
        if boxes[i, 2] > 0:
            rows[k], depth[k] = i, splats[i, ZC]
            k += 1
    keys = depth.view(
        np.uint32
    )  # positive floats order as their bits do; the last 9 bits are 0.006 % of depth
    other_rows, other_keys = np.empty_like(rows), np.empty_like(keys)
    for shift in (9, 20):
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


@compiled()
def bin_to_tiles(rows, boxes, tiles_x, tiles_y):
    """Return tile_start (t + 1,) and entries (e,): for each tile the visible splats, near to far."""
    tile_start = np.zeros(tiles_x * tiles_y + 1, np.int64)
    for r in range(len(rows)):
        b = boxes[rows[r]]
        for ty in range(b[1] // TILE_Y, (b[3] - 1) // TILE_Y + 1):
            for tx in range(b[0] // TILE_X, (b[2] - 1) // TILE_X + 1):
                tile_start[ty * tiles_x + tx + 1] += 1
    for t in range(tiles_x * tiles_y):
        tile_start[t + 1] += tile_start[t]
    cursor = tile_start[:-1].copy()
    entries = np.empty(tile_start[-1], np.int32)
    for r in range(len(rows)):
        b = boxes[rows[r]]
        for ty in range(b[1] // TILE_Y, (b[3] - 1) // TILE_Y + 1):
            for tx in range(b[0] // TILE_X, (b[2] - 1) // TILE_X + 1):
                tile = ty * tiles_x + tx
                entries[cursor[tile]] = rows[r]
                cursor[tile] += 1
    return tile_start, entries


@compiled(inline="always", fastmath=_FAST)
def _falloff(rho):
    x = rho * _STEP
    e = _ONE + x * (_ONE + x * (_E2 + x * (_E3 + x * _E4)))
    e = e * e
    e = e * e
    e = e * e
    return e * e


@compiled(inline="always", fastmath=_FAST)
def _span(s, dy, x0, x1):
    """Return the first and last (exclusive) of the pixels x0..x1 that a row at dy from the center shares with a splat.

    The ellipse is u^2 + v^2 <= reach^2, a quadratic inequality in dx; the filter is a circle.
    """
    reach2 = s[REACH]
    u, v, w = s[AY] * dy, s[BY] * dy, _ONE + s[WY] * dy
    a = s[AX] * s[AX] + s[BX] * s[BX] - reach2 * s[WX] * s[WX]
    if a <= _ZERO:  # it reaches behind the camera
        return x0, x1
    b = s[AX] * u + s[BX] * v - reach2 * s[WX] * w
    inside = b * b - a * (u * u + v * v - reach2 * w * w)
    around = _HALF * reach2 - dy * dy
    if inside < _ZERO and around < _ZERO:
        return x0, x0
    around, inside, middle = math.sqrt(max(around, _ZERO)), math.sqrt(max(inside, _ZERO)) / a, -b / a
    low, high = min(middle - inside, -around) + s[XC], max(middle + inside, around) + s[XC]
    low, high = max(low, np.float32(x0)), min(high, np.float32(x1))
    # A pixel more on both sides, against rounding.
    return max(int(low), x0), min(int(high) + 2, x1)


@compiled(nogil=True)
def blend(
    start, step, splats, boxes, bodies, tiles_x, tile_start, entries, limits, owners, softness, image, front
):
    """Blend the splats of the tiles start, start + step, ..., front to back.

    Args:
        start: First tile.
        step: Number of threads.
        splats: float32 (n, 16) of `project`.
        boxes: int32 (n, 4) of `project`.
        bodies: int32 (n,) row of each Gaussian's body.
        tiles_x: Tiles in a row.
        tile_start: Of `bin_to_tiles`.
        entries: Of `bin_to_tiles`.
        limits: float32 (h, w) depth behind which splats do not count, metres.
        owners: int32 (h, w) the body whose splats count behind the limit, too; -1 for none.
        softness: Depth over which splats fade out at the limit, metres.
        image: Output, float32 (5, h, w), planes above.
        front: Output, int32 (h, w): the Gaussian at which half of the light is stopped, -1 if none does.
    """
    for tile in range(start, len(tile_start) - 1, step):
        _blend_tile(
            tile, tiles_x, splats, boxes, bodies, tile_start, entries, limits, owners, softness, image, front
        )


@compiled(fastmath=_FAST, boundscheck=False, forceinline=True)
def _blend_tile(
    tile, tiles_x, splats, boxes, bodies, tile_start, entries, limits, owners, softness, image, front
):
    """Blend one tile; the inner loop runs over 16 pixels without branches, so that it compiles to vector instructions.

    For the same reason all values of a pixel, body and Gaussian included, are planes of one float32 array, whose shape
    is known to the compiler. Its last columns are beyond the tile: a splat's pixels begin anywhere in it.
    """
    height, width = limits.shape
    left, top = (tile % tiles_x) * TILE_X, (tile // tiles_x) * TILE_Y
    x_end, y_end = min(left + TILE_X, width), min(top + TILE_Y, height)
    planes = np.zeros((9, TILE_Y, TILE_X + _CHUNK), np.float32)
    for i in range(TILE_Y):
        for j in range(TILE_X + _CHUNK):
            planes[_LANES, i, j] = left + j
    for y in range(top, y_end):
        for x in range(left, x_end):
            i, j = y - top, x - left
            planes[LIGHT, i, j] = _ONE  # elsewhere there is no light, and nothing happens
            planes[_LIMIT, i, j], planes[_OWNER, i, j] = limits[y, x], owners[y, x]
            planes[_FRONT, i, j] = -_ONE
    sharpness = _ONE / np.float32(softness)
    for e in range(tile_start[tile], tile_start[tile + 1]):
        index = entries[e]
        s, box = splats[index], boxes[index]
        body, name = np.float32(bodies[index]), np.float32(index)
        xc, yc, zc = s[XC], s[YC], s[ZC]
        ax, bx, wx, reach2, opacity = s[AX], s[BX], s[WX], s[REACH], s[ALPHA]
        red, green, blue = s[RED], s[GREEN], s[BLUE]
        x_first, x_last = max(np.int64(box[0]), left), min(np.int64(box[2]), x_end)
        wide = x_last - x_first > _CHUNK
        for i in range(max(box[1], top) - top, min(box[3], y_end) - top):
            dy = np.float32(top + i) - yc
            x0, x1 = x_first, x_last
            if wide:
                x0, x1 = _span(s, dy, x_first, x_last)
            u_row, v_row, w_row, dy2 = s[AY] * dy, s[BY] * dy, _ONE + s[WY] * dy, dy * dy
            for chunk in range(x0 - left, x1 - left, _CHUNK):
                for j in range(_CHUNK):
                    x = np.uint64(chunk) + np.uint64(j)  # unsigned: not counted from the end
                    t = planes[LIGHT, i, x]
                    dx = planes[_LANES, i, x] - xc
                    w = w_row + wx * dx
                    inverse_w = _ONE / w
                    u, v = (u_row + ax * dx) * inverse_w, (v_row + bx * dx) * inverse_w
                    rho2, rho3 = _TWO * (dx * dx + dy2), u * u + v * v
                    on_disk = (w > _ZERO) & (rho3 <= rho2)
                    rho = rho3 if on_disk else rho2
                    flat = min(max(inverse_w, _FLAT_LOW), _FLAT_HIGH)
                    z = zc * (inverse_w if on_disk else flat)
                    seen = min(max((planes[_LIMIT, i, x] - z) * sharpness, _ZERO), _ONE)
                    seen = _ONE if planes[_OWNER, i, x] == body else seen
                    alpha = min(opacity * _falloff(rho), _ALPHA_MAX) * seen
                    alpha = alpha if (rho <= reach2) & (t >= _STOP) else _ZERO
                    weight = alpha * t
                    after = t - weight
                    before = planes[_FRONT, i, x]
                    planes[RED_SUM, i, x] += weight * red
                    planes[GREEN_SUM, i, x] += weight * green
                    planes[BLUE_SUM, i, x] += weight * blue
                    planes[DEPTH_SUM, i, x] += weight * z
                    planes[LIGHT, i, x] = after
                    planes[_FRONT, i, x] = name if (t > _HALF) & (after <= _HALF) else before
    for y in range(top, y_end):
        for x in range(left, x_end):
            for c in range(N_PLANES):
                image[c, y, x] = planes[c, y - top, x - left]
            front[y, x] = np.int32(planes[_FRONT, y - top, x - left])
