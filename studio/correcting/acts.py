"""Acts of the page as entries of the overrides file: each returns an entry and a title for the list of acts."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from reconstruction.editing.scene_entries import SCENE_KEYS
from registry.errors import UsageError
from registry.geometry import quat_from_matrix
from studio.correcting.anchoring import Anchors
from studio.correcting.document import Document, DocumentState
from studio.correcting.yaml_text import one_line
from studio.selection import Click

BASES = ("floor", "wall", "ceiling")


@dataclass(frozen=True)
class Act:
    """One act: what is written, and what the user reads."""

    entry: dict[str, Any]
    title: str


@dataclass(frozen=True)
class Outline:
    """An outline in one frame: pixels (x, y) of the undistorted photograph, in order."""

    frame: int
    pixels: tuple[tuple[float, float], ...]


def perform(document: Document, act: Act, applied: int = 0) -> DocumentState:
    """Write an act: as a new entry, or over the one that it replaces.

    A scene has one scale, one up direction and one floor, and of two moves of a thing in a row only the last counts.

    Args:
        document: the file.
        act: the act.
        applied: entries that the scene was made with; of these no move is replaced.
    """
    entries = document.state().entries
    for number, entry in reversed(list(enumerate(entries))):
        last = number == len(entries) - 1 >= applied
        if (set(act.entry) & set(SCENE_KEYS) and set(entry) == set(act.entry)) or (
            last and "move" in act.entry and _same_but("move", entry, act.entry)
        ):
            return document.replace(number, act.entry, act.title)
    return document.append(act.entry, act.title)


def _same_but(action: str, a: dict, b: dict) -> bool:
    return set(a) == set(b) and all(a[key] == b[key] for key in a if key != action)


class Acts:
    """Makes acts for one revision of a scene."""

    def __init__(
        self,
        anchors: Anchors,
        name_of: Callable[[int], str],
        joined: Callable[[int], int] = lambda number: number,
    ) -> None:
        """Remember where addresses and names (which may be hostile) come from.

        Args:
            anchors: addresses of this revision.
            name_of: name of an object or base entity.
            joined: one id for all objects that acts not applied yet have merged.
        """
        self._anchors, self._name_of, self._joined = anchors, name_of, joined

    def relabel(self, object_id: int, label: str) -> Act:
        """Name an object."""
        new = one_line(label)
        if not new:
            raise UsageError("relabel: type a name first, for example mug")
        return self._of(object_id, {"relabel": new}, f"{self._named(object_id)} is a {new}")

    def drop(self, object_id: int) -> Act:
        """Remove an object that is none."""
        return self._of(object_id, {"drop": True}, f"{self._named(object_id)} is not a thing")

    def merge(self, object_ids: Sequence[int]) -> Act:
        """Make one object of several."""
        if len(set(object_ids)) < 2:
            raise UsageError("merge: select two things or more (Shift and click adds one)")
        things = [self._anchors.thing(number) for number in object_ids]
        return Act({"merge": things}, f"{' and '.join(map(self._named, object_ids))} are one thing")

    def split(self, parts: Sequence[Sequence[Click]]) -> Act:
        """Cut an object into the parts that were clicked, each once or more."""
        clicks = [click for part in parts for click in part]
        if len(parts) < 2 or not all(parts):
            raise UsageError("split: click at least two parts of one thing")
        owners = {None if click.id is None else self._joined(click.id) for click in clicks}
        if len(owners) > 1 or None in owners:
            hit = sorted({click.id for click in clicks}, key=str)
            names = " and ".join("nothing" if o is None else self._named(o) for o in hit)
            raise UsageError(f"split: all clicks must be on one thing; they are on {names}")
        owner = clicks[0].id
        assert owner is not None
        places = [[self._place(click) for click in part] for part in parts]
        how = [part[0] if len(part) == 1 else part for part in places]
        title = f"{self._named(owner)} is {len(parts)} things"
        if any("at" in place for part in places for place in part):
            # Where no frame sees the parts, points in metres cannot say which thing is meant when others are near.
            return self._of(owner, {"split": how}, title)
        return Act({"split": how}, title)

    def make_base(self, object_id: int, kind: str) -> Act:
        """Make an object part of the room."""
        if kind not in BASES:
            raise UsageError(f"make base: choose one of {', '.join(BASES)}")
        return self._of(object_id, {"make_base": kind}, f"{self._named(object_id)} is part of the {kind}")

    def parent(self, object_id: int, parent: Click | int, relation: str = "supported_by") -> Act:
        """Say on what an object stands, or to what it is attached."""
        owner = parent if isinstance(parent, int) else parent.id
        if owner is None:
            raise UsageError("parent: nothing is there; click a thing, the floor or a wall")
        if owner == object_id:
            raise UsageError(f"parent: {self._named(object_id)} cannot carry itself")
        if isinstance(parent, Click) and not self._anchors.knows(owner):
            address = self._place(parent)  # floor and walls have no anchor of their own
        else:
            address = self._anchors.thing(owner)
        verb = "is attached to" if relation == "attached_to" else "stands on"
        said = {"parent": address} | ({"relation": relation} if relation == "attached_to" else {})
        return self._of(object_id, said, f"{self._named(object_id)} {verb} {self._named(owner)}")

    def movable(self, object_id: int, movable: bool) -> Act:
        """Say whether an object can move in the simulation."""
        word = "can move" if movable else "cannot move"
        return self._of(object_id, {"dynamic": movable}, f"{self._named(object_id)} {word}")

    def mass(self, object_id: int, mass_kg: float) -> Act:
        """Set the mass in kg."""
        mass = _short(mass_kg)
        return self._of(object_id, {"mass_kg": mass}, f"{self._named(object_id)} has {mass:g} kg")

    def friction(self, object_id: int, friction: float) -> Act:
        """Set the coefficient of friction."""
        value = _short(friction)
        return self._of(object_id, {"friction": value}, f"{self._named(object_id)} has friction {value:g}")

    def material(self, object_id: int, material: str) -> Act:
        """Set the material, which sets density, friction and restitution."""
        from reconstruction.assets.physics.materials import MATERIALS

        if material not in MATERIALS:
            raise UsageError(f"material: there are {', '.join(sorted(MATERIALS))}")
        return self._of(object_id, {"material": material}, f"{self._named(object_id)} is of {material}")

    def move(self, object_id: int, world_from_object: np.ndarray) -> Act:
        """Give an object a pose (4, 4) in world space, metres."""
        pose = np.asarray(world_from_object, np.float64)
        place = [round(float(x), 4) for x in pose[:3, 3]]
        turn = [round(float(x), 5) for x in quat_from_matrix(pose[:3, :3])]
        return self._of(
            object_id, {"move": {"to": place, "wxyz": turn}}, f"{self._named(object_id)} is moved by hand"
        )

    def size(self, object_id: int, size_m: Sequence[float]) -> Act:
        """Give an object the sides of its box along its own axes, metres."""
        sides = [_short(side) for side in size_m]
        if len(sides) != 3 or not all(0.001 <= side <= 20 for side in sides):
            raise UsageError("size: give three lengths in metres, 0.001 to 20")
        words = " x ".join(f"{100 * side:.4g}" for side in sides)
        return self._of(object_id, {"size_m": sides}, f"{self._named(object_id)} is {words} cm large")

    def drop_to_surface(self, object_id: int) -> Act:
        """Let an object down until it rests on what is below it."""
        return self._of(
            object_id, {"drop_to_surface": True}, f"{self._named(object_id)} rests on what is below"
        )

    def add(self, label: str, outlines: Sequence[Outline]) -> Act:
        """Add an object that was missed, by its outline in one frame or two."""
        new = one_line(label)
        if not new:
            raise UsageError("add: type a name for the new thing first, for example mug")
        if not 1 <= len(outlines) <= 2 or any(len(o.pixels) < 3 for o in outlines):
            raise UsageError("add: draw one outline or two in different frames, each of at least 3 points")
        shapes = [{"frame": o.frame, "points": self._anchors.filmed(o.pixels, o.frame)} for o in outlines]
        how = {"label": new, "outline": shapes[0] if len(shapes) == 1 else shapes}
        return Act({"add": how}, f"a {new} is added")

    def scale(self, a: Click, b: Click, metres: float) -> Act:
        """Set the scale of the scene by the length between two clicks."""
        if not 0.01 <= metres <= 100:
            raise UsageError(f"scale: give the length in metres, 0.01 to 100, got {metres:g}")
        ends = [self._clicked(click, "scale") for click in (a, b)]
        return Act(
            {"scale": {"from": ends[0], "to": ends[1], "metres": _short(metres)}},
            f"a length is {_short(metres):g} m",
        )

    def up(self, clicks: Sequence[Click]) -> Act:
        """Set the up direction by a level surface (one click), or by places at one height (three or more)."""
        if len(clicks) not in (1, *range(3, 20)):
            raise UsageError("up: click one level surface, or three places or more at the same height")
        places = [self._clicked(click, "up") for click in clicks]
        what = "a surface is level" if len(places) == 1 else f"{len(places)} places are at one height"
        return Act({"up": {"level": places[0] if len(places) == 1 else places}}, what)

    def floor(self, click: Click) -> Act:
        """Set the floor to pass through a click."""
        return Act({"floor": self._clicked(click, "floor")}, "the floor passes here")

    def _of(self, object_id: int, said: dict[str, Any], title: str) -> Act:
        return Act({**self._anchors.thing(object_id), **said}, title)

    def _named(self, number: int) -> str:
        return f"{one_line(self._name_of(number))} {number}"

    def _place(self, click: Click) -> dict[str, Any]:
        """Return the address of a click: the pixel of the photograph if one is shown, else a pixel that sees it."""
        if click.frame is not None and click.pixel is not None:
            return self._anchors.click(click.frame, click.pixel)
        if click.id is None or click.point_world is None:
            raise UsageError("nothing is there; click a thing")
        return self._anchors.place(click.point_world, click.id)

    def _clicked(self, click: Click, what: str) -> dict[str, Any]:
        """Return the pixel of a click; scale, up and floor cannot be said in metres."""
        place = self._place(click)
        if "pixel" not in place:
            raise UsageError(
                f"{what}: no frame of the film sees this place well; go to a frame (Frames) and click in its photograph"
            )
        return place


def _short(value: float) -> float:
    """Return a number with four significant digits."""
    return float(f"{float(value):.4g}")
