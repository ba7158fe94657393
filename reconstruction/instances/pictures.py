"""Flat things on walls: regions of another color in the wall's fused texture, or slabs just in front of it.

A picture is 1 to 3 cm thick, which is within the noise of the depth; its color is what tells it from the wall.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from reconstruction.instances.base_planes import FittedPlane, plane_axes
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.mesh_graph import MeshGraph

_DEPTH_M = 0.06  # how far in front of the wall a picture may reach


@dataclass(frozen=True)
class _WallTexture:
    lab: np.ndarray  # float32 (h, w, 3)
    seen: np.ndarray  # bool (h, w)
    cells: np.ndarray  # int64 (n, 2) row, column of each vertex used
    used: np.ndarray  # int64 (n,) vertices
    cell_m: float


def find_pictures(
    graph: MeshGraph, wall: FittedPlane, taken: np.ndarray, rest: np.ndarray, config: InstancesConfig
) -> list[np.ndarray]:
    """Return the vertex sets of flat things on a wall, the largest first.

    Args:
        graph: the surface.
        wall: the wall that is searched.
        taken: bool (v,) vertices of other base planes.
        rest: bool (v,) vertices that belong to no base plane.
        config: thresholds.
    """
    texture = _wall_texture(graph, wall, taken)
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
        region = _picture_region(labels == index, texture, hidden, config)
        if region is None:
            continue
        inside = region[texture.cells[:, 0], texture.cells[:, 1]]
        found.append(np.sort(texture.used[inside]))
    return sorted((v for v in found if len(v) >= config.min_object_vertices), key=lambda v: (-len(v), v[0]))


def _wall_texture(graph: MeshGraph, wall: FittedPlane, taken: np.ndarray) -> _WallTexture | None:
    distance = wall.distance(graph.points)
    near = wall.members | (
        ~taken & (distance < _DEPTH_M) & (distance > -0.03) & (graph.normals @ wall.plane[:3] > 0.5)
    )
    used = np.flatnonzero(near)
    if len(used) < 200:
        return None
    axis_u, axis_v = plane_axes(wall.plane)
    uv = np.column_stack([graph.points[used] @ axis_v, graph.points[used] @ axis_u])
    cell = max(0.01, 1.05 * graph.spacing_m)
    cells = np.floor((uv - uv.min(axis=0)) / cell).astype(np.int64) + 2
    shape = cells.max(axis=0) + 3
    if shape.prod() > 4_000_000:
        return None
    flat = cells[:, 0] * shape[1] + cells[:, 1]
    count = np.bincount(flat, minlength=shape.prod()).reshape(shape)
    total = np.stack(
        [np.bincount(flat, graph.lab[used, c], shape.prod()).reshape(shape) for c in range(3)], axis=-1
    )
    # Cells between vertices take the color of their neighbors.
    kernel = np.ones((3, 3))
    wide = ndimage.convolve(count.astype(float), kernel, mode="constant")
    spread = np.stack([ndimage.convolve(total[..., c], kernel, mode="constant") for c in range(3)], axis=-1)
    seen = wide >= 2
    lab = np.where(seen[..., None], spread / np.maximum(wide, 1)[..., None], 0).astype(np.float32)
    return _WallTexture(lab, seen, cells, used, cell)


def _contrast(texture: _WallTexture) -> np.ndarray:
    """Return the color distance to the wall around, whose light changes slowly, without what stands out."""
    plain = texture.seen.copy()
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
    origin_points = graph.points[texture.used]
    low = np.array([(origin_points @ axis_v).min(), (origin_points @ axis_u).min()])
    distance = wall.distance(graph.points)
    close = np.flatnonzero(rest & (distance > _DEPTH_M) & (distance < 0.5))
    grid = np.zeros(texture.seen.shape, bool)
    uv = np.column_stack([graph.points[close] @ axis_v, graph.points[close] @ axis_u])
    cells = np.floor((uv - low) / texture.cell_m).astype(np.int64) + 2
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
    return ndimage.binary_dilation(grid.astype(bool), iterations=1)


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
