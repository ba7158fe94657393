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
    tile_pixels,
)
from reconstruction.gaussians.kernels import (
    AX,
    AY,
    BX,
    BY,
    OPACITY,
    REACH2,
    TILE,
    WX,
    WY,
    XC,
    YC,
    ZC,
)

# Planes of the blended image: sums over the target's splats of alpha T, of alpha T worth, and of alpha T depth.
SEEN, WORTH, DEPTH = 0, 1, 2
N_PLANES = 3
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
    tx, ty, x_end, y_end, xs, ys = tile_pixels(tile, tiles_x, image)
    sums = np.zeros((N_PLANES, TILE, TILE), image.dtype)
    light = np.ones((TILE, TILE), image.dtype)
    row_sums = np.zeros(TILE, image.dtype)
    contributions[tile_start[tile] : tile_start[tile + 1]] = 0
    for e in range(tile_start[tile], tile_end[tile]):
        if (e - tile_start[tile]) % 32 == 31 and light[: y_end - ty, : x_end - tx].max() < stop:
            break
        s = splats[entries[e]]
        box = boxes[entries[e]]
        mine, value = own[entries[e]], worth[entries[e]]
        row_sums[:] = 0
        xc, yc, zc = s[XC] - _HALF, s[YC] - _HALF, s[ZC]
        ax, bx, wx, reach2 = s[AX], s[BX], s[WX], s[REACH2]
        edge = _falloff(reach2)
        opacity = s[OPACITY] / (_ONE - edge)
        for i in range(max(box[1], ty) - ty, min(box[3], y_end) - ty):
            dy = ys[i] - yc
            u_row, v_row, w_row, dy2 = s[AY] * dy, s[BY] * dy, _ONE + s[WY] * dy, dy * dy
            for j in range(TILE):
                t = light[i, j]
                dx = xs[j] - xc
                w, _, _, _, _, rho = splat_at(dx, dy2, u_row, v_row, w_row, ax, bx, wx)
                w = min(max(w, _FLAT_LOW), _FLAT_HIGH)
                alpha = min(opacity * (_falloff(rho) - edge), alpha_max)
                alpha = alpha if (rho <= reach2) & (t >= stop) else zero
                weight = alpha * t
                sums[SEEN, i, j] += weight * mine
                sums[WORTH, i, j] += weight * value
                sums[DEPTH, i, j] += weight * mine * (zc / w)
                light[i, j] = t - weight
                row_sums[j] += weight
        contributions[e, 0] = row_sums.sum()
    for y in range(ty, y_end):
        for x in range(tx, x_end):
            for c in range(N_PLANES):
                image[y, x, c] = sums[c, y - ty, x - tx]


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
    tx, ty, x_end, y_end, xs, ys = tile_pixels(tile, tiles_x, image)
    light = np.ones((TILE, TILE), image.dtype)
    # Planes: image gradients, then the sum over splats not passed yet.
    given = np.zeros((N_PLANES + 1, TILE, TILE), image.dtype)
    lanes = np.empty((N_GRADIENTS, TILE), image.dtype)
    for y in range(ty, y_end):
        for x in range(tx, x_end):
            for c in range(N_PLANES):
                given[c, y - ty, x - tx] = image_gradients[y, x, c]
                given[N_PLANES, y - ty, x - tx] += image_gradients[y, x, c] * image[y, x, c]
    entry_gradients[tile_start[tile] : tile_start[tile + 1]] = 0
    for e in range(tile_start[tile], tile_end[tile]):
        if (e - tile_start[tile]) % 32 == 31 and light[: y_end - ty, : x_end - tx].max() < stop:
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
        for i in range(max(box[1], ty) - ty, min(box[3], y_end) - ty):
            dy = ys[i] - yc
            u_row, v_row, w_row, dy2 = ay * dy, by * dy, _ONE + wy * dy, dy * dy
            for j in range(TILE):
                t = light[i, j]
                dx = xs[j] - xc
                w, inverse_w, u, v, on_disk, rho = splat_at(dx, dy2, u_row, v_row, w_row, ax, bx, wx)
                w_near = min(max(w, _FLAT_LOW), _FLAT_HIGH)
                inverse_near = _ONE / w_near
                z = zc * inverse_near
                inside = (rho <= reach2) & (t >= stop)
                slope = opacity * _falloff(rho)
                full = slope - opacity * edge
                full = full if inside else zero
                alpha = min(full, alpha_max)
                weight = alpha * t
                light[i, j] = t - weight
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
            for j in range(TILE):
                total += lanes[c, j]
            entry_gradients[e, c] = total
