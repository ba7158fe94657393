"""Coarse labels from size, shape, place and support; honest about how little that says."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.instances.boxes import UprightBox
from reconstruction.surface.mesh_graph import MeshGraph


@dataclass(frozen=True)
class ShapeFacts:
    """What a label is guessed from."""

    extents_m: np.ndarray  # float64 (3,) of the upright box
    on_floor: bool
    attached: bool
    carries: int  # how many things rest on it
    flat_top_share: float  # up-facing area near its top, over its ground plan
    levels: int  # number of large horizontal regions at different heights
    hollow: bool  # seen from above its middle is lower than its rim
    round_plan: bool  # ground plan closer to a disc than to a rectangle
    greenness: float  # share of green vertices


def shape_facts(
    graph: MeshGraph, vertices: np.ndarray, box: UprightBox, on_floor: bool, attached: bool, carries: int
) -> ShapeFacts:
    """Measure what labels are guessed from."""
    points, normals, areas = graph.points[vertices], graph.normals[vertices], graph.areas[vertices]
    plan = float(np.prod(box.extents_m[:2]))
    top = box.center[2] + 0.5 * box.extents_m[2]
    up = normals[:, 2] > 0.8
    near_top = up & (points[:, 2] > top - max(0.03, 0.12 * box.extents_m[2]))
    heights = points[up, 2]
    step = 0.04
    levels = (
        np.histogram(heights, np.arange(0, top + 2 * step, step), weights=areas[up])[0]
        if up.any()
        else np.zeros(1)
    )
    c, s = np.cos(box.yaw_rad), np.sin(box.yaw_rad)
    local = np.abs((points[:, :2] - box.center[:2]) @ np.array([[c, -s], [s, c]])) / (0.5 * box.extents_m[:2])
    middle = (local.max(axis=1) < 0.45) & up
    hollow = bool(middle.any() and np.median(points[middle, 2]) < top - max(0.015, 0.3 * box.extents_m[2]))
    hull = cv2.contourArea(cv2.convexHull(points[:, :2].astype(np.float32))) / max(plan, 1e-9)
    lab = graph.lab[vertices]
    green = (lab[:, 1] < -8) & (lab[:, 2] > 5)
    return ShapeFacts(
        box.extents_m,
        on_floor,
        attached,
        carries,
        float(areas[near_top].sum()) / max(plan, 1e-9),
        int((levels > 0.25 * plan).sum()),
        hollow,
        0.65 < hull < 0.87 and 0.8 < box.extents_m[0] / box.extents_m[1] < 1.25,
        float(green.mean()),
    )


def coarse_label(facts: ShapeFacts) -> tuple[str, float]:
    """Return (label, confidence)."""
    if facts.attached:
        thin = facts.extents_m[:2].min() < 0.1
        return ("picture", 0.6) if thin else ("unknown", 0.2)
    width, depth = sorted(facts.extents_m[:2], reverse=True)[:2]
    height = float(facts.extents_m[2])
    if facts.on_floor and max(width, height) > 0.35:
        return _furniture(width, depth, height, facts)
    return _small_thing(width, depth, height, facts)


def _furniture(width: float, depth: float, height: float, facts: ShapeFacts) -> tuple[str, float]:
    if facts.greenness > 0.4 and facts.flat_top_share < 0.3:
        return "plant", 0.5
    if facts.levels >= 3 and height > 0.6:
        return "shelf", 0.6
    if 0.25 < height < 1.15 and facts.flat_top_share > 0.55 and width > 0.5:
        return "table", 0.65 if facts.carries else 0.5
    if 0.6 < height < 1.3 and 0.35 < width < 1.0 and facts.levels >= 1 and facts.flat_top_share < 0.4:
        return "seat", 0.45
    if height > 1.0 and height > 1.2 * depth:
        return "cabinet", 0.4
    if 0.3 < height < 1.1 and width > 1.2 and facts.flat_top_share < 0.5:
        return "seat", 0.35
    if height <= 0.5 and width < 0.7:
        return "box", 0.4
    return "unknown", 0.2


def _small_thing(width: float, depth: float, height: float, facts: ShapeFacts) -> tuple[str, float]:
    slender = height / max(width, 1e-3)
    if facts.greenness > 0.5 and height > 0.1:
        return "plant", 0.3
    if height < 0.035 and facts.round_plan and width > 0.12:
        return "plate", 0.5
    if height < 0.075 and width > 0.1 and depth > 0.08 and facts.flat_top_share > 0.55:
        return "book", 0.4
    if facts.hollow and slender < 0.75:
        if facts.round_plan and width < 0.35:
            return "bowl", 0.45
        return ("tray", 0.45) if height < 0.2 and width > 0.2 else ("box", 0.4)
    if 0.06 < height < 0.16 and facts.hollow:
        return "cup", 0.45
    if slender > 1.5 and facts.round_plan and height > 0.1:
        return "bottle", 0.35
    if facts.flat_top_share > 0.5 and not facts.round_plan:
        return "box", 0.4
    return "unknown", 0.2
