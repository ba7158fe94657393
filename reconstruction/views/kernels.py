"""Compiled kernels of the viewpoint objective: culling, blending of the target behind its occluders, and gradients.

They share projection, sorting and tiles with `gaussians.kernels`, and omit colors, normals and derivatives by the
Gaussians. All Gaussians absorb light. Only those of the target are summed: unweighted, weighted by their remaining
worth, and times depth.

Unlike there, a splat fades to zero at its edge, alpha = o (f - f_edge) / (1 - f_edge), and its depth stays within a
tenth of its center's. Both are continuous in the pose, so the gradient is that of the computed value.
"""

import math

import numba
import numpy as np

from reconstruction.gaussians.blend_kernels import (
    _FAST,
    _FLAT_HIGH,
    _FLAT_LOW,
    _HALF,
    _ONE,
    _TWO,
    _falloff,
    splat_at,
)
from reconstruction.gaussians.kernels import (
    AX,
    AY,
    BX,
    BY,
    OPACITY,
    REACH2,
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

# Planes of the blended image: sums over the target's splats of alpha T, of alpha T worth, and of alpha T depth.
SEEN, WORTH, DEPTH = 0, 1, 2
N_PLANES = 3
_LIGHT, _WEIGHT = N_PLANES, N_PLANES + 1  # planes beside them: transmittance, weight of the last splat
N_GRADIENTS = 9  # derivatives of a splat: by XC .. WY


@numba.njit(cache=True, nogil=True)
def mark_near_view(
    start, stop, means, radii, rotation, translation, intrinsics, window, far, near, marked
):  # pragma: no cover - compiled
    """Mark the spheres start..stop that may meet the frustum of a window between depths `near` and `far`.

    means (n, 3) and radii (n,) are in world space, rotation (3, 3) and translation (3,) are camera_from_world, window
    is x0, y0, x1, y1 in pixels; marked is uint8 (n,).
    """
    left, right = (window[0] - intrinsics[2]) / intrinsics[0], (window[2] - intrinsics[2]) / intrinsics[0]
    top, bottom = (window[1] - intrinsics[3]) / intrinsics[1], (window[3] - intrinsics[3]) / intrinsics[1]
    nl, nr = 1.0 / math.sqrt(1.0 + left * left), 1.0 / math.sqrt(1.0 + right * right)
    nt, nb = 1.0 / math.sqrt(1.0 + top * top), 1.0 / math.sqrt(1.0 + bottom * bottom)
    for i in range(start, stop):
        m, radius = means[i], radii[i]
        marked[i] = 0
        z = rotation[2, 0] * m[0] + rotation[2, 1] * m[1] + rotation[2, 2] * m[2] + translation[2]
        if z < near or z - radius > far:
            continue
        x = rotation[0, 0] * m[0] + rotation[0, 1] * m[1] + rotation[0, 2] * m[2] + translation[0]
        y = rotation[1, 0] * m[0] + rotation[1, 1] * m[1] + rotation[1, 2] * m[2] + translation[1]
        if (x - left * z) * nl < -radius or (right * z - x) * nr < -radius:
            continue
        if (y - top * z) * nt < -radius or (bottom * z - y) * nb < -radius:
            continue
        marked[i] = 1


@numba.njit(cache=True)
def last_of_target(tile_start, entries, own):  # pragma: no cover - compiled
    """Return per tile, int64 (t,), the end of its entries after the last one of the target: later ones do not count."""
    ends = np.empty(len(tile_start) - 1, np.int64)
    for t in range(len(ends)):
        end = tile_start[t + 1]
        while end > tile_start[t] and own[entries[end - 1]] == 0:
            end -= 1
        ends[t] = end
    return ends


@numba.njit(cache=True, nogil=True)
def blend_target(
    start, stop, splats, boxes, own, worth, tile_start, tile_end, entries, tiles_x, scalars, image, contributions
):  # fmt: skip  # pragma: no cover - compiled
    """Blend the target behind its occluders in the tiles start..stop.

    Splats (k, 17) and boxes (k, 4) are near to far; tile_start and entries are of `bin_to_tiles`, tile_end of
    `last_of_target`. own (k,) is 1 for splats of the target, else 0; worth (k,) is their weight in the objective, else
    0. scalars (2,) are the largest alpha and the transmittance at which a pixel is finished. Fills image (h, w, 3),
    planes SEEN, WORTH, DEPTH, and contributions (e, 1), the sum over the tile's pixels of alpha T of each entry.
    """
    for tile in range(start, stop):
        _blend_tile(
            tile, splats, boxes, own, worth, tile_start, tile_end, entries, tiles_x, scalars, image, contributions
        )  # fmt: skip


@numba.njit(cache=True, fastmath=_FAST, boundscheck=False, error_model="numpy", forceinline=True)
def _blend_tile(
    tile, splats, boxes, own, worth, tile_start, tile_end, entries, tiles_x, scalars, image, contributions
):  # fmt: skip  # pragma: no cover - compiled
    """Blend one tile; the inner loop has no branches, so that it is vectorized."""
    alpha_max, stop = scalars[0], scalars[1]
    zero = alpha_max - alpha_max
    tx, ty, x_end, y_end = tile_bounds(tile, tiles_x, image)
    xs, ys = lane_offsets(image.dtype)
    finished = np.zeros(PATCHES * PATCHES, np.bool_)
    sums = np.zeros((N_PLANES + 2, PATCHES * PATCHES, LANES), image.dtype)
    for y in range(ty, y_end):
        for x in range(tx, x_end):
            i, j = place_in_tile(x - tx, y - ty)
            sums[_LIGHT, i, j] = 1
    contributions[tile_start[tile] : tile_start[tile + 1]] = 0
    for e in range(tile_start[tile], tile_end[tile]):
        rank = e - tile_start[tile]
        if rank % CHECK_EVERY == CHECK_EVERY - 1 and mark_finished(sums[_LIGHT], stop, finished):
            break
        s = splats[entries[e]]
        box = boxes[entries[e]]
        mine, value = own[entries[e]], worth[entries[e]]
        total = zero
        xc, yc, zc = s[XC] - _HALF, s[YC] - _HALF, s[ZC]
        ax, ay, bx, by, wx, wy = s[AX], s[AY], s[BX], s[BY], s[WX], s[WY]
        reach2 = s[REACH2]
        edge = _falloff(reach2)
        opacity = s[OPACITY] / (_ONE - edge)
        first_column, end_column, first_row, end_row = patches_of(box, tx, ty, x_end, y_end)
        for row in range(first_row, end_row):
            for column in range(first_column, end_column):
                i = np.uint64(row * PATCHES + column)
                left, top = np.float32(tx + column * PATCH) - xc, np.float32(ty + row * PATCH) - yc
                if finished[i] or not may_reach(left, top, ax, ay, bx, by, wx, wy, reach2):
                    continue
                for j in range(LANES):
                    t = sums[_LIGHT, i, j]
                    dx, dy = left + xs[j], top + ys[j]
                    w, _, _, _, _, rho = splat_at(dx, dy, ax, ay, bx, by, wx, wy)
                    w = min(max(w, _FLAT_LOW), _FLAT_HIGH)
                    alpha = min(opacity * (_falloff(rho) - edge), alpha_max)
                    alpha = alpha if (rho <= reach2) & (t >= stop) else zero
                    weight = alpha * t
                    sums[SEEN, i, j] += weight * mine
                    sums[WORTH, i, j] += weight * value
                    sums[DEPTH, i, j] += weight * mine * (zc / w)
                    sums[_LIGHT, i, j] = t - weight
                    sums[_WEIGHT, i, j] = weight
                for j in range(LANES):
                    total += sums[_WEIGHT, i, j]
        contributions[e, 0] = total
    for y in range(ty, y_end):
        for x in range(tx, x_end):
            i, j = place_in_tile(x - tx, y - ty)
            for c in range(N_PLANES):
                image[y, x, c] = sums[c, i, j]


@numba.njit(cache=True, nogil=True)
def blend_target_backward(
    start, stop, splats, boxes, own, worth, tile_start, tile_end, entries, tiles_x, scalars, image, contributions,
    image_gradients, entry_gradients,
):  # fmt: skip  # pragma: no cover - compiled
    """Differentiate `blend_target` front to back; sums over the splats behind are total minus prefix.

    Takes the arguments and results of `blend_target` and image_gradients (h, w, 3); fills entry_gradients (e, 9).
    Entries without contribution have no derivative.
    """
    for tile in range(start, stop):
        _blend_tile_backward(
            tile, splats, boxes, own, worth, tile_start, tile_end, entries, tiles_x, scalars, image, contributions,
            image_gradients, entry_gradients,
        )  # fmt: skip


@numba.njit(cache=True, fastmath=_FAST, boundscheck=False, error_model="numpy", forceinline=True)
def _blend_tile_backward(
    tile, splats, boxes, own, worth, tile_start, tile_end, entries, tiles_x, scalars, image, contributions,
    image_gradients, entry_gradients,
):  # fmt: skip  # pragma: no cover - compiled
    """Differentiate one tile. One function despite its length: it recomputes the forward values that it needs."""
    alpha_max, stop = scalars[0], scalars[1]
    zero = alpha_max - alpha_max
    tx, ty, x_end, y_end = tile_bounds(tile, tiles_x, image)
    xs, ys = lane_offsets(image.dtype)
    finished = np.zeros(PATCHES * PATCHES, np.bool_)
    # Planes: image gradients, then the sum over splats not passed yet, then transmittance.
    given = np.zeros((N_PLANES + 2, PATCHES * PATCHES, LANES), image.dtype)
    lanes = np.empty((N_GRADIENTS, LANES), image.dtype)
    for y in range(ty, y_end):
        for x in range(tx, x_end):
            i, j = place_in_tile(x - tx, y - ty)
            given[N_PLANES + 1, i, j] = 1
            for c in range(N_PLANES):
                given[c, i, j] = image_gradients[y, x, c]
                given[N_PLANES, i, j] += image_gradients[y, x, c] * image[y, x, c]
    entry_gradients[tile_start[tile] : tile_start[tile + 1]] = 0
    for e in range(tile_start[tile], tile_end[tile]):
        rank = e - tile_start[tile]
        if rank % CHECK_EVERY == CHECK_EVERY - 1 and mark_finished(given[N_PLANES + 1], stop, finished):
            break
        if contributions[e, 0] == zero:
            continue
        s = splats[entries[e]]
        box = boxes[entries[e]]
        mine, value = own[entries[e]], worth[entries[e]]
        xc, yc, zc = s[XC] - _HALF, s[YC] - _HALF, s[ZC]
        ax, ay, bx, by, wx, wy = s[AX], s[AY], s[BX], s[BY], s[WX], s[WY]
        reach2 = s[REACH2]
        edge = _falloff(reach2)
        opacity = s[OPACITY] / (_ONE - edge)
        lanes[:] = 0
        first_column, end_column, first_row, end_row = patches_of(box, tx, ty, x_end, y_end)
        for row in range(first_row, end_row):
            for column in range(first_column, end_column):
                i = np.uint64(row * PATCHES + column)
                left, top = np.float32(tx + column * PATCH) - xc, np.float32(ty + row * PATCH) - yc
                if finished[i] or not may_reach(left, top, ax, ay, bx, by, wx, wy, reach2):
                    continue
                for j in range(LANES):
                    t = given[N_PLANES + 1, i, j]
                    dx, dy = left + xs[j], top + ys[j]
                    w, inverse_w, u, v, on_disk, rho = splat_at(dx, dy, ax, ay, bx, by, wx, wy)
                    w_near = min(max(w, _FLAT_LOW), _FLAT_HIGH)
                    inverse_near = _ONE / w_near
                    z = zc * inverse_near
                    inside = (rho <= reach2) & (t >= stop)
                    slope = opacity * _falloff(rho)
                    full = slope - opacity * edge
                    full = full if inside else zero
                    alpha = min(full, alpha_max)
                    weight = alpha * t
                    given[N_PLANES + 1, i, j] = t - weight
                    g_z = given[DEPTH, i, j] * mine
                    q = given[SEEN, i, j] * mine + given[WORTH, i, j] * value + g_z * z
                    rest = given[N_PLANES, i, j] - weight * q
                    given[N_PLANES, i, j] = rest
                    d_z = weight * g_z
                    d_alpha = t * q - rest / (_ONE - alpha)
                    d_alpha = d_alpha if inside & (full <= alpha_max) else zero
                    d_rho = -_HALF * d_alpha * slope
                    disk_rho = d_rho if on_disk else zero
                    flat_rho = zero if on_disk else d_rho
                    d_u, d_v = _TWO * u * disk_rho * inverse_w, _TWO * v * disk_rho * inverse_w
                    d_w = -d_z * z * inverse_near
                    d_w = d_w if w == w_near else zero
                    d_w -= d_u * u + d_v * v
                    lanes[XC, j] -= d_u * ax + d_v * bx + d_w * wx + _TWO * _TWO * flat_rho * dx
                    lanes[YC, j] -= d_u * ay + d_v * by + d_w * wy + _TWO * _TWO * flat_rho * dy
                    lanes[ZC, j] += d_z * inverse_near
                    lanes[AX, j] += d_u * dx
                    lanes[AY, j] += d_u * dy
                    lanes[BX, j] += d_v * dx
                    lanes[BY, j] += d_v * dy
                    lanes[WX, j] += d_w * dx
                    lanes[WY, j] += d_w * dy
        for c in range(N_GRADIENTS):
            total = zero
            for j in range(LANES):
                total += lanes[c, j]
            entry_gradients[e, c] = total
