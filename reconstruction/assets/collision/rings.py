"""Walls of a container: a ring around a hole, cut into sectors by vertical planes through the hole.

Decomposers that search for the flattest cut close the hole of a thin ring with a few broad hulls. Cut at the hole's
corners first, a box falls into its four walls and a mug into slim wedges.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import cv2
import numpy as np

from reconstruction.assets.collision.convexity import waste
from reconstruction.assets.solid import Solid, from_manifold, manifold_of, raster_section

if TYPE_CHECKING:
    import manifold3d

_CELLS = 96  # of the raster of a horizontal section, along its longer side
_SECTIONS = (0.15, 0.4, 0.65, 0.9)  # relative heights at which an opening must be open
_HOLE_SHARE = 0.04  # least area of the opening, relative to the bounding rectangle
_ENOUGH = 1.3  # accepted empty space in the hulls, relative to the best cut
_CUTS = ((1, 4), (1, 8), (2, 4), (1, 16), (2, 8), (3, 4), (3, 8), (2, 16), (3, 16))  # layers, sectors of each
_CRUMB_SHARE = 0.002  # of a sector's mean volume: smaller pieces are dropped


@dataclass(frozen=True)
class Hole:
    """A vertical opening through a solid."""

    center: np.ndarray  # float64 (2,) metres
    corners: np.ndarray  # float64 (4,) radians, ascending: directions from the center to the corners


def find_hole(solid: Solid) -> Hole | None:
    """Return the largest opening that a solid encloses, seen from above; None where there is none."""
    body = manifold_of(solid)
    if body is None:
        return None
    (low, bottom), (high, top) = ((end[:2], float(end[2])) for end in solid.bounds)
    cell = float((high - low).max()) / _CELLS
    size = np.ceil((high - low) / cell).astype(int) + 4
    covered = np.zeros((size[1], size[0]), np.uint8)
    for share in _SECTIONS:
        covered |= raster_section(body, bottom + share * (top - bottom), low, cell, 2, size)
    count, label = cv2.connectedComponents(1 - covered, connectivity=4)
    outside = label[0, 0]
    areas = np.bincount(label[covered == 0].ravel(), minlength=count) * cell**2
    areas[[0, outside]] = 0
    if areas.max() < _HOLE_SHARE * float(np.prod(high - low)):
        return None
    hole = (label == int(np.argmax(areas))).astype(np.uint8)
    depth = cv2.distanceTransform(np.pad(hole, 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    row, column = np.unravel_index(np.argmax(depth), depth.shape)
    center = low + (np.array([column, row]) + 0.5 - 2) * cell
    outline = np.argwhere(hole > 0)[:, ::-1].astype(np.float32)
    corners = low + (cv2.boxPoints(cv2.minAreaRect(outline)) + 0.5 - 2) * cell - center
    return Hole(center, np.sort(np.arctan2(corners[:, 1], corners[:, 0])))


def ring_pieces(solid: Solid, hole: Hole, budget: int, allowed_m3: float) -> list[Solid]:
    """Cut a ring into the fewest pieces whose hulls contain little more empty space than those of the best cut.

    Args:
        solid: the ring.
        hole: its opening.
        budget: most pieces, 4 at least.
        allowed_m3: empty space that is accepted anyway.
    """
    cuts = [
        _cut(solid, hole, layers, sectors) for layers, sectors in _CUTS if layers * sectors <= max(budget, 4)
    ]
    wasted = [sum(waste(piece) for piece in cut) for cut in cuts]
    enough = _ENOUGH * min(wasted) + allowed_m3
    return next(cut for cut, lost in zip(cuts, wasted) if lost <= enough)


def _cut(solid: Solid, hole: Hole, layers: int, sectors: int) -> list[Solid]:
    """Cut a ring into layers of equal height and each into sectors, with cuts at the hole's corners."""
    low, high = float(solid.vertices[:, 2].min()), float(solid.vertices[:, 2].max())
    body = manifold_of(solid)
    if body is None:
        return [solid]
    rings = []
    for height in np.linspace(low, high, layers + 1)[1:-1]:
        body, below = body.split_by_plane((0.0, 0.0, 1.0), float(height))
        rings.append(below)
    rings.append(body)
    ends = np.append(hole.corners, hole.corners[0] + 2 * np.pi)
    parts = max(1, sectors // 4)
    angles = np.concatenate([np.linspace(a, b, parts, endpoint=False) for a, b in pairwise(ends)])
    angles = np.append(angles, ends[-1])
    out = []
    for ring in rings:
        for start, end in pairwise(angles):
            for piece in _sector(ring, hole.center, start, end).decompose():
                made = from_manifold(piece)
                if made.volume > _CRUMB_SHARE * solid.volume / (layers * sectors):
                    out.append(made)
    return out or [solid]


def _sector(
    ring: "manifold3d.Manifold", center: np.ndarray, start: float, end: float
) -> "manifold3d.Manifold":
    """Return the part of a ring between two directions from a vertical axis, less than half a turn apart."""
    for angle, side in ((start, 1.0), (end, -1.0)):
        normal = side * np.array([-np.sin(angle), np.cos(angle)])
        ring = ring.trim_by_plane((float(normal[0]), float(normal[1]), 0.0), float(normal @ center))
    return ring
