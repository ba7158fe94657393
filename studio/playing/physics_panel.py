"""The panel "Physics": play, pause, step, reset; drag, push and drop things with the mouse."""

import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import viser

from registry.errors import SimReconError
from registry.geometry import matrix_from_quat, rigid
from registry.simulation import specs_from_bundle
from studio.playing.player import PhysicsPlayer, PlayerState
from studio.playing.session import PhysicsSession
from studio.selection import Click
from studio.text import plain_markdown

if TYPE_CHECKING:
    from studio.playing.poses_in_use import PosesInUse
    from studio.scene_view import StudioPage

DRAG, PUSH = "drag", "push"
_STATE_EVERY_S = 0.5  # of the line of text below the buttons
_PAUSED = "paused"


class PhysicsPanel:
    """Physics of the scene in a thread of the server; all viewers see and touch the same bodies."""

    def __init__(self, page: "StudioPage", poses: "PosesInUse") -> None:
        """Build the panel; the physics is built when it is first needed."""
        self._page, self._poses = page, poses
        self._player: PhysicsPlayer | None = None
        self._setting = threading.local()
        self._dragging: list[tuple[Any, Any]] = []  # mesh handles and their callbacks
        self._end_clicks: Any = None
        self._said_at = 0.0
        gui = page.server.gui
        with gui.add_folder("Physics"):
            self._play = gui.add_button(
                "Run physics", icon=viser.Icon.PLAYER_PLAY, hint="Let time pass, at real time"
            )
            self._more = gui.add_button_group("Physics", ("Step", "Reset"))
            self._mouse = gui.add_dropdown(
                "Mouse",
                (DRAG, PUSH),
                initial_value=DRAG,
                hint="drag: pull a thing with the left button; push: click it",
            )
            self._push_speed = gui.add_slider("Push (m/s)", 0.1, 3.0, 0.1, 0.8)
            self._drop = gui.add_button("Drop selected", icon=viser.Icon.ARROW_DOWN)
            self._height = gui.add_slider("From (m)", 0.05, 1.0, 0.05, 0.3)
            self._speed = gui.add_slider("Speed", 0.1, 1.0, 0.1, 1.0)
            self._state = gui.add_markdown(_PAUSED)
        self._play.on_click(lambda _: self.pause() if self.running else self.play())
        self._more.on_click(lambda _: self.step() if self._more.value == "Step" else self.reset())
        self._drop.on_click(lambda _: self.drop(self._page.selection.ids))
        self._speed.on_update(lambda _: self._set_speed())
        self._mouse.on_update(lambda _: self._arm() if self.running else None)
        self._end_moves = page.on_move(self._moved_elsewhere)

    # ---- Acts.

    @property
    def running(self) -> bool:
        """Tell whether time passes."""
        return self._player is not None and self._player.running

    def play(self) -> None:
        """Let time pass from the poses that the page shows."""
        player = self._ready()
        if player is None:
            return
        player.play()
        self._show_running(True)
        self._arm()

    def pause(self) -> None:
        """Stop time; everything stays where it is."""
        if self._player is not None:
            self._player.pause()
        self._disarm()
        self._show_running(False)

    def step(self) -> None:
        """Simulate 1/30 s."""
        self.pause()
        player = self._ready()
        if player is not None:
            player.step()

    def reset(self) -> None:
        """Return everything to where it was before the first play, to the bit."""
        if self._player is not None:
            self._poses.free()

    def drop(self, ids: tuple[int, ...]) -> None:
        """Lift objects and let them fall."""
        if not ids:
            self._page.say("Select a thing first: click it in the scene", error=True)
            return
        height = float(self._height.value)
        self.play()
        player = self._player
        if player is None:  # the scene has no physics, which `play` said
            return
        for key in ids:
            player.do(lambda session, key=key: session.lift(key, height))

    # ---- Life.

    def leave(self) -> None:
        """Stop; another panel moves the objects now."""
        self._disarm()
        player, self._player = self._player, None
        if player is not None:
            player.close()
        self._show_running(False)
        self._state.content = _PAUSED

    def reload(self) -> None:
        """Forget the bodies of the former bundle."""
        self.leave()

    def close(self) -> None:
        """End the thread."""
        self._end_moves()
        player, self._player = self._player, None
        if player is not None:
            player.close()

    # ---- Inside.

    def _ready(self) -> PhysicsPlayer | None:
        """Return the player, with bodies where the page shows them; None: the scene has no physics, which is told."""
        start = self._poses.take(self)
        if self._player is None:
            try:
                session = PhysicsSession(specs_from_bundle(self._page.bundle), start)
            except SimReconError as error:
                self._state.content = plain_markdown(error)
                self._page.say(str(error), error=True)
                return None
            self._player = PhysicsPlayer(session, self._show_poses, self._show_state, self._refuse)
            self._set_speed()
        return self._player

    def _set_speed(self) -> None:
        if self._player is not None:
            self._player.speed = float(self._speed.value)

    def _show_poses(self, changes: dict[int, np.ndarray]) -> None:
        self._setting.mine = True
        try:
            with self._page.server.atomic():
                for key, pose in changes.items():
                    rotation = matrix_from_quat(pose[3:].astype(np.float64))
                    self._page.set_pose(key, rigid(rotation, pose[:3].astype(np.float64)))
        finally:
            self._setting.mine = False

    def _show_state(self, state: PlayerState) -> None:
        now = time.monotonic()
        if now - self._said_at < _STATE_EVERY_S and state.running and state.moving:
            return
        self._said_at = now
        how = "running" if state.running else _PAUSED
        moving = "all at rest" if not state.moving else f"{state.moving} moving"
        pace = (
            f", {100 * state.real_time:.0f} % of real time" if state.running and state.real_time < 0.9 else ""
        )
        self._state.content = f"{how}, {state.time_s:.1f} s, {moving}{pace}"

    def _refuse(self, text: str) -> None:
        self._page.say(text, error=True)

    def _show_running(self, running: bool) -> None:
        self._play.label = "Pause physics" if running else "Run physics"
        self._play.icon = viser.Icon.PLAYER_PAUSE if running else viser.Icon.PLAYER_PLAY

    def _moved_elsewhere(self, key: int) -> None:
        """Follow a pose that another part of the page sets, while the physics is in use."""
        player = self._player
        if player is not None and not getattr(self._setting, "mine", False):
            pose = self._page.pose_of(key)
            player.do(lambda session: session.place(key, pose))

    # ---- The mouse.

    def _arm(self) -> None:
        """Listen to the mouse, as long as time passes."""
        self._disarm()
        if self._mouse.value == PUSH:
            self._page.grab_clicks(self._clicked)
            self._end_clicks = lambda: self._page.grab_clicks(None)
            return
        assert self._player is not None
        movable = set(self._player.session.movable)
        for key, mesh in self._page.object_handles().items():
            if key in movable:
                callback = self._drag_of(key)
                mesh.on_drag("left")(callback)
                self._dragging.append((mesh, callback))

    def _disarm(self) -> None:
        for mesh, callback in self._dragging:
            try:
                mesh.remove_drag_callback(callback)
            except RuntimeError:  # the mesh is gone with its bundle
                continue
        self._dragging.clear()
        if self._end_clicks is not None:
            self._end_clicks()
            self._end_clicks = None

    def _drag_of(self, key: int) -> Any:
        # async: viser calls it in order, on its event loop; the player's thread does the work.
        async def dragged(event: viser.SceneNodeDragEvent) -> None:
            player, who = self._player, event.client_id
            if player is None:
                return
            at, to = np.array(event.start_position), np.array(event.end_position)
            if event.phase == "start":
                player.do(lambda session: session.grab(who, key, at))
            if event.phase == "end":
                player.do(lambda session: session.release(who))
            else:
                player.do(lambda session: session.drag(who, to))

        return dragged

    def _clicked(self, click: Click) -> None:
        player = self._player
        if player is None or click.id is None or click.point_world is None:
            return
        if click.id not in self._page.object_handles():
            return
        key, point, along, speed = (
            click.id,
            click.point_world,
            click.ray_direction,
            float(self._push_speed.value),
        )
        player.do(lambda session: session.push(key, point, along, speed))
