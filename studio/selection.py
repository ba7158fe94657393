"""Selected objects of a page, and clicks into its scene."""

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Click:
    """A click into the scene, with the first surface that its ray meets."""

    id: int | None  # object or base entity; None: nothing was hit
    point_world: np.ndarray | None  # float64 (3,) metres; None: nothing was hit
    normal_world: np.ndarray | None  # float64 (3,) unit, towards the viewer
    ray_origin: np.ndarray  # float64 (3,)
    ray_direction: np.ndarray  # float64 (3,) unit
    frame: int | None  # number of the video frame whose photograph this viewer sees
    pixel: tuple[float, float] | None  # (x, y) in that frame
    client_id: int
    modifier: str | None = None  # "shift", "cmd/ctrl"; None: none


class Listeners:
    """Callbacks of an event; a failing one is logged and does not stop the others."""

    def __init__(self) -> None:
        self._callbacks: list[Callable[..., object]] = []

    def add(self, callback: Callable[..., object]) -> Callable[[], None]:
        """Add a callback; return a function that removes it."""
        self._callbacks.append(callback)

        def remove() -> None:
            if callback in self._callbacks:
                self._callbacks.remove(callback)

        return remove

    def call(self, *arguments: object) -> None:
        """Call all callbacks in the order in which they were added."""
        for callback in list(self._callbacks):
            try:
                callback(*arguments)
            except Exception:  # one part's mistake must not stop the page
                logger.exception("a listener of the page failed")


class Selection:
    """The selected objects, in the order of selection; shared by all viewers of a page."""

    def __init__(self) -> None:
        self._ids: tuple[int, ...] = ()
        self._listeners = Listeners()

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of the selected objects, the first selected first."""
        return self._ids

    @property
    def last(self) -> int | None:
        """The object that was selected last; None: nothing is selected."""
        return self._ids[-1] if self._ids else None

    def set(self, ids: Iterable[int]) -> None:
        """Replace the selection; listeners are called if it changes."""
        new = tuple(dict.fromkeys(int(i) for i in ids))
        if new != self._ids:
            self._ids = new
            self._listeners.call(new)

    def toggle(self, object_id: int) -> None:
        """Add an object to the selection, or remove it."""
        kept = tuple(i for i in self._ids if i != object_id)
        self.set(kept if object_id in self._ids else (*kept, object_id))

    def on_change(self, callback: Callable[[tuple[int, ...]], object]) -> Callable[[], None]:
        """Call `callback(ids)` after every change; return a function that ends it."""
        return self._listeners.add(callback)
