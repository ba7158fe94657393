"""Compiled kernels of the assets stage: viewing angles, volumetric fusion, texture sampling.

They are long because all work on a voxel or texel happens in one iteration of a loop. Objects are made beside each
other: a kernel releases the interpreter lock and runs on one thread.
"""

import math

import numpy as np
from numba import njit, prange

_BLOCK = 256  # points that are weighed at once
_EDGE = 0.025  # relative depth difference to a neighbor that is a discontinuity


@njit(cache=True, parallel=True)
def incidence_cosines(depth, fx, fy, cx, cy):  # pragma: no cover - compiled
    """Return the cosine between ray and surface normal (n, h, w); 0 at discontinuities and where depth is unknown."""
    n, h, w = depth.shape
    out = np.zeros((n, h, w), np.float32)
    for job in prange(n * h):
        f, y = job // h, job % h
        if y == 0 or y == h - 1:
            continue
        for x in range(1, w - 1):
            z = depth[f, y, x]
            if z <= 0:
                continue
            zl, zr, zu, zd = depth[f, y, x - 1], depth[f, y, x + 1], depth[f, y - 1, x], depth[f, y + 1, x]
            limit = _EDGE * z
            if zl <= 0 or zr <= 0 or zu <= 0 or zd <= 0:
                continue
            # Pixels beside a nearer surface, and flying pixels between two surfaces, carry no evidence.
            if z - min(min(zl, zr), min(zu, zd)) > limit:
                continue
            left, right = abs(zl - z) < limit, abs(zr - z) < limit
            up, down = abs(zu - z) < limit, abs(zd - z) < limit
            xl, xr = (x - 0.5 - cx) / fx, (x + 1.5 - cx) / fx
            yu, yd = (y - 0.5 - cy) / fy, (y + 1.5 - cy) / fy
            xm, ym = (x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy
            if not (left or right) or not (up or down):
                continue
            ax = (xr * zr if right else xm * z) - (xl * zl if left else xm * z)
            ay = (ym * zr if right else ym * z) - (ym * zl if left else ym * z)
            az = (zr if right else z) - (zl if left else z)
            bx = (xm * zd if down else xm * z) - (xm * zu if up else xm * z)
            by = (yd * zd if down else ym * z) - (yu * zu if up else ym * z)
            bz = (zd if down else z) - (zu if up else z)
            nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            size = math.sqrt(nx * nx + ny * ny + nz * nz)
            if size < 1e-15:
                continue
            ray = math.sqrt(xm * xm + ym * ym + 1.0)
            out[f, y, x] = abs(nx * xm + ny * ym + nz) / (size * ray)
    return out


@njit(cache=True, nogil=True)
def _fuse_slab(
    depth, confidence, ids, cosine, inner, f, m, fx, fy, cx, cy, target, gx, origin, voxel, trunc, tau, shell, shade,
    num, den, freed, support, outside, behind, within, shaded,
):  # pragma: no cover - compiled  # fmt: skip
    """Add the evidence of frame `f` to the sums (ny, nz) of the voxels at `gx`; see `fuse_object`."""
    ny, nz = num.shape
    h, w = depth.shape[1:]
    hidden = -max(shade, 2.0 * trunc)  # voxels that far behind the surface learn nothing from it
    for j in range(ny):
        gy = origin[1] + (j + 0.5) * voxel
        mx, my, mz = (
            m[0, 0] * gx + m[0, 1] * gy,
            m[1, 0] * gx + m[1, 1] * gy,
            m[2, 0] * gx + m[2, 1] * gy,
        )
        for k in range(nz):
            gz = origin[2] + (k + 0.5) * voxel
            z = mz + m[2, 2] * gz + m[2, 3]
            if z < 0.05:
                continue
            xn, yn = (mx + m[0, 2] * gz + m[0, 3]) / z, (my + m[1, 2] * gz + m[1, 3]) / z
            u, v = fx * xn + cx, fy * yn + cy
            if u < 0 or v < 0 or u >= w or v >= h:
                continue
            iu, iv = int(u), int(v)
            d = depth[f, iv, iu]
            if d <= 0:
                continue
            if ids[f, iv, iu] == target:
                if d * (1.0 + _EDGE) - z < hidden:
                    continue
                cos = cosine[f, iv, iu]
                # Bilinear where the four pixels around show the object and are one surface.
                x0, y0 = int(math.floor(u - 0.5)), int(math.floor(v - 0.5))
                if (
                    x0 >= 0 and y0 >= 0 and x0 + 1 < w and y0 + 1 < h
                    and ids[f, y0, x0] == target and ids[f, y0, x0 + 1] == target
                    and ids[f, y0 + 1, x0] == target and ids[f, y0 + 1, x0 + 1] == target
                ):  # fmt: skip
                    d00, d01 = depth[f, y0, x0], depth[f, y0, x0 + 1]
                    d10, d11 = depth[f, y0 + 1, x0], depth[f, y0 + 1, x0 + 1]
                    low, high = min(min(d00, d01), min(d10, d11)), max(max(d00, d01), max(d10, d11))
                    if low > 0 and high - low <= _EDGE * d:
                        tx, ty = u - 0.5 - x0, v - 0.5 - y0
                        top, bottom = d00 * (1 - tx) + d01 * tx, d10 * (1 - tx) + d11 * tx
                        d = top * (1 - ty) + bottom * ty
                along = (d - z) * math.sqrt(xn * xn + yn * yn + 1.0)
                s = along * max(cos, 0.25)
                if along < -trunc and s < -0.5 * trunc:
                    if along > -shade:
                        shaded[j, k] += 1
                    continue
                if s >= trunc:
                    if cos > 0:
                        freed[j, k] += 1
                    continue
                if cos > 0:
                    support[j, k] += 1
                    if inner[f, iv, iu]:
                        within[j, k] += 1
                    if s < 0 and s > -shell:
                        behind[j, k] += 1
                weight = (0.1 + cos) * (1.0 if confidence[f, iv, iu] >= 2 else 0.3)
                soft = weight * math.exp(max(s, -trunc) / tau)
                num[j, k] += soft * max(s, -trunc)
                den[j, k] += soft
            elif d > z and cosine[f, iv, iu] > 0:
                # Outlines are known to a pixel only.
                if (
                    (iu > 0 and ids[f, iv, iu - 1] == target)
                    or (iu < w - 1 and ids[f, iv, iu + 1] == target)
                    or (iv > 0 and ids[f, iv - 1, iu] == target)
                    or (iv < h - 1 and ids[f, iv + 1, iu] == target)
                ):
                    continue
                outside[j, k] += 1
                ray = math.sqrt(xn * xn + yn * yn + 1.0)
                if (d - z) * ray * max(cosine[f, iv, iu], 0.1) > 0.6 * trunc:
                    freed[j, k] += 1


@njit(cache=True, nogil=True)
def fuse_object(
    depth, confidence, ids, cosine, inner, frames, camera_from_grid, fx, fy, cx, cy, target, shape, origin, voxel,
    trunc, tau, shell, shade,
):  # pragma: no cover - compiled  # fmt: skip
    """Accumulate the evidence of all frames in every voxel of one object's grid, a slab of voxels at a time.

    Returns (nx, ny, nz) each:
        numerator, denominator: of the mean signed distance to the seen surface, weighted towards large ones (soft
            maximum of temperature `tau`);
        numbers of frames that saw: the voxel free; the object's surface at it; something else there that does not
            occlude the voxel; the surface less than `shell` in front of it; the surface at it, well inside the
            object's outline; the surface in front of it by more than `trunc` and less than `shade`.
    """
    nx, ny, nz = shape
    numerator = np.zeros((nx, ny, nz), np.float32)
    denominator = np.zeros((nx, ny, nz), np.float32)
    freed = np.zeros((nx, ny, nz), np.uint16)
    support = np.zeros((nx, ny, nz), np.uint16)
    outside = np.zeros((nx, ny, nz), np.uint16)
    behind = np.zeros((nx, ny, nz), np.uint16)
    within = np.zeros((nx, ny, nz), np.uint16)
    shaded = np.zeros((nx, ny, nz), np.uint16)
    num, den = np.zeros((ny, nz)), np.zeros((ny, nz))
    for i in range(nx):
        gx = origin[0] + (i + 0.5) * voxel
        num[:] = 0.0
        den[:] = 0.0
        # Neighbours of a slab project to neighbouring pixels of a frame, which are in the processor's cache.
        for q in range(len(frames)):
            _fuse_slab(
                depth, confidence, ids, cosine, inner, frames[q], camera_from_grid[q], fx, fy, cx, cy, target, gx,
                origin, voxel, trunc, tau, shell, shade, num, den,
                freed[i], support[i], outside[i], behind[i], within[i], shaded[i],
            )  # fmt: skip
        numerator[i] = num
        denominator[i] = den
    return numerator, denominator, freed, support, outside, behind, within, shaded


@njit(cache=True, nogil=True)
def _weigh(
    first, k, points, normals, camera_from_world, centers, images, depths, borders, fx, fy, cx, cy, dfx, dfy, dcx, dcy,
    tolerance, out,
):  # pragma: no cover - compiled  # fmt: skip
    """Write the weight of frame `k`, its column and row to `out` (n, 3) for points from `first` on; 0 where unseen."""
    m = camera_from_world[k]
    h, w = images.shape[1], images.shape[2]
    for row in range(min(len(out), len(points) - first)):
        t = first + row
        out[row, 0] = 0.0
        px, py, pz = points[t, 0], points[t, 1], points[t, 2]
        z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
        if z < 0.05:
            continue
        xn = (m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]) / z
        yn = (m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]) / z
        u, v = fx * xn + cx, fy * yn + cy
        if u < 0.5 or v < 0.5 or u >= w - 0.5 or v >= h - 0.5:
            continue
        iu = min(max(int(dfx * xn + dcx), 0), depths.shape[2] - 1)
        iv = min(max(int(dfy * yn + dcy), 0), depths.shape[1] - 1)
        here, border = depths[k, iv, iu], borders[k, iv, iu]
        if here <= 0 or border <= 0:
            continue
        vx, vy, vz = centers[k, 0] - px, centers[k, 1] - py, centers[k, 2] - pz
        length = math.sqrt(vx * vx + vy * vy + vz * vz)
        cos = (vx * normals[t, 0] + vy * normals[t, 1] + vz * normals[t, 2]) / max(length, 1e-9)
        if cos < 0.08:
            continue
        slope = 1.5 * z / dfx / max(cos, 0.1)  # change of depth over a pixel
        if abs(here - z) <= tolerance + slope:
            out[row, 0], out[row, 1], out[row, 2] = cos * cos / max(length, 0.1) ** 2 * border, u, v


@njit(cache=True, inline="always")
def _sample_pixel(images, k, u, v, out):  # pragma: no cover - compiled
    """Write the interpolated color of frame `k` at column `u` and row `v` to `out` (3,)."""
    x0, y0 = int(u - 0.5), int(v - 0.5)
    x1, y1 = min(x0 + 1, images.shape[2] - 1), min(y0 + 1, images.shape[1] - 1)
    tx, ty = u - 0.5 - x0, v - 0.5 - y0
    for c in range(3):
        top = images[k, y0, x0, c] * (1 - tx) + images[k, y0, x1, c] * tx
        low = images[k, y1, x0, c] * (1 - tx) + images[k, y1, x1, c] * tx
        out[c] = top * (1 - ty) + low * ty


@njit(cache=True, nogil=True)
def sample_frames(
    points, normals, camera_from_world, centers, images, depths, borders, intrinsics, depth_intrinsics, tolerance
):  # pragma: no cover - compiled  # fmt: skip
    """Return colors (k, t, 3) and weights (k, t) of surface points in every frame."""
    count, frames = len(points), len(images)
    colors = np.zeros((frames, count, 3), np.float32)
    weights = np.zeros((frames, count), np.float32)
    fx, fy, cx, cy = intrinsics
    dfx, dfy, dcx, dcy = depth_intrinsics
    place = np.zeros((count, 3))
    for k in range(frames):
        _weigh(
            0, k, points, normals, camera_from_world, centers, images, depths, borders,
            fx, fy, cx, cy, dfx, dfy, dcx, dcy, tolerance, place,
        )  # fmt: skip
        for t in range(count):
            weights[k, t] = place[t, 0]
            if place[t, 0] > 0:
                _sample_pixel(images, k, place[t, 1], place[t, 2], colors[k, t])
    return colors, weights


@njit(cache=True, nogil=True)
def blend_frames(
    points, normals, camera_from_world, centers, images, depths, borders, gains, intrinsics, depth_intrinsics, tolerance
):  # pragma: no cover - compiled  # fmt: skip
    """Blend the three best colors of each surface point; return colors (t, 3) and whether any frame saw it (t,)."""
    count, frames = len(points), len(images)
    out = np.zeros((count, 3), np.float32)
    seen = np.zeros(count, np.bool_)
    fx, fy, cx, cy = intrinsics
    dfx, dfy, dcx, dcy = depth_intrinsics
    places, best = np.zeros((frames, _BLOCK, 3)), np.zeros((3, 3), np.float32)
    weight, frame = np.zeros(3), np.zeros(3, np.int64)  # of the best frames, best first
    for t in range(count):
        row = t % _BLOCK
        if row == 0:
            for k in range(frames):
                _weigh(
                    t, k, points, normals, camera_from_world, centers, images, depths, borders,
                    fx, fy, cx, cy, dfx, dfy, dcx, dcy, tolerance, places[k],
                )  # fmt: skip
        weight[:] = 0.0
        for k in range(frames):
            w = places[k, row, 0]
            if w <= weight[2]:
                continue
            slot = 2
            while slot > 0 and w > weight[slot - 1]:
                weight[slot], frame[slot] = weight[slot - 1], frame[slot - 1]
                slot -= 1
            weight[slot], frame[slot] = w, k
        if weight[0] <= 0:
            continue
        seen[t] = True
        for slot in range(3):
            if weight[slot] > 0:
                place = places[frame[slot], row]
                _sample_pixel(images, frame[slot], place[1], place[2], best[slot])
                for c in range(3):
                    best[slot, c] *= gains[frame[slot]]
        total = 0.0
        for slot in range(3):
            if weight[slot] <= 0:
                break
            # Specular highlights and wrong ids differ from the median of the three colors.
            off = 0.0
            if weight[2] > 0:
                for c in range(3):
                    a, b, d = best[0, c], best[1, c], best[2, c]
                    middle = max(min(a, b), min(max(a, b), d))
                    off = max(off, abs(best[slot, c] - middle) / 40.0)
            share = weight[slot] ** 2 / (1 + off * off)
            total += share
            for c in range(3):
                out[t, c] += share * best[slot, c]
        for c in range(3):
            out[t, c] /= total
    return out, seen
