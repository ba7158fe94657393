"""What was put into a container and has none of its colors: a cup in a crate, cans in a box.

A thing that leans on a side, or stands so near one that depth fills the gap, has no foot and no crease of its own: the
mesh holds it for a part of the container. Its color tells. What the container looks like is seen where nothing else
can be, along its rim and its outer sides, and on its bottom where that shows; what stands well within the rim, turns
outwards as things do, and has none of those colors in most frames that see it, is a content. The inside of a bowl of
two colors does not turn outwards, and corners and prints of the container are at its rim.
"""

from collections.abc import Iterator

import cv2
import numpy as np
from scipy.spatial import cKDTree

from reconstruction.instances.boxes import quantiles
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.convexity import MIN_BULGE, bulge
from reconstruction.instances.foreign import ColorView, main_colors
from reconstruction.instances.outlines import inset
from reconstruction.instances.segmentation import Thing
from reconstruction.instances.sightings import unconfirmed
from reconstruction.instances.supports import find_supports
from reconstruction.progress import Progress
from reconstruction.surface.mesh_graph import MeshGraph, pieces

_LEAST_SIDE_M, _MOST_SIDE_M = 0.12, 0.8  # of a container, in plan
_RIM_M = 0.025  # how far within the outline rims and sides reach
_CLEAR = 0.3  # of the height: below it are skirts, and the colors of the ground
_LOW = 0.4  # of the height: bottoms are below it
_MIN_INNER = 0.85  # share of a content that is further within the outline than a rim
_SOME = 0.2  # share of the foreign color in what stands free: shade and light of its own colors are the rest
_MOST_PLAN = 0.5  # of the container's outline
_UNDER = 0.75  # of the mesh's spacing, about half the diagonal of a cell: closer in plan is right under
_BOTTOM_M, _LEVEL = 0.02, 0.7  # height and z of the normals of a bottom
_CELL_M = 0.01
_MIN_HOLLOW = 0.25  # share of the cells within the rim, contents aside, that are below half of its height
_MIN_VERTICES = 15


def cut_contents(
    view: ColorView, things: list[Thing], config: InstancesConfig, progress: Progress
) -> list[Thing]:
    """Cut what is in containers off them where color tells the two apart.

    Args:
        view: the surface and the keyframes.
        things: what was found; theirs are the vertices.
        config: what a support and a thing are.
        progress: told of how many were cut off.

    Returns:
        The things, those cut off at the end.
    """
    found: list[Thing] = []
    for carrier in things:
        if carrier.attached or carrier.foreign:
            continue
        inside = [thing for thing in things if thing.rests_on is carrier]
        for part in _contents_of(view, carrier, inside, config):
            for thing in (carrier, *inside):
                thing.vertices = np.setdiff1d(thing.vertices, part, assume_unique=True)
            found.append(Thing(part, carrier, carrier.depth + 1, foreign=True))
    if found:
        progress.note(f"{len(found)} things are cut off the containers that they are in by their color")
    return [*things, *found]


def _contents_of(
    view: ColorView, carrier: Thing, inside: list[Thing], config: InstancesConfig
) -> list[np.ndarray]:
    """Return sorted vertices of each content of a thing beside those known; none where it is no container."""
    graph, body = view.graph, carrier.vertices
    if len(body) < _MIN_VERTICES:
        return []
    points = graph.points[body]
    sides = np.ptp(points[:, :2], axis=0)
    if sides.min() < _LEAST_SIDE_M or sides.max() > _MOST_SIDE_M:
        return []
    hull = cv2.convexHull(points[:, :2].astype(np.float32))
    within = np.full(len(graph.points), np.nan)  # meters within the outline, of the body's vertices
    within[body] = inset(hull, points[:, :2])
    sure = ~unconfirmed(points, graph.normals[body], view.frames)
    colors = _own_colors(graph, body, within, sure, config)
    if colors is None:
        return []
    odd = view.foreign(body, colors) & sure
    low = quantiles(points[:, 2], graph.areas[body], (0.02,))[0]
    bottom = (points[:, 2] < low + _BOTTOM_M) & (graph.normals[body, 2] > _LEVEL)
    inner = (within[body] > _RIM_M) & ~bottom
    sides = body[inner]
    parts: list[np.ndarray] = []
    used = np.zeros(len(graph.points), bool)
    tops = pieces(graph, body[odd], config.bridge_gap_m)
    free = pieces(graph, body[inner & sure]) if carrier.container else []
    for top in [*_partly_odd(graph, free, tops), *tops]:
        top = top[~used[top]]
        if not _is_shaped(graph, top, hull, within[top]):
            continue
        under = [_under(graph, top, sides), *(_scrap_under(graph, top, thing) for thing in inside)]
        part = np.unique(np.concatenate([top, *under]))
        part = part[~used[part]]
        if _is_large(graph, part, config):
            used[part] = True
            parts.append(part)
    if parts and (carrier.container or _is_hollow(points, within[body], low, used[body])):
        return parts
    return []


def _own_colors(
    graph: MeshGraph, body: np.ndarray, within: np.ndarray, sure: np.ndarray, config: InstancesConfig
) -> np.ndarray | None:
    """Return the colors of a container's rim, outer sides and bottom.

    Args:
        graph: the surface.
        body: sorted vertices (n,) of the container.
        within: (v,) of each vertex of the surface, those of the container only: meters within its outline in plan.
        sure: bool (n,) which of `body` the frames confirm.
        config: what a support is.

    Returns:
        Weighted CIELAB (k, 3), None if no rim is sure, or if it has so many colors that none is its own.
    """
    low, high = quantiles(graph.points[body, 2], graph.areas[body], (0.02, 0.98))
    clear = graph.points[body, 2] > low + _CLEAR * (high - low)
    edge = body[clear & (within[body] < _RIM_M) & sure]
    if len(edge) < _MIN_VERTICES:
        return None
    colors = [main_colors(graph, edge)]
    if len(colors[0]) == 0:
        return None
    for support in find_supports(graph, body, config):
        inner = support.vertices[within[support.vertices] > _RIM_M]
        if support.height_m < low + _LOW * (high - low) and len(inner) >= _MIN_VERTICES:
            colors.append(main_colors(graph, inner))
    return np.concatenate(colors)


def _is_shaped(graph: MeshGraph, part: np.ndarray, hull: np.ndarray, within: np.ndarray) -> bool:
    """Tell a thing, `within` (n,) meters inside an outline, from the inside of that, from its rim and from a print."""
    if len(part) < _MIN_VERTICES:
        return False
    outline = cv2.convexHull(graph.points[part, :2].astype(np.float32))
    if cv2.contourArea(outline) > _MOST_PLAN * cv2.contourArea(hull):
        return False
    return bool((within > _RIM_M).mean() > _MIN_INNER and bulge(graph, part) > MIN_BULGE)


def _partly_odd(graph: MeshGraph, free: list[np.ndarray], tops: list[np.ndarray]) -> Iterator[np.ndarray]:
    """Yield pieces that nothing joins to their container and that much of one top is on, with that top."""
    for piece in free:
        on = [top for top in tops if np.isin(top, piece).sum() >= _MIN_VERTICES]
        if len(on) != 1:
            continue
        odd = np.intersect1d(piece, on[0])
        if graph.areas[odd].sum() > _SOME * graph.areas[piece].sum():
            yield np.union1d(piece, on[0])


def _is_large(graph: MeshGraph, part: np.ndarray, config: InstancesConfig) -> bool:
    points, areas = graph.points[part], graph.areas[part]
    size = [float(np.ptp(quantiles(points[:, k], areas, (0.02, 0.98)))) for k in range(3)]
    return min(size) >= config.min_object_m and float(areas.sum()) >= config.min_object_area_m2


def _under(graph: MeshGraph, part: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return which vertices `others` are right under a part: sides of it that have a color of what it is in."""
    top = quantiles(graph.points[part, 2], graph.areas[part], (0.98,))[0]
    chosen = others[graph.points[others, 2] < top]
    reach = _UNDER * graph.spacing_m
    gap = cKDTree(graph.points[part, :2]).query(graph.points[chosen, :2], distance_upper_bound=reach)[0]
    return chosen[np.isfinite(gap)]


def _scrap_under(graph: MeshGraph, part: np.ndarray, thing: Thing) -> np.ndarray:
    """Return the vertices of another thing that are under a part, unless they are most of it."""
    under = _under(graph, part, thing.vertices)
    most = graph.areas[under].sum() > 0.5 * graph.areas[thing.vertices].sum()
    return under[:0] if most else under


def _is_hollow(points: np.ndarray, within: np.ndarray, low: float, content: np.ndarray) -> bool:
    """Tell whether points (n, 3), contents (n,) aside, are lower within a rim than along it.

    `within` (n,) is how far each is inside the outline, in meters.
    """
    cells = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / _CELL_M).astype(int)
    top = np.full(cells.max(axis=0) + 1, -np.inf)
    np.maximum.at(top, tuple(cells.T), points[:, 2] - low)
    rim, inner, filled = (np.zeros(top.shape, bool) for _ in range(3))
    rim[tuple(cells[within < _RIM_M].T)] = True
    inner[tuple(cells[within >= _RIM_M].T)] = True
    filled[tuple(cells[content].T)] = True
    inner &= ~filled & ~rim
    if not rim.any() or not inner.any():
        return False
    return bool((top[inner] < 0.5 * np.median(top[rim])).mean() > _MIN_HOLLOW)
