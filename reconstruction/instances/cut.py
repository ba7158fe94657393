"""Input and output that the two segmentation methods share: the surface graph with its base, and the objects."""

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
    base: tuple[BaseEntity, ...]  # one per plane, after an assumed floor if none was seen
    owner: np.ndarray  # int32 (v,) id of the base entity that a vertex lies on, 0 = none
    behind: np.ndarray  # bool (v,) below the floor or behind a wall

    @classmethod
    def of(cls, surface: Surface, progress: Progress) -> "Shell":
        """Build the graph and the base of a surface."""
        graph = MeshGraph.from_surface(surface)
        planes = base_planes(surface)
        base = base_entities(surface, progress)
        return cls(graph, planes, base, base_owner(planes, len(graph.points)), behind_base(graph, planes))

    def entity_id(self, plane: int) -> int:
        """Return the id of the base entity of a plane, by its row in `planes`."""
        return plane + 1 + len(self.base) - len(self.planes)


@dataclass
class Thing:
    """The surface of one object, and what supports it."""

    vertices: np.ndarray  # int (n,) sorted
    rests_on: "Thing | None" = None  # the supporting object; None: on the floor, or attached
    attached: bool = False  # to a wall
    is_object: bool = True  # False: the structure, which is many things


@dataclass(frozen=True)
class Cut:
    """A segmentation: the objects, and the base entity of each vertex."""

    things: list[Thing]
    owner: np.ndarray  # int32 (v,) base entity, 0 = none; vertices of things may have one, too
    artifact: np.ndarray | None = None  # bool (v,) surface that only wrong depth made, where that is known
    labeled: FrameMasks | None = None  # its 2D masks, with ids of the base, then of `things` in their order
