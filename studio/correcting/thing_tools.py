"""Tools of the tab "Correct" for the selected thing: name, drop, merge, room, movable, mass, friction, material."""

from typing import TYPE_CHECKING

from studio.correcting.acts import BASES
from studio.text import bare

if TYPE_CHECKING:
    from studio.correcting.tab import CorrectPart

_NOT_FILLED: tuple[str, ...] = ("unknown",)


class ThingTools:
    """The folder of the selected thing."""

    def __init__(self, part: "CorrectPart") -> None:
        self._part = part
        gui, acts = part.page.server.gui, lambda: part.session.acts
        with gui.add_folder("Selected thing"):
            self._who = gui.add_text("Selected", "nothing", disabled=True)
            self._label = gui.add_text("New name", "")
            part.act("Rename", lambda: acts().relabel(part.selected(), str(self._label.value)))
            part.act(
                "Merge selected",
                lambda: acts().merge(part.page.selection.ids),
                "Shift and click selects more",
            )
            part.act(
                "Not a thing", lambda: acts().drop(part.selected()), "its surface belongs to nothing any more"
            )
            self._base = gui.add_dropdown("Part of", BASES, initial_value="wall")
            part.act("Part of the room", lambda: acts().make_base(part.selected(), str(self._base.value)))
            part.act("Can move", lambda: acts().movable(part.selected(), True))
            part.act("Cannot move", lambda: acts().movable(part.selected(), False))
            self._mass = gui.add_number("Mass (kg)", 1.0, min=0.001, max=10000.0, step=0.001)
            part.act("Set mass", lambda: acts().mass(part.selected(), float(self._mass.value)))
            self._friction = gui.add_number("Friction", 0.5, min=0.01, max=10.0, step=0.01)
            part.act("Set friction", lambda: acts().friction(part.selected(), float(self._friction.value)))
            self._material = gui.add_dropdown("Material", _NOT_FILLED, initial_value=_NOT_FILLED[0])
            part.act("Set material", lambda: acts().material(part.selected(), str(self._material.value)))

    def fill(self) -> None:
        """Offer the materials of the table; imports the assets stage."""
        from reconstruction.assets.physics.materials import MATERIALS

        self._material.options = tuple(sorted(MATERIALS))
        self.selected(self._part.page.selection.ids)

    def selected(self, ids: tuple[int, ...]) -> None:
        """Show the values of the selection."""
        names = [f"{self._part.session.name_of(i)} {i}" for i in ids]
        self._who.value = bare(", ".join(names) or "nothing", 120)
        item = next((o for o in self._part.page.bundle.scene["objects"] if ids and o["id"] == ids[-1]), None)
        if item is not None:
            self._mass.value, self._friction.value = float(item["mass_kg"]), float(item["friction"])
            if item["material"] in self._material.options:
                self._material.value = item["material"]
