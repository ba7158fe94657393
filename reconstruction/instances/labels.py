"""Coarse labels by rules on size, shape, place and support.

Confidences stay below the accuracy of the rules in generated rooms (docs/instances.md, `python -m benchmarks.labels`).
"""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.instances.boxes import UprightBox

UNKNOWN = ("unknown", 0.0)
_LEVEL_M = 0.04  # height of the bins in which horizontal surfaces are counted


@dataclass(frozen=True)
class ShapeFacts:
    """Measurements of an object that the label rules read."""

    extents_m: np.ndarray  # float64 (3,) of the upright box
    on_floor: bool
    attached: bool  # to a wall
    carries: int  # number of objects that rest on it
    flat_top_share: float  # up-facing area near the top, over the footprint of the box
    levels: int  # number of large horizontal surfaces at different heights
    hollow: bool  # the up-facing surface in the middle is lower than the top
    squareness: float  # 1: the sides face two directions at right angles; 0: they face all around
    outward: float  # 1: the sides face away from the center; 0: they also face inwards, as in a shelf
    side_share: float  # vertical area over all area
    fill: float  # area of the footprint (attached: of the outline from the front) over its bounding rectangle
    greenness: float  # share of green vertices


def shape_facts(
    graph: MeshGraph, vertices: np.ndarray, box: UprightBox, on_floor: bool, attached: bool, carries: int
) -> ShapeFacts:
    """Measure an object: the vertices int (n,), their box, and what is known of its support."""
    points, normals, areas = graph.points[vertices], graph.normals[vertices], graph.areas[vertices]
    plan = float(np.prod(box.extents_m[:2]))
    top = box.center[2] + 0.5 * box.extents_m[2]
    up = normals[:, 2] > 0.8
    near_top = up & (points[:, 2] > top - max(0.03, 0.12 * box.extents_m[2]))
    heights = points[up, 2]
    bins = np.arange(0, top + 2 * _LEVEL_M, _LEVEL_M)
    levels = np.histogram(heights, bins, weights=areas[up])[0] if up.any() else np.zeros(1)
    local = np.abs(box.plan_offsets(points)) / (0.5 * box.extents_m[:2])
    middle = (local.max(axis=1) < 0.45) & up
    hollow = bool(middle.any() and np.median(points[middle, 2]) < top - max(0.015, 0.3 * box.extents_m[2]))
    lab = graph.lab[vertices]
    green = (lab[:, 1] < -8) & (lab[:, 2] > 5)
    squareness, outward, side_share = _sides(points[:, :2] - box.center[:2], normals, areas)
    return ShapeFacts(
        box.extents_m, on_floor, attached, carries, float(areas[near_top].sum()) / max(plan, 1e-9),
        int((levels > 0.25 * plan).sum()), hollow, squareness, outward, side_share, _fill(points, box, attached),
        float(green.mean()),
    )  # fmt: skip


def _sides(flat: np.ndarray, normals: np.ndarray, areas: np.ndarray) -> tuple[float, float, float]:
    """Return squareness, outwardness and area share of the vertical surface, of points (n, 2) around the center."""
    upright = np.abs(normals[:, 2]) < 0.5
    total = float(areas[upright].sum())
    if total <= 0:
        return 0.0, 0.0, 0.0
    facing, weights = normals[upright, :2], areas[upright] / total
    angle = np.arctan2(facing[:, 1], facing[:, 0])
    squareness = float(np.hypot((weights * np.cos(4 * angle)).sum(), (weights * np.sin(4 * angle)).sum()))
    lengths = np.linalg.norm(flat[upright], axis=1) * np.linalg.norm(facing, axis=1)
    outward = float((weights * (flat[upright] * facing).sum(axis=1) / np.maximum(lengths, 1e-9)).sum())
    return squareness, outward, total / max(float(areas.sum()), 1e-12)


def _fill(points: np.ndarray, box: UprightBox, attached: bool) -> float:
    outline = box.plan_offsets(points)
    if attached:
        outline = np.column_stack([outline[:, int(np.argmax(box.extents_m[:2]))], points[:, 2]])
    hull = cv2.convexHull(outline.astype(np.float32))
    return float(cv2.contourArea(hull)) / max(float(np.prod(np.ptp(outline, axis=0))), 1e-9)


def coarse_label(facts: ShapeFacts) -> tuple[str, float]:
    """Return label and confidence; ("unknown", 0) where no rule applies."""
    width, depth = sorted(facts.extents_m[:2], reverse=True)[:2]
    height = float(facts.extents_m[2])
    if facts.attached:
        return _on_wall(width, depth, height, facts)
    if facts.on_floor and max(width, height) > 0.35:
        return _furniture(width, depth, height, facts)
    return _small_thing(width, depth, height, facts)


def _on_wall(width: float, depth: float, height: float, facts: ShapeFacts) -> tuple[str, float]:
    if depth < 0.1 and min(width, height) > 0.2 and 0.3 < height / width < 3.3 and facts.fill > 0.85:
        return "picture", 0.6
    if 0.1 < depth < 0.5 and facts.flat_top_share > 0.4 and width > 2 * height:
        return "shelf", 0.4
    return UNKNOWN


def _furniture(width: float, depth: float, height: float, facts: ShapeFacts) -> tuple[str, float]:
    solid = facts.outward > 0.55 and facts.side_share > 0.5
    if facts.greenness > 0.4 and facts.flat_top_share < 0.3:
        return "plant", 0.5
    if facts.levels >= 3 and height > 0.6:
        return "shelf", 0.7
    if facts.levels >= 2 and height > 0.9 and facts.hollow:
        return "shelf", 0.5
    if height > 0.4 and solid and facts.squareness > 0.6:
        return "cabinet", 0.4
    top = facts.flat_top_share > 0.55 or (facts.carries >= 3 and facts.levels >= 1)
    if top and 0.3 < height < 0.6 and depth < 0.42 * width:
        return "seat", 0.4
    if top and 0.25 < height < 1.15 and width > 0.5 and not solid:
        return "table", 0.7 if facts.carries else 0.5
    if 0.3 < height < 0.6 and width < 0.5 and facts.flat_top_share > 0.5:
        return "seat", 0.35
    if 0.6 < height < 1.3 and 0.35 < width < 0.8 and facts.levels >= 1 and facts.flat_top_share < 0.5:
        return "seat", 0.4
    if height <= 0.5 and width < 0.7 and facts.squareness > 0.3:
        return "box", 0.4
    return UNKNOWN


def _small_thing(width: float, depth: float, height: float, facts: ShapeFacts) -> tuple[str, float]:
    if max(width, height) > 0.7:
        return UNKNOWN
    slender = height / max(width, 1e-3)
    square = facts.squareness > 0.27
    if facts.greenness > 0.5 and height > 0.1 and not square and facts.outward < 0.8:
        return "plant", 0.3
    if height < 0.05 and not square and depth > 0.75 * width and width > 0.15:
        return "plate", 0.5
    if square:
        return _square_thing(width, depth, height, facts)
    if max(width, height) < 0.075:
        return UNKNOWN
    if slender < 0.5:
        return ("bowl", 0.5) if facts.hollow and 0.1 < width < 0.4 else UNKNOWN
    if slender < 0.95:
        return ("cup", 0.5) if facts.hollow else UNKNOWN
    if slender < 1.55:
        return ("can", 0.35) if facts.flat_top_share > 0.3 and width < 0.13 else UNKNOWN
    return ("bottle", 0.35) if height < 0.45 else UNKNOWN


def _square_thing(width: float, depth: float, height: float, facts: ShapeFacts) -> tuple[str, float]:
    if facts.hollow and width > 0.2 and height < 0.6 * width:
        return ("tray", 0.35) if height < 0.2 else ("box", 0.5)
    if height < 0.07 and width > 0.13 and facts.flat_top_share > 0.4:
        return "book", 0.3
    if height < 0.04 or facts.side_share < 0.1 or facts.outward < 0:
        return UNKNOWN  # too little was observed to tell the shape
    return "box", 0.5
