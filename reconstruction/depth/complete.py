"""Completion: fill what could not be measured with planes that the surroundings support, and small gaps.

Every view chooses, for each pixel, one of the scene's planes or none. Measured pixels vote for the plane that they
lie on; labels spread along the image where it shows no edge (the aggregation of `sgm`, with labels in place of
depths); and other views object where they looked through the plane. A fill must be anchored in measured pixels.
"""

from collections.abc import Callable

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.core.types import Camera, PosedFrames
from reconstruction.depth.config import DepthConfig
from reconstruction.depth.views import ViewPlan
from registry.geometry import invert_rigid

_MAX_LABELS = 20
_RIM_SHARE = 0.15  # of a blank region's rim that has to lie on one plane: much is skirts of what stands there
_LIMITS = (66, 16)


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
        if inlier[best] < max(12.0, _RIM_SHARE * weight.sum()):
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

    from reconstruction.depth.blank_walls import fill_walls
    from reconstruction.depth.fill_kernels import (
        choose_labels,
        confirm_fill,
        exposure_gains,
        fill_small_gaps,
        label_costs,
    )
    from reconstruction.depth.planes import find_planes, oriented_points, plane_extents
    from reconstruction.depth.refine import fit_slopes
    from reconstruction.depth.sgm import aggregate

    n, h, w = depth.shape
    scale = min(1.0, config.sweep_side_px / max(w, h))
    small = camera.resized(round(w * scale), round(h * scale))
    size = (small.width, small.height)
    gapless = np.empty_like(depth)
    maps = np.empty((n, small.height, small.width), np.float32)
    tones = np.empty((n, small.height, small.width, 3), np.uint8)
    clouds: list[tuple] = [()] * n

    def prepare(i: int) -> None:
        fill_small_gaps(depth[i], gapless[i])
        rho = np.where(depth[i] > 0, 1.0 / np.maximum(depth[i], 1e-12), 0).astype(np.float32)
        smooth, gx, gy = (np.empty((h, w), np.float32) for _ in range(3))
        fit_slopes(rho, 0.01, smooth, gx, gy)
        clouds[i] = oriented_points(depth[i], gx, gy, camera, posed.world_from_camera[i])
        maps[i] = cv2.resize(depth[i], size, interpolation=cv2.INTER_NEAREST)
        color = cv2.resize(np.ascontiguousarray(posed.images[i]), size, interpolation=cv2.INTER_AREA)
        tones[i] = cv2.GaussianBlur(color, (0, 0), 1.0)

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
        gains = np.ones(len(rows))
        exposure_gains(maps[i], tones[i], rows, relative, maps, tones, k, gains)
        label_costs(
            maps[i],
            hint,
            local,
            here,
            doubt[chosen],
            tones[i],
            rows,
            relative,
            maps,
            tones,
            gains,
            k,
            near,
            far,
            cost,
        )
        gray = cv2.cvtColor(np.ascontiguousarray(posed.images[i]), cv2.COLOR_RGB2GRAY)
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        total = np.zeros(cost.shape, np.uint16)
        aggregate(cost, gray, np.int32(20000), np.int32(260), np.int32(12), 3.0, total)
        label = np.empty((small.height, small.width), np.int32)
        choose_labels(total, cost, maps[i], limit, label)
        label[~_anchored(label, maps[i] > 0, 40)] = -1
        color = cv2.resize(np.ascontiguousarray(posed.images[i]), size, interpolation=cv2.INTER_AREA)
        if limit == _LIMITS[0]:
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

    fine = np.array([camera.fx, camera.fy, camera.cx, camera.cy])

    def confirm(i: int) -> None:
        rows = plan.neighbors[i]
        relative = invert_rigid(posed.world_from_camera[np.maximum(rows, 0)]) @ posed.world_from_camera[i]
        keep = np.zeros((h, w), bool)
        confirm_fill(i, rows, filled, trust, relative, fine, keep)
        drop = (trust[i] == 1) & ~keep & (gapless[i] == 0)
        out[i][drop] = 0
        confidence[i][drop] = 0

    for limit in _LIMITS:
        each(n, complete, "completing planes", progress)
        if limit == _LIMITS[0]:
            for i in range(n):
                maps[i] = cv2.resize(out[i], size, interpolation=cv2.INTER_NEAREST)
            walls, extents = fill_walls(posed, small, maps, tones, planes, plan, out, confidence)
            planes, bounds = np.concatenate([planes, walls]), np.concatenate([bounds, extents])
            doubt = np.concatenate([doubt, np.zeros(len(walls))])
            progress.note(f"depth: {len(walls)} blank planes stand on lines in measured ones")
        filled, trust = out.copy(), confidence.copy()
        each(n, confirm, "confirming planes", progress)
        # What was filled and confirmed speaks to the views that could not decide.
        for i in range(n):
            maps[i] = cv2.resize(out[i], size, interpolation=cv2.INTER_NEAREST)
    return out, confidence
