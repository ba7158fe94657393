"""A flat thing that reaches beyond what it lies on: a plate on a carton, a book on a box.

It hides from above where it lies, and depth smears its rim down along what is below; it is told by its outline, which
steps out, and by the colors of its rim and of what is below.
"""

import cv2
import numpy as np

from reconstruction.instances.boxes import quantiles
from reconstruction.instances.colors import LIGHTNESS_WEIGHT
from reconstruction.instances.columns import (
    BELOW,
    CONTRAST,
    FAR_M,
    MIN_KNOWN,
    MIN_SAMPLES,
    NEAR_M,
    SEAM_COLOR,
    SEAMS,
    STEEP,
    medians,
    polar,
    upright_share,
)
from reconstruction.instances.image_colors import SurfaceSamples
from reconstruction.instances.outlines import inset
from reconstruction.surface.mesh_graph import MeshGraph

_WIDE_M = 0.13  # how wide flat things are at least
_FLAT_M = 0.07  # height of the highest that may lie across what is smaller
_OUT_M, _OUT, _LEAST_OUT = 0.01, 0.4, 0.3  # how far it reaches beyond that, in what share of directions
_RIM_SHARE = 90  # percentile of radii that is its rim
_TOP, _TOP_SHARE = 0.6, 0.35  # z of the normals of its top, and share of its outline that this is
_STEM = 0.4  # of its reach: what is slimmer below is the stem of one thing
_LOWEST_SHARE = 0.1  # of its level surface: below that it ends
_THIN_M = 0.025  # a seam as near to the level part hardly has anything of the lower one above it
_SLACK_M = 0.005  # beyond the outline of the sides


def is_flat(graph: MeshGraph, piece: np.ndarray) -> bool:
    """Tell what is low, wide and mostly a top: a plate, a book, a tray."""
    points, areas = graph.points[piece], graph.areas[piece]
    wide, deep, high = (np.ptp(quantiles(points[:, k], areas, (0.02, 0.98))) for k in range(3))
    if high > _FLAT_M or min(wide, deep) < _WIDE_M:
        return False
    return bool(areas[graph.normals[piece, 2] > _TOP].sum() > _TOP_SHARE * wide * deep)


def score_of_flat(own: SurfaceSamples, above: np.ndarray, height: float) -> float:
    """Return how sure it is that samples `above` (mask) a height are of a flat thing that lies across those below."""
    z, steep = own.points[:, 2], np.abs(own.normals[:, 2]) < STEEP
    upper = above & (z > height) & (z < height + FAR_M)
    lower = ~above & (z < height - NEAR_M) & (z > height - FAR_M)
    column = lower & steep
    if column.sum() < MIN_SAMPLES:
        return 0.0
    radius, turn = polar(own, column)
    below, reach = medians(radius, turn, column), medians(radius, turn, upper, _RIM_SHARE)
    known = np.isfinite(below) & np.isfinite(reach)
    if known.sum() < MIN_KNOWN or np.median(below[known]) < _STEM * np.median(reach[known]):
        return 0.0
    out = float((reach - below > _OUT_M)[known].mean())
    if out < _LEAST_OUT:
        return 0.0
    rim = upper & (radius > below[turn] - _OUT_M)
    seen = np.isfinite(own.lab[:, 0])
    if min((rim & seen).sum(), (column & seen).sum()) < MIN_SAMPLES:
        return 0.0
    lab = own.lab * LIGHTNESS_WEIGHT
    sides = [np.stack([medians(lab[:, k], turn, side & seen) for k in range(3)], 1) for side in (rim, column)]
    steps = np.linalg.norm(sides[0] - sides[1], axis=1)
    steps = steps[np.isfinite(steps)]
    if len(steps) < MIN_KNOWN:
        return 0.0
    contrast = np.linalg.norm(np.median(lab[rim & seen], axis=0) - np.median(lab[column & seen], axis=0))
    upright = min(1.0, upright_share(own, lower & (radius < below[turn] + _OUT_M)) / BELOW)
    shape = min(1.0, out / _OUT) * upright
    return shape * float((steps > SEAM_COLOR).mean()) / SEAMS * min(2.0, float(contrast) / CONTRAST)


def without_sides(graph: MeshGraph, body: np.ndarray, piece: np.ndarray, height: float) -> np.ndarray:
    """Return the vertices of a flat piece of a body without the sides of what it lies on.

    A seam is at a height that is sure, below where the two touch. What is steep there, lower than the level part of the
    flat thing and over the lower one's outline, belongs to the lower one.
    """
    rest = np.setdiff1d(body, piece, assume_unique=True)
    below = height - graph.points[rest, 2]
    sides = rest[(below > 0) & (below < FAR_M) & (np.abs(graph.normals[rest, 2]) < STEEP)]
    up = graph.normals[piece, 2] > _TOP
    if len(sides) < MIN_SAMPLES or not up.any():
        return piece
    level = quantiles(graph.points[piece[up], 2], graph.areas[piece[up]], (_LOWEST_SHARE,))[0]
    if level - height < _THIN_M:
        return piece
    outline = cv2.convexHull(graph.points[sides, :2].astype(np.float32))
    hanging = np.flatnonzero(~up & (graph.points[piece, 2] < level))
    over = inset(outline, graph.points[piece[hanging], :2]) > -_SLACK_M
    return np.delete(piece, hanging[over])
