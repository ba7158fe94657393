"""The tab "Play": live physics, the assembly step by step, and rollouts of tasks."""

from typing import TYPE_CHECKING

import viser

from studio.playing.assembly_panel import AssemblyPanel
from studio.playing.physics_panel import PhysicsPanel
from studio.playing.poses_in_use import PosesInUse
from studio.playing.rollout_panel import RolloutPanel

if TYPE_CHECKING:
    from studio.scene_view import StudioPage


class PlayingPart:
    """The tab "Play"."""

    def __init__(self, page: "StudioPage") -> None:
        """Build the tab."""
        self._page = page
        self._poses = PosesInUse(page)
        with page.tabs.add_tab("Play", viser.Icon.PLAYER_PLAY):
            self.physics = PhysicsPanel(page, self._poses)
            self.assembly = AssemblyPanel(page, self._poses)
            self.rollout = RolloutPanel(page, self._poses)
        self._end_reload = page.on_reload(self._reloaded)

    def _reloaded(self) -> None:
        self._poses.free()
        for panel in (self.physics, self.assembly, self.rollout):
            panel.reload()

    def close(self) -> None:
        """End threads and processes."""
        self._end_reload()
        for panel in (self.physics, self.assembly, self.rollout):
            panel.close()
