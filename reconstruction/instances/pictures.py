"""Flat things on walls: regions of another color in the wall's fused texture, or slabs just in front of it.

A picture is 1 to 3 cm thick, which is within the noise of the depth; its color is what tells it from the wall. It has
an outline: where the color fades, there is a stain, or light.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import ndimage

from reconstruction.instances.config import InstancesConfig
from reconstruction.surface.base_planes import FittedPlane, plane_axes
from reconstruction.surface.mesh_graph import MeshGraph, lab_from_rgb
from reconstruction.types import DepthMaps, PosedFrames
from registry.geometry import invert_rigid

_FADED_CELLS = 8
_DEPTH_M = 0.06  # how far in front of the wall a picture may reach
_EDGE_M, _LEAST_STEP = 0.03, 0.65  # how wide an outline is, and how much of the contrast is gained across it


@dataclass(frozen=True)
class _WallTexture:
    lab: np.ndarray  # float32 (h, w, 3)
    seen: np.ndarray  # bool (h, w)
    cells: np.ndarray  # int64 (n, 2) row, column of each vertex used
    used: np.ndarray  # int64 (n,) vertices
    cell_m: float
    low: np.ndarray  # float64 (2,) of the first cells


def find_pictures(
    graph: MeshGraph,
    wall: FittedPlane,
    taken: np.ndarray,
    rest: np.ndarray,
    posed: PosedFrames,
    depth: DepthMaps,
    config: InstancesConfig,
) -> list[np.ndarray]:
    """Return the vertex sets of flat things on a wall, the largest first.

    Args:
        graph: the surface.
        wall: the wall that is searched.
        taken: bool (v,) vertices of other base planes.
        rest: bool (v,) vertices that belong to no base plane.
        posed: keyframes in world space, whose colors are projected onto the wall.
        depth: their depth, which tells where they see the wall.
        config: thresholds.
    """
    texture = _wall_texture(graph, wall, taken, posed, depth, config)
    if texture is None:
        return []
    contrast = _contrast(texture)
    noise = np.median(contrast[texture.seen]) / 0.8
    different = texture.seen & (contrast > max(config.wall_color_contrast, 3.5 * noise))
    different = cv2.morphologyEx(different.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)) > 0
    closed = cv2.morphologyEx(different.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    labels, count = ndimage.label(closed, structure=np.ones((3, 3)))
    hidden = _hidden_by_furniture(graph, wall, rest, texture)
    found = []
    for index in range(1, count + 1):
        patch = labels == index
        region = _picture_region(patch, texture, hidden, config)
        if region is None or _fades(patch, contrast, texture):
            continue
        inside = region[texture.cells[:, 0], texture.cells[:, 1]]
        found.append(np.sort(texture.used[inside]))
    least = 0.3 * config.min_picture_m**2
    areas = [graph.areas[vertices].sum() for vertices in found]
    order = sorted(range(len(found)), key=lambda k: (-areas[k], found[k][:1].sum()))
    return [found[k] for k in order if areas[k] >= least]


def _wall_texture(
    graph: MeshGraph,
    wall: FittedPlane,
    taken: np.ndarray,
    posed: PosedFrames,
    depth: DepthMaps,
    config: InstancesConfig,
) -> _WallTexture | None:
    """Project the keyframes onto the wall: sharper than vertex colors, which are sparse where a wall is flat."""
    distance = wall.distance(graph.points)
    near = wall.members | (
        ~taken & (distance < _DEPTH_M) & (distance > -0.03) & (graph.normals @ wall.plane[:3] > 0.5)
    )
    used = np.flatnonzero(near)
    if graph.areas[used].sum() < 10 * config.min_picture_m**2:
        return None
    axis_u, axis_v = plane_axes(wall.plane)
    uv = np.column_stack([graph.points[used] @ axis_v, graph.points[used] @ axis_u])
    low = np.percentile(uv, 0.1, axis=0)
    size = np.percentile(uv, 99.9, axis=0) - low
    cell = max(0.01, float(np.sqrt(size.prod() / 400_000)))
    cells = np.floor((uv - low) / cell).astype(np.int64) + 2
    shape = tuple((np.ceil(size / cell) + 5).astype(int))
    cells = np.clip(cells, 0, np.array(shape) - 1)
    row, column = np.mgrid[: shape[0], : shape[1]]
    corner = (low[0] - 1.5 * cell) * axis_v + (low[1] - 1.5 * cell) * axis_u - wall.plane[3] * wall.plane[:3]
    points = corner + cell * (row[..., None] * axis_v + column[..., None] * axis_u)
    total = np.zeros((*shape, 3), np.float32)
    count = np.zeros(shape, np.float32)
    step = max(1, len(posed.images) // 30)
    for i in range(0, len(posed.images), step):
        _add_view(total, count, points.reshape(-1, 3), i, posed, depth)
    seen = count >= 1
    lab = lab_from_rgb(np.clip(total / np.maximum(count, 1)[..., None], 0, 255))
    return _WallTexture(lab, seen, cells, used, cell, low)


def _add_view(
    total: np.ndarray, count: np.ndarray, points: np.ndarray, i: int, posed: PosedFrames, depth: DepthMaps
) -> None:
    """Add the colors that frame `i` saw at wall points (n, 3), where its depth says that it saw the wall."""
    camera_from_world = invert_rigid(np.asarray(posed.world_from_camera[i]))
    local = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    z = np.maximum(local[:, 2], 1e-6)
    ratio = posed.camera.width / depth.camera.width
    camera = posed.camera
    u, v = camera.fx * local[:, 0] / z + camera.cx, camera.fy * local[:, 1] / z + camera.cy
    inside = (local[:, 2] > 0.2) & (u > 2) & (v > 2) & (u < camera.width - 2) & (v < camera.height - 2)
    column = np.clip((u / ratio).astype(np.int32), 0, depth.camera.width - 1)
    row = np.clip((v / ratio).astype(np.int32), 0, depth.camera.height - 1)
    measured = np.asarray(depth.depth[i])[row, column]
    visible = inside & (measured > 0) & (np.abs(measured - z) < np.maximum(0.04 * z, 0.08))
    image = np.asarray(posed.images[i])
    colors = image[v[visible].astype(np.int32), u[visible].astype(np.int32)]
    total.reshape(-1, 3)[visible] += colors
    count.reshape(-1)[visible] += 1


def _contrast(texture: _WallTexture) -> np.ndarray:
    """Return the color distance to the wall around, whose light changes slowly, without what stands out."""
    weight = cv2.GaussianBlur(texture.seen.astype(np.float32), (0, 0), 1.0)[..., None]
    lab = cv2.GaussianBlur(texture.lab * texture.seen[..., None].astype(np.float32), (0, 0), 1.0) / (
        weight + 1e-6
    )
    texture = replace(texture, lab=lab)
    sigma = 0.35 / texture.cell_m
    wall_color = np.median(texture.lab[texture.seen], axis=0)
    contrast = np.linalg.norm((texture.lab - wall_color) * [0.6, 1, 1], axis=-1)
    for _ in range(3):
        limit = max(6.0, 2.5 * float(np.median(contrast[texture.seen])))
        plain = texture.seen & (contrast < limit)
        weight = cv2.GaussianBlur(plain.astype(np.float32), (0, 0), sigma) + 1e-6
        smooth = cv2.GaussianBlur(texture.lab * plain[..., None].astype(np.float32), (0, 0), sigma)
        local = (smooth + 1e-6 * wall_color.astype(np.float32)) / weight[..., None]
        contrast = np.linalg.norm((texture.lab - local) * [0.8, 1, 1], axis=-1)
    return np.where(texture.seen, contrast, 0)


def _hidden_by_furniture(graph, wall: FittedPlane, rest: np.ndarray, texture: _WallTexture) -> np.ndarray:
    """Mark cells right behind furniture, whose shadows on the wall are not pictures."""
    axis_u, axis_v = plane_axes(wall.plane)
    distance = wall.distance(graph.points)
    close = np.flatnonzero(rest & (distance > _DEPTH_M) & (distance < 0.5))
    grid = np.zeros(texture.seen.shape, bool)
    uv = np.column_stack([graph.points[close] @ axis_v, graph.points[close] @ axis_u])
    cells = np.floor((uv - texture.low) / texture.cell_m).astype(np.int64) + 2
    inside = ((cells >= 0) & (cells < grid.shape)).all(axis=1)
    grid[cells[inside, 0], cells[inside, 1]] = True
    return ndimage.binary_dilation(grid, iterations=max(1, round(0.05 / texture.cell_m)))


def _picture_region(
    region: np.ndarray, texture: _WallTexture, hidden: np.ndarray, config: InstancesConfig
) -> np.ndarray | None:
    """Return the filled cells of a picture, or None if the region does not look like one."""
    if region.sum() * texture.cell_m**2 < 0.3 * config.min_picture_m**2:
        return None
    filled = _filled(region, texture.seen)
    cells = np.argwhere(filled).astype(np.float32)
    (_, (height, width), _) = cv2.minAreaRect(cells)
    height, width = height + 1, width + 1
    if min(height, width) * texture.cell_m < config.min_picture_m:
        return None
    if max(height, width) * texture.cell_m < 1.5 * config.min_picture_m:
        return None
    hull = cv2.convexHull(cells.astype(np.int32))
    rectangular = (cv2.contourArea(hull) + 0.5 * cv2.arcLength(hull, True) + 1) / (height * width)
    solid = filled.sum() / (height * width)
    border = region & ~ndimage.binary_erosion(region)
    if (border & hidden).sum() > 0.15 * border.sum() or (region & hidden).mean() > 0.25 * region.mean():
        return None  # a shadow, or the back of furniture
    # The frame of a picture whose inside looks like the wall: three sides suffice, the hull is the picture.
    framed = (
        solid > 0.2 and rectangular > 0.8 and min(height, width) * texture.cell_m > 2 * config.min_picture_m
    )
    if rectangular < 0.7 or (solid < 0.6 and not framed):
        return None
    grid = np.zeros(region.shape, np.uint8)
    cv2.fillConvexPoly(grid, np.ascontiguousarray(hull[..., ::-1]), 1)
    return _to_the_edge(ndimage.binary_dilation(grid.astype(bool), iterations=1), texture.seen)


def _fades(region: np.ndarray, contrast: np.ndarray, texture: _WallTexture) -> bool:
    """Tell whether a region has no outline of its own: a stain, or light, whose color fades into the wall's."""
    reach = max(2, round(_EDGE_M / texture.cell_m))
    border = region & ~ndimage.binary_erosion(region) & ndimage.binary_erosion(texture.seen, iterations=reach)
    around = texture.seen & ~region
    inner = ndimage.maximum_filter(np.where(region, contrast, 0.0), 2 * reach + 1)
    outer = ndimage.minimum_filter(np.where(around, contrast, np.inf), 2 * reach + 1)
    step = (inner - outer)[border & np.isfinite(outer)]
    return bool(len(step)) and float(np.median(step)) < _LEAST_STEP * float(np.median(contrast[region]))


def _to_the_edge(region: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Let a picture that the images' edge cuts go on to the last that was seen, where its outline has faded."""
    out = region.copy()
    for axis in (0, 1):
        side = region.any(axis=1 - axis)
        first, last = np.flatnonzero(side)[[0, -1]]
        across = np.flatnonzero(region.any(axis=axis))
        lanes = np.zeros(region.shape[1 - axis], bool)
        lanes[across[0] : across[-1] + 1] = True
        profile = (seen[:, lanes] if axis == 0 else seen[lanes].T).mean(axis=1)
        for end, step in ((first, -1), (last, 1)):
            probe = end + step * (_FADED_CELLS + 1)
            if 0 <= probe < len(profile) and profile[probe] > 0.2:
                continue  # wall is seen beyond: this side is the picture's own
            rim = np.zeros(len(profile), bool)
            low, high = sorted((end, end + step * _FADED_CELLS))
            rim[max(low, 0) : high + 1] = True
            out |= seen & (np.outer(rim, lanes) if axis == 0 else np.outer(lanes, rim))
    return out


def _filled(region: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Fill what the region encloses, alone or together with the edge of what was seen."""
    out = ndimage.binary_fill_holes(region)
    holes, count = ndimage.label(seen & ~region)
    reach = ndimage.binary_dilation(region, iterations=1)
    for index, where in enumerate(ndimage.find_objects(holes), start=1):
        if where is None or count == 1:
            continue
        hole = holes[where] == index
        if hole.sum() > 4 * region.sum() + 50:
            continue
        outline = hole & ~ndimage.binary_erosion(hole)
        if (outline & reach[where]).sum() > 0.5 * outline.sum():
            out[where] |= hole
    return out
