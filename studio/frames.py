"""The video's frames: their cameras, their photographs, and viewers that stand at a camera and compare both."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import viser
import viser.transforms

from registry.errors import UsageError
from registry.geometry import invert_rigid, quat_from_matrix
from studio.selection import Listeners

if TYPE_CHECKING:
    from studio.scene_view import StudioPage

logger = logging.getLogger(__name__)

_DISTANCE_M = 0.03  # of the photograph from its camera; the near plane is at 0.01
_FLY_S, _STEPS = 0.7, 18
_STAY_M, _STAY_DEG = 0.01, 1.0  # a viewer farther from the camera than this has walked away


@dataclass
class Comparison:
    """State of one viewer at a camera: frame, opacity and columns of the photograph shown."""

    frame: int
    opacity: float  # 0 scene, 1 photograph
    wipe: float  # the photograph covers this share of the width, from the left
    image: viser.ImageHandle | None
    arrived: bool = False  # the viewer's camera has been where it was sent


class Frames:
    """Cameras and photographs of the frames of a page's scene."""

    def __init__(self, page: "StudioPage") -> None:
        self._page = page
        self._shown: dict[int, Comparison] = {}
        self._changes = Listeners()
        self._lock = threading.RLock()
        page.server.on_client_connect(self._watch)
        page.server.on_client_disconnect(self._forget)

    def reload(self) -> None:
        """Forget the photographs of another revision."""
        self.__dict__.pop("_photographs", None)

    @property
    def indices(self) -> tuple[int, ...]:
        """Numbers of the frames whose cameras are known, ascending."""
        return tuple(sorted(int(i) for i in self._page.bundle.cameras.indices))

    @property
    def photographed(self) -> tuple[int, ...]:
        """Numbers of the frames whose photographs are at hand, ascending."""
        return tuple(sorted(self._photographs.keys() & set(self.indices)))

    def world_from_camera(self, frame: int) -> np.ndarray:
        """Return the pose (4, 4) of a frame's camera, OpenCV axes.

        Raises:
            UsageError: the frame's camera is not known.
        """
        cameras = self._page.bundle.cameras
        row = np.flatnonzero(cameras.indices == frame)
        if not len(row):
            raise UsageError(
                f"frame {frame}: its camera is not known; known are {self.indices[:8]} and so on"
            )
        return cameras.world_from_camera[row[0]]

    def photograph(self, frame: int) -> np.ndarray | None:
        """Return the undistorted photograph, RGB uint8 (h, w, 3); None: it is not kept."""
        found = self._photographs.get(frame)
        found = found() if callable(found) else found
        return None if found is None else np.asarray(found)

    def pixel(self, frame: int, point_world: np.ndarray) -> tuple[float, float] | None:
        """Project a point (3,) into a frame, in pixels of the bundle's cameras; None: it is behind the camera."""
        point = invert_rigid(self.world_from_camera(frame)) @ np.append(point_world, 1.0)
        if point[2] <= 0:
            return None
        fx, fy, cx, cy = self._page.bundle.cameras.params[:4]
        return float(fx * point[0] / point[2] + cx), float(fy * point[1] / point[2] + cy)

    def shown_to(self, client_id: int) -> int | None:
        """Return the frame at whose camera a viewer stands; None: at none."""
        shown = self._shown.get(client_id)
        return None if shown is None else shown.frame

    def show(self, frame: int, client_id: int | None = None) -> None:
        """Fly a viewer (None: all) to a frame's camera, and lay the photograph over the scene.

        Raises:
            UsageError: the frame's camera is not known.
        """
        world_from_camera = self.world_from_camera(frame)
        for client in self._viewers(client_id):
            old = self._shown.get(client.client_id)
            opacity, wipe = (old.opacity, old.wipe) if old else (1.0, 0.5)
            self.leave(client.client_id)
            fly(client, world_from_camera, self._fov_for(client))
            with self._lock:
                self._shown[client.client_id] = Comparison(frame, opacity, wipe, None)
                self._draw(client)
        self._changes.call()

    def on_change(self, callback: Callable[[], object]) -> Callable[[], None]:
        """Call `callback()` when a viewer begins or ends to stand at a camera; return a function that ends it."""
        return self._changes.add(callback)

    @property
    def somebody_stands(self) -> bool:
        """Whether any viewer stands at a camera."""
        return bool(self._shown)

    def compare(self, opacity: float, wipe: float, client_id: int | None = None) -> None:
        """Set how much of the photograph viewers see: its opacity, and the share of the width that it covers."""
        for client in self._viewers(client_id):
            shown = self._shown.get(client.client_id)
            if shown is not None:
                with self._lock:
                    shown.opacity, shown.wipe = opacity, wipe
                    self._draw(client)

    def leave(self, client_id: int | None = None) -> None:
        """Take the photograph away; the viewer stays where it is."""
        for client in self._viewers(client_id):
            with self._lock:
                shown = self._shown.pop(client.client_id, None)
                if shown is not None and shown.image is not None:
                    shown.image.remove()
            if shown is not None:
                client.camera.up_direction = (0.0, 0.0, 1.0)
                self._changes.call()

    def _viewers(self, client_id: int | None) -> list[viser.ClientHandle]:
        clients = self._page.server.get_clients()
        return (
            list(clients.values())
            if client_id is None
            else [clients[client_id]]
            if client_id in clients
            else []
        )

    def _watch(self, client: viser.ClientHandle) -> None:
        client.camera.on_update(lambda _: self._leave_if_gone(client))

    def _forget(self, client: viser.ClientHandle) -> None:
        if self._shown.pop(client.client_id, None) is not None:
            self._changes.call()

    def _leave_if_gone(self, client: viser.ClientHandle) -> None:
        shown = self._shown.get(client.client_id)
        if shown is None:
            return
        pose = self.world_from_camera(shown.frame)
        rotation = viser.transforms.SO3(quat_from_matrix(pose[:3, :3]))
        turned = np.linalg.norm((viser.transforms.SO3(client.camera.wxyz).inverse() @ rotation).log())
        moved = np.linalg.norm(client.camera.position - pose[:3, 3])
        if moved <= _STAY_M and np.degrees(turned) <= _STAY_DEG:
            shown.arrived = True
        elif shown.arrived:
            self.leave(client.client_id)

    def _fov_for(self, client: viser.ClientHandle) -> float:
        """Return the vertical field of view in which the whole photograph fits the viewer's window."""
        cameras = self._page.bundle.cameras
        fx, fy, cx, cy = cameras.params[:4]
        tan_x, tan_y = max(cx, cameras.width - cx) / fx, max(cy, cameras.height - cy) / fy
        return float(2 * np.arctan(max(tan_y, tan_x / max(client.camera.aspect, 0.1))))

    def _draw(self, client: viser.ClientHandle) -> None:
        """Put the visible part of the photograph before the camera, as a picture of its own size in the scene."""
        shown = self._shown[client.client_id]
        photograph = self.photograph(shown.frame)
        if shown.image is not None:
            shown.image.remove()
            shown.image = None
        if photograph is None:
            return
        cameras = self._page.bundle.cameras
        columns = round(shown.wipe * photograph.shape[1])
        if columns < 1 or shown.opacity <= 0:
            return
        picture, opaque = photograph[:, :columns], shown.opacity >= 1
        if not opaque:
            alpha = np.full((*picture.shape[:2], 1), round(255 * shown.opacity), np.uint8)
            picture = np.concatenate([picture, alpha], axis=2)
        fx, fy, cx, cy = cameras.params[:4]
        width, height = cameras.width * columns / photograph.shape[1], cameras.height
        center = _DISTANCE_M * np.array([(width / 2 - cx) / fx, (height / 2 - cy) / fy, 1.0])
        pose = self.world_from_camera(shown.frame)
        shown.image = client.scene.add_image(
            "/photograph", picture, _DISTANCE_M * width / fx, _DISTANCE_M * height / fy,
            format="jpeg" if opaque else "png", jpeg_quality=90, wxyz=quat_from_matrix(pose[:3, :3]),
            position=pose[:3, :3] @ center + pose[:3, 3], cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    @cached_property
    def _photographs(self) -> dict:
        """Photographs by frame: those of the stage cache, else the few that the bundle keeps."""
        bundle = self._page.bundle
        kept = bundle.scene.get("instances", {"frames": []})["frames"]
        found: dict = {f["index"]: partial(_read_picture, bundle.resolve(f["image"])) for f in kept}
        posed = self._page.stage_results.get("poses")
        if posed is not None:
            found |= dict(zip(posed.indices.tolist(), posed.images))
            found |= dict(zip(posed.held_out_indices.tolist(), posed.held_out_images))
        return found


def _read_picture(path: Path) -> np.ndarray | None:
    image = cv2.imread(str(path))
    return None if image is None else image[..., ::-1]


def fly(client: viser.ClientHandle, world_from_camera: np.ndarray, fov: float) -> None:
    """Move a viewer's camera to a pose (4, 4; OpenCV axes) in 0.7 s, and set its vertical field of view (radians)."""
    start = viser.transforms.SE3.from_rotation_and_translation(
        viser.transforms.SO3(client.camera.wxyz), client.camera.position
    )
    step = start.inverse() @ viser.transforms.SE3.from_matrix(world_from_camera)
    first_fov = client.camera.fov
    for part in np.linspace(1 / _STEPS, 1, _STEPS):
        eased = part * part * (3 - 2 * part)
        now = start @ viser.transforms.SE3.exp(step.log() * eased)
        with client.atomic():
            client.camera.wxyz, client.camera.position = now.rotation().wxyz, now.translation()
            client.camera.fov = first_fov + eased * (fov - first_fov)
        client.flush()
        time.sleep(_FLY_S / _STEPS)
