"""What every way to cut a room into things starts from, and what it ends with."""

from dataclasses import dataclass

import numpy as np

from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.core.progress import Progress
from reconstruction.core.types import BaseEntity, Surface
from reconstruction.instances.base import base_entities, base_planes
from reconstruction.instances.masks.base import FrameMasks
from reconstruction.surface.base_planes import FittedPlane, base_owner, behind_base


@dataclass(frozen=True)
class Shell:
    """The surface as a graph, and the floor, walls and ceiling on it."""

    graph: MeshGraph
    planes: list[FittedPlane]  # the floor first, if it was seen
    base: tuple[BaseEntity, ...]  # of each plane, and a floor that had to be assumed
    owner: np.ndarray  # int32 (v,) id of the base entity that a vertex lies on, 0 = none
    behind: np.ndarray  # bool (v,) below the floor or behind a wall

    @classmethod
    def of(cls, surface: Surface, progress: Progress) -> "Shell":
        """Read the base off the surface's planes."""
        graph = MeshGraph.from_surface(surface)
        planes = base_planes(surface)
        base = base_entities(surface, progress)
        return cls(graph, planes, base, base_owner(planes, len(graph.points)), behind_base(graph, planes))

    def entity_id(self, plane: int) -> int:
        """Return the id of the base entity of a plane, by its row in `planes`."""
        return plane + 1 + len(self.base) - len(self.planes)


@dataclass
class Thing:
    """Surface of one thing; `rests_on` is the thing that carries it, None where the base does or it hangs."""

    vertices: np.ndarray  # int (n,) sorted
    rests_on: "Thing | None" = None
    attached: bool = False  # it hangs on a wall


@dataclass(frozen=True)
class Cut:
    """The separate things, and what is base; vertices of things are in `owner` too where they lie on a plane."""

    things: list[Thing]
    owner: np.ndarray  # int32 (v,)
    told: FrameMasks | None = None  # masks it was made by, with ids of the base, then of things
