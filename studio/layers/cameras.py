"""The cameras of the video's frames, with small photographs; a click flies there."""

import threading
from typing import Any

import cv2
import numpy as np
import viser

from registry.geometry import quat_from_matrix
from studio.layers.base import Layer

_SCALE_M = 0.05  # distance of a frustum's picture from its camera
_THUMBNAIL_PX = 96
_BLANK = np.full((18, 24, 3), 225, np.uint8)  # where no photograph is kept: the lines alone cannot be clicked
_KEYFRAME, _HELD_OUT = (38, 110, 142), (150, 150, 150)


class CameraLayer(Layer):
    """A frustum at every camera that is known."""

    label = "Cameras"
    hint = "Where each frame was taken from; click one to stand there"

    def build(self) -> list[Any]:
        """Add the frustums, with a thumbnail each."""
        page, cameras = self.page, self.page.bundle.cameras
        fov = float(2 * np.arctan(cameras.height / 2 / cameras.params[1]))
        held_out = {f["index"] for f in page.bundle.scene["cameras"]["frames"] if f.get("held_out")}
        nodes = []
        for frame, pose in zip(cameras.indices.tolist(), cameras.world_from_camera, strict=True):
            photograph = page.frames.photograph(frame)
            node = page.server.scene.add_camera_frustum(
                f"/layers/cameras/{frame}", fov, cameras.width / cameras.height, scale=_SCALE_M, thickness=0.0015,
                color=_HELD_OUT if frame in held_out else _KEYFRAME, format="jpeg", jpeg_quality=70,
                image=_BLANK if photograph is None else _thumbnail(photograph), wxyz=quat_from_matrix(pose[:3, :3]),
                position=pose[:3, 3], cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
            node.on_click(self._clicked(frame))
            nodes.append(node)
        return nodes

    def show(self, visible: bool) -> None:
        """Show or hide the frustums; they are hidden while a viewer stands at a camera, where they are in the way."""
        super().show(visible and not self.page.frames.somebody_stands)

    def legend(self) -> str:
        """Say which frames are which."""
        return "Blue frames were used, gray ones kept out to measure. Click a frame to stand at its camera."

    def _clicked(self, frame: int) -> Any:
        async def on_click(event: viser.SceneNodePointerEvent) -> None:
            self.page.swallow_click()
            # Flying takes a moment; the loop must not wait for it.
            threading.Thread(target=self.page.show_frame, args=(frame, event.client_id), daemon=True).start()

        return on_click


def _thumbnail(photograph: np.ndarray) -> np.ndarray:
    height, width = photograph.shape[:2]
    scale = _THUMBNAIL_PX / max(height, width)
    return cv2.resize(photograph, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)
