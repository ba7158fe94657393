"""What rises beside a lower thing that it touches: a carton at a tray's rim, a candle beside a lemon.

Depth fills the gap between the two with a sheet as high as the lower one. Above that the tall one stands alone, and
right below what stands alone there it reaches down to the ground, next to the lower one and not over it, in other
colors. A chimney is over its house, a handle does not reach the ground, and a bottle has its neck over its body.
"""

import cv2
import numpy as np

from reconstruction.instances.boxes import quantiles
from reconstruction.instances.colors import LIGHTNESS_WEIGHT
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.image_colors import SurfaceSamples
from reconstruction.instances.outlines import inset
from reconstruction.instances.two_colors import Paint
from reconstruction.surface.mesh_graph import MeshGraph, pieces

_LEVELS = (0.5, 0.6, 0.7, 0.8)  # of the height: somewhere there the tall one is alone
_CLEAR = 0.3  # of the lower one's height: below it are skirts, and the colors of the ground
_HIGHER_M, _LOWER_M = 0.03, 0.02  # how much the tall one rises above the low one, and that above the ground
_GROUND_M = 0.025  # both stand on the same
_SLACKS_M = (0.008, 0.016, 0.024)  # around the outline of the tall one: it may be wider below
_MOST_OVER = 0.3  # share of the tall one's outline that is over the low one's
_LIKE_GROUND = 12.0
_WITH_SIDES = (0.8, 1.5)  # surface as a share of its outline: of less, a sheet; of more, with sides and a top
_LEAST_SHARE, _MOST_COMMON = 0.08, 0.22  # of the area on either side; of it in colors that the other has, too


def tower_parts(
    graph: MeshGraph,
    body: np.ndarray,
    samples: SurfaceSamples,
    ground: np.ndarray,
    config: InstancesConfig,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the vertices of a tall and a low thing that touch, the larger first; None if there is but one.

    Args:
        graph: the surface.
        body: vertices of what may be two things.
        samples: of the same, with colors.
        ground: float64 (k, 3) colors, weighted CIELAB, of what carries it: smears of that are no low thing.
        config: how large a thing is at least.
    """
    points, areas = graph.points[body], graph.areas[body]
    bottom, top = quantiles(points[:, 2], areas, (0.01, 0.99))
    if top - bottom < _HIGHER_M + _LOWER_M:
        return None
    best, found = _MOST_COMMON, None
    for share in _LEVELS:
        high = body[points[:, 2] > bottom + share * (top - bottom)]
        alone = [p for p in pieces(graph, high) if graph.areas[p].sum() > 0.5 * config.min_object_area_m2]
        for upper in [*alone, *([np.concatenate(alone)] if len(alone) > 1 else [])]:
            outline = cv2.convexHull(graph.points[upper, :2].astype(np.float32))
            within = inset(outline, points[:, :2])
            slack = next(
                (m for m in _SLACKS_M if _stand_apart(points, areas, within > -m, outline, bottom)), None
            )
            if slack is None:
                continue
            column = within > -slack
            low_top = quantiles(points[~column, 2], areas[~column], (0.98,))[0]
            clear = samples.points[:, 2] > bottom + _CLEAR * (low_top - bottom)
            seen = samples.of(clear & np.isfinite(samples.lab[:, 0]))
            upright = inset(outline, seen.points[:, :2]) > -slack
            if not len(seen.points):
                continue
            common = Paint.of(seen).common(upright)
            if common < best and not _is_sheet(points, areas, ~column, seen.of(~upright), ground):
                best, found = common, column
    if (
        found is None
        or min(_width(points[side], areas[side]) for side in (found, ~found)) < config.min_object_m
    ):
        return None
    first, second = sorted((body[found], body[~found]), key=lambda part: -graph.areas[part].sum())
    return first, second


def _width(points: np.ndarray, areas: np.ndarray) -> float:
    """Return the lesser of the extents in plan: slivers are no things."""
    return min(float(np.ptp(quantiles(points[:, k], areas, (0.02, 0.98)))) for k in range(2))


def _is_sheet(
    points: np.ndarray, areas: np.ndarray, low: np.ndarray, samples: SurfaceSamples, ground: np.ndarray
) -> bool:
    """Tell whether what is low (mask) is smeared ground: without sides, or hardly with, and of the ground's colors."""
    outline = cv2.convexHull(points[low, :2].astype(np.float32))
    solid = float(areas[low].sum()) / max(cv2.contourArea(outline), 1e-9)
    if solid < _WITH_SIDES[0] or solid > _WITH_SIDES[1] or not len(ground):
        return solid < _WITH_SIDES[0]
    lab = samples.lab * LIGHTNESS_WEIGHT
    gap = np.linalg.norm(lab[:, None] - ground[None], axis=2).min(axis=1)
    return bool(samples.areas[gap < _LIKE_GROUND].sum() > 0.5 * samples.areas.sum())


def _stand_apart(
    points: np.ndarray, areas: np.ndarray, column: np.ndarray, outline: np.ndarray, bottom: float
) -> bool:
    """Tell whether what is in a column (mask) and the rest both stand on the ground, the rest lower and beside it."""
    share = areas[column].sum() / areas.sum()
    if min(share, 1.0 - share) < _LEAST_SHARE:
        return False
    (low, high), (rest_low, rest_high) = (
        quantiles(points[side, 2], areas[side], (0.02, 0.98)) for side in (column, ~column)
    )
    if max(low, rest_low) > bottom + _GROUND_M or rest_high > high - _HIGHER_M:
        return False
    if rest_high < bottom + _LOWER_M:
        return False
    around = cv2.convexHull(points[~column, :2].astype(np.float32))
    if len(around) < 3 or len(outline) < 3:
        return False
    over = cv2.intersectConvexConvex(around, outline)[0]
    return bool(over < _MOST_OVER * cv2.contourArea(outline))
