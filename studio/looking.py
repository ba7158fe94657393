"""The tab "Scene": what is shown, the panel of the selected object, frames, and the scene graph."""

import threading
from typing import TYPE_CHECKING, Any

import numpy as np
import viser

from studio.graph_tree import tree_html
from studio.inspector import object_html, selection_html, views_html
from studio.layers import COVERAGE, OVERLAYS, Appearance, CameraLayer
from studio.text import bare

if TYPE_CHECKING:
    from studio.scene_view import StudioPage

_NONE = "–"
_OUTLINE = (255, 196, 61)
_VIEW_BUTTONS = 5
_NOTE = '<div style="font-size:12px;line-height:1.45;padding:2px 10px;opacity:.75">{}</div>'


class LookingPart:
    """Layers, the object panel, frames and the scene graph."""

    def __init__(self, page: "StudioPage") -> None:
        self._page, self._gui = page, page.server.gui
        self.appearance = Appearance(page)
        self.overlays = {kind.label: kind(page) for kind in OVERLAYS}
        self._lock = threading.RLock()
        self._outlines: list[Any] = []
        self._view_buttons: viser.GuiButtonGroupHandle | None = None
        with page.tabs.add_tab("Scene", viser.Icon.EYE):
            self._choice = self._gui.add_dropdown("Object", self._names(), initial_value=_NONE)
            self._panel = self._gui.add_html("")
            self._views_folder = self._gui.add_folder("Its photographs", visible=False)
            with self._views_folder:
                self._views = self._gui.add_html("")
            with self._gui.add_folder("Show"):
                self._add_layers()
            with self._gui.add_folder("Photographs", expand_by_default=False):
                self._add_frames()
            with self._gui.add_folder("Scene graph", expand_by_default=False):
                self._tree = self._gui.add_html("")
        self._choice.on_update(lambda _: self._choose())
        self._removers = [
            page.selection.on_change(self._selected),
            page.on_reload(self._reloaded),
            page.frames.on_change(self._stood),
        ]
        self._selected(page.selection.ids)

    def close(self) -> None:
        """End listening."""
        for remove in self._removers:
            remove()

    # ---- Controls.

    def _add_layers(self) -> None:
        modes = self.surfaces = self._gui.add_dropdown(
            "Surfaces",
            self.appearance.modes,
            initial_value=self.appearance.mode,
            hint="How the surfaces look",
        )
        room = self._gui.add_checkbox("Room", True, hint="Floor, walls and what is beyond them")
        self.boxes: dict[str, viser.GuiCheckboxHandle] = {}
        for layer in self.overlays.values():
            box = self.boxes[layer.label] = self._gui.add_checkbox(layer.label, layer.on, hint=layer.hint)
            box.on_update(lambda event, layer=layer: self._switch(layer, event.target.value))
        self._legend = self._gui.add_html("")

        def change(_: Any) -> None:
            if modes.value != self.appearance.mode:
                self._legend.content = _NOTE.format("One moment …")
            self.appearance.set(modes.value, room.value)
            self._explain()
            if modes.value == COVERAGE:
                self._selected(self._page.selection.ids)

        modes.on_update(change)
        room.on_update(change)

    def _switch(self, layer: Any, on: bool) -> None:
        layer.set(on)
        self._explain()

    def _explain(self) -> None:
        texts = [self.appearance.legend(), *(layer.legend() for layer in self.overlays.values() if layer.on)]
        self._legend.content = "".join(_NOTE.format(text) for text in texts if text)

    def _add_frames(self) -> None:
        frames = self._page.frames
        first, last = (frames.indices[0], frames.indices[-1]) if frames.indices else (0, 1)
        self._frame = self._gui.add_slider("Frame", first, max(last, first + 1), 1, first)
        go = self._gui.add_button("Stand at its camera", icon=viser.Icon.CAMERA)
        opacity = self._gui.add_slider(
            "Photograph", 0, 100, 5, 100, hint="How opaque the photograph is, in percent"
        )
        wipe = self._gui.add_slider(
            "Wipe", 0, 100, 1, 50, hint="How far the photograph reaches from the left, in percent"
        )
        away = self._gui.add_button("Take the photograph away", icon=viser.Icon.X)
        go.on_click(lambda event: frames.show(self._nearest(self._frame.value), event.client_id))
        away.on_click(lambda event: frames.leave(event.client_id))
        for slider in (opacity, wipe):
            slider.on_update(
                lambda event: frames.compare(opacity.value / 100, wipe.value / 100, event.client_id)
            )

    def _nearest(self, frame: int) -> int:
        known = np.array(self._page.frames.photographed or self._page.frames.indices)
        return int(known[np.argmin(np.abs(known - frame))])

    # ---- The selection.

    def _names(self) -> list[str]:
        return [_NONE, *(f"{bare(self._page.name_of(o.id), 60)} ({o.id})" for o in self._page.bundle.objects)]

    def _choose(self) -> None:
        value = self._choice.value
        if value == _NONE:
            self._page.selection.set(())
        elif self._page.selection.last is None or value != self._named(self._page.selection.last):
            self._page.selection.set((int(value.rsplit("(", 1)[1][:-1]),))

    def _named(self, object_id: int) -> str:
        return f"{bare(self._page.name_of(object_id), 60)} ({object_id})"

    def _selected(self, ids: tuple[int, ...]) -> None:
        with self._lock:
            for node in self._outlines:
                node.remove()
            self._outlines = [self._outline(i) for i in ids]
            wanted = self._named(ids[-1]) if ids else _NONE
            if self._choice.value != wanted:
                self._choice.value = wanted
            self._tree.content = tree_html(self._page, ids)
            if len(ids) != 1:
                self._panel.content = selection_html(self._page, ids)
                self._views_folder.visible = False
                return
            self._panel.content = object_html(self._page, ids[0], self.appearance.shares_of(ids[0]))
            self._show_views(ids[0])

    def _show_views(self, object_id: int) -> None:
        item = next(o for o in self._page.bundle.objects if o.id == object_id)
        frames = [str(f) for f in item.views if f in self._page.frames.indices][:_VIEW_BUTTONS]
        self._views.content = views_html(self._page, object_id)
        if self._view_buttons is not None:
            self._view_buttons.remove()
            self._view_buttons = None
        if frames:
            with self._views_folder:
                self._view_buttons = self._gui.add_button_group("Stand at", frames)
            self._view_buttons.on_click(
                lambda event: self._page.show_frame(int(event.target.value), event.client_id)
            )
        self._views_folder.visible = True

    def _outline(self, object_id: int) -> Any:
        """Draw the box of an object; it moves with the object."""
        vertices = self._page.pickable.geometry(object_id).vertices
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        bits = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        corners = low + bits * (high - low)
        edges = [(a, b) for a in range(8) for b in range(a) if np.abs(bits[a] - bits[b]).sum() == 1]
        return self._page.server.scene.add_line_segments(
            f"/objects/{object_id}/outline", corners[np.array(edges)].astype(np.float32), _OUTLINE, thickness=2.5,
            thickness_units="screen",
        )  # fmt: skip

    def _stood(self) -> None:
        cameras = self.overlays[CameraLayer.label]
        cameras.show(cameras.on)

    def _reloaded(self) -> None:
        with self._lock:
            self._outlines = []
            self._choice.options = self._names()
            self.appearance.rebuild()
            for layer in self.overlays.values():
                layer.rebuild()
            self._explain()
        self._selected(self._page.selection.ids)
