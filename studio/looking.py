"""The tab "Scene": what is shown, and the panel of the selected object."""

from typing import TYPE_CHECKING

import viser

if TYPE_CHECKING:
    from studio.scene_view import StudioPage


class LookingPart:
    """Shows the selection."""

    def __init__(self, page: "StudioPage") -> None:
        self._page = page
        with page.tabs.add_tab("Scene", viser.Icon.EYE):
            self._who = page.server.gui.add_text("Selected", "", disabled=True)
        page.selection.on_change(self._selected)

    def _selected(self, ids: tuple[int, ...]) -> None:
        self._who.value = ", ".join(self._page.name_of(i) for i in ids)

    def close(self) -> None:
        """Do nothing."""
