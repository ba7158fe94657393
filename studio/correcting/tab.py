"""The tab "Correct": tools, the list of acts with undo and redo, the preview, and Apply."""

import logging
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import viser

from registry.errors import SimReconError
from studio.correcting.act_list import ActList
from studio.correcting.acts import Act
from studio.correcting.applying import Applying
from studio.correcting.click_tools import ClickTools
from studio.correcting.document import DocumentState
from studio.correcting.gizmo import Gizmo
from studio.correcting.pending import Preview
from studio.correcting.session import Session
from studio.correcting.shown import Shown
from studio.correcting.thing_tools import ThingTools
from studio.text import bare

if TYPE_CHECKING:
    from studio.scene_view import StudioPage

logger = logging.getLogger(__name__)
_LOOK_EVERY_S = 0.7  # for edits by hand and for acts of another page
_INEXACT = (
    "**The results of the stages are gone, or another version made them.** Clicks on surfaces become metres, and "
    "splits are not shown before *Apply*, which makes the results again."
)


class CorrectPart:
    """Corrects the scene of a page."""

    def __init__(self, page: "StudioPage") -> None:
        """Build the tab."""
        self.page = page
        self.session = Session(page.registry, page.bundle)
        self._lock = threading.RLock()  # one act at a time
        self._closed = threading.Event()
        self._version = 0
        self.preview = Preview()
        self._shown = Shown(page)
        with page.tabs.add_tab("Correct", viser.Icon.PENCIL):
            self._told = page.server.gui.add_markdown("", visible=False)
            self._inexact = page.server.gui.add_markdown(_INEXACT, visible=False)
            self.things = ThingTools(self)
            self.gizmo = Gizmo(self)
            self.clicks = ClickTools(self)
            self.list = ActList(self)
            self.applying = Applying(self)
        self._text: str | None = None
        self._clients = -1
        self._ends = [
            page.selection.on_change(self._selected),
            page.on_reload(self._reloaded),
        ]
        state = self.session.document.state()
        self._text = state.text
        pending, taken_back = self.session.pending(state)
        self.list.show(
            state, Preview(len(pending), taken_back)
        )  # drawn by the watcher, which can wait for it
        self._tell()
        self._watcher = threading.Thread(target=self._watch, name="corrections", daemon=True)
        self._watcher.start()

    def close(self) -> None:
        """End the watching; the file and a running Apply stay."""
        self._closed.set()
        for end in self._ends:
            end()
        self._watcher.join(2 * _LOOK_EVERY_S)
        self.session.close()

    # ---- For the tools.

    def button(
        self, label: str, action: Callable[[], object], hint: str | None = None
    ) -> viser.GuiButtonHandle:
        """Add a button; an expected error of its action becomes one line in the page."""
        handle = self.page.server.gui.add_button(label, hint=hint)
        handle.on_click(lambda _: self.run(action))
        return handle

    def act(self, label: str, make: Callable[[], Act], hint: str | None = None) -> viser.GuiButtonHandle:
        """Add a button that performs an act."""
        return self.button(label, lambda: self.perform(make()), hint)

    def run(self, action: Callable[[], object]) -> None:
        """Run an action of the user, one at a time."""
        try:
            with self._lock:
                action()
        except SimReconError as error:
            self.fail(error)
        except Exception as error:
            logger.exception("an act of the page failed")
            self.fail(error)

    def in_background(self, action: Callable[[], object]) -> None:
        """Run an action in a thread of its own."""
        threading.Thread(target=lambda: self.run(action), daemon=True).start()

    def perform(self, act: Act) -> None:
        """Write an act, and show it."""
        with self._lock:
            self._show(self.session.perform(act))

    def selected(self) -> int:
        """Return the object that was selected last.

        Raises:
            UsageError: none is selected.
        """
        from registry.errors import UsageError

        if self.page.selection.last is None:
            raise UsageError("select a thing first: click it in the scene")
        return self.page.selection.last

    def shown_pose(self, object_id: int) -> np.ndarray:
        """Return the pose (4, 4) of an object with the pending acts."""
        known = {item.id: item.world_from_object for item in self.page.bundle.objects}
        return self.preview.poses.get(object_id, known[object_id])

    def fail(self, error: Exception) -> None:
        """Say an error in one line."""
        self.page.say(" ".join(str(error).split()), error=True)

    def show(self, state: DocumentState) -> None:
        """Show a state of the file."""
        with self._lock:
            self._show(state)

    # ---- Inside.

    def _show(self, state: DocumentState) -> None:
        self._text = state.text
        self._version += 1
        self.preview = self.session.preview(state)
        self.list.show(state, self.preview)
        self._shown.draw(self.preview)
        self.gizmo.follow(self.page.selection.last)
        pending, _ = self.session.pending(state)
        if any(
            set(entry) & {"split", "add", "merge", "make_base"}
            for entry in pending
            if isinstance(entry, dict)
        ):
            threading.Thread(target=self._look_closer, args=(state, self._version), daemon=True).start()

    def _look_closer(self, state: DocumentState, version: int) -> None:
        """Show the parts of split things, and the first error of the cut, when they are known."""
        try:
            full = self.session.previewer.full(state.entries)
        except Exception:
            logger.exception("no preview of the cut")
            return
        with self._lock:
            if version == self._version and not self._closed.is_set():
                self.preview = full
                self._shown.draw(full)
                self.list.show(state, full)

    def _selected(self, ids: tuple[int, ...]) -> None:
        self.things.selected(ids)
        self.gizmo.follow(ids[-1] if ids else None)

    def _reloaded(self) -> None:
        with self._lock:
            self._shown = Shown(self.page)
            self.clicks.cancel()
            self.session.show(self.page.bundle)
            self._fill()

    def _fill(self) -> None:
        """Fill the lists that take seconds to know."""
        self._show(self.session.document.state())
        self._inexact.visible = not self.session.anchors.exact
        self.things.fill()
        self.clicks.fill()

    def _watch(self) -> None:
        """Notice edits by hand, acts of other pages, and other viewers."""
        self.run(self._fill)
        while not self._closed.wait(_LOOK_EVERY_S):
            try:
                state = self.session.document.state()
                if state.text != self._text:
                    with self._lock:
                        self._show(state)
                    self.page.say(
                        "the file of corrections was changed outside of this page; its acts are taken over"
                    )
                self._tell()
                self.applying.look()
            except Exception:
                logger.exception("the file of corrections cannot be watched")

    def _tell(self) -> None:
        """Tell viewers that they are not alone."""
        clients = len(self.page.server.get_clients())
        if clients == self._clients:
            return
        self._clients = clients
        said = []
        if clients > 1:
            said.append(
                f"{clients} tabs have this scene open; they share its acts, and undo takes back the last of all."
            )
        if self.session.other:
            said.append(
                f"Another studio ({bare(self.session.other)}) corrects this scene, too; both write the same file."
            )
        self._told.content, self._told.visible = "**Not alone.** " + " ".join(said), bool(said)
        if said:
            self.page.say(" ".join(said))
