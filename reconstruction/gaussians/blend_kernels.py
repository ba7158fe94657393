"""Compiled kernels that alpha-blend the splats of a tile front to back, and their backward pass."""

import numba
import numpy as np

from reconstruction.gaussians.kernels import (
    AX,
    AY,
    BLUE,
    BX,
    BY,
    F_ALPHA,
    F_DEPTH,
    F_DISTORTION,
    F_FIRST,
    F_MEDIAN,
    F_MOMENT1,
    F_MOMENT2,
    F_NORMAL,
    GREEN,
    N_FEATURES,
    N_SPLAT_GRADIENTS,
    NX,
    NY,
    NZ,
    OPACITY,
    REACH2,
    RED,
    WX,
    WY,
    XC,
    YC,
    ZC,
)
from reconstruction.gaussians.patches import (
    CHECK_EVERY,
    LANES,
    PATCH,
    PATCHES,
    lane_offsets,
    mark_finished,
    may_reach,
    patches_of,
    place_in_tile,
    tile_bounds,
)

LIGHT, WEIGHT = (
    N_FEATURES,
    N_FEATURES + 1,
)  # planes beside the features: transmittance, weight of the last splat
_HALF = np.float32(0.5)
_ONE = np.float32(1.0)
_TWO = np.float32(2.0)
_FOUR = np.float32(4.0)
_FAST = {"contract", "arcp", "nsz", "reassoc", "afn"}
# exp(-rho / 2) = exp(x)^64 with x = -rho / 128, by the Taylor polynomial of exp(x).
_FALLOFF_STEP = np.float32(-1.0 / 128.0)
_E2, _E3, _E4, _E5 = np.float32(1 / 2), np.float32(1 / 6), np.float32(1 / 24), np.float32(1 / 120)
# Where the screen-space filter determines a splat, its depth follows its plane within these factors of the center's:
# constant depth would bias slanted surfaces of splats smaller than a pixel towards the camera.
_FLAT_LOW, _FLAT_HIGH = np.float32(0.9), np.float32(1.1)


@numba.njit(cache=True, inline="always", fastmath=_FAST)
def _falloff(rho):  # pragma: no cover - compiled
    """Return exp(-rho / 2) by arithmetic that is vectorized; relative error 1e-5 for rho < 100, never negative."""
    x = rho * _FALLOFF_STEP
    e = _ONE + x * (_ONE + x * (_E2 + x * (_E3 + x * (_E4 + x * _E5))))
    e = max(e, x - x)
    e = e * e
    e = e * e
    e = e * e
    e = e * e
    e = e * e
    return e * e


@numba.njit(cache=True, inline="always", fastmath=_FAST)
def splat_at(dx, dy, ax, ay, bx, by, wx, wy):  # pragma: no cover - compiled
    """Return W, 1 / W, u, v, whether the disk determines rho (else the screen-space filter), and rho, at a pixel."""
    w = _ONE + wy * dy + wx * dx
    inverse_w = _ONE / w
    u, v = (ay * dy + ax * dx) * inverse_w, (by * dy + bx * dx) * inverse_w
    rho2, rho3 = _TWO * (dx * dx + dy * dy), u * u + v * v
    on_disk = (w > dx - dx) & (rho3 <= rho2)
    return w, inverse_w, u, v, on_disk, rho3 if on_disk else rho2


@numba.njit(cache=True, nogil=True)
def blend(
    start, stop, splats, boxes, tile_start, entries, tile_order, tiles_x, scalars, weights, features, contributions
):  # fmt: skip  # pragma: no cover - compiled
    """Blend the splats of the tiles tile_order[start:stop].

    Splats (k, 17) and boxes (k, 4) are near to far; tile_start and entries are of `bin_to_tiles`. scalars (3,) are the
    largest alpha, the transmittance at which a pixel is finished, and the reference depth r. Distortion is measured by
    the place 4 r / (r + z) of a splat along the ray: relative depth around r, bounded, so that a splat in front of the
    lens does not outweigh the picture. weights (h, w) are those of
    the pixels in `contributions`, or (0, 0) to omit these. Fills features (h, w, 13) and contributions (e,), the sum
    over the tile's pixels of weight alpha T of each entry.
    """
    for k in range(start, stop):
        _blend_tile(
            tile_order[k], splats, boxes, tile_start, entries, tiles_x, scalars, weights, features, contributions
        )  # fmt: skip


@numba.njit(cache=True, fastmath=_FAST, boundscheck=False, error_model="numpy", forceinline=True)
def _blend_tile(
    tile, splats, boxes, tile_start, entries, tiles_x, scalars, weights, features, contributions
):  # pragma: no cover - compiled
    """Blend one tile; the inner loop runs over a patch of 16 pixels without branches, so that it is vectorized.

    Planes are in one array, so that the compiler knows that they do not overlap.
    """
    alpha_max, stop, reference = scalars[0], scalars[1], scalars[2]
    zero = alpha_max - alpha_max
    with_weights = weights.shape[0] > 0
    tx, ty, x_end, y_end = tile_bounds(tile, tiles_x, features)
    xs, ys = lane_offsets(features.dtype)
    finished = np.zeros(PATCHES * PATCHES, np.bool_)
    image = np.zeros((N_FEATURES + 2, PATCHES * PATCHES, LANES), features.dtype)
    factors = np.zeros((PATCHES * PATCHES, LANES), features.dtype)
    for y in range(ty, y_end):
        for x in range(tx, x_end):
            i, j = place_in_tile(x - tx, y - ty)
            image[LIGHT, i, j] = 1
            if with_weights:
                factors[i, j] = weights[y, x]
    if with_weights:
        contributions[tile_start[tile] : tile_start[tile + 1]] = 0
    for e in range(tile_start[tile], tile_start[tile + 1]):
        rank = e - tile_start[tile]
        if rank % CHECK_EVERY == CHECK_EVERY - 1 and mark_finished(image[LIGHT], stop, finished):
            break
        s = splats[entries[e]]
        box = boxes[entries[e]]
        xc, yc, zc = s[XC] - _HALF, s[YC] - _HALF, s[ZC]
        ax, ay, bx, by, wx, wy = s[AX], s[AY], s[BX], s[BY], s[WX], s[WY]
        opacity, reach2 = s[OPACITY], s[REACH2]
        red, green, blue, nx, ny, nz = s[RED], s[GREEN], s[BLUE], s[NX], s[NY], s[NZ]
        total = zero
        first_column, end_column, first_row, end_row = patches_of(box, tx, ty, x_end, y_end)
        for row in range(first_row, end_row):
            for column in range(first_column, end_column):
                i = np.uint64(row * PATCHES + column)
                left, top = np.float32(tx + column * PATCH) - xc, np.float32(ty + row * PATCH) - yc
                if finished[i] or not may_reach(left, top, ax, ay, bx, by, wx, wy, reach2):
                    continue
                for j in range(LANES):
                    t = image[LIGHT, i, j]
                    dx, dy = left + xs[j], top + ys[j]
                    w, _, _, _, on_disk, rho = splat_at(dx, dy, ax, ay, bx, by, wx, wy)
                    w_flat = min(max(w, _FLAT_LOW), _FLAT_HIGH)
                    w = w if on_disk else w_flat
                    z = zc / w
                    alpha = min(opacity * _falloff(rho), alpha_max)
                    alpha = alpha if (rho <= reach2) & (t >= stop) else zero
                    weight = alpha * t
                    place = _FOUR * reference / (reference + z)
                    first = place if (t == _ONE) else image[F_FIRST, i, j]
                    m = first - place
                    before, m1, m2 = image[F_ALPHA, i, j], image[F_MOMENT1, i, j], image[F_MOMENT2, i, j]
                    after = t * (_ONE - alpha)
                    median = image[F_MEDIAN, i, j]
                    image[0, i, j] += weight * red
                    image[1, i, j] += weight * green
                    image[2, i, j] += weight * blue
                    image[F_DEPTH, i, j] += weight * z
                    image[F_NORMAL, i, j] += weight * nx
                    image[F_NORMAL + 1, i, j] += weight * ny
                    image[F_NORMAL + 2, i, j] += weight * nz
                    image[F_FIRST, i, j] = first
                    image[F_DISTORTION, i, j] += weight * (m * m * before + m2 - _TWO * m * m1)
                    image[F_ALPHA, i, j] = before + weight
                    image[F_MOMENT1, i, j] = m1 + weight * m
                    image[F_MOMENT2, i, j] = m2 + weight * m * m
                    image[F_MEDIAN, i, j] = z if (t > _HALF) & (after <= _HALF) else median
                    image[LIGHT, i, j] = after
                    image[WEIGHT, i, j] = weight
                if with_weights:
                    for j in range(LANES):
                        total += image[WEIGHT, i, j] * factors[i, j]
        if with_weights:
            contributions[e] = total
    for y in range(ty, y_end):
        for x in range(tx, x_end):
            i, j = place_in_tile(x - tx, y - ty)
            for c in range(N_FEATURES):
                features[y, x, c] = image[c, i, j]


@numba.njit(cache=True, nogil=True)
def blend_backward(
    start, stop, splats, boxes, tile_start, entries, tile_order, tiles_x, scalars, features, image_gradients, error,
    entry_gradients,
):  # fmt: skip  # pragma: no cover - compiled
    """Differentiate `blend` front to back; sums over the splats behind are total minus prefix.

    With q_i the derivative of the loss by the weight w_i = alpha_i T_i, dL/dalpha_i = T_i q_i - sum_{j>i} w_j q_j /
    (1 - alpha_i), and sum_j w_j q_j follows from the rendered image alone.

    Takes the arguments and features of `blend`, image_gradients (h, w, 9), and error (h, w), the weight of the pixels
    in the last column of the result (for densification). Fills entry_gradients (e, 18).
    """
    for k in range(start, stop):
        _blend_tile_backward(
            tile_order[k], splats, boxes, tile_start, entries, tiles_x, scalars, features, image_gradients, error,
            entry_gradients,
        )  # fmt: skip


@numba.njit(cache=True, fastmath=_FAST, boundscheck=False, error_model="numpy", forceinline=True)
def _blend_tile_backward(
    tile, splats, boxes, tile_start, entries, tiles_x, scalars, features, image_gradients, error, entry_gradients
):  # fmt: skip  # pragma: no cover - compiled
    """Differentiate one tile. One function despite its length: it recomputes the forward values that it needs."""
    alpha_max, stop, reference = scalars[0], scalars[1], scalars[2]
    zero = alpha_max - alpha_max
    tx, ty, x_end, y_end = tile_bounds(tile, tiles_x, features)
    xs, ys = lane_offsets(features.dtype)
    finished = np.zeros(PATCHES * PATCHES, np.bool_)
    # Planes: gradients 0..8, error 9, sum over splats not passed yet 10, opacity 11, moments 12 and 13, place of the
    # first 14, transmittance 15.
    given = np.zeros((16, PATCHES * PATCHES, LANES), features.dtype)
    lanes = np.empty((N_SPLAT_GRADIENTS, LANES), features.dtype)
    for y in range(ty, y_end):
        for x in range(tx, x_end):
            f, g = features[y, x], image_gradients[y, x]
            i, j = place_in_tile(x - tx, y - ty)
            given[15, i, j] = 1
            total = _TWO * g[8] * f[F_DISTORTION]
            for c in range(8):
                total += g[c] * f[c]
                given[c, i, j] = g[c]
            given[8, i, j], given[9, i, j], given[10, i, j] = g[8], error[y, x], total
            given[11, i, j], given[12, i, j] = f[F_ALPHA], f[F_MOMENT1]
            given[13, i, j], given[14, i, j] = f[F_MOMENT2], f[F_FIRST]
    done = False
    for e in range(tile_start[tile], tile_start[tile + 1]):
        out = entry_gradients[e]
        if (e - tile_start[tile]) % CHECK_EVERY == CHECK_EVERY - 1:
            done = done or mark_finished(given[15], stop, finished)
        if done:
            out[:] = 0
            continue
        s = splats[entries[e]]
        box = boxes[entries[e]]
        xc, yc, zc = s[XC] - _HALF, s[YC] - _HALF, s[ZC]
        ax, ay, bx, by, wx, wy = s[AX], s[AY], s[BX], s[BY], s[WX], s[WY]
        opacity, reach2 = s[OPACITY], s[REACH2]
        red, green, blue, nx, ny, nz = s[RED], s[GREEN], s[BLUE], s[NX], s[NY], s[NZ]
        lanes[:] = 0
        first_column, end_column, first_row, end_row = patches_of(box, tx, ty, x_end, y_end)
        for row in range(first_row, end_row):
            for column in range(first_column, end_column):
                i = np.uint64(row * PATCHES + column)
                left, top = np.float32(tx + column * PATCH) - xc, np.float32(ty + row * PATCH) - yc
                if finished[i] or not may_reach(left, top, ax, ay, bx, by, wx, wy, reach2):
                    continue
                for j in range(LANES):
                    t = given[15, i, j]
                    dx, dy = left + xs[j], top + ys[j]
                    w, inverse_w, u, v, on_disk, rho = splat_at(dx, dy, ax, ay, bx, by, wx, wy)
                    w_flat = min(max(w, _FLAT_LOW), _FLAT_HIGH)
                    moves = on_disk | (w == w_flat)
                    w = w if on_disk else w_flat
                    inverse_w = _ONE / w
                    z = zc * inverse_w
                    falloff = _falloff(rho)
                    inside = (rho <= reach2) & (t >= stop)
                    falloff = falloff if inside else zero
                    full = opacity * falloff
                    alpha = min(full, alpha_max)
                    weight = alpha * t
                    after = t * (_ONE - alpha)
                    given[15, i, j] = after
                    g_d, g_x = given[3, i, j], given[8, i, j]
                    g_r, g_g, g_b = given[0, i, j], given[1, i, j], given[2, i, j]
                    g_nx, g_ny, g_nz = given[4, i, j], given[5, i, j], given[6, i, j]
                    place = _FOUR * reference / (reference + z)
                    m = given[14, i, j] - place
                    spread = m * given[11, i, j] - given[12, i, j]
                    q = (
                        g_r * red + g_g * green + g_b * blue + g_d * z + g_nx * nx + g_ny * ny + g_nz * nz
                        + given[7, i, j] + g_x * (m * spread + given[13, i, j] - m * given[12, i, j])
                    )  # fmt: skip
                    rest = given[10, i, j] - weight * q
                    given[10, i, j] = rest
                    d_place = place * place / (_FOUR * reference)
                    d_z = weight * (g_d + _TWO * g_x * spread * d_place)
                    d_alpha = t * q - rest / (_ONE - alpha)
                    d_alpha = d_alpha if inside & (full <= alpha_max) else zero
                    d_rho = -_HALF * d_alpha * alpha
                    disk_rho = d_rho if on_disk else zero
                    flat_rho = zero if on_disk else d_rho
                    d_u, d_v = _TWO * u * disk_rho * inverse_w, _TWO * v * disk_rho * inverse_w
                    d_w = -(d_u * u + d_v * v) - d_z * z * inverse_w
                    d_w = d_w if moves else zero
                    lanes[XC, j] -= d_u * ax + d_v * bx + d_w * wx + _TWO * _TWO * flat_rho * dx
                    lanes[YC, j] -= d_u * ay + d_v * by + d_w * wy + _TWO * _TWO * flat_rho * dy
                    lanes[ZC, j] += d_z * inverse_w
                    lanes[AX, j] += d_u * dx
                    lanes[AY, j] += d_u * dy
                    lanes[BX, j] += d_v * dx
                    lanes[BY, j] += d_v * dy
                    lanes[WX, j] += d_w * dx
                    lanes[WY, j] += d_w * dy
                    lanes[OPACITY, j] += d_alpha * falloff
                    lanes[10, j] += weight * g_r
                    lanes[11, j] += weight * g_g
                    lanes[12, j] += weight * g_b
                    lanes[13, j] += weight * g_nx
                    lanes[14, j] += weight * g_ny
                    lanes[15, j] += weight * g_nz
                    lanes[16, j] += weight
                    lanes[17, j] += weight * given[9, i, j]
        for c in range(N_SPLAT_GRADIENTS):
            total = zero
            for j in range(LANES):
                total += lanes[c, j]
            out[c] = total
