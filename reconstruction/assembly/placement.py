"""Where one object stands so far, and what is asked of it alone."""

from dataclasses import dataclass, replace

import numpy as np

from reconstruction.assembly.base import base_slabs
from reconstruction.assembly.collision import flatten_foot, with_legs
from reconstruction.assembly.config import AssemblyConfig
from reconstruction.assets.gltf import written_corners
from reconstruction.core.types import AssetSet, BaseAsset, ConvexPart, Edge, ObjectAsset
from registry.geometry import rigid, transform_points
from registry.simulation import BASE_FRICTION, BASE_RESTITUTION, BodySpec

_FURNITURE_LABELS = (
    "table",
    "desk",
    "shelf",
    "bookshelf",
    "cabinet",
    "sofa",
    "bed",
    "chair",
    "counter",
    "wardrobe",
)
TOUCH_GAP_M = 2e-4  # hanging things and furniture stop this far short of what they touch
WORTH_SAYING_M = 0.005


@dataclass(frozen=True)
class Placement:
    """Where an object stands so far."""

    asset: ObjectAsset
    edge: Edge
    pose: np.ndarray  # (4, 4)
    parts: tuple[ConvexPart, ...]
    unflattened: tuple[ConvexPart, ...]  # before its foot was
    dynamic: bool
    band_mm: float  # how much of its foot was flattened
    notes: tuple[str, ...]
    stands: bool

    def noted(self, note: str, **changes: object) -> "Placement":
        """Return a copy with one more note."""
        return replace(self, notes=(*self.notes, note), **changes)


def base_specs(assets: AssetSet) -> list[BodySpec]:
    """Describe floor, walls and ceiling to the physics."""
    return [
        BodySpec(
            b.id,
            f"{b.label}_{b.id}",
            tuple(written_corners(p) for p in base_slabs(b)),
            0.0,
            np.zeros(3),
            None,
            BASE_FRICTION,
            BASE_RESTITUTION,
            np.eye(4),
            False,
            base=True,
        )
        for b in assets.base
    ]


def world_points(parts: tuple[ConvexPart, ...], pose: np.ndarray) -> np.ndarray:
    """Return all collision vertices (n, 3) in world space."""
    return transform_points(pose, np.concatenate([np.asarray(p.vertices, np.float64) for p in parts]))


def is_furniture(asset: ObjectAsset, on_base: bool, config: AssemblyConfig) -> bool:
    """Tell whether an object is too large or too heavy to be moved by a robot arm or a bump."""
    extent = float(np.ptp(np.asarray(asset.visual.vertices), axis=0).max())
    labelled = any(word in asset.label.lower().split() for word in _FURNITURE_LABELS)
    large = extent > config.fixed_extent_m or (labelled and extent > 0.65 * config.fixed_extent_m)
    return (on_base and large) or asset.physics.mass_kg > config.fixed_mass_kg


def moves_by_rule(
    asset: ObjectAsset, edge: Edge, on_base: bool, parent_moves: bool, config: AssemblyConfig
) -> bool:
    """Tell whether an object can move in the simulation: furniture cannot, nor what hangs on what cannot."""
    if edge.relation == "attached_to":
        return parent_moves
    return not is_furniture(asset, on_base, config)


def upright(pose: np.ndarray, max_tilt_deg: float) -> np.ndarray:
    """Remove the tilt of a pose that is nearly upright; heading and position stay."""
    up = pose[:3, 2]
    axis = np.cross(up, [0, 0, 1.0])
    sine, cosine = np.linalg.norm(axis), up[2]
    angle = np.degrees(np.arctan2(sine, cosine))
    if angle < 1e-6 or angle > max_tilt_deg:
        return pose
    axis = axis / sine
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = np.eye(3) + sine * k + (1 - cosine) * k @ k
    return rigid(turn @ pose[:3, :3], pose[:3, 3])


def flattened(item: Placement, band_mm: float) -> Placement:
    up = item.pose[:3, :3].T @ np.array([0, 0, 1.0])
    parts = flatten_foot(item.unflattened, up, band_mm * 1e-3)
    kept = tuple(n for n in item.notes if not n.startswith("foot flattened"))
    return replace(item, parts=parts, band_mm=band_mm, notes=(*kept, f"foot flattened by {band_mm:g} mm"))


def on_legs(item: Placement) -> Placement:
    """Give an upright thing that tips the legs that it must have had, since it stood; slim ones escape the depth."""
    if item.pose[2, 2] < 1 - 1e-6:
        return item
    unflattened = with_legs(item.unflattened)
    if unflattened is item.unflattened:
        return item
    item = item.noted("tips as it was seen: it got legs at its corners, in its collision shape only")
    return replace(item, parts=unflattened, unflattened=unflattened)


def moved_by(item: Placement, shift: np.ndarray) -> Placement:
    pose = item.pose.copy()
    pose[:3, 3] += shift
    return replace(item, pose=pose)


def normal_of(base: BaseAsset) -> np.ndarray:
    normal = np.asarray(base.plane[:3], np.float64)
    return normal / np.linalg.norm(normal)


def distance_to(base: BaseAsset, points: np.ndarray) -> np.ndarray:
    plane = np.asarray(base.plane, np.float64) / np.linalg.norm(base.plane[:3])
    return points @ plane[:3] + plane[3]


def beside(base: BaseAsset, item: Placement) -> bool:
    """Tell whether an object reaches the part of a wall that exists."""
    points = world_points(item.parts, item.pose)
    low, high = np.asarray(base.visual.vertices).min(axis=0), np.asarray(base.visual.vertices).max(axis=0)
    return bool(np.all(points.max(axis=0) > low - 0.05) and np.all(points.min(axis=0) < high + 0.05))
