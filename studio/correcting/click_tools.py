"""Tools of the tab "Correct" that take clicks in the scene: split, stands on, measure, up, floor, add by outlines."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from registry.errors import SimReconError, UsageError
from studio.correcting.acts import Act, Outline
from studio.correcting.shown import COLOR_NAMES, COLORS
from studio.selection import Click

if TYPE_CHECKING:
    from studio.correcting.tab import CorrectPart

_DOT_M = 0.008
_NEAR = 0.14  # metres before the camera, where outlines are drawn: nearer than the photograph

_NOTHING: tuple[str, ...] = ("none",)


class ClickTools:
    """One tool at a time takes the clicks, until it is done or cancelled."""

    def __init__(self, part: "CorrectPart") -> None:
        self._part, self._page = part, part.page
        self._clicks: list[list[Click]] = []
        self._outlines: list[Outline] = []
        self._nodes: list = []
        self._finish: Callable[[], Act] | None = None
        self._last_split: tuple[dict, list[list[Click]]] | None = None  # its entry, and what was clicked
        self._onto: int | None = (
            None  # part of a split that gets the next points; None: a new one, or by Shift the last
        )
        self._auto: int | None = None  # number of clicks after which the tool is done by itself
        gui = self._page.server.gui
        with gui.add_folder("By clicks"):
            part.button(
                "Split",
                self._split,
                "click each part of one thing; Shift and click: another point of the same part",
            )
            part.button(
                "More points",
                self._more_points,
                "after a split whose colors are wrong: its points are kept, and you add others",
            )
            self._relation = gui.add_dropdown(
                "Relation", ("supported_by", "attached_to"), initial_value="supported_by"
            )
            part.button("Stands on", self._parent, "then click what carries the selected thing")
            self._metres = gui.add_number("Length (m)", 0.5, min=0.01, max=100.0, step=0.001)
            part.button("Measured length", self._measure, "click the two ends of a length that you know")
            part.button(
                "Level surface", self._up, "click a surface that is level, or three places at one height"
            )
            part.button("Floor is here", self._floor, "click a place on the floor")
        with gui.add_folder("Add a missed thing"):
            self._label = gui.add_text("Name", "")
            self._frame = gui.add_dropdown("Frame", _NOTHING, initial_value=_NOTHING[0])
            part.button(
                "Outline", self._outline, "go to the frame, and click around the thing in the photograph"
            )
            part.button("Next frame", self._next_outline, "go on with the outline in another frame")
        self._hint = gui.add_markdown("", visible=False)
        self._colors = gui.add_button_group(
            "Next point", COLOR_NAMES, visible=False, hint="which part of a split gets the next points"
        )
        self._colors.on_click(lambda _: self._choose(COLOR_NAMES.index(self._colors.value)))
        self._done = part.button("Done", self._end, "write the act")
        self._cancel = part.button("Cancel", self.cancel, "forget these clicks")
        self._done.visible = self._cancel.visible = False

    def fill(self) -> None:
        """Offer the frames whose photographs are kept; reads the stage cache."""
        self._last_split = None  # its clicks are on another revision
        frames = tuple(str(index) for index in self._page.frames.photographed)
        if frames:
            self._frame.options = frames
            self._frame.value = frames[0]

    @property
    def busy(self) -> bool:
        """Whether a tool takes the clicks."""
        return self._finish is not None

    def cancel(self) -> None:
        """Give the clicks back, and forget those that were made."""
        self._page.grab_clicks(None)
        self._finish, self._auto, self._clicks, self._outlines, self._onto = None, None, [], [], None
        for node in self._nodes:
            node.remove()
        self._nodes = []
        self._hint.visible = self._done.visible = self._cancel.visible = self._colors.visible = False

    def _begin(self, hint: str, finish: Callable[[], Act], auto: int | None = None) -> None:
        self.cancel()
        self._finish, self._auto = finish, auto
        self._hint.content, self._hint.visible = hint, True
        self._done.visible = self._cancel.visible = True
        self._page.grab_clicks(self._clicked)

    def _end(self) -> None:
        if self._finish is None:
            return
        act = self._finish()  # where it fails, the clicks stay and the tool goes on
        if "split" in act.entry:
            self._last_split = act.entry, self._clicks
        self.cancel()
        self._part.perform(act)

    def _clicked(self, click: Click) -> None:
        try:
            if click.point_world is None or click.id is None:
                raise UsageError("nothing is there; click a surface of the scene")
            number = self._part_of(click)
            if number == len(self._clicks):
                self._clicks.append([])
            self._clicks[number].append(click)
            self._dot(click, COLORS[number % len(COLORS)])
            if self._auto is not None and len(self._clicks) >= self._auto:
                self._end()
        except SimReconError as error:
            self._part.fail(error)

    def _part_of(self, click: Click) -> int:
        """Return the number of the part that gets a click; the next free one is a new part."""
        if self._onto is not None:
            return min(self._onto, len(self._clicks))
        again = click.modifier == "shift" and self._clicks
        return len(self._clicks) - 1 if again else len(self._clicks)

    def _dot(self, click: Click, color: tuple[int, int, int]) -> None:
        assert click.point_world is not None
        self._nodes.append(
            self._page.server.scene.add_icosphere(
                f"/correct/click_{len(self._nodes)}", _DOT_M, color=color, position=click.point_world,
                cast_shadow=False, receive_shadow=False,
            )
        )  # fmt: skip

    # ---- The tools.

    def _split(self) -> None:
        self._begin(
            "**Split**: click each part once. Shift and click adds a point to the last part, a color below to another "
            "one. Then *Done*.",
            lambda: self._part.session.acts.split(self._clicks),
        )
        self._colors.visible = True

    def _more_points(self) -> None:
        """Take the last split back, and go on with its clicks."""
        entries = self._part.session.document.state().entries
        if self._last_split is None or entries[-1:] != [self._last_split[0]]:
            raise UsageError("more points: the last act is no split that was made here; press Split")
        clicks = self._last_split[1]
        self._part.show(self._part.session.document.undo())
        self._split()
        self._clicks = [list(part) for part in clicks]
        for number, part in enumerate(self._clicks):
            for click in part:
                self._dot(click, COLORS[number % len(COLORS)])
        self._choose(0)

    def _choose(self, number: int) -> None:
        """Give the next points to a part of a split, by its number; beyond the last one it is a new part."""
        self._onto = number
        self._hint.content = (
            f"**Split**: points that you click now are of the **{COLOR_NAMES[number]}** part. Then *Done*."
        )

    def _parent(self) -> None:
        child = self._part.selected()
        relation = str(self._relation.value)
        self._begin(
            "**Stands on**: click what carries it: a thing, the floor or a wall.",
            lambda: self._part.session.acts.parent(child, self._clicks[0][0], relation), auto=1,
        )  # fmt: skip

    def _measure(self) -> None:
        self._begin(
            "**Measured length**: click both ends.",
            lambda: self._part.session.acts.scale(*self._single(2), metres=float(self._metres.value)), auto=2,
        )  # fmt: skip

    def _up(self) -> None:
        self._begin(
            "**Level surface**: click it once, or click three places or more at one height. Then *Done*.",
            lambda: self._part.session.acts.up([part[0] for part in self._clicks]),
        )

    def _floor(self) -> None:
        self._begin(
            "**Floor is here**: click a place on the floor.",
            lambda: self._part.session.acts.floor(self._single(1)[0]), auto=1,
        )  # fmt: skip

    def _single(self, count: int) -> list[Click]:
        if len(self._clicks) < count:
            raise UsageError(f"click {count} places first")
        return [part[0] for part in self._clicks[:count]]

    # ---- Outlines.

    def _outline(self) -> None:
        """Begin an outline in the chosen frame."""
        self._begin(
            "**Outline**: click around the thing in the photograph. Then choose another frame: *Next frame*.",
            lambda: self._part.session.acts.add(
                str(self._label.value), [o for o in self._outlines if o.pixels]
            ),
        )
        self._page.grab_clicks(self._outlined)
        self._open_outline()

    def _next_outline(self) -> None:
        if not self._outlines:
            raise UsageError("add: press Outline first, and click around the thing in one frame")
        if len(self._outlines) > 1:
            raise UsageError("add: two outlines are enough; press Done")
        if int(self._frame.value) == self._outlines[0].frame:
            raise UsageError("add: choose another frame first")
        self._open_outline()

    def _open_outline(self) -> None:
        if self._frame.value == "none":
            raise UsageError("add: no photograph of this scene is kept; reconstruct it again to have them")
        frame = int(self._frame.value)
        self._outlines.append(Outline(frame, ()))
        self._page.show_frame(frame)

    def _outlined(self, click: Click) -> None:
        try:
            outline = self._outlines[-1]
            if click.frame != outline.frame or click.pixel is None:
                raise UsageError(
                    f"this view has left frame {outline.frame}; press Cancel, then Outline again"
                )
            self._outlines[-1] = Outline(outline.frame, (*outline.pixels, click.pixel))
            self._line(self._outlines[-1])
        except SimReconError as error:
            self._part.fail(error)

    def _line(self, outline: Outline) -> None:
        """Draw an outline in front of its photograph."""
        pose = self._page.frames.world_from_camera(outline.frame)
        fx, fy, cx, cy = self._page.bundle.cameras.params[:4]
        pixels = np.array(outline.pixels)
        rays = np.column_stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(len(pixels))])
        points = _NEAR * rays @ pose[:3, :3].T + pose[:3, 3]
        ends = np.stack([points, np.roll(points, -1, axis=0)], axis=1)
        self._nodes.append(
            self._page.server.scene.add_line_segments(
                f"/correct/outline_{len(self._outlines)}", ends.astype(np.float32), COLORS[0], thickness=2.0,
                thickness_units="screen",
            )
        )  # fmt: skip
