"""The panel "Assembly": the scene built step by step, parents before children, forward and back."""

from typing import TYPE_CHECKING

import viser

from studio.assembly import AssemblyStep, assembly_steps, pose_at
from studio.playing.ticker import Ticker
from studio.text import plain_markdown

if TYPE_CHECKING:
    from studio.playing.poses_in_use import PosesInUse
    from studio.scene_view import StudioPage

STEP_S = 0.8  # of the animation of a step
_IDLE = "The scene as it was assembled: floor and walls first, then each thing after the one that carries it."


class AssemblyPanel:
    """Replays the assembly in the page."""

    def __init__(self, page: "StudioPage", poses: "PosesInUse") -> None:
        """Build the panel."""
        self._page, self._poses = page, poses
        self._steps: tuple[AssemblyStep, ...] = ()
        self._progress = self._goal = 0.0  # in steps
        self._hidden: set[int] = set()
        self._said = -1
        self._ticker = Ticker(self._tick, "studio-assembly")
        gui = page.server.gui
        with gui.add_folder("Assembly"):
            self._play = gui.add_button("Play assembly", icon=viser.Icon.PLAYER_PLAY)
            self._more = gui.add_button_group("Assembly", ("Back", "Forward", "End"))
            self._text = gui.add_markdown(_IDLE)
        self._play.on_click(lambda _: self.stop() if self._ticker.running else self.play())
        acts = {"Back": self.back, "Forward": self.forward, "End": self.end}
        self._more.on_click(lambda _: acts[self._more.value]())

    @property
    def step(self) -> int:
        """Return the number of objects that are in place; that of all if the replay is not in use."""
        return int(self._progress + 1e-9) if self._steps else len(self._page.bundle.objects)

    def play(self) -> None:
        """Play from the present step, or from the empty room, to the end."""
        self._begin()
        if self._progress >= len(self._steps):
            self._progress = 0.0
        self._go(len(self._steps))

    def stop(self) -> None:
        """Stop the animation."""
        self._ticker.stop()
        self._show_running(False)

    def forward(self) -> None:
        """Place one more object; from the empty room if the replay is not in use."""
        self._begin()
        if self._progress >= len(self._steps):
            self._progress = 0.0
        self._go(min(int(self._progress + 1e-9) + 1, len(self._steps)))

    def back(self) -> None:
        """Take the last object away; the whole scene is the last step."""
        if not self._steps:
            self._begin()
            self._progress = float(len(self._steps))
        self._go(max(-(-self._progress // 1) - 1, 0))

    def end(self) -> None:
        """End the replay: the whole scene."""
        if self._steps:
            self._poses.free()

    def leave(self) -> None:
        """End the replay; `PosesInUse` returns the objects."""
        self.stop()
        self._steps, self._progress, self._said = (), 0.0, -1
        self._show(set())
        self._text.content = _IDLE

    def reload(self) -> None:
        """Forget the steps of the former bundle."""
        self.leave()

    def close(self) -> None:
        """End the thread."""
        self._ticker.close()

    # ---- Inside.

    def _begin(self) -> None:
        start = self._poses.take(self)
        if not self._steps:
            self._steps, self._progress = assembly_steps(self._page.bundle, start), 0.0
            self._draw()

    def _go(self, goal: float) -> None:
        self._goal = float(goal)
        self._show_running(True)
        self._ticker.start()

    def _tick(self, seconds: float) -> None:
        change = seconds / STEP_S
        if self._goal >= self._progress:
            self._progress = min(self._progress + change, self._goal)
        else:
            self._progress = max(self._progress - change, self._goal)
        self._draw()
        if self._progress == self._goal:
            self.stop()

    def _draw(self) -> None:
        """Show the objects of the present moment where they are."""
        missing = set()
        with self._page.server.atomic():
            for number, step in enumerate(self._steps):
                pose = pose_at(step, number, self._progress)
                if pose is None:
                    missing.add(step.object_id)
                elif self._progress <= number + 2:  # those before have arrived
                    self._page.set_pose(step.object_id, pose)
            self._show(missing)
        self._say()

    def _show(self, missing: set[int]) -> None:
        """Hide the objects that are not there yet, and show those that this panel hid."""
        known, scene = self._page.object_handles(), self._page.server.scene
        for key in (missing - self._hidden) & known.keys():
            frame = scene.get_handle_by_name(f"/objects/{key}")
            if frame is not None and frame.visible:
                self._page.show_object(key, False)
                self._hidden.add(key)
        for key in (self._hidden - missing) & known.keys():
            self._page.show_object(key, True)
        self._hidden &= missing

    def _say(self) -> None:
        number = min(int(-(-self._progress // 1)), len(self._steps))
        if number == self._said:
            return
        self._said = number
        if number == 0:
            self._text.content = f"0 of {len(self._steps)}: floor and walls"
            return
        step = self._steps[number - 1]
        how = "hangs on" if step.relation == "attached_to" else "stands on"
        name, parent = self._page.name_of(step.object_id), self._page.name_of(step.parent)
        lines = [f"**{number} of {len(self._steps)}: {plain_markdown(name)}** {how} {plain_markdown(parent)}"]
        lines += [plain_markdown(text) for text in (step.evidence, step.settling) if text]
        self._text.content = "\n\n".join(lines)

    def _show_running(self, running: bool) -> None:
        self._play.label = "Stop" if running else "Play assembly"
        self._play.icon = viser.Icon.PLAYER_PAUSE if running else viser.Icon.PLAYER_PLAY
