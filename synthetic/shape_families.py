"""Families of small things whose shapes vary widely: what trains depth on procedural rooms.

The makers live in `shapes_bodies` (superquadrics, turned, extruded, with handles, hollow), `shapes_thin` (thin
things, plants, cables) and `shapes_toys` (soft things, toys, devices); `shapes_kit` is what they build with.
Parts are closed solids that overlap where they join. `Thing.pieces` stays empty: nobody simulates these things,
so nothing cuts them into convex pieces.
"""

from synthetic.shapes_bodies import (
    EXTRUDED_KINDS,
    HOLLOW_KINDS,
    LATHED_KINDS,
    SUPERQUADRIC_KINDS,
    UNION_KINDS,
)
from synthetic.shapes_kit import mesh_solid, mesh_solids, random_look
from synthetic.shapes_thin import CABLE_KINDS, FOLIAGE_KINDS, THIN_KINDS
from synthetic.shapes_toys import DEVICE_KINDS, MANYPART_KINDS, SOFT_KINDS
from synthetic.things import Kind

__all__ = ["SHAPE_FAMILIES", "mesh_solid", "mesh_solids", "random_look"]

SHAPE_FAMILIES: dict[str, dict[str, Kind]] = {
    "superquadric": SUPERQUADRIC_KINDS,
    "lathed": LATHED_KINDS,
    "extruded": EXTRUDED_KINDS,
    "union": UNION_KINDS,
    "hollow": HOLLOW_KINDS,
    "thin": THIN_KINDS,
    "soft": SOFT_KINDS,
    "manypart": MANYPART_KINDS,
    "foliage": FOLIAGE_KINDS,
    "cable": CABLE_KINDS,
    "device": DEVICE_KINDS,
}
"""Family -> key -> kind; keys are unique over all families and differ from those of `layout.KINDS`."""
