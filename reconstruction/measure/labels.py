"""Are coarse labels right as often as they say? True names beside them, and a table of confidence against truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

UNKNOWN = "unknown"
# What may truly be called by each coarse label. What is in no row has no coarse label that would be right.
MEANS: dict[str, frozenset[str]] = {
    label: frozenset(words.split(", "))
    for label, words in {
        "table": "table, coffee table, side table, desk",
        "shelf": "shelf, bookshelf, wall shelf, rack",
        "cabinet": "cabinet, wardrobe, dresser, chest of drawers",
        "seat": "chair, stool, bench, sofa, armchair",
        "box": "box, cardboard box, open box, storage box, pudding box, sugar box, crate, package, carton, "
        "milk carton, block, cube, tin, book",
        "book": "book",
        "can": "can, soup can, tin, jar, candle",
        "bottle": "bottle, sauce bottle, jar, vase, pitcher",
        "cup": "cup, mug",
        "bowl": "bowl, pot",
        "plate": "plate",
        "tray": "tray, basket, open box, crate, dish rack",
        "picture": "picture, painting, poster, picture frame",
        "plant": "plant, potted plant",
        "lamp": "lamp, desk lamp, floor lamp",
    }.items()
}
BINS = (0.0, 0.3, 0.45, 0.6, 0.75, 1.0)


@dataclass(frozen=True)
class Guess:
    """What a thing was called, how surely, and what it truly is ("" where it is no true thing at all)."""

    label: str
    confidence: float
    truth: str

    @property
    def right(self) -> bool:
        """Tell whether the label is a word for what the thing is."""
        return self.truth.lower().replace("_", " ") in MEANS.get(self.label, frozenset([self.label]))


@dataclass(frozen=True)
class Bin:
    """Guesses of about the same confidence."""

    low: float
    high: float
    count: int
    confidence: float  # mean of what was said
    right: float  # share that is


def reliability(guesses: Sequence[Guess]) -> list[Bin]:
    """Return the bins that hold any guess; `unknown` says nothing and is left out."""
    out = []
    for low, high in pairwise(BINS):
        inside = [
            g
            for g in guesses
            if g.label != UNKNOWN and low <= g.confidence and (g.confidence < high or high == 1.0)
        ]
        if inside:
            out.append(
                Bin(
                    low,
                    high,
                    len(inside),
                    sum(g.confidence for g in inside) / len(inside),
                    sum(g.right for g in inside) / len(inside),
                )
            )
    return out


def overconfidence(guesses: Sequence[Guess]) -> float:
    """Return by how much the mean confidence exceeds the share that is right; negative where labels are too modest."""
    said = [g for g in guesses if g.label != UNKNOWN]
    return sum(g.confidence - g.right for g in said) / len(said) if said else 0.0
