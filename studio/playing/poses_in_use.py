"""`PosesInUse`: one panel at a time moves the objects of a page."""

import threading
from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    from studio.scene_view import StudioPage


class Panel(Protocol):
    """A panel that moves the objects of the page while it is active."""

    def leave(self) -> None:
        """Stop moving objects: another panel takes over, or the bundle changes."""
        ...

    def close(self) -> None:
        """Leave, and end threads and processes."""
        ...


class PosesInUse:
    """The panel that moves the objects of a page: one at a time. Objects return where they were when it leaves."""

    def __init__(self, page: "StudioPage") -> None:
        self._page = page
        self._lock = threading.RLock()
        self._panel: Panel | None = None
        self._before: dict[int, np.ndarray] = {}

    def take(self, panel: Panel) -> dict[int, np.ndarray]:
        """Make a panel the active one; return the poses (4, 4) that the objects had before, by id."""
        with self._lock:
            if self._panel is not panel:
                self.free()
                self._before = {key: self._page.pose_of(key) for key in self._page.object_handles()}
                self._panel = panel
            return self._before

    def free(self) -> None:
        """Let the active panel leave, and return the objects to where they were."""
        with self._lock:
            panel, self._panel = self._panel, None
            if panel is None:
                return
            panel.leave()
            known = self._page.object_handles()
            with self._page.server.atomic():
                for key, pose in self._before.items():
                    if key in known:
                        self._page.set_pose(key, pose)
