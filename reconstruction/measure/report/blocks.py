"""What a report page is made of. The template has one macro for each kind of block."""

from dataclasses import dataclass, field
from typing import ClassVar


@dataclass(frozen=True)
class Picture:
    """One picture, inline."""

    src: str  # data URI
    width: int
    height: int
    alt: str
    caption: str = ""
    overlay: str = ""  # SVG that is drawn over it, edge to edge


@dataclass(frozen=True)
class Pictures:
    """Pictures side by side; `columns` on a wide screen, fewer on a phone."""

    kind: ClassVar[str] = "pictures"
    items: list[Picture]
    columns: int
    heads: list[str] = field(default_factory=list)  # over the columns
    phone_columns: int = 2
    caption: str = ""


@dataclass(frozen=True)
class Legend:
    """What the colors of a picture mean."""

    kind: ClassVar[str] = "legend"
    gradient: str  # CSS
    low: str
    high: str
    text: str


@dataclass(frozen=True)
class Cell:
    """A cell of a table; `status` is "", "good", "bad" or "warn"."""

    text: str
    status: str = ""
    swatch: str = ""  # CSS color
    figures: tuple[tuple[str, str], ...] = ()  # names and values, set in one paragraph


@dataclass(frozen=True)
class Table:
    """A table; the columns named in `numeric` are set flush right."""

    kind: ClassVar[str] = "table"
    columns: list[str]
    rows: list[list[Cell]]
    numeric: list[int] = field(default_factory=list)
    caption: str = ""


@dataclass(frozen=True)
class Tile:
    """One figure that is seen at a glance."""

    value: str
    label: str
    status: str = ""
    detail: str = ""


@dataclass(frozen=True)
class Tiles:
    """Figures side by side."""

    kind: ClassVar[str] = "tiles"
    items: list[Tile]
    columns: int = 6


@dataclass(frozen=True)
class Plots:
    """SVG plots side by side; they scroll on narrow screens where `wide`."""

    kind: ClassVar[str] = "plots"
    svgs: list[str]
    columns: int = 1
    wide: bool = False
    caption: str = ""


@dataclass(frozen=True)
class Text:
    """A line of text; `left_out` ones say what is not shown and why."""

    kind: ClassVar[str] = "text"
    text: str
    left_out: bool = False


@dataclass(frozen=True)
class Listing:
    """A list of lines."""

    kind: ClassVar[str] = "listing"
    lines: list[str]


@dataclass(frozen=True)
class Details:
    """Preformatted text that is folded away."""

    kind: ClassVar[str] = "details"
    summary: str
    text: str


@dataclass(frozen=True)
class Card:
    """One object: its turntable, facts and views."""

    id: int
    title: str
    color: str
    turntable: Picture
    angles: int
    facts: list[tuple[str, str]]
    views: list[Picture]
    notes: list[str]


@dataclass(frozen=True)
class Cards:
    """All objects."""

    kind: ClassVar[str] = "cards"
    items: list[Card]


@dataclass(frozen=True)
class Split:
    """Two blocks side by side on a wide screen."""

    kind: ClassVar[str] = "split"
    left: "Block"
    right: "Block"


Block = Pictures | Legend | Table | Tiles | Plots | Text | Listing | Details | Cards | Split


@dataclass(frozen=True)
class Section:
    """A part of the page with an entry in its table of contents."""

    id: str
    title: str
    blocks: list[Block]
    lead: str = ""
    short: str = ""  # its name in the table of contents, where the title is too long


def left_out(what: str, why: str) -> Text:
    """One line for what cannot be shown."""
    return Text(f"{what} left out: {why}.", left_out=True)


def facts(rows: list[tuple[str, str]]) -> Table:
    """A table of names and values."""
    return Table([], [[Cell(name), Cell(value)] for name, value in rows])


def graded(value: float, good: float, fair: float) -> str:
    """Return the status of a figure that is better the larger it is."""
    return "good" if value >= good else "warn" if value >= fair else "bad"
