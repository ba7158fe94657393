"""Plane completion: measured depth maps -> maps whose textureless regions lie on planes of the scene.

Every pixel of a view gets one of the scene's planes as its label, or none (piecewise planar stereo). Measured pixels
vote for the plane that they lie on. Labels spread where the image has no edge, by the aggregation of `sgm` with a
Potts model. Views that look through a plane raise its cost. A labelled piece needs enough measured pixels in it.
"""

from functools import partial

import numpy as np

from reconstruction.core.types import Camera
from reconstruction.depth.scene import DepthScene

_MAX_LABELS = 20
_RIM_SHARE = (
    0.15  # least share of a blank region's rim on one plane; the rest is mostly fattened edges of objects
)
_PASSES = ((66, True), (16, False))  # greatest cost of a label, and whether the rim of a blank region votes
_OBJECTING_VIEWS = 8  # neighbors that are asked whether they look through a plane


def _anchored(label: np.ndarray, measured: np.ndarray, min_px: int) -> np.ndarray:
    """Return which labelled pixels belong to a piece of one label with enough measured pixels in it."""
    from reconstruction.depth.consistency import label_pieces

    pieces = np.zeros(label.shape, np.int32)
    size = label_pieces((label + 1).astype(np.float32), 0.0, pieces)
    anchor = np.bincount(pieces.ravel(), measured.ravel(), minlength=len(size))
    good = (anchor >= min_px) & (anchor >= 0.04 * size)
    good[0] = False
    return good[pieces]


def _fill_regions(label: np.ndarray, cost: np.ndarray, measured: np.ndarray, color: np.ndarray) -> None:
    """Label blank regions that no label reached by a vote of the measured pixels on their rim; writes `label`.

    Labels do not spread across wrong depth, such as the fattened edges of objects on a plain table. Votes are weighted
    by similarity of color; a region is labelled where one plane wins clearly.
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
    """Return 1.0 for each plane that is neither parallel nor perpendicular to the main direction, else 0.0.

    The main direction is the one that most planes are parallel or perpendicular to: the vertical, in a room. Wrong
    matches on blank surfaces make oblique planes that face the cameras.
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


def complete_depth(scene: DepthScene, depth: np.ndarray, raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fill unmeasured pixels of all views with planes of the scene; return depth and confidence (n, h, w).

    Two passes: the second one sees what the first one filled, and accepts a plane only where two other views see it.

    Args:
        scene: keyframes with their plan.
        depth: float32 (n, h, w) measured depth, 0 = unknown.
        raw: float32 (n, h, w) depth before views were compared, a weak hint.

    Returns:
        Depth float32, and confidence uint8: 2 measured, 1 completed, 0 unknown.
    """
    views = _Views(scene, depth)
    scene.each(views.prepare, "looking for planes")
    views.find_planes()
    scene.progress.note(f"depth: {len(views.planes)} planes support the completion")
    for limit, by_rim in _PASSES:
        scene.each(partial(views.complete, raw=raw, limit=limit, by_rim=by_rim), "completing planes")
        filled, trust = views.out.copy(), views.confidence.copy()
        scene.each(partial(views.confirm, filled=filled, trust=trust), "confirming planes")
        views.update_maps()
    return views.out, views.confidence


class _Views:
    """All views of a scene while their unmeasured pixels are filled with planes."""

    def __init__(self, scene: DepthScene, depth: np.ndarray) -> None:
        n, h, w = depth.shape
        scale = min(1.0, scene.config.sweep_side_px / max(w, h))
        self.scene, self.posed, self.camera, self.plan = scene, scene.posed, scene.camera, scene.plan
        self.depth = depth
        self.small = self.camera.resized(
            round(w * scale), round(h * scale)
        )  # labels are chosen at this resolution
        small = (self.small.height, self.small.width)
        self.gapless = np.empty_like(depth)  # measured depth with small gaps filled
        self.maps = np.empty((n, *small), np.float32)  # known depth at the small resolution
        self.tones = np.empty((n, *small, 3), np.uint8)  # smoothed colors
        self.clouds: list[tuple[np.ndarray, ...]] = [()] * n  # points, normals, depths
        self.planes, self.bounds, self.doubt = np.zeros((0, 4)), np.zeros((0, 16, 4)), np.zeros(0)
        self.out, self.confidence = depth, np.zeros(depth.shape, np.uint8)

    def prepare(self, i: int) -> None:
        """Fill small gaps of a view, and sample its oriented points, depth and colors."""
        import cv2

        from reconstruction.depth.fill_kernels import fill_small_gaps
        from reconstruction.depth.planes import oriented_points
        from reconstruction.depth.refine import fit_slopes

        depth, size = self.depth[i], (self.small.width, self.small.height)
        fill_small_gaps(depth, self.gapless[i])
        rho = np.where(depth > 0, 1.0 / np.maximum(depth, 1e-12), 0).astype(np.float32)
        smooth, gx, gy = (np.empty(depth.shape, np.float32) for _ in range(3))
        fit_slopes(rho, 0.01, smooth, gx, gy)
        self.clouds[i] = oriented_points(depth, gx, gy, self.camera, self.posed.world_from_camera[i])
        self.maps[i] = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST)
        self.tones[i] = cv2.GaussianBlur(self._color(i), (0, 0), 1.0)

    def find_planes(self) -> None:
        """Find the planes of the scene in the points of all views, with their extents."""
        from reconstruction.depth.planes import find_planes, plane_extents

        points, normals, depths = (np.concatenate([c[a] for c in self.clouds]) for a in range(3))
        self.planes = find_planes(
            points, normals, depths, tolerance=0.006, max_planes=48, seed=self.scene.config.seed
        )
        self.bounds = plane_extents(self.planes, points, normals, depths, tolerance=0.006)
        self.doubt = 14.0 * _crooked(self.planes)
        self.out = self.gapless.copy()
        self.confidence = np.where(self.depth > 0, 2, np.where(self.gapless > 0, 1, 0)).astype(np.uint8)

    def complete(self, i: int, raw: np.ndarray, limit: int, by_rim: bool) -> None:
        """Choose a plane, or none, for every unknown pixel of a view, and write its depth."""
        import cv2

        chosen, local = _view_planes(self.planes, self.posed.world_from_camera[i], self.maps[i], self.small)
        if len(local) == 0:
            return
        cost = self._costs(i, chosen, local, raw[i])
        label = self._labels(i, cost, limit)
        if by_rim:
            _fill_regions(label, cost, self.maps[i] > 0, self._color(i).astype(np.float32))
        size = (self.camera.width, self.camera.height)
        label = np.asarray(
            cv2.resize(label.astype(np.int16), size, interpolation=cv2.INTER_NEAREST), np.int16
        )
        y, x = np.nonzero((label >= 0) & (self.out[i] == 0))
        rays = self.camera.unproject(x + 0.5, y + 0.5, np.ones(len(x)))
        plane = local[label[y, x]]
        z = -plane[:, 3] / np.einsum("ij,ij->i", plane[:, :3], rays)
        good = np.isfinite(z) & (z > 0)
        self.out[i, y[good], x[good]] = z[good]
        self.confidence[i, y[good], x[good]] = 1

    def confirm(self, i: int, filled: np.ndarray, trust: np.ndarray) -> None:
        """Drop completed pixels of a view that other views do not see, or look through."""
        from reconstruction.depth.fill_kernels import confirm_fill

        rows, relative = self.scene.neighbors(i)
        keep = np.zeros(filled.shape[1:], bool)
        confirm_fill(i, rows, filled, trust, relative, self.camera.intrinsics, keep)
        drop = (trust[i] == 1) & ~keep & (self.gapless[i] == 0)
        self.out[i][drop] = 0
        self.confidence[i][drop] = 0

    def update_maps(self) -> None:
        """Let later passes see what was filled and confirmed."""
        import cv2

        size = (self.small.width, self.small.height)
        for i in range(len(self.maps)):
            self.maps[i] = cv2.resize(self.out[i], size, interpolation=cv2.INTER_NEAREST)

    def _costs(self, i: int, chosen: np.ndarray, local: np.ndarray, raw: np.ndarray) -> np.ndarray:
        """Return the costs uint8 (h, w, labels + 1) of the planes `local` of a view and of "none"."""
        import cv2

        from reconstruction.depth.fill_kernels import exposure_gains, label_costs

        rows, relative = (values[:_OBJECTING_VIEWS] for values in self.scene.neighbors(i))
        k = self.small.intrinsics
        hint = cv2.resize(raw, (self.small.width, self.small.height), interpolation=cv2.INTER_NEAREST)
        cost = np.empty((self.small.height, self.small.width, len(local) + 1), np.uint8)
        here = self.bounds[chosen] @ self.posed.world_from_camera[i]
        gains = np.ones(len(rows))
        exposure_gains(self.maps[i], self.tones[i], rows, relative, self.maps, self.tones, k, gains)
        label_costs(
            self.maps[i], hint, local, here, self.doubt[chosen], self.tones[i], rows, relative, self.maps, self.tones,
            gains, k, self.plan.near[i] * 0.8, self.plan.far[i], cost,
        )  # fmt: skip
        return cost

    def _labels(self, i: int, cost: np.ndarray, limit: int) -> np.ndarray:
        """Return the plane int32 (h, w) of each pixel, -1 = none: labels that spread from measured pixels."""
        import cv2

        from reconstruction.depth.fill_kernels import choose_labels
        from reconstruction.depth.sgm import aggregate

        gray = cv2.cvtColor(np.ascontiguousarray(self.posed.images[i]), cv2.COLOR_RGB2GRAY)
        size = (self.small.width, self.small.height)
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        total = np.zeros(cost.shape, np.uint16)
        aggregate(cost, gray, np.int32(20000), np.int32(260), np.int32(12), 3.0, total)
        label = np.empty(cost.shape[:2], np.int32)
        choose_labels(total, cost, self.maps[i], limit, label)
        label[~_anchored(label, self.maps[i] > 0, 40)] = -1
        return label

    def _color(self, i: int) -> np.ndarray:
        """Return the picture uint8 (h, w, 3) of a view at the small resolution."""
        import cv2

        size = (self.small.width, self.small.height)
        return cv2.resize(np.ascontiguousarray(self.posed.images[i]), size, interpolation=cv2.INTER_AREA)
