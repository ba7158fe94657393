"""What lies on furniture and has colors that the furniture has nowhere else: small things across the room.

Three metres away a book is a few dozen points of the fused surface, hardly higher than the noise of the cabinet that it
lies on and without an edge of its own; shape alone takes it for the cabinet. Its color tells it from the cabinet in
every frame that sees it. Of other color are also smears, which show the wall behind them, and shaded corners: what
confirms no frame, what shows the wall, and what does not bulge, is no thing.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.instances.boxes import quantiles
from reconstruction.instances.colors import LIGHTNESS_WEIGHT
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.convexity import bulge
from reconstruction.instances.cut import Shell
from reconstruction.instances.outlines import inset
from reconstruction.instances.patches import palette
from reconstruction.instances.segmentation import Thing
from reconstruction.instances.sightings import Sighting, unconfirmed
from reconstruction.instances.smears import WallPicture
from reconstruction.instances.supports import SupportRegion, find_supports
from reconstruction.instances.two_colors import solidity
from reconstruction.progress import Progress
from reconstruction.surface.mesh_graph import MeshGraph, pieces

_LEAST_CARRIER_M, _MIN_SUPPORT_M2, _LEAST_HEIGHT_M = 0.45, 0.02, 0.05
_MOST_SAMPLES = 4000  # vertices that tell a carrier's colors
_COLORS, _COLOR_GAP = 24, 4.0
_MOST_FOREIGN = 0.08  # of a carrier's area: a color with more than that is its own
_FOREIGN, _LIKE_WALL = 12.0, 8.0  # CIELAB, lightness at half weight
_MIXTURE = 6.0  # from the line between a color of the furniture and that of the wall behind: pixels of both
_MIN_SEEN, _SURE_SHARE, _WALL_SHARE = 3, 0.6, 0.4  # frames, and of them
_UP = 0.7  # of a normal's z: smears are steeper than tops
_ABOVE_M, _REACH_M = 0.004, 0.4  # over a support
_BOARD_M, _CLEAR_M = 0.12, 0.03  # the next board is as far above, and what is on this one ends below it
_BRIDGE_M = 0.025
_MIN_VERTICES = 15
_MIN_BULGE = 0.12
_BOWL_M, _ROUND, _SOLID = 0.1, 0.7, 0.75  # of an open thing: width, share of its length, share of its hull
_LOW_M, _RISE_M, _SLIM_M, _MOST_M = 0.025, 0.02, 0.025, 0.45
_LID_M = 0.05  # what is over a thing may be its lid, in a color that the furniture has
_BESIDE_M, _BESIDE_SHARE = 0.05, 0.35  # of a larger one: its own fringe


@dataclass(frozen=True)
class ColorView:
    """The surface, and the keyframes that tell its colors."""

    graph: MeshGraph
    frames: list[Sighting]
    walls: list[WallPicture]

    @classmethod
    def of(cls, shell: Shell, frames: list[Sighting]) -> "ColorView":
        """Return the surface of a shell seen in frames, with pictures of its walls."""
        walls = [WallPicture(shell.graph, plane, frames) for plane in shell.planes if plane.label == "wall"]
        return cls(shell.graph, frames, walls)

    def shows_wall(self, frame: Sighting, points: np.ndarray, lab: np.ndarray) -> np.ndarray:
        """Return which points, of colors (n, 3) in a frame, have there the color of the wall behind them."""
        out = np.zeros(len(points), bool)
        for wall in self.walls:
            out |= np.linalg.norm(lab - wall.behind(points, frame), axis=1) < _LIKE_WALL
        return out

    def of_wall(self, vertices: np.ndarray) -> np.ndarray:
        """Return which vertices no frame sees, or many see in the color of the wall behind."""
        points = self.graph.points[vertices]
        seen, like = np.zeros(len(vertices)), np.zeros(len(vertices))
        for frame in self.frames:
            row, column, z = frame.seen_at(points)
            rows = np.flatnonzero(frame.shown(row, column, z))
            seen[rows] += 1
            like[rows] += self.shows_wall(frame, points[rows], frame.lab[row[rows], column[rows]])
        return like >= np.where(seen > 0, _WALL_SHARE * seen, 0.0)

    def foreign(self, vertices: np.ndarray, own: np.ndarray, *, mixed: bool = False) -> np.ndarray:
        """Return which vertices most frames see in none of some colors (k, 3), nor in that of the wall behind.

        Where `mixed`, nor in a mixture of the two: along edges before a wall pixels show both.

        Of what has no color of its own (k = 0), since it has too many, nothing can be told.
        """
        if len(own) == 0:
            return np.zeros(len(vertices), bool)
        points, up = self.graph.points[vertices], self.graph.normals[vertices, 2] > _UP
        seen, other = np.zeros(len(vertices)), np.zeros(len(vertices))
        for frame in self.frames:
            row, column, z = frame.seen_at(points)
            shown = frame.shown(row, column, z)
            lab = frame.lab[row, column]
            gap = np.linalg.norm(lab[:, None] - own[None], axis=2).min(axis=1)
            odd = shown & (gap > _FOREIGN)
            asked = np.flatnonzero(odd if mixed else odd & ~up)
            shows = (
                self.shows_mixed(frame, points[asked], lab[asked], own)
                if mixed
                else self.shows_wall(frame, points[asked], lab[asked])
            )
            odd[asked] = ~shows
            seen += shown
            other += odd
        return (seen >= _MIN_SEEN) & (other >= _SURE_SHARE * seen)

    def shows_mixed(
        self, frame: Sighting, points: np.ndarray, lab: np.ndarray, own: np.ndarray
    ) -> np.ndarray:
        """Return which points, of colors (n, 3) in a frame, mix one of some colors (k, 3) with the wall behind."""
        out = np.zeros(len(points), bool)
        for wall in self.walls:
            across = wall.behind(points, frame)[:, None] - own[None]
            from_own = lab[:, None] - own[None]
            share = (from_own * across).sum(axis=2) / np.maximum((across**2).sum(axis=2), 1e-9)
            rest = from_own - np.clip(share, 0.0, 1.0)[..., None] * across
            out |= (np.linalg.norm(rest, axis=2) < _MIXTURE).any(axis=1)
        return out


def cut_foreign(
    shell: Shell,
    things: list[Thing],
    owner: np.ndarray,
    view: ColorView,
    config: InstancesConfig,
    progress: Progress,
) -> list[Thing]:
    """Cut things off the furniture that they lie on where color alone tells them from it.

    Args:
        shell: the surface and its base.
        things: what was found; theirs are the vertices.
        owner: int32 (v,) base entity of each vertex.
        view: the surface and the keyframes.
        config: what a support and a thing are.
        progress: told of how many were cut off.

    Returns:
        The things, those cut off at the end.
    """
    graph = shell.graph
    free = (owner == 0) & ~shell.behind
    for thing in things:
        free[thing.vertices] = False
    found: list[Thing] = []
    for carrier in things:
        if carrier.attached or np.ptp(graph.points[carrier.vertices], axis=0).max() < _LEAST_CARRIER_M:
            continue
        for vertices in _foreign_on(view, carrier, free, config):
            free[vertices] = False
            carrier.vertices = np.setdiff1d(carrier.vertices, vertices, assume_unique=True)
            found.append(Thing(vertices, carrier, carrier.depth + 1, foreign=True))
    if found:
        progress.note(f"{len(found)} things are cut off what carries them by their color")
    return [*things, *found]


def _foreign_on(
    view: ColorView, carrier: Thing, free: np.ndarray, config: InstancesConfig
) -> list[np.ndarray]:
    """Return sorted vertices of each thing on a carrier, its own or `free` ones (v,) bool."""
    graph, found = view.graph, []
    supports = [
        support
        for support in find_supports(graph, carrier.vertices, config)
        if support.footprint.area_m2 > _MIN_SUPPORT_M2 and support.height_m > _LEAST_HEIGHT_M
    ]
    pools = [(support, _above(graph, carrier, support, supports, free)) for support in supports]
    pools = [(support, pool) for support, pool in pools if len(pool) >= _MIN_VERTICES]
    if not pools:
        return []
    colors = _own_colors(view, carrier.vertices)
    used = np.zeros(len(graph.points), bool)
    for support, pool in pools:
        own = np.concatenate([colors, main_colors(graph, support.vertices)])
        pool = pool[~used[pool]]
        odd = pool[view.foreign(pool, own)]
        odd = odd[~unconfirmed(graph.points[odd], graph.normals[odd], view.frames)]
        # Along edges before a wall pixels show both; what they join is looked at without them first.
        pure = odd[view.foreign(odd, own, mixed=True)]
        parts = _things_in(graph, pure, support, config)
        used[np.concatenate([pure[:0], *parts])] = True
        parts.extend(_things_in(graph, odd[~used[odd]], support, config))
        for part in _without_fringes(graph, parts):
            part = _with_column(view, part, pool[~used[pool]])
            used[part] = True
            found.append(np.sort(part))
    return found


def _with_column(view: ColorView, part: np.ndarray, pool: np.ndarray) -> np.ndarray:
    """Add what is right over and under a thing, but for what shows the wall: sides in its shade, its lid."""
    graph = view.graph
    beside = np.setdiff1d(pool, part, assume_unique=True)
    outline = cv2.convexHull(graph.points[part, :2].astype(np.float32))
    high = graph.points[part, 2].max() + _LID_M
    within = (inset(outline, graph.points[beside, :2]) > 0.0) & (graph.points[beside, 2] < high)
    beside = beside[within]
    return np.concatenate([part, beside[~view.of_wall(beside)]])


def _things_in(
    graph: MeshGraph, odd: np.ndarray, support: SupportRegion, config: InstancesConfig
) -> list[np.ndarray]:
    return [part for part in pieces(graph, odd, _BRIDGE_M) if _is_thing(graph, part, support, config)]


def _above(
    graph: MeshGraph, carrier: Thing, support: SupportRegion, supports: list[SupportRegion], free: np.ndarray
) -> np.ndarray:
    """Return the vertices over a support and below the next board, those of the carrier and free ones."""
    higher = [other.height_m - support.height_m for other in supports]
    reach = min([_REACH_M, *(rise - _CLEAR_M for rise in higher if rise > _BOARD_M)])
    rise = graph.points[:, 2] - support.height_m
    chosen = free.copy()
    chosen[carrier.vertices] = True
    rows = np.flatnonzero(chosen & (rise > _ABOVE_M) & (rise < reach))
    return rows[support.footprint.contains(graph.points[rows, :2], 2)]


def _own_colors(view: ColorView, vertices: np.ndarray) -> np.ndarray:
    """Return the colors (k, 3) of furniture without the smears on it."""
    graph = view.graph
    some = vertices[:: max(1, len(vertices) // _MOST_SAMPLES)]
    doubtful = unconfirmed(graph.points[some], graph.normals[some], view.frames) | view.of_wall(some)
    sure = some[~doubtful]
    if graph.areas[sure].sum() < _WALL_SHARE * graph.areas[some].sum():
        sure = some  # furniture of the wall's color
    return main_colors(graph, sure)


def main_colors(graph: MeshGraph, vertices: np.ndarray) -> np.ndarray:
    """Return the colors (k, 3), weighted CIELAB, that cover a good part of the area of some vertices.

    None (k = 0) where no color does: on a print of many.
    """
    nearest, means = palette(graph.lab[vertices] * LIGHTNESS_WEIGHT, _COLORS, _COLOR_GAP)
    area = np.bincount(nearest, weights=graph.areas[vertices], minlength=len(means))
    return means[area > _MOST_FOREIGN * area.sum()]


def _is_thing(graph: MeshGraph, part: np.ndarray, support: SupportRegion, config: InstancesConfig) -> bool:
    """Tell a thing on a support from a strip along its edge, a corner of it and a scrap in mid-air."""
    points, areas = graph.points[part], graph.areas[part]
    if len(part) < _MIN_VERTICES or areas.sum() < config.min_object_area_m2:
        return False
    low, high = np.stack([quantiles(points[:, k], areas, (0.02, 0.98)) for k in range(3)], axis=1)
    size = high - low
    slim = min(size[:2]) < _SLIM_M or np.sort(size)[1] < config.min_object_m
    if slim or size.max() > _MOST_M or low[2] - support.height_m > _LOW_M:
        return False
    if high[2] - support.height_m < _RISE_M:
        return False
    return bool(bulge(graph, part) > _MIN_BULGE or _is_bowl(graph, part, size))


def _is_bowl(graph: MeshGraph, part: np.ndarray, size: np.ndarray) -> bool:
    """Tell an open thing, whose inside does not bulge: about as long as wide, without bays in its outline."""
    if min(size[:2]) < _BOWL_M or min(size[:2]) < _ROUND * max(size[:2]):
        return False
    flat = graph.points[part, :2]
    return solidity(flat) > _SOLID


def _without_fringes(graph: MeshGraph, parts: list[np.ndarray]) -> list[np.ndarray]:
    """Leave out what is small beside a larger one: smears around it."""
    kept: list[np.ndarray] = []
    for part in sorted(parts, key=lambda p: (-graph.areas[p].sum(), p[0])):
        area = graph.areas[part].sum()
        for other in kept:
            if area < _BESIDE_SHARE * graph.areas[other].sum() and _gap(graph, part, other) < _BESIDE_M:
                break
        else:
            kept.append(part)
    return kept


def _gap(graph: MeshGraph, part: np.ndarray, other: np.ndarray) -> float:
    outline = cv2.convexHull(graph.points[other, :2].astype(np.float32))
    return -float(inset(outline, graph.points[part, :2]).max())
