"""Compiled kernels of the plane completion: label costs, choice of labels, and confirmation by other views."""

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, inline="always")
def reproject(m, k, xn, yn, z):  # pragma: no cover - compiled
    """Return depth and pixel coordinates (u, v), in a neighbor, of a pixel's point; u = v = -1 behind the camera.

    Args:
        m: (4, 4) neighbor_from_view.
        k: fx, fy, cx, cy of both views, pixels.
        xn: Normalized image coordinate (x - cx) / fx of the pixel.
        yn: (y - cy) / fy.
        z: z-depth of the pixel, in the units of `m`.
    """
    there = z * (m[2, 0] * xn + m[2, 1] * yn + m[2, 2]) + m[2, 3]
    if there <= 1e-9:
        return there, -1.0, -1.0
    u = k[0] * (z * (m[0, 0] * xn + m[0, 1] * yn + m[0, 2]) + m[0, 3]) / there + k[2]
    v = k[1] * (z * (m[1, 0] * xn + m[1, 1] * yn + m[1, 2]) + m[1, 3]) / there + k[3]
    return there, u, v


@numba.njit(cache=True, nogil=True)
def fill_small_gaps(depth, out):  # pragma: no cover - compiled
    """Fill pixels that are surrounded by measured ones of one surface (5x5 window) with the plane through these."""
    h, w = depth.shape
    for y in range(h):
        for x in range(w):
            out[y, x] = depth[y, x]
            if depth[y, x] > 0.0 or x < 2 or y < 2 or x >= w - 2 or y >= h - 2:
                continue
            n, low, high = 0, 1e30, 0.0
            left = right = up = down = 0
            sx = sy = sr = sxx = syy = sxy = sxr = syr = 0.0
            for b in range(-2, 3):
                for a in range(-2, 3):
                    z = depth[y + b, x + a]
                    if z <= 0.0:
                        continue
                    r = 1.0 / z
                    n += 1
                    low, high = min(low, r), max(high, r)
                    left, right, up, down = left + (a < 0), right + (a > 0), up + (b < 0), down + (b > 0)
                    sx, sy, sr = sx + a, sy + b, sr + r
                    sxx, syy, sxy = sxx + a * a, syy + b * b, sxy + a * b
                    sxr, syr = sxr + a * r, syr + b * r
            if n < 8 or min(min(left, right), min(up, down)) < 2 or high - low > 0.03 * high:
                continue
            sxx, syy, sxy = sxx - sx * sx / n, syy - sy * sy / n, sxy - sx * sy / n
            sxr, syr = sxr - sx * sr / n, syr - sy * sr / n
            det = sxx * syy - sxy * sxy
            if det > 1.0:
                gx, gy = (sxr * syy - syr * sxy) / det, (syr * sxx - sxr * sxy) / det
                r = (sr - gx * sx - gy * sy) / n
                if r > 0.0:
                    out[y, x] = 1.0 / r


@numba.njit(cache=True, nogil=True)
def _differ(a, b, gain):  # pragma: no cover - compiled
    """Return by how much two colors differ in the channel where they differ most, b in the exposure of a."""
    most = 0.0
    for c in range(3):
        if a[c] > 250 and b[c] * gain > 250.0:
            continue
        most = max(most, abs(a[c] - b[c] * gain))
    return most


@numba.njit(cache=True, nogil=True)
def exposure_gains(depth, tone, neighbors, relative, maps, tones, k, gains):  # pragma: no cover - compiled
    """Write the ratio of brightness of a view to each neighbor, over points that both measured, to gains (m,)."""
    h, w = depth.shape
    fx, fy, cx, cy = k
    for s in range(len(neighbors)):
        gains[s] = 1.0
        j = neighbors[s]
        if j < 0:
            break
        m = relative[s]
        here, there, count = 0.0, 0.0, 0
        for y in range(2, h, 4):
            for x in range(2, w, 4):
                q = depth[y, x]
                if q <= 0.0:
                    continue
                xn, yn = (x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy
                qz, u, v = reproject(m, k, xn, yn, q)
                if not (u >= 0.0 and v >= 0.0 and u < w and v < h):
                    continue
                if abs(maps[j, int(v), int(u)] - qz) > 0.01 * qz:
                    continue
                for c in range(3):
                    a, b = tone[y, x, c], tones[j, int(v), int(u), c]
                    if a < 240 and b < 240:
                        here, there, count = here + a, there + b, count + 1
        if count > 150 and there > 0.0:
            gains[s] = min(2.0, max(0.5, here / there))


@numba.njit(cache=True, nogil=True)
def label_costs(
    depth, raw, planes, bounds, doubt, tone, neighbors, relative, maps, tones, gains, k, near, far, cost
):  # pragma: no cover - compiled
    """Write the cost (h, w, labels + 1) of each plane at each pixel; the last label is "no plane".

    A plane costs more where another view looks through it, or shows another color at the same point of it (the plane
    is occluded in one of the two views).

    Args:
        depth: (h, w) measured depth, 0 = none.
        raw: (h, w) depth before views were compared, a weak hint.
        planes: (labels, 4) in this camera's space: inverse depth = -(n . r) / d.
        bounds: (labels, sides, 4) within which each plane was measured, in this camera's space.
        doubt: (labels,) extra cost of oblique planes.
        tone: uint8 (h, w, 3) smoothed colors of this view.
        neighbors: (m,) rows of `maps`, -1 = none.
        relative: (m, 4, 4) neighbour_from_view.
        maps: (n, h, w) measured depth of all views.
        tones: uint8 (n, h, w, 3) smoothed colors of all views.
        gains: (m,) brightness of this view over that of each neighbor.
        k: fx, fy, cx, cy.
        near: Nearest depth that a plane may have here.
        far: Farthest depth.
        cost: uint8, written.
    """
    h, w = depth.shape
    labels = planes.shape[0]
    fx, fy, cx, cy = k
    for y in range(h):
        for x in range(w):
            xn, yn = (x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy
            z = depth[y, x]
            cost[y, x, labels] = 35 if z > 0.0 else 42
            for c in range(labels):
                p = planes[c]
                rho = -(p[0] * xn + p[1] * yn + p[2]) / p[3]
                if not (rho > 1.0 / far and rho < 1.0 / near):
                    cost[y, x, c] = 200
                    continue
                if z > 0.0:
                    cost[y, x, c] = np.uint8(min(100.0, abs(z * rho - 1.0) * 5000.0))
                    continue
                through, agree, alien = 0, 0, 0
                q = 1.0 / rho
                within = True
                for side in range(bounds.shape[1]):
                    e = bounds[c, side]
                    if q * (e[0] * xn + e[1] * yn + e[2]) + e[3] < 0.0:
                        within = False
                        break
                if not within:
                    cost[y, x, c] = 255
                    continue
                for s in range(len(neighbors)):
                    j = neighbors[s]
                    if j < 0:
                        break
                    qz, u, v = reproject(relative[s], k, xn, yn, q)
                    if not (u >= 0.0 and v >= 0.0 and u < w and v < h):
                        continue
                    d = maps[j, int(v), int(u)]
                    if d > 1.025 * qz:
                        through += 1
                    elif d <= 0.0 or (d > 0.985 * qz and d < 1.015 * qz):
                        differs = _differ(tone[y, x], tones[j, int(v), int(u)], gains[s])
                        if differs > 24.0:
                            alien += 2 if d > 0.0 else 1
                        elif d > 0.0 and differs < 14.0:
                            agree += 1
                value = 44.0 + doubt[c] + 40.0 * through + 12.0 * alien - 15.0 * min(agree, 2)
                if raw[y, x] > 0.0 and abs(raw[y, x] * rho - 1.0) < 0.015:
                    value -= 12.0
                cost[y, x, c] = np.uint8(min(200.0, max(0.0, value)))


@numba.njit(cache=True, nogil=True)
def choose_labels(total, cost, depth, limit, label):  # pragma: no cover - compiled
    """Write the cheapest label of each pixel, or -1 where it is "none" or costs more than `limit`."""
    h, w, n = total.shape
    for y in range(h):
        for x in range(w):
            best, at = np.int64(1 << 40), n - 1
            for c in range(n):
                if total[y, x, c] < best:
                    best, at = np.int64(total[y, x, c]), c
            label[y, x] = at
            if at == n - 1 or cost[y, x, at] > (30 if depth[y, x] > 0.0 else limit):
                label[y, x] = -1


@numba.njit(cache=True, nogil=True)
def confirm_fill(i, neighbors, depth, confidence, relative, k, keep):  # pragma: no cover - compiled
    """Mark in keep (h, w) the completed pixels of view i that at least two other completed maps agree with.

    More views have to agree than look through the point. Planes belong to the scene, so that right fills coincide.
    """
    h, w = depth.shape[1:]
    fx, fy, cx, cy = k
    for y in range(h):
        for x in range(w):
            if confidence[i, y, x] != 1:
                continue
            z = depth[i, y, x]
            xn, yn = (x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy
            agree, through = 0, 0
            for s in range(len(neighbors)):
                j = neighbors[s]
                if j < 0:
                    break
                qz, u, v = reproject(relative[s], k, xn, yn, z)
                if not (u >= 0.0 and v >= 0.0 and u < w and v < h):
                    continue
                d = depth[j, int(v), int(u)]
                if d <= 0.0:
                    continue
                if abs(d - qz) < 0.01 * qz:
                    agree += 1
                elif d > 1.02 * qz:
                    through += 2 if confidence[j, int(v), int(u)] == 2 else 1
            keep[y, x] = agree >= 2 and agree > through
