"""Calibration of coarse labels: a reliability table of confidence against accuracy."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

UNKNOWN = "unknown"
# Coarse label -> true names that it is correct for. A true name in no row has no correct coarse label.
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
BINS = (0.0, 0.3, 0.45, 0.6, 0.75, 1.0)  # edges of confidence


@dataclass(frozen=True)
class Guess:
    """A predicted label, its confidence, and the true name ("" for an object that matches no true one)."""

    label: str
    confidence: float
    truth: str

    @property
    def right(self) -> bool:
        """Whether the label is correct for the true name."""
        return self.truth.lower().replace("_", " ") in MEANS.get(self.label, frozenset([self.label]))


@dataclass(frozen=True)
class Bin:
    """The guesses in one interval of confidence."""

    low: float
    high: float
    count: int
    confidence: float  # mean
    right: float  # share of correct labels


def reliability(guesses: Sequence[Guess]) -> list[Bin]:
    """Bin the guesses by confidence, without `unknown` labels; return the non-empty bins."""
    out = []
    for low, high in pairwise(BINS):
        inside = [
            g
            for g in guesses
            if g.label != UNKNOWN and low <= g.confidence and (g.confidence < high or high == 1.0)
        ]
        if inside:
            count = len(inside)
            confidence, right = (
                sum(g.confidence for g in inside) / count,
                sum(g.right for g in inside) / count,
            )
            out.append(Bin(low, high, count, confidence, right))
    return out


def overconfidence(guesses: Sequence[Guess]) -> float:
    """Return mean confidence minus accuracy, without `unknown` labels; negative: underconfident."""
    said = [g for g in guesses if g.label != UNKNOWN]
    return sum(g.confidence - g.right for g in said) / len(said) if said else 0.0
