"""Place of the selected thing: move and turn by a gizmo (each release is an act), drop to surface, size."""

from typing import TYPE_CHECKING

import numpy as np
import viser

from registry.errors import SimReconError
from registry.geometry import matrix_from_quat, quat_from_matrix, rigid

if TYPE_CHECKING:
    from studio.correcting.tab import CorrectPart

_SIZE_M = 0.25
_LEAST_M, _LEAST_RAD = 0.0005, 0.001  # a release after less than this was a click on the gizmo


class Gizmo:
    """The folder "Place", and the gizmo at the selected thing while it is switched on."""

    def __init__(self, part: "CorrectPart") -> None:
        self._part, self._page = part, part.page
        self.handle: viser.TransformControlsHandle | None = None
        self._object_id: int | None = None
        gui = self._page.server.gui
        with gui.add_folder("Place"):
            self._on = gui.add_checkbox("Move and turn", False)
            self._tilt = gui.add_checkbox("Tilt, too", False)
            part.act("Drop to surface", lambda: part.session.acts.drop_to_surface(part.selected()))
            self._sides = [
                gui.add_number(f"{name} (m)", 0.1, min=0.001, max=20.0, step=0.001)
                for name in ("Width", "Depth", "Height")
            ]
            part.act(
                "Set size",
                lambda: part.session.acts.size(part.selected(), [float(side.value) for side in self._sides]),
                "along its red, green and blue arrow; its bottom center stays",
            )
        for box in (self._on, self._tilt):
            box.on_update(lambda _: self.follow(self._page.selection.last))

    def follow(self, object_id: int | None) -> None:
        """Put the gizmo at an object, if it is switched on, and show its size."""
        self.remove()
        self._show_size(object_id)
        if not self._on.value or object_id not in self._page.object_handles():
            return
        pose = self._page.pose_of(object_id)
        sideways = (-9, 9) if self._tilt.value else (0, 0)
        self._object_id = object_id
        self.handle = self._page.server.scene.add_transform_controls(
            "/correct/gizmo", scale=_SIZE_M, depth_test=False, wxyz=quat_from_matrix(pose[:3, :3]),
            position=pose[:3, 3], disable_rotations=False,
            rotation_limits=(sideways, sideways, (-9, 9)),
        )  # fmt: skip
        self.handle.on_update(self._moved)

    def _show_size(self, object_id: int | None) -> None:
        known = {item.id: item.scale for item in self._page.bundle.objects}
        size = None if object_id is None else self._part.preview.sizes.get(object_id, known.get(object_id))
        for field, side in zip(self._sides, () if size is None else size):
            field.value = round(float(side), 3)

    def remove(self) -> None:
        """Take the gizmo away."""
        if self.handle is not None:
            self.handle.remove()
        self.handle = self._object_id = None

    async def _moved(self, event: viser.TransformControlsEvent) -> None:
        if self._object_id is None or self.handle is None:
            return
        target = event.target
        pose = rigid(
            matrix_from_quat(np.asarray(target.wxyz, np.float64)), np.asarray(target.position, np.float64)
        )
        self._page.set_pose(self._object_id, pose)
        if event.phase == "end":
            self._part.in_background(lambda number=self._object_id: self._write(number, pose))

    def _write(self, object_id: int, pose: np.ndarray) -> None:
        before = self._part.shown_pose(object_id)
        turn = np.arccos(np.clip((np.trace(before[:3, :3].T @ pose[:3, :3]) - 1) / 2, -1, 1))
        if np.linalg.norm(before[:3, 3] - pose[:3, 3]) < _LEAST_M and turn < _LEAST_RAD:
            return
        try:
            self._part.perform(self._part.session.acts.move(object_id, pose))
        except SimReconError as error:
            self._part.fail(error)
