"""Planes of the scene: oriented points of all views -> planes and their extents, by RANSAC and by offset histograms."""

import numpy as np

from reconstruction.core.types import Camera

_STRIDE = 6
_EXTENT_SIDES = 16


def oriented_points(
    depth: np.ndarray, gx: np.ndarray, gy: np.ndarray, camera: Camera, world_from_camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points (m, 3), normals (m, 3) towards the camera and depths (m,) of every sixth measured pixel.

    `gx`, `gy` (h, w) are slopes of inverse depth per pixel: a plane n.X = d has inverse depth n.r / d along ray r.
    """
    y, x = np.mgrid[_STRIDE // 2 : depth.shape[0] : _STRIDE, _STRIDE // 2 : depth.shape[1] : _STRIDE]
    y, x = y.ravel(), x.ravel()
    good = (depth[y, x] > 0) & ((gx[y, x] != 0) | (gy[y, x] != 0))
    y, x = y[good], x[good]
    z = depth[y, x].astype(np.float64)
    xn, yn = (x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy
    a, b = gx[y, x] * camera.fx, gy[y, x] * camera.fy
    normal = -np.stack([a, b, 1.0 / z - a * xn - b * yn], 1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    local = np.stack([xn * z, yn * z, z], 1)
    rotation, center = world_from_camera[:3, :3], world_from_camera[:3, 3]
    return local @ rotation.T + center, normal @ rotation.T, z


def find_planes(
    points: np.ndarray,
    normals: np.ndarray,
    depths: np.ndarray,
    *,
    tolerance: float,
    max_planes: int,
    seed: int,
) -> np.ndarray:
    """Return planes (k, 4), n.x + d = 0 with n towards the cameras: by sequential sampling, then parallel ones.

    A point supports a plane within `tolerance` times the depth at which it was measured, if their normals agree.
    """
    rng = np.random.default_rng(seed)
    if len(points) > 120_000:
        pick = rng.choice(len(points), 120_000, replace=False)
        points, normals, depths = points[pick], normals[pick], depths[pick]
    least = max(60, len(points) // 600)
    left = np.ones(len(points), bool)
    planes: list[np.ndarray] = []
    failures = 0
    while len(planes) < max_planes and left.sum() >= least and failures < 4:
        rows = np.flatnonzero(left)
        trial = rng.choice(rows, min(len(rows), 160), replace=False)
        test = rng.choice(rows, min(len(rows), 6000), replace=False)
        n = normals[trial]
        d = -np.einsum("ij,ij->i", n, points[trial])
        near = np.abs(points[test] @ n.T + d) < tolerance * depths[test][:, None]
        near &= normals[test] @ n.T > 0.9
        best = int(np.argmax(near.sum(0)))
        plane = np.append(n[best], d[best])
        for _ in range(4):
            inliers = _support(plane, points, normals, depths, tolerance) & left
            if inliers.sum() < 12:
                break
            plane = _fit(points[inliers], depths[inliers], plane)
        inliers = _support(plane, points, normals, depths, tolerance) & left
        if inliers.sum() < least:
            failures += 1
            continue
        planes.append(plane)
        # Points near the plane are removed even if their normals disagree.
        left &= ~(np.abs(points @ plane[:3] + plane[3]) < 1.5 * tolerance * depths) | (
            normals @ plane[:3] < 0.5
        )
    found = np.array(planes).reshape(-1, 4)
    return np.concatenate([found, _parallel_planes(found, points[left], depths[left], least // 3, tolerance)])


def _parallel_planes(planes: np.ndarray, points, depths, least: int, tolerance: float) -> np.ndarray:
    """Return planes parallel to the largest ones, at peaks of the histogram of the remaining points' offsets.

    Normals are not used: of a blank table top only the rim can be measured, and its normals are noise. A wrong plane
    does no harm, since no measured pixels anchor it in a view.
    """
    directions: list[np.ndarray] = []
    for plane in planes:
        if len(directions) < 4 and all(abs(plane[:3] @ d) < 0.9 for d in directions):
            directions.append(plane[:3])
    out: list[np.ndarray] = []
    if len(points) < least:
        return np.zeros((0, 4))
    width = 0.6 * tolerance * float(np.median(depths))
    for direction in directions:
        offset = points @ direction
        low = offset.min()
        histogram = np.bincount(((offset - low) / width).astype(np.int64))
        peaked = np.convolve(histogram, [1, 1, 1], "same")
        background = np.convolve(histogram, np.ones(41) / 41 * 3, "same")
        order = np.argsort(-peaked, kind="stable")
        taken = np.zeros(len(peaked), bool)
        for b in order[:200]:
            if len(out) >= 24 or peaked[b] < least or peaked[b] < 2.0 * background[b]:
                break
            if taken[max(0, b - 3) : b + 4].any():
                continue
            taken[b] = True
            near = np.abs(offset - low - (b + 0.5) * width) < 1.5 * width
            out.append(np.append(direction, -np.median(offset[near])))
    return np.array(out).reshape(-1, 4)


def _support(plane, points, normals, depths, tolerance) -> np.ndarray:
    return (np.abs(points @ plane[:3] + plane[3]) < tolerance * depths) & (normals @ plane[:3] > 0.9)


def _fit(points: np.ndarray, depths: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Least-squares plane, far points counting less, on the side of `like`."""
    weight = 1.0 / depths**2
    center = (points * weight[:, None]).sum(0) / weight.sum()
    scaled = (points - center) * np.sqrt(weight)[:, None]
    _, vectors = np.linalg.eigh(scaled.T @ scaled)
    normal = vectors[:, 0] * np.sign(vectors[:, 0] @ like[:3] or 1.0)
    return np.append(normal, -normal @ center)


def plane_extents(
    planes: np.ndarray, points: np.ndarray, normals: np.ndarray, depths: np.ndarray, *, tolerance: float
) -> np.ndarray:
    """Return 16 bounds (k, 16, 4) around the measured points of each plane: inside, all e.x + f >= 0.

    Completion stays inside them, since nothing is known beyond the end of a wall.
    """
    out = np.zeros((len(planes), _EXTENT_SIDES, 4))
    angle = np.arange(_EXTENT_SIDES) * 2 * np.pi / _EXTENT_SIDES
    for row, plane in enumerate(planes):
        near = np.abs(points @ plane[:3] + plane[3]) < tolerance * depths
        agreeing = near & (normals @ plane[:3] > 0.9)
        # A plane that was measured at its rim alone has few reliable normals.
        own = points[agreeing if agreeing.sum() > 0.5 * near.sum() else near]
        first = np.cross(plane[:3], np.eye(3)[np.argmin(np.abs(plane[:3]))])
        first /= np.linalg.norm(first)
        second = np.cross(plane[:3], first)
        sides = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
        reach = np.percentile(own @ sides.T, 99.9, axis=0)
        half = _EXTENT_SIDES // 2
        width = reach + np.roll(reach, half)
        out[row, :, :3] = -sides
        out[row, :, 3] = reach + 0.03 * width
    return out
