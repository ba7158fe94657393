"""Draws a preview of pending acts into the page: merged things in one color, dropped ones hidden, others moved."""

from typing import TYPE_CHECKING

import numpy as np

from studio.correcting.pending import Preview
from studio.text import bare

if TYPE_CHECKING:
    from studio.scene_view import StudioPage

COLORS = ((230, 120, 30), (60, 140, 220), (120, 190, 60), (190, 80, 190), (220, 190, 40), (60, 190, 190))
COLOR_NAMES = ("orange", "blue", "green", "violet", "yellow", "teal")
_POINT_M = 0.006
_LIFT_M = 0.03  # of a name over its thing


class Shown:
    """Draws previews in a page: hides, moves, stretches, paints and renames objects."""

    def __init__(self, page: "StudioPage") -> None:
        self._page = page
        self._nodes: list = []
        self._hidden: set[int] = set()
        self._moved: set[int] = set()
        self._stretched: set[int] = set()

    def draw(self, preview: Preview) -> None:
        """Show a preview in place of the last one."""
        with self._page.server.atomic():
            self._remove()
            self._hide(preview.hidden)
            self._move(preview)
            self._stretch(preview)
            for number, group in enumerate(preview.merged):
                for object_id in group:
                    self._paint(object_id, COLORS[number % len(COLORS)])
            for number, points in enumerate(preview.parts):
                self._cloud(number, points)
            for object_id, label in preview.labels.items():
                self._name(object_id, label)

    def clear(self) -> None:
        """Show the bundle as it is."""
        with self._page.server.atomic():
            self._remove()
            self._hide(set())
            self._move(Preview())
            self._stretch(Preview())

    def _remove(self) -> None:
        for node in self._nodes:
            node.remove()
        self._nodes = []

    def _hide(self, hidden: set[int]) -> None:
        """Hide these objects, so that clicks go through them; show those that were hidden before."""
        known = self._page.object_handles().keys()
        for object_id in (self._hidden - hidden) & known:
            self._page.show_object(object_id, True)
        for object_id in hidden & known:
            self._page.show_object(object_id, False)
        self._page.skip_in_clicks("corrections", hidden & known)
        self._hidden = set(hidden)

    def _move(self, preview: Preview) -> None:
        poses = {item.id: item.world_from_object for item in self._page.bundle.objects}
        for object_id in (self._moved - preview.poses.keys()) & poses.keys():
            self._page.set_pose(object_id, poses[object_id])
        for object_id, pose in preview.poses.items():
            if object_id in poses:
                self._page.set_pose(object_id, pose)
        self._moved = set(preview.poses)

    def _stretch(self, preview: Preview) -> None:
        """Stretch the meshes about the bottom center of their boxes; clicks meet them as they were."""
        meshes = self._page.object_handles()
        for object_id in (self._stretched | preview.sizes.keys()) & meshes.keys():
            x, y, z = preview.sizes.get(object_id, self._sides(object_id)) / self._sides(object_id)
            meshes[object_id].scale = (x, z, y)  # glTF is +y up
        self._stretched = set(preview.sizes)

    def _sides(self, object_id: int) -> np.ndarray:
        """Return the sides (3,) of an object's box in its own axes, metres."""
        return np.maximum(np.ptp(self._page.pickable.geometry(object_id).vertices, axis=0), 1e-6)

    def _paint(self, object_id: int, color: tuple[int, int, int]) -> None:
        """Lay a colored skin over an object."""
        if object_id not in self._page.object_handles():
            return
        mesh = self._page.pickable.geometry(object_id)
        self._nodes.append(
            self._page.server.scene.add_mesh_simple(
                f"/objects/{object_id}/merged", mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32),
                color=color, opacity=0.55, cast_shadow=False, receive_shadow=False,
            )
        )  # fmt: skip

    def _cloud(self, number: int, points: np.ndarray) -> None:
        if len(points):
            self._nodes.append(
                self._page.server.scene.add_point_cloud(
                    f"/correct/part_{number}", points.astype(np.float32), COLORS[number % len(COLORS)],
                    point_size=_POINT_M, point_shading="flat", precision="float32",
                )
            )  # fmt: skip

    def _name(self, object_id: int, label: str) -> None:
        if object_id in self._page.object_handles():
            top = float(self._page.pickable.geometry(object_id).vertices[:, 2].max()) + _LIFT_M
            self._nodes.append(
                self._page.server.scene.add_label(
                    f"/objects/{object_id}/new_name", bare(label, 60), position=(0.0, 0.0, top)
                )
            )
