"""Placement: the current pose and collision shape of an object, and operations on a single one."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from reconstruction.assembly.base import base_slabs
from reconstruction.assembly.collision import flatten_foot, with_legs
from reconstruction.assembly.config import AssemblyConfig
from reconstruction.assembly.depenetration import shifted
from reconstruction.assets.gltf import written_corners
from reconstruction.core.types import AssetSet, BaseAsset, ConvexPart, Edge, ObjectAsset
from registry.geometry import rigid, transform_points
from registry.labels import STRUCTURE
from registry.simulation import BodySpec, base_spec

_FURNITURE = {"table", "desk", "shelf", "bookshelf", "cabinet", "sofa", "bed", "chair", "counter", "wardrobe"}
TOUCH_GAP_M = 2e-4  # gap between a static object and the surface that it touches
WORTH_SAYING_M = 0.005  # smaller moves and cuts get no note


@dataclass(frozen=True)
class Placement:
    """The current state of an object."""

    asset: ObjectAsset
    edge: Edge
    pose: np.ndarray  # world_from_object (4, 4)
    parts: tuple[ConvexPart, ...]  # collision shape, object space
    unflattened: tuple[ConvexPart, ...]  # the same before its underside was flattened
    dynamic: bool
    band_mm: float  # flattened band of the underside
    notes: tuple[str, ...]  # moves and repairs, for the user
    stands: bool  # rests where it was seen

    def noted(self, note: str, **changes: Any) -> "Placement":
        """Return a copy with one more note, and other fields changed."""
        return replace(self, notes=(*self.notes, note), **changes)


def base_specs(assets: AssetSet) -> list[BodySpec]:
    """Return the bodies of floor, walls, ceiling and structure."""
    shapes = [(b.id, b.label, base_slabs(b)) for b in assets.base]
    if assets.structure is not None and assets.structure.collision:
        shapes.append((assets.structure.id, STRUCTURE, assets.structure.collision))
    return [base_spec(i, label, (written_corners(p) for p in parts)) for i, label, parts in shapes]


def world_points(parts: tuple[ConvexPart, ...], pose: np.ndarray) -> np.ndarray:
    """Return the vertices (n, 3) of all parts in world space."""
    return transform_points(pose, np.concatenate([np.asarray(p.vertices, np.float64) for p in parts]))


def is_furniture(asset: ObjectAsset, on_base: bool, config: AssemblyConfig) -> bool:
    """Tell whether an object is static: too large, by size and label, or too heavy to be moved by a robot."""
    extent = float(np.ptp(np.asarray(asset.visual.vertices), axis=0).max())
    labelled = not _FURNITURE.isdisjoint(asset.label.lower().split())
    large = extent > config.fixed_extent_m or (labelled and extent > 0.65 * config.fixed_extent_m)
    return (on_base and large) or asset.physics.mass_kg > config.fixed_mass_kg


def moves_by_rule(
    asset: ObjectAsset, edge: Edge, on_base: bool, parent_moves: bool, config: AssemblyConfig
) -> bool:
    """Tell whether an object is dynamic: furniture is not, attached objects are if their parent is."""
    if edge.relation == "attached_to":
        return parent_moves
    return not is_furniture(asset, on_base, config)


def upright(pose: np.ndarray, max_tilt_deg: float) -> np.ndarray:
    """Remove the tilt of a pose (4, 4) that is nearly upright; heading and position stay."""
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
    """Flatten the underside of the unflattened shape by a band, at the current pose."""
    up = item.pose[:3, :3].T @ np.array([0, 0, 1.0])
    parts = flatten_foot(item.unflattened, up, band_mm * 1e-3)
    kept = tuple(n for n in item.notes if not n.startswith("foot flattened"))
    return replace(item, parts=parts, band_mm=band_mm, notes=(*kept, f"foot flattened by {band_mm:g} mm"))


def on_legs(item: Placement) -> Placement:
    """Add legs, which depth maps may miss, to the collision shape of an upright object; `item` itself if none fit."""
    if item.pose[2, 2] < 1 - 1e-6:
        return item
    unflattened = with_legs(item.unflattened)
    if unflattened is item.unflattened:
        return item
    item = item.noted("tips as it was seen: it got legs at its corners, in its collision shape only")
    return replace(item, parts=unflattened, unflattened=unflattened)


def moved_by(item: Placement, shift: np.ndarray) -> Placement:
    """Translate an object by `shift` (3,), world space."""
    return replace(item, pose=shifted(item.pose, shift))


def normal_of(base: BaseAsset) -> np.ndarray:
    """Return the unit normal (3,) of a base surface, into the room."""
    normal = np.asarray(base.plane[:3], np.float64)
    return normal / np.linalg.norm(normal)


def distance_to(base: BaseAsset, points: np.ndarray) -> np.ndarray:
    """Return the signed distances (n,) of points (n, 3) to a base surface, positive in the room."""
    plane = np.asarray(base.plane, np.float64) / np.linalg.norm(base.plane[:3])
    return points @ plane[:3] + plane[3]


def beside(base: BaseAsset, item: Placement) -> bool:
    """Tell whether the box of an object overlaps the box of a wall's mesh."""
    points = world_points(item.parts, item.pose)
    low, high = np.asarray(base.visual.vertices).min(axis=0), np.asarray(base.visual.vertices).max(axis=0)
    return bool(np.all(points.max(axis=0) > low - 0.05) and np.all(points.min(axis=0) < high + 0.05))
