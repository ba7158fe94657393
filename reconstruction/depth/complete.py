"""Completion: fill what could not be measured with planes that the surroundings support, and small gaps.

Every view chooses, for each pixel, one of the scene's planes or none. Measured pixels vote for the plane that they
lie on; labels spread along the image where it shows no edge (the aggregation of `sgm`, with labels in place of
depths); and other views object where they looked through the plane. A fill must be anchored in measured pixels.
"""

from collections.abc import Callable

import numba
import numpy as np

from reconstruction.depth.config import DepthConfig
from reconstruction.depth.views import ViewPlan
from reconstruction.progress import Progress
from reconstruction.types import Camera, PosedFrames
from registry.geometry import invert_rigid

_MAX_LABELS = 20


@numba.njit(cache=True, nogil=True)
def fill_small_gaps(depth, out):  # pragma: no cover - compiled
    """Fill pixels that measured ones of a single surface surround (5x5, both sides) with the plane through them."""
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
def label_costs(
    depth, raw, planes, bounds, doubt, neighbors, relative, maps, k, near, far, cost
):  # pragma: no cover - compiled
    """Fill cost (h, w, labels + 1): how badly each plane suits a pixel; the last label is "no plane".

    Args:
        depth: (h, w) measured depth, 0 = none.
        raw: (h, w) depth before it was checked: a weak hint.
        planes: (labels, 4) in this camera's space: inverse depth = -(n . r) / d.
        bounds: (labels, sides, 4) within which each plane was measured, in this camera's space.
        doubt: (labels,) what filling with a plane costs more, because few things in a room lie like it.
        neighbors: (m,) rows of `maps`, -1 = none.
        relative: (m, 4, 4) neighbour_from_view.
        maps: (n, h, w) measured depth of all views.
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
                through, agree = 0, 0
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
                    m = relative[s]
                    qz = q * (m[2, 0] * xn + m[2, 1] * yn + m[2, 2]) + m[2, 3]
                    if qz <= 1e-9:
                        continue
                    u = fx * (q * (m[0, 0] * xn + m[0, 1] * yn + m[0, 2]) + m[0, 3]) / qz + cx
                    v = fy * (q * (m[1, 0] * xn + m[1, 1] * yn + m[1, 2]) + m[1, 3]) / qz + cy
                    if not (u >= 0.0 and v >= 0.0 and u < w and v < h):
                        continue
                    d = maps[j, int(v), int(u)]
                    if d > 1.025 * qz:
                        through += 1
                    elif d > 0.985 * qz and d < 1.015 * qz:
                        agree += 1
                value = 44.0 + doubt[c] + 40.0 * through - 15.0 * min(agree, 2)
                if raw[y, x] > 0.0 and abs(raw[y, x] * rho - 1.0) < 0.015:
                    value -= 12.0
                cost[y, x, c] = np.uint8(min(200.0, max(0.0, value)))


@numba.njit(cache=True, nogil=True)
def choose_labels(total, cost, depth, label):  # pragma: no cover - compiled
    """Write the cheapest label, or -1 where it is "none" or where another view objects to it."""
    h, w, n = total.shape
    for y in range(h):
        for x in range(w):
            best, at = np.int64(1 << 40), n - 1
            for c in range(n):
                if total[y, x, c] < best:
                    best, at = np.int64(total[y, x, c]), c
            label[y, x] = at
            if at == n - 1 or cost[y, x, at] > (30 if depth[y, x] > 0.0 else 66):
                label[y, x] = -1


@numba.njit(cache=True, nogil=True)
def confirm_fill(i, neighbors, depth, confidence, relative, k, keep):  # pragma: no cover - compiled
    """Mark in keep (h, w) the completed pixels of view i that the completed maps of other views bear out.

    The planes are the scene's, so right fills meet in space; what was filled with the wrong one differs from view to
    view, or other views look through it.
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
                m = relative[s]
                qz = z * (m[2, 0] * xn + m[2, 1] * yn + m[2, 2]) + m[2, 3]
                if qz <= 1e-9:
                    continue
                u = fx * (z * (m[0, 0] * xn + m[0, 1] * yn + m[0, 2]) + m[0, 3]) / qz + cx
                v = fy * (z * (m[1, 0] * xn + m[1, 1] * yn + m[1, 2]) + m[1, 3]) / qz + cy
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


def _anchored(label: np.ndarray, measured: np.ndarray, min_px: int) -> np.ndarray:
    """Return which labelled pixels belong to a piece of one label with enough measured pixels in it."""
    import cv2

    keep = np.zeros(label.shape, bool)
    for value in np.unique(label[label >= 0]):
        count, pieces = cv2.connectedComponents((label == value).astype(np.uint8), connectivity=4)
        size = np.bincount(pieces.ravel(), minlength=count)
        anchor = np.bincount(pieces.ravel(), measured.ravel(), minlength=count)
        good = (anchor >= min_px) & (anchor >= 0.04 * size)
        good[0] = False
        keep |= good[pieces]
    return keep


def _fill_regions(label: np.ndarray, cost: np.ndarray, measured: np.ndarray, color: np.ndarray) -> None:
    """Give blank regions that no label reached the plane that the measured pixels around them lie on, in place.

    The spreading of labels dies where wrong depth surrounds a blank surface, as around things on a plain table. Here
    the whole rim of a region votes, pixels of the region's own colour first, and the vote must be clear.
    """
    import cv2

    gray = np.clip(color.mean(2), 0, 255).astype(np.uint8)
    edges = cv2.Canny(cv2.GaussianBlur(gray, (0, 0), 1.0), 12, 30) > 0
    hole = ((label < 0) & ~measured & ~edges).astype(np.uint8)
    count, pieces, stats, _ = cv2.connectedComponentsWithStats(hole, connectivity=4)
    ring_kernel = np.ones((9, 9), np.uint8)
    for piece in range(1, count):
        x, y, w, h, area = stats[piece]
        if area < 60:
            continue
        box = (slice(max(0, y - 5), y + h + 5), slice(max(0, x - 5), x + w + 5))
        region = pieces[box] == piece
        ring = (cv2.dilate(region.astype(np.uint8), ring_kernel) > 0) & measured[box]
        if ring.sum() < 15:
            continue
        tone = np.median(color[box][region], axis=0)
        weight = np.exp(-0.5 * (np.abs(color[box][ring] - tone).max(1) / 12.0) ** 2)
        inlier = ((cost[box][ring][:, :-1] < 30) * weight[:, None]).sum(0)
        inside = cost[box][region][:, :-1]
        objection = ((inside > 66) & (inside < 255)).mean(0) + ((inside == 255).mean(0) > 0.5)
        inlier[objection > 0.1] = 0.0
        order = np.argsort(-inlier, kind="stable")
        best = int(order[0])
        if inlier[best] < max(12.0, 0.2 * weight.sum()):
            continue
        # A rival counts only if it is another surface: pixels on both planes vote for both.
        both = ((cost[box][ring][:, :-1] < 30) & (cost[box][ring][:, best : best + 1] >= 30)) * weight[
            :, None
        ]
        rival = both.sum(0)
        rival[objection > 0.1] = 0.0
        if inlier[best] > 1.5 * rival.max():
            label[box][region & (cost[box][..., best] < 255)] = best


def _crooked(planes: np.ndarray) -> np.ndarray:
    """Return 1.0 for each plane that is neither parallel nor square to the room's main direction, else 0.0.

    That is the direction to which most planes are parallel or square: the vertical, in a room. Shells that wrong
    matches of blank surfaces leave behind face the cameras and are crooked.
    """
    if len(planes) == 0:
        return np.zeros(0)
    cosine = np.abs(planes[:, :3] @ planes[:, :3].T)
    straight = (cosine > 0.996) | (cosine < 0.087)
    # The largest planes come first and weigh most.
    weight = 1.0 / np.arange(2, len(planes) + 2)
    main = int(np.argmax((straight * weight).sum(1)))
    return np.where(straight[main], 0.0, 1.0)


def _view_planes(
    planes: np.ndarray, world_from_camera: np.ndarray, depth, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and camera-space planes that enough measured pixels of this view lie on, best first."""
    local = planes @ world_from_camera  # a plane is a row vector: p_camera = p_world @ world_from_camera
    y, x = np.nonzero(depth[1::3, 1::3])
    y, x = y * 3 + 1, x * 3 + 1
    rays = np.stack([(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, np.ones(len(x))])
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = -(local[:, :3] @ rays) / local[:, 3:] * depth[y, x]
    support = (np.abs(ratio - 1.0) < 0.006).sum(1)
    order = np.argsort(-support, kind="stable")[:_MAX_LABELS]
    order = order[support[order] >= 15]
    return order, np.ascontiguousarray(local[order])


def complete_depth(
    posed: PosedFrames, camera: Camera, plan: ViewPlan, depth: np.ndarray, raw: np.ndarray, config: DepthConfig,
    each: Callable, progress: Progress,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return completed depth and confidence (n, h, w): 2 measured, 1 completed, 0 unknown."""
    import cv2

    from reconstruction.depth.planes import find_planes, oriented_points, plane_extents
    from reconstruction.depth.refine import fit_slopes
    from reconstruction.depth.sgm import aggregate

    n, h, w = depth.shape
    scale = min(1.0, config.sweep_side_px / max(w, h))
    small = camera.resized(round(w * scale), round(h * scale))
    size = (small.width, small.height)
    gapless = np.empty_like(depth)
    maps = np.empty((n, small.height, small.width), np.float32)
    clouds: list[tuple] = [()] * n

    def prepare(i: int) -> None:
        fill_small_gaps(depth[i], gapless[i])
        rho = np.where(depth[i] > 0, 1.0 / np.maximum(depth[i], 1e-12), 0).astype(np.float32)
        smooth, gx, gy = (np.empty((h, w), np.float32) for _ in range(3))
        fit_slopes(rho, 0.01, smooth, gx, gy)
        clouds[i] = oriented_points(depth[i], gx, gy, camera, posed.world_from_camera[i])
        maps[i] = cv2.resize(depth[i], size, interpolation=cv2.INTER_NEAREST)

    each(n, prepare, "looking for planes", progress)
    points, normals, depths = (np.concatenate([c[a] for c in clouds]) for a in range(3))
    planes = find_planes(points, normals, depths, tolerance=0.006, max_planes=48, seed=config.seed)
    progress.note(f"depth: {len(planes)} planes support the completion")
    bounds = plane_extents(planes, points, normals, depths, tolerance=0.006)
    doubt = 14.0 * _crooked(planes)
    out, confidence = gapless.copy(), np.where(depth > 0, 2, np.where(gapless > 0, 1, 0)).astype(np.uint8)
    k = np.array([small.fx, small.fy, small.cx, small.cy])

    def complete(i: int) -> None:
        chosen, local = _view_planes(planes, posed.world_from_camera[i], maps[i], small)
        if len(local) == 0:
            return
        rows = plan.neighbors[i][:8]
        relative = invert_rigid(posed.world_from_camera[np.maximum(rows, 0)]) @ posed.world_from_camera[i]
        hint = cv2.resize(raw[i], size, interpolation=cv2.INTER_NEAREST)
        cost = np.empty((small.height, small.width, len(local) + 1), np.uint8)
        here = bounds[chosen] @ posed.world_from_camera[i]
        near, far = plan.near[i] * 0.8, plan.far[i]
        label_costs(maps[i], hint, local, here, doubt[chosen], rows, relative, maps, k, near, far, cost)
        gray = cv2.cvtColor(np.ascontiguousarray(posed.images[i]), cv2.COLOR_RGB2GRAY)
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        total = np.zeros(cost.shape, np.uint16)
        aggregate(cost, gray, np.int32(20000), np.int32(260), np.int32(12), 3.0, total)
        label = np.empty((small.height, small.width), np.int32)
        choose_labels(total, cost, maps[i], label)
        label[~_anchored(label, maps[i] > 0, 40)] = -1
        color = cv2.resize(np.ascontiguousarray(posed.images[i]), size, interpolation=cv2.INTER_AREA)
        _fill_regions(label, cost, maps[i] > 0, color.astype(np.float32))
        label = cv2.resize(label.astype(np.int16), (w, h), interpolation=cv2.INTER_NEAREST)
        y, x = np.nonzero((label >= 0) & (out[i] == 0))
        rays = np.stack(
            [(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, np.ones(len(x))], 1
        )
        plane = local[label[y, x]]
        z = -plane[:, 3] / np.einsum("ij,ij->i", plane[:, :3], rays)
        good = np.isfinite(z) & (z > 0)
        out[i, y[good], x[good]] = z[good]
        confidence[i, y[good], x[good]] = 1

    each(n, complete, "completing planes", progress)
    filled, trust = out.copy(), confidence.copy()
    fine = np.array([camera.fx, camera.fy, camera.cx, camera.cy])

    def confirm(i: int) -> None:
        rows = plan.neighbors[i]
        relative = invert_rigid(posed.world_from_camera[np.maximum(rows, 0)]) @ posed.world_from_camera[i]
        keep = np.zeros((h, w), bool)
        confirm_fill(i, rows, filled, trust, relative, fine, keep)
        drop = (trust[i] == 1) & ~keep & (gapless[i] == 0)
        out[i][drop] = 0
        confidence[i][drop] = 0

    each(n, confirm, "confirming planes", progress)
    return out, confidence
