"""Who says what things are made of: the seam."""

from typing import Protocol

import numpy as np

from reconstruction.assets.physics.materials import MaterialChoice, choose_material
from reconstruction.core.progress import Progress
from reconstruction.core.types import Instance, InstanceSet, PosedFrames
from reconstruction.views import SceneViews


class Physicist(Protocol):
    """Says what things are made of and what they weigh."""

    name: str

    def choose(
        self, found: InstanceSet, posed: PosedFrames, *, views: SceneViews | None = None, progress: Progress
    ) -> dict[int, MaterialChoice]:
        """Return a choice for each object, by its id, of which anything is known; the table decides on the others.

        Args:
            found: The things and which pixels show them.
            posed: The frames they show in.
            views: Of each thing, where they were made.
            progress: Told of what went wrong.
        """
        ...


def choice_for(
    item: Instance, said: dict[int, MaterialChoice], mean_rgb: np.ndarray, extents_m: np.ndarray
) -> MaterialChoice:
    """Return what was said of an object, or else what the table says."""
    if item.id in said:
        return said[item.id]
    return choose_material(item.label, item.label_confidence, mean_rgb, extents_m)
