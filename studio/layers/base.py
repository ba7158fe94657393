"""A layer: nodes of the scene that are made when it is first shown."""

import threading
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from studio.scene_view import StudioPage


class Layer:
    """Nodes that are shown and hidden together. Subclasses set `label` and `hint`, and override `build`."""

    label = ""
    hint = ""

    def __init__(self, page: "StudioPage") -> None:
        self.page = page
        self.on = False
        self._nodes: list[Any] | None = None  # None: not made yet
        self._lock = threading.RLock()

    def build(self) -> list[Any]:
        """Add the layer's nodes to the scene and return their handles."""
        raise NotImplementedError

    def legend(self) -> str:
        """Return HTML that explains the layer while it is shown; texts of the scene in it are escaped."""
        return ""

    def set(self, on: bool) -> None:
        """Show or hide the layer; the first showing makes it, which may take a while."""
        with self._lock:
            self.on = on
            if on and self._nodes is None:
                self._nodes = self.build()
            self.show(on)

    def show(self, visible: bool) -> None:
        """Show or hide the nodes that there are, for a while; the layer stays switched on or off."""
        for node in self._nodes or ():
            if node.visible != visible:
                node.visible = visible

    def rebuild(self) -> None:
        """Make the layer anew, for another revision of the scene."""
        with self._lock:
            self.remove()
            if self.on:
                self._nodes = self.build()

    def remove(self) -> None:
        """Remove the layer's nodes."""
        with self._lock:
            discard(self.page, self._nodes or ())
            self._nodes = None


def discard(page: "StudioPage", nodes: Iterable[Any]) -> None:
    """Remove nodes of the scene, except those that went with the objects that they belong to."""
    for node in nodes:
        if page.server.scene.get_handle_by_name(node.name) is node:
            node.remove()
