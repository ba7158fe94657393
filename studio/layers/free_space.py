"""The space that rays of the cameras passed through: known to be free."""

from typing import Any

import numpy as np

from studio.layers.base import Layer

_POINTS = 40_000  # most that are sent
_FREE = 1  # value of `SpaceGrid.state`


class FreeSpaceLayer(Layer):
    """Points in free space, colored by height."""

    label = "Free space"
    hint = "Where rays of the cameras passed: known to be empty"

    def build(self) -> list[Any]:
        """Add a point at every k-th free voxel, k so that there are at most 40,000."""
        import matplotlib

        self._text = "The stage cache of this scene is gone, and free space with it."
        surface = self.page.stage_results.get("surface")
        if surface is None:
            return []
        space = surface.space
        step = 1
        while np.count_nonzero(space.state[::step, ::step, ::step] == _FREE) > _POINTS:
            step += 1
        cells = np.argwhere(space.state[::step, ::step, ::step] == _FREE) * step
        points = space.origin + (cells + 0.5) * space.voxel_size_m
        if not len(points):
            self._text = "No free space is known."
            return []
        volume = np.count_nonzero(space.state == _FREE) * space.voxel_size_m**3
        self._text = (
            f"{volume:.1f} m³ known to be free; a point every {100 * step * space.voxel_size_m:.0f} cm."
        )
        height = (points[:, 2] - points[:, 2].min()) / max(float(np.ptp(points[:, 2])), 1e-6)
        colors = (255 * matplotlib.colormaps["cool"](height)[:, :3]).astype(np.uint8)
        return [
            self.page.server.scene.add_point_cloud(
                "/layers/free_space",
                points.astype(np.float32),
                colors,
                point_size=0.006,
                point_shape="circle",
                point_shading="flat",
            )
        ]

    def legend(self) -> str:
        """Say how much is free."""
        return self._text
