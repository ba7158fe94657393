"""Parts of the page: each is a class that builds a tab of its own and listens to the page."""

from importlib import import_module
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from studio.scene_view import StudioPage


class Part(Protocol):
    """One part of the page.

    A part builds its tab in `__init__`, usually with `with page.tabs.add_tab("Name"): ...`. It must not block: long
    work runs in a thread and shows its progress in the page.
    """

    def __init__(self, page: "StudioPage") -> None: ...

    def close(self) -> None:
        """End what the part began: threads, files, listeners. The page is about to close."""
        ...


def load_parts(names: tuple[str, ...]) -> tuple[type[Part], ...]:
    """Import parts named `module:class`."""
    return tuple(getattr(import_module(module), kind) for module, kind in (n.split(":") for n in names))
