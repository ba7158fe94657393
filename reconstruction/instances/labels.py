"""Coarse classes of things: shape, place and color of a thing's surface -> class with its probability.

Boosted trees, one sum for each class, fitted to generated rooms whose things have names (`python -m priors.labels`,
docs/instances.md#labels). What they are not sure of is unknown.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from reconstruction.instances.boxes import UprightBox
from reconstruction.instances.partition.boosting import Boosted
from reconstruction.surface.mesh_graph import MeshGraph
from registry.errors import EnvironmentMissing

UNKNOWN = "unknown"
CLASSES = (
    UNKNOWN, "table", "shelf", "cabinet", "seat", "box", "book", "can", "bottle", "cup", "bowl", "plate", "tray",
    "picture", "plant", "lamp",
)  # fmt: skip
LABEL_FEATURES = (
    "width", "depth", "height", "depth_of_width", "height_of_width", "bottom", "top", "on_floor", "attached", "carries",
    "flat_top", "levels", "middle_below_top", "squareness", "outward", "sides", "up", "down", "outline_fill",
    "hull_fill", "area_of_hull", "lightness", "red", "yellow", "lightness_spread", "color_spread", "green",
)  # fmt: skip
WEIGHTS = Path(__file__).parent / "weights" / "labels.safetensors"
_UP, _UPRIGHT = 0.8, 0.5  # vertical part of normals
_LEVEL_M = 0.04  # surface within such a layer is of one level
_LEVEL_SHARE = 0.25  # of the ground plan
_TOP_SHARE, _TOP_M = 0.12, 0.03  # of the height
_MIDDLE = 0.45  # of the half sides
_GREEN = (-8, 5)  # a below, b above
_TINY = 1e-9


@dataclass(frozen=True)
class LabelModel:
    """Trees of each class; the scores' softmax are probabilities."""

    trees: tuple[Boosted, ...]  # in the order of CLASSES
    sharpness: float  # factor on scores, which calibrates the probabilities

    def probabilities(self, rows: np.ndarray) -> np.ndarray:
        """Return float64 (m, len(CLASSES)) of features float32 (m, len(LABEL_FEATURES))."""
        scores = self.sharpness * np.stack([tree(rows) for tree in self.trees], axis=1).astype(np.float64)
        odds = np.exp(scores - scores.max(axis=1, keepdims=True))
        return odds / odds.sum(axis=1, keepdims=True)


@lru_cache(maxsize=2)
def load_labels(weights: Path = WEIGHTS) -> LabelModel:
    """Read the trees, named `<class>.<array>`, and `sharpness`.

    Raises:
        EnvironmentMissing: the file is not there or is not what this version reads.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    try:
        stored = load_file(weights)
        trees = tuple(
            Boosted.named({k[len(c) + 1 :]: v for k, v in stored.items() if k.startswith(f"{c}.")})
            for c in CLASSES
        )
        if {int(tree.features) for tree in trees} != {len(LABEL_FEATURES)}:
            raise KeyError(f"made for {int(trees[0].features)} features")
        return LabelModel(trees, float(stored["sharpness"][0]))
    except (OSError, KeyError, ValueError, SafetensorError) as error:
        raise EnvironmentMissing(
            f"instances: the weights {weights} cannot be read ({error}). Install the package again."
        ) from error


def coarse_label(features: np.ndarray) -> tuple[str, float]:
    """Return the most probable class and its probability; an unknown thing has confidence 0.

    Args:
        features: float32 (len(LABEL_FEATURES),) of `label_features`.
    """
    probability = load_labels().probabilities(features[None])[0]
    best = int(np.argmax(probability))
    return (CLASSES[best], round(float(probability[best]), 2)) if best else (UNKNOWN, 0.0)


def label_features(
    graph: MeshGraph, vertices: np.ndarray, box: UprightBox, on_floor: bool, attached: bool, carries: int
) -> np.ndarray:
    """Return float32 (len(LABEL_FEATURES),) of a thing.

    Args:
        graph: the surface, world metres, +z up.
        vertices: int (k,) the thing's.
        box: around it.
        on_floor: whether it stands on the floor.
        attached: whether it hangs on a wall.
        carries: how many things rest on it.
    """
    points, normals, areas = graph.points[vertices], graph.normals[vertices], graph.areas[vertices]
    lab = graph.lab[vertices].astype(np.float64)
    weight = np.maximum(areas, _TINY)
    depth, width = sorted(box.extents_m[:2])
    height, plan = float(box.extents_m[2]), float(np.prod(box.extents_m[:2]))
    top = float(box.center[2] + 0.5 * height)
    up, down = normals[:, 2] > _UP, normals[:, 2] < -_UP
    near_top = up & (points[:, 2] > top - max(_TOP_M, _TOP_SHARE * height))
    layers = np.histogram(points[up, 2], np.arange(0, top + 2 * _LEVEL_M, _LEVEL_M), weights=areas[up])[0]
    turned = _turned(points[:, :2] - box.center[:2], box.yaw_rad) / (0.5 * box.extents_m[:2])
    middle = (np.abs(turned).max(axis=1) < _MIDDLE) & up
    below = (top - float(np.median(points[middle, 2]))) / height if middle.any() else -1.0
    color = np.average(lab, axis=0, weights=weight)
    spread = np.sqrt(np.average((lab - color) ** 2, axis=0, weights=weight))
    green = (lab[:, 1] < _GREEN[0]) & (lab[:, 2] > _GREEN[1])
    volume, hull = _hull(points)
    total = float(weight.sum())
    return np.array(
        [width, depth, height, depth / width, height / width, top - height, top, on_floor, attached, carries,
         float(areas[near_top].sum()) / max(plan, _TINY), int((layers > _LEVEL_SHARE * plan).sum()), below,
         *_sides(points[:, :2] - box.center[:2], normals, areas), weight[up].sum() / total, weight[down].sum() / total,
         _outline_fill(points, box, attached), volume / max(plan * height, _TINY), total / max(hull, _TINY), *color,
         spread[0], float(np.hypot(*spread[1:])), np.average(green, weights=weight)],
        np.float32,
    )  # fmt: skip


def _turned(flat: np.ndarray, yaw_rad: float) -> np.ndarray:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return flat @ np.array([[c, -s], [s, c]])


def _hull(points: np.ndarray) -> tuple[float, float]:
    """Return volume and area of the convex hull; 0 where the points are in a plane."""
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return 0.0, 0.0
    return float(hull.volume), float(hull.area)


def _sides(flat: np.ndarray, normals: np.ndarray, areas: np.ndarray) -> tuple[float, float, float]:
    """Return squareness, outwardness and share of the upright part of points (n, 2) around a middle.

    Squareness is 1 where sides face two directions at right angles, 0 where they face all around. Outwardness is 1
    where they face away from the middle, less where they also face inwards, as in a shelf.
    """
    upright = np.abs(normals[:, 2]) < _UPRIGHT
    total = float(areas[upright].sum())
    if total <= 0:
        return 0.0, 0.0, 0.0
    facing, weights = normals[upright, :2], areas[upright] / total
    angle = np.arctan2(facing[:, 1], facing[:, 0])
    squareness = float(np.hypot((weights * np.cos(4 * angle)).sum(), (weights * np.sin(4 * angle)).sum()))
    lengths = np.linalg.norm(flat[upright], axis=1) * np.linalg.norm(facing, axis=1)
    outward = float((weights * (flat[upright] * facing).sum(axis=1) / np.maximum(lengths, _TINY)).sum())
    return squareness, outward, total / max(float(areas.sum()), _TINY)


def _outline_fill(points: np.ndarray, box: UprightBox, attached: bool) -> float:
    """Return the outline from above (of what hangs: from the front) over its bounding rectangle."""
    local = _turned(points[:, :2] - box.center[:2], box.yaw_rad)
    if attached:
        local = np.column_stack([local[:, int(np.argmax(box.extents_m[:2]))], points[:, 2]])
    hull = cv2.convexHull(local.astype(np.float32))
    return float(cv2.contourArea(hull)) / max(float(np.prod(np.ptp(local, axis=0))), _TINY)
