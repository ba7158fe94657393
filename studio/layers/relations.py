"""The scene graph as lines from every object to what carries it."""

from typing import Any

import numpy as np

from registry.geometry import transform_points
from studio.layers.base import Layer

_SUPPORT, _ATTACHED = (38, 110, 142), (168, 88, 150)
_BASE = (90, 90, 90)
_NODE_M, _LINE_M = 0.012, 0.006
_ABOVE_M = 0.05  # of the dots above their objects: lines between middles would be hidden inside of them


class RelationLayer(Layer):
    """A dot above every object, a line to that of its parent; on the room the line ends where it is nearest.

    The structure is no plane: on it the line ends at the foot of the object.
    """

    label = "Relations"
    hint = "What stands on what, and what hangs on what"

    def build(self) -> list[Any]:
        """Add dots and lines."""
        page = self.page
        tops = {o.id: self._top(o.id) for o in page.bundle.objects}
        planes = {b.id: b.plane for b in page.bundle.base}
        starts, ends, colors = [], [], []
        for edge in page.bundle.edges:
            start = tops[edge.child]
            if edge.parent not in planes:
                end = tops[edge.parent]
            elif (plane := planes[edge.parent]) is not None:
                end = start - (plane[:3] @ start + plane[3]) * plane[:3]
            else:
                end = np.array([*start[:2], self._vertices(edge.child)[:, 2].min()])
            starts.append(start)
            ends.append(end)
            colors.append(_ATTACHED if edge.relation == "attached_to" else _SUPPORT)
        if not starts:
            return []
        scene = page.server.scene
        nodes: list[Any] = [
            scene.add_line_segments(
                "/layers/relations/lines",
                np.stack([starts, ends], axis=1).astype(np.float32),
                np.repeat(np.array(colors, np.uint8)[:, None], 2, axis=1),
                thickness=_LINE_M,
            )
        ]
        for number, (point, color) in enumerate(
            [*zip(starts, colors, strict=True), *((e, _BASE) for e in ends)]
        ):
            nodes.append(
                scene.add_icosphere(
                    f"/layers/relations/{number}",
                    _NODE_M,
                    color,
                    subdivisions=2,
                    position=point,
                    cast_shadow=False,
                    receive_shadow=False,
                )
            )
        return nodes

    def legend(self) -> str:
        """Name the colors."""
        return (
            f'<span style="color:rgb{_SUPPORT}">&#9473;</span> stands on&emsp;'
            f'<span style="color:rgb{_ATTACHED}">&#9473;</span> hangs on'
        )

    def _top(self, object_id: int) -> np.ndarray:
        vertices = self._vertices(object_id)
        middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        return np.array([*middle[:2], vertices[:, 2].max() + _ABOVE_M])

    def _vertices(self, object_id: int) -> np.ndarray:
        return transform_points(self.page.pose_of(object_id), self.page.pickable.geometry(object_id).vertices)
