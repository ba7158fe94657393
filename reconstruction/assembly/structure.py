"""Collision shape of the structure, beside objects: plates are cut back, and objects are cut clear of plates."""

from dataclasses import replace

import numpy as np

from reconstruction.assembly.collision_trimming import cut_out
from reconstruction.assembly.config import AssemblyConfig
from reconstruction.assembly.placement import Placement, world_points
from reconstruction.core.types import AssetSet, ConvexPart

_STILL = np.eye(4)  # world_from_structure


def clear_structure(assets: AssetSet, config: AssemblyConfig) -> AssetSet:
    """Return the assets with the structure's plates cut back where objects reach into them from the side.

    Depth at outlines is off by a centimetre or two: the wall behind a bottle and the bottle overlap. What overlaps from
    above stays, as an object whose foot is too low is lifted.
    """
    if assets.structure is None:
        return assets
    plates = list(assets.structure.collision)
    for item in assets.objects:
        if not item.collision:
            continue
        points = world_points(item.collision, item.world_from_object)
        low, high = points.min(axis=0), points.max(axis=0)
        kept: list[ConvexPart] = []
        for plate in plates:
            if not _meets(plate, low, high):
                kept.append(plate)
                continue
            left, _ = cut_out(
                (plate,), _STILL, item.collision, item.world_from_object, 1e-3 * config.penetration_mm,
                sideways=True,
            )  # fmt: skip
            kept += left
        plates = kept
    # Objects may have the structure as their parent, and a body has a shape: one plate stays.
    plates = plates or assets.structure.collision[:1]
    return replace(assets, structure=replace(assets.structure, collision=tuple(plates)))


def cut_by_structure(
    item: Placement, plates: tuple[ConvexPart, ...], tolerance_m: float, clearance_m: float
) -> tuple[tuple[ConvexPart, ...], float]:
    """Return the parts of a placed object, object space, cut where they overlap plates, and the depth cut off."""
    points = world_points(item.parts, item.pose)
    low, high = points.min(axis=0), points.max(axis=0)
    near = tuple(plate for plate in plates if _meets(plate, low, high))
    return cut_out(item.parts, item.pose, near, _STILL, tolerance_m, clearance_m)


def _meets(plate: ConvexPart, low: np.ndarray, high: np.ndarray) -> bool:
    """Tell whether the box of a plate overlaps the box from `low` to `high`."""
    own = np.asarray(plate.vertices)
    return bool((own.max(axis=0) > low).all() and (own.min(axis=0) < high).all())
