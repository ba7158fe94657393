"""One scene, served as a page: its meshes, the selection, clicks, cameras and tabs that parts fill.

Scene nodes: `/objects/<id>` is the frame of an object (`world_from_object`), `/objects/<id>/mesh` its textured mesh,
`/room/<id>` a base entity, `/room/backdrop` the backdrop. `/layers/...` belong to the "Scene" tab (`studio.layers`).
"""

import contextlib
import io
import logging
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import viser

from registry import SceneBundle, SceneRegistry
from registry.geometry import WORLD_FROM_GLTF, quat_from_matrix
from studio.as_filmed import as_filmed
from studio.frames import Frames
from studio.parts import Part
from studio.picking import Pickable
from studio.remembered import find_stage_results
from studio.same_origin import same_origin_only
from studio.selection import Click, Listeners, Selection
from studio.start_view import start_view
from studio.text import bare

if TYPE_CHECKING:
    from reconstruction.measure.stage_results import StageResults

logger = logging.getLogger(__name__)

BRAND_COLOR = (38, 110, 142)
_AMBIENT, _SUN = 1.4, 2.2  # of what has no baked texture, such as collision parts
_PANEL_WIDTH_PX = 360
_SWALLOW_S = 0.4  # a click on a node is also reported as a click into the scene, a moment later
_BACKDROP = 0  # no object or base entity has this id
_GLTF_WXYZ = quat_from_matrix(WORLD_FROM_GLTF[:3, :3])


class StudioPage:
    """A served scene. All viewers of the page share selection, layers and poses; each has its own camera."""

    def __init__(
        self,
        registry: SceneRegistry,
        scene_id: str,
        *,
        parts: Sequence[type[Part]] = (),
        host: str = "127.0.0.1",
        port: int = 0,
        revision: str | None = None,
    ) -> None:
        """Serve a scene.

        Args:
            registry: the registry that has the scene.
            scene_id: its id.
            parts: classes of the parts, in the order of their tabs.
            host: address to bind.
            port: 0 takes a free one.
            revision: another revision than the current one, if it still exists.

        Raises:
            SceneNotFound: there is no such scene.
            BundleError: the bundle is damaged.
        """
        self.registry, self.scene_id = registry, scene_id
        self.bundle = self._open(revision)
        self.selection = Selection()
        self.pickable = Pickable()
        self._clicks, self._reloads, self._moves = Listeners(), Listeners(), Listeners()
        self._grabbed: Callable[[Click], object] | None = None
        self._swallow_until = 0.0
        self._unpickable: dict[str, frozenset[int]] = {}  # ids that are not shown, by who hid them
        self._stages: tuple[str, StageResults | None] = ("", None)
        self._nodes: list[viser.SceneNodeHandle] = []
        self._frames_of: dict[int, viser.FrameHandle] = {}
        self._meshes: dict[int, viser.GlbHandle] = {}
        self._poses: dict[int, np.ndarray] = {}
        self._lock = threading.RLock()
        # viser prints a table of its own.
        with contextlib.redirect_stdout(io.StringIO()), same_origin_only(host):
            self.server = viser.ViserServer(host=host, port=port, label=scene_id, verbose=False)
        self._dress()
        self.frames = Frames(self)
        self._show_bundle()
        self.tabs = self.server.gui.add_tab_group()
        self._listen_to_clicks()
        self.parts: tuple[Part, ...] = tuple(part(self) for part in parts)

    @property
    def port(self) -> int:
        """Port of the page's own server."""
        return self.server.get_port()

    @property
    def revision(self) -> str:
        """Revision shown."""
        return self.bundle.revision

    @property
    def stage_results(self) -> "StageResults":
        """Stage results of the revision shown; the first access imports the pipeline (seconds)."""
        revision, results = self._stages
        if results is None or revision != self.revision:
            results = find_stage_results(self.bundle, self.registry.root)
            self._stages = self.revision, results
        return results

    # ---- Objects.

    def object_handles(self) -> dict[int, viser.GlbHandle]:
        """Return the mesh handles by object id; their parents are the frames that `set_pose` moves."""
        return dict(self._meshes)

    def room_handles(self) -> list[viser.GlbHandle]:
        """Return the mesh handles of floor, walls, ceiling and backdrop."""
        return [*self._room.values(), *([self.backdrop] if self.backdrop else [])]

    def name_of(self, thing_id: int) -> str:
        """Return the name of an object or base entity, unescaped (`studio.text` escapes it)."""
        for item in self.bundle.objects:
            if item.id == thing_id:
                return item.name or item.label
        return next((b.label for b in self.bundle.base if b.id == thing_id), f"id {thing_id}")

    def pose_of(self, object_id: int) -> np.ndarray:
        """Return `world_from_object` (4, 4) as shown, which may differ from the bundle's."""
        return self._poses[object_id].copy()

    def bundle_pose(self, object_id: int) -> np.ndarray:
        """Return `world_from_object` (4, 4) of the bundle."""
        return next(o.world_from_object for o in self.bundle.objects if o.id == object_id).copy()

    def show_object(self, object_id: int, visible: bool) -> None:
        """Show or hide an object with all that belongs to it."""
        if self._frames_of[object_id].visible != visible:
            self._frames_of[object_id].visible = visible

    def set_pose(self, object_id: int, world_from_object: np.ndarray) -> None:
        """Move an object in the page; the bundle is not changed.

        Args:
            object_id: the object.
            world_from_object: rigid (4, 4), metres.
        """
        pose = np.asarray(world_from_object, np.float64)
        self._poses[object_id] = pose
        self.pickable.move(object_id, pose)
        frame = self._frames_of[object_id]
        frame.wxyz, frame.position = quat_from_matrix(pose[:3, :3]), pose[:3, 3]
        self._moves.call(object_id)

    def on_move(self, callback: Callable[[int], object]) -> Callable[[], None]:
        """Call `callback(object_id)` after every `set_pose`; return a function that ends it."""
        return self._moves.add(callback)

    # ---- Clicks.

    def on_click(self, callback: Callable[[Click], object]) -> Callable[[], None]:
        """Call `callback(click)` for every click, after it has selected; return a function that ends it."""
        return self._clicks.add(callback)

    def grab_clicks(self, callback: Callable[[Click], object] | None) -> None:
        """Give all clicks to one tool, so that they do not select; None gives them back."""
        self._grabbed = callback

    def swallow_click(self) -> None:
        """Ignore the click into the scene that accompanies a click on a node with its own callback."""
        self._swallow_until = time.monotonic() + _SWALLOW_S

    def _listen_to_clicks(self) -> None:
        for modifier in (None, "shift", "cmd/ctrl"):
            self.server.scene.on_click(modifier=modifier)(self._clicked)

    @property
    def unpickable(self) -> frozenset[int]:
        """Ids that are not shown, which clicks go through."""
        return frozenset().union(*self._unpickable.values())

    def skip_in_clicks(self, who: str, ids: Iterable[int]) -> None:
        """Let clicks go through these ids, in place of those that `who` named before."""
        self._unpickable[who] = frozenset(ids)

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        if time.monotonic() < self._swallow_until:
            return
        origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
        hit = self.pickable.cast(origin, direction, self.unpickable)
        frame = self.frames.shown_to(event.client_id)
        pixel = None if frame is None else self.frames.pixel(frame, origin + direction)
        click = Click(
            None if hit is None else hit.owner, None if hit is None else hit.point,
            None if hit is None else hit.normal, origin, direction / np.linalg.norm(direction), frame, pixel,
            event.client_id, event.modifier,
        )  # fmt: skip
        if self._grabbed is not None:
            self._grabbed(click)
            return
        self._select(click)
        self._clicks.call(click)

    def _select(self, click: Click) -> None:
        if click.id not in self._meshes:
            if click.modifier is None:
                self.selection.set(())
        elif click.modifier is None:
            self.selection.set((click.id,))
        else:
            self.selection.toggle(click.id)

    # ---- Frames and messages.

    def show_frame(self, frame: int, client_id: int | None = None) -> None:
        """Move a viewer (None: all of them) to the camera of a video frame, with its photograph over the scene.

        Raises:
            UsageError: no camera of that frame is known.
        """
        self.frames.show(frame, client_id)

    def say(self, text: str, *, error: bool = False) -> None:
        """Show a notification to every viewer; errors stay until they are closed."""
        for client in self.server.get_clients().values():
            client.add_notification(
                "Not done" if error else bare(self.scene_id), bare(text, 1000), color="red" if error else None,
                auto_close_seconds=None if error else 5.0,
            )  # fmt: skip

    # ---- The bundle.

    def reload(self, revision: str | None = None) -> None:
        """Show another revision (None: the current one) in the same page; then `on_reload` listeners are called."""
        with self._lock:
            self.bundle = self._open(revision)
            with self.server.atomic():
                for node in self._nodes:
                    node.remove()
                self._show_bundle()
            self.frames.reload()
            self.selection.set(i for i in self.selection.ids if i in self._meshes)
        self._reloads.call()

    def on_reload(self, callback: Callable[[], object]) -> Callable[[], None]:
        """Call `callback()` after every reload; return a function that ends it."""
        return self._reloads.add(callback)

    def close(self) -> None:
        """Close the parts and stop the server."""
        for part in self.parts:
            part.close()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _open(self, revision: str | None) -> SceneBundle:
        if revision is None:
            return self.registry.load(self.scene_id)
        return SceneBundle.open(self.registry.scenes_folder / self.scene_id / revision, check_hashes=False)

    def _show_bundle(self) -> None:
        """Add the meshes of the bundle as they are in its files: glTF with textures."""
        self._nodes, self._frames_of, self._meshes, self._poses = [], {}, {}, {}
        self._room: dict[int, viser.GlbHandle] = {}
        self.pickable = Pickable()
        self._nodes.append(self.server.scene.add_frame("/objects", show_axes=False))
        self._nodes.append(self.server.scene.add_frame("/room", show_axes=False))
        files = self._mesh_files()
        with ThreadPoolExecutor() as pool:  # pictures are decoded and encoded without the interpreter's lock
            read = dict(
                zip(files, pool.map(lambda path: as_filmed(path.read_bytes()), files.values()), strict=True)
            )
        for base in self.bundle.base:
            self._room[base.id] = self._add_glb(f"/room/{base.id}", read[base.id])
            self.pickable.add(base.id, files[base.id], np.eye(4))
        self.backdrop = self._add_glb("/room/backdrop", read[_BACKDROP]) if _BACKDROP in read else None
        for item in self.bundle.objects:
            pose = item.world_from_object
            name = f"/objects/{item.id}"
            self._frames_of[item.id] = self.server.scene.add_frame(
                name, show_axes=False, wxyz=quat_from_matrix(pose[:3, :3]), position=pose[:3, 3]
            )
            self._poses[item.id] = pose
            mesh = self._meshes[item.id] = self._add_glb(f"{name}/mesh", read[item.id])
            mesh.on_click(_show_pointer)
            self.pickable.add(item.id, files[item.id], pose)

    def _mesh_files(self) -> dict[int, Path]:
        """Return the visual meshes by id of object or base entity; `_BACKDROP` is the backdrop's."""
        found = {item.id: item.mesh for item in self.bundle.base} | {
            o.id: o.visual for o in self.bundle.objects
        }
        if self.bundle.backdrop is not None:
            found[_BACKDROP] = self.bundle.backdrop
        return {key: self.bundle.resolve(path) for key, path in found.items()}

    def _add_glb(self, name: str, data: bytes) -> viser.GlbHandle:
        return self.server.scene.add_glb(name, data, wxyz=_GLTF_WXYZ, cast_shadow=False, receive_shadow=False)

    def _dress(self) -> None:
        gui, scene = self.server.gui, self.server.scene
        gui.configure_theme(
            brand_color=BRAND_COLOR, show_logo=False, show_share_button=False, control_width="medium"
        )
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_PANEL_WIDTH_PX)
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(None)
        scene.add_light_ambient("/lights/ambient", intensity=_AMBIENT)
        scene.add_light_directional("/lights/sun", intensity=_SUN, position=(1.0, -2.0, 4.0))
        view = start_view(self.bundle)
        camera = self.server.initial_camera
        camera.position, camera.look_at, camera.up, camera.fov = (
            view.position,
            view.look_at,
            (0.0, 0.0, 1.0),
            view.fov,
        )


async def _show_pointer(_: viser.SceneNodePointerEvent) -> None:
    """Do nothing: a node with a callback is outlined under the pointer."""
