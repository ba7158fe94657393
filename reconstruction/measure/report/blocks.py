"""The building blocks of a report page; the template has one macro per kind of block."""

from dataclasses import dataclass, field
from typing import ClassVar


@dataclass(frozen=True)
class Picture:
    """One inline image."""

    src: str  # data URI
    width: int
    height: int
    alt: str
    caption: str = ""
    overlay: str = ""  # SVG drawn over the whole image


@dataclass(frozen=True)
class Pictures:
    """Images in a grid with `columns` on a wide screen, `phone_columns` on a phone."""

    kind: ClassVar[str] = "pictures"
    items: list[Picture]
    columns: int
    heads: list[str] = field(default_factory=list)  # titles of the columns
    phone_columns: int = 2
    caption: str = ""


@dataclass(frozen=True)
class Legend:
    """The color scale of an image."""

    kind: ClassVar[str] = "legend"
    gradient: str  # CSS value
    low: str
    high: str
    text: str


@dataclass(frozen=True)
class Cell:
    """A cell of a table; `status` is "", "good", "bad" or "warn"."""

    text: str
    status: str = ""
    swatch: str = ""  # CSS color
    figures: tuple[tuple[str, str], ...] = ()  # (name, value) pairs, in one paragraph


@dataclass(frozen=True)
class Table:
    """A table; the columns with the indices `numeric` are right-aligned."""

    kind: ClassVar[str] = "table"
    columns: list[str]
    rows: list[list[Cell]]
    numeric: list[int] = field(default_factory=list)
    caption: str = ""


@dataclass(frozen=True)
class Tile:
    """One highlighted figure."""

    value: str
    label: str
    status: str = ""
    detail: str = ""


@dataclass(frozen=True)
class Tiles:
    """Highlighted figures side by side."""

    kind: ClassVar[str] = "tiles"
    items: list[Tile]
    columns: int = 6


@dataclass(frozen=True)
class Plots:
    """SVG plots in a grid; `wide` ones scroll on narrow screens."""

    kind: ClassVar[str] = "plots"
    svgs: list[str]
    columns: int = 1
    wide: bool = False
    caption: str = ""


@dataclass(frozen=True)
class Text:
    """A paragraph; `left_out` marks one about missing content."""

    kind: ClassVar[str] = "text"
    text: str
    left_out: bool = False


@dataclass(frozen=True)
class Listing:
    """A bulleted list."""

    kind: ClassVar[str] = "listing"
    lines: list[str]


@dataclass(frozen=True)
class Details:
    """Preformatted text in a collapsed element."""

    kind: ClassVar[str] = "details"
    summary: str
    text: str


@dataclass(frozen=True)
class Card:
    """One object: turntable, facts and crops of its views."""

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
    """A grid of objects."""

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
    """A section of the page, with an entry in the table of contents."""

    id: str
    title: str
    blocks: list[Block]
    lead: str = ""
    short: str = ""  # entry in the table of contents, if the title is too long


def left_out(what: str, why: str) -> Text:
    """Return a paragraph on missing content and the reason."""
    return Text(f"{what} left out: {why}.", left_out=True)


def facts(rows: list[tuple[str, str]]) -> Table:
    """Return a table of (name, value) rows."""
    return Table([], [[Cell(name), Cell(value)] for name, value in rows])


def graded(value: float, good: float, fair: float) -> str:
    """Grade a figure for which larger is better by two thresholds: "good", "warn" or "bad"."""
    return "good" if value >= good else "warn" if value >= fair else "bad"
