"""Connected bodies above the base: pieces of the surface, each with the parts that a hole in the surface tore from it.

Legs and thin boards are seen badly, tops gleam and have holes, sides are dark: what is one piece of furniture comes as
several pieces of surface. Signs that a piece belongs to another one:

- it is a leg or a side: slim, below the other one, reaching up to nearly its underside;
- it is a large thing in mid-air above something that reaches up to it;
- it is in mid-air just over the level of a support of the other one, within its outline: it stands there, or is itself
  an island of the support; which of them is found when the body is cut;
- it is in mid-air, of the other one's color where they are nearest, and within its box or a small piece beside it.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from reconstruction.instances.boxes import quantiles
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.supports import SupportRegion, contact_height, find_supports
from reconstruction.instances.tops import cut_between_tops
from reconstruction.surface.mesh_graph import MeshGraph, pieces

_CRUMB_REACH_M = 0.04
_AIR_M = 0.1  # what begins higher than this does not stand on the floor
_OVER_LOW_M, _OVER_HIGH_M, _MIN_OVER = (
    -0.02,
    0.04,
    0.6,
)  # foot over a support, and its share within the outline
_TORN_GAP_M, _TORN_COLOR = 0.12, 12.0
_SCRAP_GAP_M, _SCRAP_COLOR = 0.15, 6.0


@dataclass
class _Body:
    """A piece of surface with what is asked of it again and again."""

    graph: MeshGraph
    vertices: np.ndarray  # int (n,) sorted

    def __post_init__(self) -> None:
        points, areas = self.graph.points[self.vertices], self.graph.areas[self.vertices]
        self.area_m2 = float(areas.sum())
        self.low, self.high = points.min(axis=0), points.max(axis=0)
        self.bottom, self.lower, self.upper, self.top = quantiles(points[:, 2], areas, (0.02, 0.1, 0.9, 0.98))
        self._tree: cKDTree | None = None
        self._supports: list[SupportRegion] | None = None

    @property
    def points(self) -> np.ndarray:
        return self.graph.points[self.vertices]

    @property
    def tree(self) -> cKDTree:
        if self._tree is None:
            self._tree = cKDTree(self.points)
        return self._tree

    def supports(self, config: InstancesConfig) -> list[SupportRegion]:
        if self._supports is None:
            self._supports = find_supports(self.graph, self.vertices, config)
        return self._supports

    def within(self, other: "_Body", margin_m: float, axes: int) -> float:
        """Return the share of its points within the other one's box, grown by a margin."""
        low, high = other.low[:axes] - margin_m, other.high[:axes] + margin_m
        points = self.points[:, :axes]
        return float(((points > low) & (points < high)).all(axis=1).mean())


@dataclass(frozen=True)
class Bodies:
    """What the surface above the base falls into."""

    whole: list[np.ndarray]  # sorted vertices of each
    standing: list[
        tuple[np.ndarray, int]
    ]  # things seen apart from what they stand on: vertices, index of the body


def find_bodies(graph: MeshGraph, rest: np.ndarray, config: InstancesConfig) -> Bodies:
    """Return the bodies among vertices `rest` (sorted indices, without the base)."""
    found = [
        _Body(graph, part)
        for piece in pieces(graph, rest, config.bridge_gap_m)
        for part in cut_between_tops(graph, piece)
    ]
    bodies = [body for body in found if body.area_m2 >= config.min_piece_area_m2]
    crumbs = [body.vertices for body in found if body.area_m2 < config.min_piece_area_m2]
    bodies = _with_stands(_with_legs(bodies))
    over = _over_supports(bodies, config)
    apart = {id(piece) for piece, _, _ in over}
    bodies = _with_torn([body for body in bodies if id(body) not in apart], config)
    standing = []
    for piece, body, support in over:
        level = support.height_m + contact_height(support, config)
        high = piece.vertices[graph.points[piece.vertices, 2] > level]
        if graph.areas[high].sum() >= config.min_piece_area_m2:
            standing.append((high, next(i for i, b in enumerate(bodies) if body.vertices[0] in b.vertices)))
        else:
            high = high[:0]
        crumbs.append(np.setdiff1d(piece.vertices, high, assume_unique=True))
    return Bodies(_with_crumbs(graph, [body.vertices for body in bodies], crumbs), standing)


def _with_legs(bodies: list[_Body]) -> list[_Body]:
    changed = True
    while changed:
        changed = False
        for lower in bodies:
            upper = next((body for body in bodies if body is not lower and _is_leg_of(lower, body)), None)
            if upper is not None:
                bodies = _joined(bodies, upper, lower)
                changed = True
                break
    return bodies


def _is_leg_of(lower: _Body, upper: _Body) -> bool:
    """A slim piece under a larger one that reaches up to nearly its underside is its leg (or its side)."""
    if lower.area_m2 > upper.area_m2 or lower.low[2] > upper.bottom:
        return False
    if upper.upper < 0.2 or lower.top > upper.upper + 0.02 or lower.within(upper, 0.05, 2) < 0.8:
        return False
    extents = lower.high - lower.low
    thickness = float(extents.min())
    slim = thickness < 0.12 and extents[2] > 0.05
    if slim and thickness < 0.05:
        return True
    gap = upper.upper - lower.top
    return gap < 0.15 * upper.upper or (slim and gap < 0.85 * upper.upper)


def _with_stands(bodies: list[_Body]) -> list[_Body]:
    """Join large things in mid-air to what must carry them: the pieces under them that reach up highest."""
    for upper in sorted(bodies, key=lambda body: -body.area_m2):
        if not any(body is upper for body in bodies):
            continue
        points, normals = upper.points, upper.graph.normals[upper.vertices]
        areas = upper.graph.areas[upper.vertices]
        spans = [np.diff(quantiles(points[:, k], areas, (0.02, 0.98)))[0] for k in (0, 1)]
        if upper.bottom < _AIR_M or min(spans) < 0.25 or np.average(normals[:, 2], weights=areas) < 0.2:
            continue
        for lower in list(bodies):
            if (
                lower is upper
                or not upper.bottom > lower.high[2] - 0.05
                or lower.high[2] < 0.4 * upper.bottom
            ):
                continue
            if lower.within(upper, 0.03, 2) > 0.8:
                bodies = _joined(bodies, upper, lower)
                upper = next(body for body in bodies if np.isin(upper.vertices[0], body.vertices))
    return bodies


def _over_supports(bodies: list[_Body], config: InstancesConfig) -> list[tuple[_Body, _Body, SupportRegion]]:
    """Return (piece, body, support) for the pieces in mid-air whose foot is over a support of a larger body."""
    found = []
    for piece in bodies:
        if piece.bottom < _AIR_M:
            continue
        points = piece.points
        foot = points[points[:, 2] < piece.bottom + 0.03, :2]
        over = (
            (piece, body, support)
            for body in sorted(bodies, key=lambda body: -body.area_m2)
            if body is not piece and body.area_m2 > piece.area_m2 and piece.within(body, 0.0, 2) > _MIN_OVER
            for support in body.supports(config)
            if _is_over(body, foot, piece.bottom, support)
        )
        one = next(over, None)
        if one is not None:
            found.append(one)
    carriers = {id(body) for _, body, _ in found}
    return [one for one in found if id(one[0]) not in carriers]


def _is_over(body: _Body, foot: np.ndarray, bottom: float, support: SupportRegion) -> bool:
    if not _OVER_LOW_M < bottom - support.height_m < _OVER_HIGH_M:
        return False
    hull = cv2.convexHull(body.graph.points[support.vertices, :2].astype(np.float32))
    inside = [cv2.pointPolygonTest(hull, (float(x), float(y)), False) >= 0 for x, y in foot]
    return bool(np.mean(inside) > _MIN_OVER)


def _with_torn(bodies: list[_Body], config: InstancesConfig) -> list[_Body]:
    """Join pieces in mid-air to the furniture that has their color where it is nearest: boards torn off by holes."""
    while True:
        pairs = [
            (gap, i, j)
            for i, piece in enumerate(bodies)
            if piece.low[2] >= _AIR_M
            for j, whole in enumerate(bodies)
            if whole.low[2] < _AIR_M and (gap := _torn_gap(piece, whole, config)) is not None
        ]
        if not pairs:
            return bodies
        _, i, j = min(pairs)
        bodies = _joined(bodies, bodies[j], bodies[i])


def _torn_gap(piece: _Body, whole: _Body, config: InstancesConfig) -> float | None:
    """Return the distance of a piece that was torn off `whole`; None if nothing says so."""
    reach, color = _TORN_GAP_M, _TORN_COLOR
    if piece.within(whole, 0.05, 3) < 0.8:  # beside it, only what would be a scrap by itself
        if (piece.high - piece.low).max() > config.min_floating_m:
            return None
        reach, color = _SCRAP_GAP_M, _SCRAP_COLOR
    if piece.within(whole, reach, 3) == 0.0:
        return None
    points = piece.points
    gap, index = whole.tree.query(points[:: max(1, len(points) // 500)])
    if gap.min() > reach:
        return None
    near = whole.vertices[index[np.argsort(gap, kind="stable")[: max(10, len(gap) // 5)]]]
    lab = piece.graph.lab
    apart = np.linalg.norm(np.median(lab[near], axis=0) - np.median(lab[piece.vertices], axis=0))
    return float(gap.min()) if apart < color else None


def _joined(bodies: list[_Body], into: _Body, other: _Body) -> list[_Body]:
    whole = _Body(into.graph, np.sort(np.concatenate([into.vertices, other.vertices])))
    return [whole if body is into else body for body in bodies if body is not other]


def _with_crumbs(graph: MeshGraph, bodies: list[np.ndarray], crumbs: list[np.ndarray]) -> list[np.ndarray]:
    """Give each crumb to the body that it nearly touches."""
    crumbs = [crumb for crumb in crumbs if len(crumb)]
    if not bodies or not crumbs:
        return bodies
    owner = np.concatenate([np.full(len(body), i) for i, body in enumerate(bodies)])
    tree = cKDTree(graph.points[np.concatenate(bodies)])
    distance, index = tree.query(graph.points[np.concatenate(crumbs)], distance_upper_bound=_CRUMB_REACH_M)
    parts = [[body] for body in bodies]
    start = 0
    for crumb in crumbs:
        nearest = start + int(np.argmin(distance[start : start + len(crumb)]))
        start += len(crumb)
        if np.isfinite(distance[nearest]):
            parts[owner[index[nearest]]].append(crumb)
    return [np.sort(np.concatenate(part)) for part in parts]
