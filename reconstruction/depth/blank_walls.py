"""Blank planes known by nothing but the line in which they meet a measured one: a painted wall that ends a floor.

In one view such a line may as well be the rim of something that hides what is behind it. But where a hidden floor
begins depends on where the camera stands, and where a wall stands does not: views from different sides must find one
line. The plane stands square on the measured one, faces the cameras, and fills the blank regions that end on its line.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.types import Camera, PosedFrames
from reconstruction.depth.planes import plane_extents
from reconstruction.depth.views import ViewPlan

_MIN_REGION = 0.012  # of the image
_MIN_SHADING = 4.0  # gray levels
_EDGE_PX = 3  # from a region to the image edge that bounds it
_SUPPORT_PX = 6  # from there to measured pixels of the plane
_MIN_POINTS = 25
_MIN_SHARE = 0.6  # of a boundary that must lie on one straight line
_TOLERANCE = 0.01  # of the depth, across the line
_MIN_LENGTH = 0.15  # of the depth
_MIN_VIEWS = 3
_MIN_TURN = np.radians(4.0)  # of the line of sight about the line, between the views that found it
_BASES = 12  # planes that a blank one may end on
_MAX_LINES = 24
_SQUARE = 0.35  # cosine between the two measured planes
_PARALLEL = np.cos(np.radians(5.0))


def fill_walls(
    posed: PosedFrames, camera: Camera, maps: np.ndarray, tones: np.ndarray, planes: np.ndarray,
    plan: ViewPlan, depth: np.ndarray, confidence: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Fill blank planes in depth and confidence (n, h, w), in place; return them (k, 4) and their extents.

    Args:
        posed: Frames with cameras.
        camera: That of `maps`.
        maps: (n, h', w') what is known of depth so far.
        tones: uint8 (n, h', w', 3) colors.
        planes: (m, 4) of the scene, the best supported first.
        plan: Depth ranges.
        depth: Written where it is 0.
        confidence: Written with 1 there.
    """
    poses = posed.world_from_camera
    regions, boundaries = [], []
    for i in range(len(maps)):
        region, edges = blank_regions(tones[i].astype(np.float32), maps[i] > 0)
        regions.append(region)
        boundaries += find_boundaries(i, region, edges, maps[i], planes[:_BASES], poses[i], camera, i)
    walls = find_walls(boundaries, planes, poses[:, :3, 3])
    h, w = depth.shape[1:]
    extents = np.zeros((len(walls), 16, 4))
    fine = camera.resized(w, h)
    for row, (plane, group) in enumerate(walls):
        cloud, away = [np.zeros((0, 3))], [np.zeros(0)]
        for view, region in sorted({(b.view, b.region) for b in group}):
            # Up to the edge that bounds the region, which belongs to neither side.
            mask = cv2.dilate((regions[view] == region).astype(np.uint8), np.ones((3, 3), np.uint8))
            mask = cv2.resize(mask, (w, h), interpolation=cv2.INTER_NEAREST) > 0
            y, x = np.nonzero(mask & (depth[view] == 0))
            rays = np.stack(
                [(x + 0.5 - fine.cx) / fine.fx, (y + 0.5 - fine.cy) / fine.fy, np.ones(len(x))], 1
            )
            local = plane @ poses[view]
            z = -local[3] / (rays @ local[:3])
            good = (z > 0.8 * plan.near[view]) & (z < 1.2 * plan.far[view])
            depth[view, y[good], x[good]], confidence[view, y[good], x[good]] = z[good], 1
            points = rays[good][::7] * z[good][::7, None]
            cloud.append(points @ poses[view, :3, :3].T + poses[view, :3, 3])
            away.append(z[good][::7])
        points, depths = np.concatenate(cloud), np.concatenate(away)
        if len(points):
            normals = np.broadcast_to(plane[:3], points.shape)
            extents[row] = plane_extents(plane[None], points, normals, depths, tolerance=0.006)[0]
    return np.array([plane for plane, _ in walls]).reshape(-1, 4), extents


@dataclass(frozen=True)
class Boundary:
    """Where a blank region of a view ends on a measured plane."""

    view: int
    region: int  # label in the view's map of regions
    plane: int  # row of the measured plane
    points: np.ndarray  # float64 (m, 3) in the world, on the plane
    depths: np.ndarray  # float64 (m,) in the view
    direction: np.ndarray | None  # float64 (3,) of the straight line that most of them are on, None: of none
    origin: np.ndarray | None


def blank_regions(color: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return large unknown regions without image edges (h, w), 0 = none, and the image's edges bool (h, w).

    `color` (h, w, 3) is smoothed, `known` bool (h, w). Light falls unevenly on any surface of that size: what shows
    none of it is overexposed, or no surface at all.
    """
    gray = np.clip(color.mean(2), 0, 255).astype(np.uint8)
    edges = cv2.Canny(gray, 12, 30) > 0
    _, pieces, stats, _ = cv2.connectedComponentsWithStats((~known & ~edges).astype(np.uint8), connectivity=4)
    left_out = stats[:, cv2.CC_STAT_AREA] < _MIN_REGION * known.size
    left_out[0] = True
    smooth = cv2.GaussianBlur(color.mean(2).astype(np.float32), (0, 0), 2.0)
    for piece in np.flatnonzero(~left_out):
        inside = cv2.erode((pieces == piece).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        low, high = np.percentile(smooth[inside], [2, 98]) if inside.any() else (0.0, 0.0)
        left_out[piece] = high - low < _MIN_SHADING
    return np.where(left_out[pieces], 0, pieces), edges


def find_boundaries(
    view: int, regions: np.ndarray, edges: np.ndarray, depth: np.ndarray, planes: np.ndarray,
    world_from_camera: np.ndarray, camera: Camera, seed: int,
) -> list[Boundary]:  # fmt: skip
    """Return where the blank regions of a view end on planes (k, 4) of the world that it measured."""
    out: list[Boundary] = []
    if not regions.any():
        return out
    local = planes @ world_from_camera
    y, x = np.mgrid[: depth.shape[0], : depth.shape[1]]
    rays = np.stack(
        [(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, np.ones(depth.shape)], -1
    )
    slope = rays @ local[:, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        plane_depth = -local[:, 3] / slope
    near_region = np.ones((2 * _EDGE_PX + 1,) * 2, np.uint8)
    near_plane = np.ones((2 * _SUPPORT_PX + 1,) * 2, np.uint8)
    for row in range(len(planes)):
        z = plane_depth[..., row]
        on = (depth > 0) & (np.abs(depth / z - 1.0) < 0.006)
        if on.sum() < 400:
            continue
        reached = cv2.dilate(on.astype(np.uint8), near_plane) > 0
        for region in np.unique(regions[regions > 0]):
            beside = cv2.dilate((regions == region).astype(np.uint8), near_region) > 0
            at = edges & beside & reached & (z > 0) & np.isfinite(z)
            if at.sum() < _MIN_POINTS:
                continue
            depths = z[at]
            points = (rays[at] * depths[:, None]) @ world_from_camera[:3, :3].T + world_from_camera[:3, 3]
            origin, direction = _straight(points, depths, seed)
            out.append(Boundary(view, int(region), row, points, depths, direction, origin))
    return out


def _straight(points: np.ndarray, depths: np.ndarray, seed: int):
    """Return origin and direction (3,) of the line that most of the points are on, or two None."""
    rng = np.random.default_rng(seed)
    pairs = rng.integers(0, len(points), (120, 2))
    run = points[pairs[:, 1]] - points[pairs[:, 0]]
    length = np.linalg.norm(run, axis=1)
    good = length > 0.3 * _MIN_LENGTH * np.median(depths)
    if not good.any():
        return None, None
    direction, origin = run[good] / length[good, None], points[pairs[good, 0]]
    inside = np.stack([_off_line(points, o, d) < _TOLERANCE * depths for o, d in zip(origin, direction)])
    best = inside[int(np.argmax(inside.sum(1)))]
    if best.mean() < _MIN_SHARE or best.sum() < _MIN_POINTS:
        return None, None
    center, axis = _fit_line(points[best])
    along = (points[best] - center) @ axis
    if np.ptp(along) < _MIN_LENGTH * np.median(depths):
        return None, None
    return center, axis


def _fit_line(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    center = points.mean(0)
    return center, np.linalg.svd(points - center, full_matrices=False)[2][0]


def _off_line(points: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    away = points - origin
    return np.linalg.norm(away - (away @ direction)[:, None] * direction, axis=1)


def find_walls(
    boundaries: list[Boundary], planes: np.ndarray, centers: np.ndarray
) -> list[tuple[np.ndarray, list[Boundary]]]:
    """Return planes (4,) that two measured planes bear out, and the boundaries of the blank regions they fill.

    A line alone leaves open how the plane on it stands. Square to its plane is a guess; that the lines on two measured
    planes lead to one and the same plane is evidence.
    """
    guesses = _stand_on_lines(boundaries, planes, centers)
    out: list[tuple[np.ndarray, list[Boundary]]] = []
    used: set[int] = set()
    for i, (plane, group) in enumerate(guesses):
        for j in range(i + 1, len(guesses)):
            other, rest = guesses[j]
            places = {(b.view, b.region) for b in group} & {(b.view, b.region) for b in rest}
            if i in used or j in used or group[0].plane == rest[0].plane or len(places) < _MIN_VIEWS:
                continue
            square = abs(planes[group[0].plane, :3] @ planes[rest[0].plane, :3]) < _SQUARE
            if not square or plane[:3] @ other[:3] < _PARALLEL:
                continue
            both = [b for b in group + rest if (b.view, b.region) in places]
            found = _through(both, plane)
            if found is not None:
                out.append((found, both))
                used |= {i, j}
    return out


def _through(boundaries: list[Boundary], like: np.ndarray) -> np.ndarray | None:
    """Fit a plane to the boundaries' points; None if it does not hold for each of the two lines."""
    points = np.concatenate([b.points for b in boundaries])
    depths = np.concatenate([b.depths for b in boundaries])
    plane, near = like, np.ones(len(points), bool)
    for tolerance in (3 * _TOLERANCE, 2 * _TOLERANCE, _TOLERANCE):
        near = np.abs(points @ plane[:3] + plane[3]) < tolerance * depths
        if near.sum() < _MIN_POINTS:
            return None
        center = points[near].mean(0)
        normal = np.linalg.svd(points[near] - center, full_matrices=False)[2][2]
        normal *= np.sign(normal @ like[:3])
        plane = np.append(normal, -normal @ center)
    for row in {b.plane for b in boundaries}:
        own = np.concatenate(
            [np.abs(b.points @ plane[:3] + plane[3]) / b.depths for b in boundaries if b.plane == row]
        )
        if (own < _TOLERANCE).mean() < _MIN_SHARE:
            return None
    return plane if plane[:3] @ like[:3] > _PARALLEL else None


def _stand_on_lines(boundaries: list[Boundary], planes: np.ndarray, centers: np.ndarray):
    """Return planes square to measured ones on lines that views found from different sides, with their groups."""
    out: list[tuple[np.ndarray, list[Boundary]]] = []
    left = list(boundaries)
    while len(out) < _MAX_LINES:
        best: list[Boundary] = []
        for one in left:
            if one.direction is not None:
                group = [
                    b
                    for b in left
                    if b.plane == one.plane and _share_on(b, one.origin, one.direction) >= _MIN_SHARE
                ]
                best = group if len(group) > len(best) else best
        if len({b.view for b in best}) < _MIN_VIEWS:
            return out
        left = [b for b in left if not any(b is other for other in best)]
        points, depths = np.concatenate([b.points for b in best]), np.concatenate([b.depths for b in best])
        origin, direction = _straight(points, depths, len(out))
        if direction is None:
            continue
        base = planes[best[0].plane, :3]
        across = np.cross(base, direction)
        across /= np.linalg.norm(across)
        eyes = centers[[b.view for b in best]] - origin
        angle = np.arctan2(eyes @ base, eyes @ across)
        normal = across * np.sign(np.median(eyes @ across) or 1.0)
        if np.ptp(angle) >= _MIN_TURN and (eyes @ normal > 0).all():
            out.append((np.append(normal, -normal @ origin), best))
    return out


def _share_on(boundary: Boundary, origin: np.ndarray, direction: np.ndarray) -> float:
    return float((_off_line(boundary.points, origin, direction) < _TOLERANCE * boundary.depths).mean())
