"""Compiled kernels that color pixels: textures, baked light, shine, and which face is seen where."""

import numpy as np
from numba import njit, prange


@njit(cache=True, inline="always")
def _sample(atlas, levels, texture, level, s, t):  # pragma: no cover - compiled
    """Bilinear lookup at (s, t) in [0, 1) of one mip level; repeats at the border; three channels."""
    start, height, width = levels[texture, level, 0], levels[texture, level, 1], levels[texture, level, 2]
    x, y = s * width - 0.5, t * height - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    ax, ay = x - x0, y - y0
    xa = x0 + width if x0 < 0 else x0
    xb = x0 + 1 - width if x0 + 1 >= width else x0 + 1
    ya = y0 + height if y0 < 0 else y0
    yb = y0 + 1 - height if y0 + 1 >= height else y0 + 1
    aa, ab = start + ya * width + xa, start + ya * width + xb
    ba, bb = start + yb * width + xa, start + yb * width + xb
    red = (1 - ay) * ((1 - ax) * atlas[aa, 0] + ax * atlas[ab, 0])
    red += ay * ((1 - ax) * atlas[ba, 0] + ax * atlas[bb, 0])
    green = (1 - ay) * ((1 - ax) * atlas[aa, 1] + ax * atlas[ab, 1])
    green += ay * ((1 - ax) * atlas[ba, 1] + ax * atlas[bb, 1])
    blue = (1 - ay) * ((1 - ax) * atlas[aa, 2] + ax * atlas[ab, 2])
    blue += ay * ((1 - ax) * atlas[ba, 2] + ax * atlas[bb, 2])
    return red, green, blue


@njit(cache=True, inline="always")
def _edge(value, low, high, soft):  # pragma: no cover - compiled
    """Return 1 between low and high, 0 outside, with borders as wide as `soft`."""
    a = min(max((value - low) / soft + 0.5, 0.0), 1.0)
    b = min(max((high - value) / soft + 0.5, 0.0), 1.0)
    return a * b


@njit(cache=True)
def _shine(at, normal, ray, gloss, sharpness, mirrored, windows, box, out):  # pragma: no cover - compiled
    """Write the light (3,) that a glossy surface sends to the camera: lamps, windows, ceiling, walls."""
    facing = -(ray[0] * normal[0] + ray[1] * normal[1] + ray[2] * normal[2])
    if facing < 0.0:  # interpolated normals may turn away at outlines
        facing = 0.0
    rx = ray[0] + 2 * facing * normal[0]
    ry = ray[1] + 2 * facing * normal[1]
    rz = ray[2] + 2 * facing * normal[2]
    bright = 0.04 + 0.10 * gloss * gloss
    fresnel = bright + (1 - bright) * (1 - facing) ** 5 * min(1.0, 0.2 + sharpness / 200.0)
    out[0] = out[1] = out[2] = 0.0
    # Where the mirrored ray leaves the room.
    way, side = 1e9, 4
    for axis in range(3):
        r = rx if axis == 0 else (ry if axis == 1 else rz)
        if abs(r) < 1e-9:
            continue
        t = (box[2 * axis + (1 if r > 0 else 0)] - at[axis]) / r
        if 0.0 < t < way:
            way, side = t, 2 * axis + (1 if r > 0 else 0)
    hz = at[2] + way * rz
    blur = 0.03 + way * 1.6 / np.sqrt(sharpness + 1.0)
    if side == 5:
        around = 0.85
    elif side == 4:
        around = 0.22
    else:
        around = 0.30 + 0.20 * hz
    for channel in range(3):
        out[channel] = fresnel * gloss * around
    for k in range(windows.shape[0]):
        axis = int(windows[k, 0])
        r = rx if axis == 0 else ry
        if abs(r) < 1e-9:
            continue
        t = (windows[k, 1] - at[axis]) / r
        if t <= 0.0 or t > way + 0.3:
            continue
        along = at[1] + t * ry if axis == 0 else at[0] + t * rx
        up = at[2] + t * rz
        share = _edge(along, windows[k, 2], windows[k, 3], blur) * _edge(
            up, windows[k, 4], windows[k, 5], blur
        )
        middle = 0.5 * (windows[k, 2] + windows[k, 3])  # the post between two panes
        share *= 1.0 - 0.6 * _edge(along, middle - 0.03, middle + 0.03, blur)
        for channel in range(3):
            out[channel] += fresnel * gloss * 4.0 * share * windows[k, 6 + channel]
    for k in range(mirrored.shape[0]):
        dx, dy, dz = mirrored[k, 0] - at[0], mirrored[k, 1] - at[1], mirrored[k, 2] - at[2]
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        cosine = (dx * rx + dy * ry + dz * rz) / distance
        if cosine <= 0.0:
            continue
        # A large or near lamp gives a large, a weak one a faint highlight.
        size = mirrored[k, 6] / distance
        power = 1.0 / (1.0 / sharpness + 0.5 * size * size)
        lobe = np.exp(-power * (1.0 - cosine)) * (power + 2.0) / 8.0 * 0.12
        for channel in range(3):
            out[channel] += fresnel * gloss * min(lobe, 60.0) * mirrored[k, 3 + channel] * 4.0


@njit(cache=True, inline="always")
def _add_shine(value, light):  # pragma: no cover - compiled
    """Add light to a value of 0..255 as the eye's scale wants it."""
    linear = (max(value, 0.0) / 255.0) ** 2.2 + light
    return 255.0 * linear ** (1 / 2.2)


@njit(cache=True, parallel=True)
def shade(
    depth, face, bary, faces, uvs, light, face_texture, face_normal, atlas, levels, sizes,
    world_from_camera, fx, fy, cx, cy, background, normals, finish, mirrored, windows, box, out,
):  # fmt: skip  # pragma: no cover - compiled
    """Color every sample of a rasterized picture, mixing two mip levels."""
    height, width = depth.shape
    for y in prange(height):
        extra, at = np.empty(3), np.empty(3)
        ray, normal = np.empty(3), np.empty(3)
        for x in range(width):
            f = face[y, x]
            if f < 0:
                for channel in range(3):
                    out[y, x, channel] = background[channel]
                continue
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            wa, wb, wc = bary[y, x, 0], bary[y, x, 1], bary[y, x, 2]
            texture = face_texture[f]
            s = (wa * uvs[a, 0] + wb * uvs[b, 0] + wc * uvs[c, 0]) / sizes[texture, 0]
            t = 1.0 - (wa * uvs[a, 1] + wb * uvs[b, 1] + wc * uvs[c, 1]) / sizes[texture, 1]
            s, t = s - np.floor(s), t - np.floor(t)
            # The footprint of a sample on a tilted surface decides the mip level.
            rx, ry = (x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy
            norm = np.sqrt(rx * rx + ry * ry + 1.0)
            cosine = 0.0
            for k in range(3):
                ray[k] = world_from_camera[k, 0] * rx + world_from_camera[k, 1] * ry + world_from_camera[k, 2]
                cosine -= ray[k] * face_normal[f, k] / norm
            footprint = depth[y, x] / fx / np.sqrt(max(abs(cosine), 0.08))
            wanted = min(max(np.log2(footprint * sizes[texture, 2]), 0.0), levels.shape[1] - 2.0)
            level = int(wanted)
            blend = wanted - level
            near = _sample(atlas, levels, texture, level, s, t)
            far = _sample(atlas, levels, texture, level + 1, s, t)
            for channel in range(3):
                value = (1 - blend) * near[channel]
                value += blend * far[channel]
                value *= wa * light[a, channel] + wb * light[b, channel] + wc * light[c, channel]
                out[y, x, channel] = value
            if finish[texture, 0] <= 0.0:
                continue
            length = 0.0
            for k in range(3):
                at[k] = world_from_camera[k, 3] + depth[y, x] * ray[k]
                ray[k] /= norm
                normal[k] = wa * normals[a, k] + wb * normals[b, k] + wc * normals[c, k]
                length += normal[k] * normal[k]
            normal /= np.sqrt(max(length, 1e-12))
            _shine(at, normal, ray, finish[texture, 0], finish[texture, 1], mirrored, windows, box, extra)
            for channel in range(3):
                out[y, x, channel] = _add_shine(out[y, x, channel], extra[channel])


@njit(cache=True, nogil=True)
def into_camera(vertices, camera_from_world):  # pragma: no cover - compiled
    """Return points (n, 3) in the camera's space."""
    out = np.empty_like(vertices)
    m = camera_from_world
    for i in range(len(vertices)):
        x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        for k in range(3):
            out[i, k] = m[k, 0] * x + m[k, 1] * y + m[k, 2] * z + m[k, 3]
    return out


@njit(cache=True, nogil=True)
def _fill(f, ax, ay, ai, bx, by, bi, cx, cy, ci, near, face):  # pragma: no cover - compiled
    """Draw a triangle given by its corners on the image and their 1 / z; the back side is left out."""
    height, width = face.shape
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    if area > -1e-12:
        return
    x0 = max(0, int(np.ceil(min(ax, bx, cx) - 0.5)))
    x1 = min(width - 1, int(np.floor(max(ax, bx, cx) - 0.5)))
    y0 = max(0, int(np.ceil(min(ay, by, cy) - 0.5)))
    y1 = min(height - 1, int(np.floor(max(ay, by, cy) - 0.5)))
    if x0 > x1 or y0 > y1:
        return
    inv = 1.0 / area
    for y in range(y0, y1 + 1):
        py, px = y + 0.5, x0 + 0.5
        wa = ((bx - px) * (cy - py) - (cx - px) * (by - py)) * inv
        wb = ((cx - px) * (ay - py) - (ax - px) * (cy - py)) * inv
        da, db = (by - cy) * inv, (cy - ay) * inv
        entered = False
        for x in range(x0, x1 + 1):
            wc = 1.0 - wa - wb
            if wa >= -1e-9 and wb >= -1e-9 and wc >= -1e-9:
                entered = True
                i = wa * ai + wb * bi + wc * ci
                if i > near[y, x]:
                    near[y, x] = i
                    face[y, x] = f
            elif entered:
                break
            wa += da
            wb += db


@njit(cache=True, nogil=True)
def see(points, faces, fx, fy, cx, cy, limit, near, face):  # pragma: no cover - compiled
    """Write which face is seen where; `points` are in the camera's space."""
    count = points.shape[0]
    sx, sy, iz = np.empty(count), np.empty(count), np.empty(count)
    for k in range(count):
        z = points[k, 2]
        if z < limit:
            iz[k] = 0.0
            continue
        iz[k] = 1.0 / z
        sx[k] = fx * points[k, 0] * iz[k] + cx
        sy[k] = fy * points[k, 1] * iz[k] + cy
    px, py, pi = np.empty(4), np.empty(4), np.empty(4)
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if iz[a] > 0.0 and iz[b] > 0.0 and iz[c] > 0.0:
            _fill(f, sx[a], sy[a], iz[a], sx[b], sy[b], iz[b], sx[c], sy[c], iz[c], near, face)
            continue
        if iz[a] == 0.0 and iz[b] == 0.0 and iz[c] == 0.0:
            continue
        corners = 0
        for k in range(3):
            p, q = points[faces[f, k]], points[faces[f, (k + 1) % 3]]
            if p[2] >= limit:
                pi[corners] = 1.0 / p[2]
                px[corners], py[corners] = fx * p[0] * pi[corners] + cx, fy * p[1] * pi[corners] + cy
                corners += 1
            if (p[2] >= limit) != (q[2] >= limit):
                t = (limit - p[2]) / (q[2] - p[2])
                pi[corners] = 1.0 / limit
                px[corners] = fx * (p[0] + t * (q[0] - p[0])) / limit + cx
                py[corners] = fy * (p[1] + t * (q[1] - p[1])) / limit + cy
                corners += 1
        for k in range(1, corners - 1):
            _fill(
                f, px[0], py[0], pi[0], px[k], py[k], pi[k], px[k + 1], py[k + 1], pi[k + 1], near, face
            )  # fmt: skip


@njit(cache=True, parallel=True, fastmath=True)
def paint(
    face, times, points, faces, uvs, light, face_texture, face_patch, atlas, levels, sizes,
    world_from_camera, fx, fy, cx, cy, background, normals, finish, mirrored, windows, box, out,
):  # fmt: skip  # pragma: no cover - compiled
    """Color every pixel from `times` x `times` samples of `face`, once per patch that they see."""
    height, width = out.shape[:2]
    samples = times * times
    for y in prange(height):
        extra, at = np.empty(3), np.empty(3)
        ray, normal = np.empty(3), np.empty(3)
        known, level, texture, a, b, c = -1, 0, 0, 0, 0, 0
        pax = pay = paz = pbx = pby = pbz = pcx = pcy = pcz = 0.0
        mx = my = mz = steep = volume = wide = high = az = bz = dz = 0.0
        for x in range(width):
            red_sum = green_sum = blue_sum = 0.0
            for sample in range(samples):
                row, column = sample // times, sample % times
                f = face[y * times + row, x * times + column]
                if f < 0:
                    red_sum += background[0]
                    green_sum += background[1]
                    blue_sum += background[2]
                    continue
                first, same = True, 1
                if samples > 1:
                    same = 0
                    for other in range(samples):
                        g = face[y * times + other // times, x * times + other % times]
                        if g == f or (g >= 0 and face_patch[g] == face_patch[f]):
                            if other < sample:
                                first = False
                                break
                            same += 1
                if not first:
                    continue
                middle = same == samples
                px = x + (0.5 if middle else (column + 0.5) / times)
                py = y + (0.5 if middle else (row + 0.5) / times)
                rx, ry = (px - cx) / fx, (py - cy) / fy
                fresh = f != known
                if fresh:
                    known = f
                    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
                    ax, ay, az = points[a, 0], points[a, 1], points[a, 2]
                    bx, by, bz = points[b, 0], points[b, 1], points[b, 2]
                    dx, dy, dz = points[c, 0], points[c, 1], points[c, 2]
                    # A corner's weight is the volume that the ray spans with the other two corners.
                    pax, pay, paz = by * dz - bz * dy, bz * dx - bx * dz, bx * dy - by * dx
                    pbx, pby, pbz = dy * az - dz * ay, dz * ax - dx * az, dx * ay - dy * ax
                    pcx, pcy, pcz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
                    volume = ax * pax + ay * pay + az * paz
                    mx, my, mz = pax + pbx + pcx, pay + pby + pcy, paz + pbz + pcz
                    steep = 1.0 / np.sqrt(max(mx * mx + my * my + mz * mz, 1e-30))
                    texture = face_texture[f]
                    wide, high = 1.0 / sizes[texture, 0], 1.0 / sizes[texture, 1]
                whole = mx * rx + my * ry + mz
                if abs(whole) < 1e-30:
                    whole = 1e-30
                inverse = 1.0 / whole
                wa = (rx * pax + ry * pay + paz) * inverse
                wb = (rx * pbx + ry * pby + pbz) * inverse
                wc = 1.0 - wa - wb
                z = volume * inverse
                if middle and (min(wa, wb, wc) < -1.0 or z <= 0.0):
                    wa = min(max(wa, 0.0), 1.0)
                    wb = min(max(wb, 0.0), 1.0 - wa)
                    wc = 1.0 - wa - wb
                    z = wa * az + wb * bz + wc * dz
                s = (wa * uvs[a, 0] + wb * uvs[b, 0] + wc * uvs[c, 0]) * wide
                t = 1.0 - (wa * uvs[a, 1] + wb * uvs[b, 1] + wc * uvs[c, 1]) * high
                s, t = s - np.floor(s), t - np.floor(t)
                if fresh or x % 4 == 0:
                    # A sample's footprint on a tilted surface decides the mip level; rows and columns take turns
                    # at rounding it up, which looks as if levels were mixed.
                    cosine = abs(whole) * steep / np.sqrt(rx * rx + ry * ry + 1.0)
                    footprint = z / fx / np.sqrt(max(cosine, 0.08)) * sizes[texture, 2]
                    wanted = np.log2(max(footprint, 1e-6)) - 0.2
                    wanted += 0.25 + 0.5 * ((x // 4 + y) % 2)
                    level = int(min(max(wanted, 0.0), levels.shape[1] - 1.0))
                red, green, blue = _sample(atlas, levels, texture, level, s, t)
                red *= wa * light[a, 0] + wb * light[b, 0] + wc * light[c, 0]
                green *= wa * light[a, 1] + wb * light[b, 1] + wc * light[c, 1]
                blue *= wa * light[a, 2] + wb * light[b, 2] + wc * light[c, 2]
                if finish[texture, 0] > 0.0:
                    norm = np.sqrt(rx * rx + ry * ry + 1.0)
                    length = 0.0
                    for k in range(3):
                        ray[k] = (
                            world_from_camera[k, 0] * rx
                            + world_from_camera[k, 1] * ry
                            + world_from_camera[k, 2]
                        )
                        at[k] = world_from_camera[k, 3] + z * ray[k]
                        ray[k] /= norm
                        normal[k] = wa * normals[a, k] + wb * normals[b, k] + wc * normals[c, k]
                        length += normal[k] * normal[k]
                    for k in range(3):
                        normal[k] /= np.sqrt(max(length, 1e-12))
                    _shine(
                        at, normal, ray, finish[texture, 0], finish[texture, 1], mirrored, windows, box, extra
                    )
                    red = _add_shine(red, extra[0])
                    green = _add_shine(green, extra[1])
                    blue = _add_shine(blue, extra[2])
                red_sum += same * red
                green_sum += same * green
                blue_sum += same * blue
                if middle:
                    break
            out[y, x, 0] = red_sum / samples
            out[y, x, 1] = green_sum / samples
            out[y, x, 2] = blue_sum / samples
