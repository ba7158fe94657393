"""Fit the base planes of the room (floor, walls, ceiling) to the surface mesh and assign vertices to them."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.surface.config import SurfaceConfig

_MAX_WALLS = 8
_MOST_CAMERAS = 24  # from which surface behind a plane is looked at


@dataclass(frozen=True)
class FittedPlane:
    """A base plane and its vertices."""

    label: str  # "floor" | "wall" | "ceiling"
    plane: np.ndarray  # float64 (4,) n . x + d = 0 in metres, n unit and into the room
    band_m: float  # largest distance of vertices that belong to the plane
    members: np.ndarray  # bool (v,)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return signed distances (n,) of points (n, 3), metres, positive in the room."""
        return points @ self.plane[:3] + self.plane[3]


def _band(residuals: np.ndarray, low: float, high: float) -> float:
    """Return three robust standard deviations (by the median absolute deviation) of residuals, within [low, high]."""
    sigma = 1.4826 * float(np.median(np.abs(residuals - np.median(residuals)))) if len(residuals) else low
    return float(np.clip(3.0 * sigma, low, high))


def fit_floor(graph: MeshGraph, config: SurfaceConfig) -> FittedPlane | None:
    """Fit the floor near z = 0 by a height histogram and trimmed least squares; None if too little was seen."""
    z = graph.points[:, 2]
    flat = (graph.normals[:, 2] > 0.8) & (np.abs(z) < 0.06)
    if graph.areas[flat].sum() < config.min_floor_area_m2:
        return None
    histogram, bounds = np.histogram(z[flat], bins=np.arange(-0.06, 0.0601, 0.005), weights=graph.areas[flat])
    peak = int(np.argmax(np.convolve(histogram, [1, 2, 1], "same")))
    height = 0.5 * (bounds[peak] + bounds[peak + 1])
    slope = np.zeros(2)
    for _ in range(3):  # z = slope . xy + height
        residual = z - graph.points[:, :2] @ slope - height
        near = flat & (np.abs(residual) < 0.02)
        weights = np.sqrt(graph.areas[near])
        design = np.column_stack([graph.points[near, :2], np.ones(near.sum())]) * weights[:, None]
        solution = np.linalg.lstsq(design, z[near] * weights, rcond=None)[0]
        if np.linalg.norm(solution[:2]) > 0.03:  # 1.7 degrees: objects tilted the fit
            break
        slope, height = solution[:2], float(solution[2])
    normal = np.array([-slope[0], -slope[1], 1.0])
    scale = np.linalg.norm(normal)
    plane = np.append(normal, -height) / scale
    residual = graph.points @ plane[:3] + plane[3]
    band = _band(residual[flat & (np.abs(residual) < 0.03)], 0.01, 0.03)
    up = graph.normals[:, 2]
    members = (residual < band) & (up > 0.6)
    members |= residual < 0.5 * band
    return FittedPlane("floor", plane, band, members)


def fit_walls(
    graph: MeshGraph, taken: np.ndarray, config: SurfaceConfig, centers: np.ndarray | None = None
) -> list[FittedPlane]:
    """Find walls: large vertical planes without surface that is seen past them, and not behind a larger wall.

    Args:
        graph: the surface.
        taken: bool (v,) vertices that are excluded.
        config: least sizes.
        centers: float (k, 3) of the cameras; None: all surface behind a plane counts as seen past it.
    """
    upright = (np.abs(graph.normals[:, 2]) < 0.35) & ~taken
    candidates: list[tuple[np.ndarray, np.ndarray, float]] = []
    free = upright.copy()
    for _ in range(3 * _MAX_WALLS):
        found = _strongest_upright_plane(graph, free, config)
        if found is None:
            break
        plane, inliers, area = found
        free &= ~inliers
        candidates.append((plane, inliers, area))
    walls: list[FittedPlane] = []
    behind = np.zeros(len(graph.points), bool)  # vertices behind or on the walls found so far
    for plane, inliers, area in candidates:
        if len(walls) == _MAX_WALLS or graph.areas[inliers & behind].sum() > 0.5 * area:
            continue
        if _bounds_the_room(graph, plane, inliers, area, candidates, config, centers):
            distance = graph.points @ plane[:3] + plane[3]
            band = _band(distance[inliers], 0.012, 0.035)
            within = _within_extent(graph, plane, inliers)
            members = ~taken & (distance < band) & (distance > -0.08) & within
            members &= (graph.normals @ plane[:3] > 0.55) | (distance < 0.5 * band)
            walls.append(FittedPlane("wall", plane, band, members))
            taken = taken | members
            behind |= (distance < band) & within
    return walls


def _strongest_upright_plane(
    graph: MeshGraph, free: np.ndarray, config: SurfaceConfig
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Return (plane, inliers, area) of the vertical plane with the largest free area; None if none is wall-sized.

    Histograms of azimuth and then of offset give the start; `_refined` fits it.
    """
    index = np.flatnonzero(free)
    if graph.areas[index].sum() < config.min_wall_area_m2:
        return None
    azimuth = np.arctan2(graph.normals[index, 1], graph.normals[index, 0])
    areas = graph.areas[index]
    histogram = np.bincount((np.degrees(azimuth) % 360).astype(int) % 360, weights=areas, minlength=360)
    padded = np.concatenate([histogram[-6:], histogram, histogram[:6]])
    smooth = np.convolve(padded, np.hanning(13), "valid")
    best: tuple[float, np.ndarray] | None = None
    for _ in range(6):
        peak = int(np.argmax(smooth))
        direction = np.radians(peak + 0.5)
        smooth[(np.arange(peak - 15, peak + 16)) % 360] = 0
        normal = np.array([np.cos(direction), np.sin(direction), 0.0])
        facing = graph.normals[index] @ normal > 0.9
        offsets = graph.points[index[facing]] @ normal
        if len(offsets) == 0:
            continue
        bins = np.arange(offsets.min() - 0.03, offsets.max() + 0.04, 0.01)
        counts = np.convolve(np.histogram(offsets, bins, weights=areas[facing])[0], np.ones(5), "same")
        place = int(np.argmax(counts))
        if best is None or counts[place] > best[0]:
            best = (counts[place], np.append(normal, -(bins[place] + 0.005)))
    if best is None or best[0] < 0.5 * config.min_wall_area_m2:
        return None
    return _refined(graph, free, best[1], config)


def _refined(
    graph: MeshGraph, free: np.ndarray, plane: np.ndarray, config: SurfaceConfig
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Refit a vertical plane to its inliers in shrinking bands; None if too little area is left."""
    for width in (0.06, 0.04, 0.03):
        distance = graph.points @ plane[:3] + plane[3]
        inliers = free & (np.abs(distance) < width) & (graph.normals @ plane[:3] > 0.8)
        if inliers.sum() < 10:
            return None
        weights = graph.areas[inliers]
        xy = graph.points[inliers, :2]
        center = np.average(xy, axis=0, weights=weights)
        spread = ((xy - center) * weights[:, None]).T @ (xy - center)
        normal = np.linalg.eigh(spread)[1][:, 0]
        if normal @ plane[:2] < 0:
            normal = -normal
        if normal @ plane[:2] < 0.97:  # a short patch does not determine its direction: keep the former one
            normal = plane[:2]
        plane = np.array([normal[0], normal[1], 0.0, -normal @ center])
    distance = graph.points @ plane[:3] + plane[3]
    inliers = free & (np.abs(distance) < 0.04) & (graph.normals @ plane[:3] > 0.75)
    area = float(graph.areas[inliers].sum())
    return (plane, inliers, area) if area >= 0.5 * config.min_wall_area_m2 else None


def _along(graph: MeshGraph, plane: np.ndarray) -> np.ndarray:
    """Return the horizontal coordinates (v,) of all vertices along a wall."""
    return graph.points[:, :2] @ np.array([-plane[1], plane[0]])


def _within_extent(graph: MeshGraph, plane: np.ndarray, inliers: np.ndarray) -> np.ndarray:
    along = _along(graph, plane)
    low, high = np.percentile(along[inliers], [0.5, 99.5])
    return (along > low - 0.15) & (along < high + 0.15)


def _bounds_the_room(
    graph, plane, inliers, area, candidates, config: SurfaceConfig, centers: np.ndarray | None
) -> bool:
    """Tell a wall from the side of furniture by its size, surface seen past it and parallel candidates."""
    if area < config.min_wall_area_m2:
        return False
    along = _along(graph, plane)
    low, high = np.percentile(along[inliers], [1, 99])
    bottom, top = np.percentile(graph.points[inliers, 2], [1, 99])
    if high - low < config.min_wall_width_m or top - bottom < 0.45 or top < 0.8:
        return False
    distance = graph.points @ plane[:3] + plane[3]
    behind = (distance < -0.12) & (along > low) & (along < high)
    past = 1.0 if centers is None else _seen_past(graph.points[behind], plane, (low, high, top), centers)
    if (past * graph.areas[behind]).sum() > 0.10 * area:
        return False
    for other, other_inliers, other_area in candidates:
        # With a wall-sized parallel plane up to 1 m behind, this one is a furniture front.
        if other @ np.append(plane[:3], 0) < 0.95 or other_area < 0.7 * area:
            continue
        gap = -float(np.median(distance[other_inliers]))
        # With a larger parallel plane 3 to 8 cm behind, it is a board, a panel or frames on the wall.
        if 0.08 < gap < 1.0 or (0.03 < gap <= 0.08 and other_area > area):
            return False
    return True


def _seen_past(
    points: np.ndarray, plane: np.ndarray, outline: tuple[float, float, float], centers: np.ndarray
) -> np.ndarray | float:
    """Return the share (n,) of the cameras before a plane that see points behind it over its top or beside its ends.

    Each line of sight is intersected with the plane. Crossings inside of the outline are not counted: openings of a
    wall (doors, windows), mirror images and noise have them. The wall behind furniture is seen over the top or beside
    the ends.

    Args:
        points: float (n, 3) behind the plane.
        plane: float (4,) vertical, its normal into the room.
        outline: where it starts and ends along the wall, and its top, metres.
        centers: float (k, 3) of the cameras.
    """
    low, high, top = outline
    before = centers @ plane[:3] + plane[3]
    centers, before = centers[before > 0], before[before > 0]
    if not len(centers) or not len(points):
        return 1.0
    ways = np.linspace(0, len(centers) - 1, min(len(centers), _MOST_CAMERAS)).astype(int)
    past = np.zeros(len(points))
    for center, ahead in zip(centers[ways], before[ways]):
        share = ahead / (ahead - points @ plane[:3] - plane[3])
        crossing = center + share[:, None] * (points - center)
        along = crossing[:, :2] @ np.array([-plane[1], plane[0]])
        past += (along < low) | (along > high) | (crossing[:, 2] > top)
    return past / len(ways)


def fit_ceiling(graph: MeshGraph, taken: np.ndarray, config: SurfaceConfig) -> FittedPlane | None:
    """Find a ceiling: a large down-facing level plane above 1.8 m with nearly no vertices above it."""
    down = (graph.normals[:, 2] < -0.85) & (graph.points[:, 2] > 1.8) & ~taken
    if graph.areas[down].sum() < config.min_wall_area_m2:
        return None
    z = graph.points[down, 2]
    histogram, bounds = np.histogram(z, bins=np.arange(1.8, z.max() + 0.04, 0.02), weights=graph.areas[down])
    height = float(bounds[int(np.argmax(histogram))] + 0.01)
    near = down & (np.abs(graph.points[:, 2] - height) < 0.04)
    if graph.areas[near].sum() < config.min_wall_area_m2 or (graph.points[:, 2] > height + 0.1).mean() > 0.01:
        return None
    height = float(np.average(graph.points[near, 2], weights=graph.areas[near]))
    members = ~taken & (graph.points[:, 2] > height - 0.04)
    return FittedPlane("ceiling", np.array([0, 0, -1.0, height]), 0.04, members)


def fit_base(graph: MeshGraph, config: SurfaceConfig, centers: np.ndarray | None = None) -> list[FittedPlane]:
    """Fit floor, walls and ceiling, those that were seen; a plane does not claim vertices of an earlier one.

    `centers`: as of `fit_walls`.
    """
    floor = fit_floor(graph, config)
    planes = [] if floor is None else [floor]
    planes += fit_walls(graph, base_owner(planes, len(graph.points)) > 0, config, centers)
    ceiling = fit_ceiling(graph, base_owner(planes, len(graph.points)) > 0, config)
    return planes if ceiling is None else [*planes, ceiling]


def base_owner(planes: list[FittedPlane], count: int) -> np.ndarray:
    """Return the plane of each of `count` vertices, int32: 0 none, 1 floor, 2 and up the others in their order."""
    owner = np.zeros(count, np.int32)
    number = 2
    for plane in planes:
        owner[plane.members & (owner == 0)] = 1 if plane.label == "floor" else number
        number += plane.label != "floor"
    return owner


def behind_base(graph: MeshGraph, planes: list[FittedPlane]) -> np.ndarray:
    """Return the mask (v,) of vertices below the floor or behind a wall: reflections, views out of windows, noise."""
    out = np.zeros(len(graph.points), bool)
    for plane in planes:
        distance = plane.distance(graph.points)
        beyond = distance < -plane.band_m
        if plane.label == "wall":
            along = _along(graph, plane.plane)
            low, high = np.percentile(along[plane.members], [0.5, 99.5])
            beyond &= (along > low - 0.05) & (along < high + 0.05)
        out |= beyond
    return out


def base_outline(points: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """Return the convex hull (k, 3) of points (n, 3) projected onto a plane (4,), clipped to the 0.1-99.9 % range."""
    axis_u, axis_v = plane_axes(plane)
    uv = np.column_stack([points @ axis_u, points @ axis_v])
    low, high = np.percentile(uv, [0.1, 99.9], axis=0)
    hull = cv2.convexHull(np.clip(uv, low, high).astype(np.float32)).reshape(-1, 2).astype(np.float64)
    return on_plane(hull, plane)


def plane_axes(plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return orthonormal in-plane axes u, v (3,) with u x v = n; for upright planes v is up and u horizontal."""
    normal = plane[:3]
    reference = np.array([0, 0, 1.0]) if abs(normal[2]) < 0.7 else np.array([0, 1.0, 0])
    axis_u = np.cross(reference, normal)
    axis_u /= np.linalg.norm(axis_u)
    return axis_u, np.cross(normal, axis_u)


def on_plane(uv: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """Return the world points (n, 3) at in-plane coordinates (n, 2), see `plane_axes`."""
    axis_u, axis_v = plane_axes(plane)
    return uv[:, :1] * axis_u + uv[:, 1:] * axis_v - plane[3] * plane[:3]
