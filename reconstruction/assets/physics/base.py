"""Interface of the sources of materials and masses."""

from typing import Protocol

import numpy as np

from reconstruction.assets.physics.materials import MaterialChoice, choose_material
from reconstruction.core.progress import Progress
from reconstruction.core.types import Instance, InstanceSet, PosedFrames
from reconstruction.views import SceneViews


class Physicist(Protocol):
    """A source of materials and masses."""

    name: str

    def choose(
        self, found: InstanceSet, posed: PosedFrames, *, views: SceneViews | None = None, progress: Progress
    ) -> dict[int, MaterialChoice]:
        """Return a choice by object id where it has one; the table decides on the others.

        Args:
            found: the objects and their pixels.
            posed: the keyframes.
            views: views of each object, where they were made.
            progress: notes failures.
        """
        ...


def choice_for(
    item: Instance, said: dict[int, MaterialChoice], mean_rgb: np.ndarray, extents_m: np.ndarray
) -> MaterialChoice:
    """Return the physicist's choice for an object, else the table's."""
    if item.id in said:
        return said[item.id]
    return choose_material(item.label, item.label_confidence, mean_rgb, extents_m)
