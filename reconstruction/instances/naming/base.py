"""Interface of naming backends, and how their names are applied."""

import re
from dataclasses import dataclass, replace
from typing import Protocol

from reconstruction.core.progress import Progress
from reconstruction.core.types import InstanceSet, PosedFrames

MAX_CONFIDENCE = 0.9  # upper bound for labels that come from images
LABEL_RULE = "up to 40 letters, digits, spaces and hyphens"
_WORD = re.compile(r"[a-z0-9][a-z0-9 \-]{0,39}")


@dataclass(frozen=True)
class Name:
    """A label with its confidence, checked at construction.

    Raises:
        ValueError: the label has other characters than `is_label` allows, or the confidence is not in 0 to 1.
    """

    label: str
    confidence: float

    def __post_init__(self) -> None:
        if not is_label(self.label):
            raise ValueError(f"{self.label!r} is no label: {LABEL_RULE}")
        if not 0.0 <= self.confidence <= 1.0:
            raise ValueError(f"a confidence of {self.confidence} is not between 0 and 1")


class Namer(Protocol):
    """A naming backend."""

    name: str

    def name_objects(
        self, found: InstanceSet, posed: PosedFrames, *, progress: Progress
    ) -> list[Name | None]:
        """Return one name for each of `found.objects`, in their order, None where unknown.

        The keyframes are `posed.images`; `found.id_maps` has the object at each of their pixels.
        """
        ...


def is_label(text: str) -> bool:
    """Return whether a text may be a label: up to 40 lower-case letters, digits, spaces and hyphens."""
    return _WORD.fullmatch(text) is not None


def apply_names(found: InstanceSet, names: list[Name | None], by: str, *, progress: Progress) -> InstanceSet:
    """Return the instances with new labels; those without a name keep their label."""
    objects = tuple(
        item
        if name is None
        else replace(item, label=name.label, label_confidence=min(name.confidence, MAX_CONFIDENCE))
        for item, name in zip(found.objects, names, strict=True)
    )
    kept = [str(item.id) for item, name in zip(found.objects, names) if name is None]
    progress.note(
        f"labels: {by} named {len(objects) - len(kept)} of {len(objects)} objects"
        + (f"; {', '.join(kept)} keep their embedded labels" if kept else "")
    )
    return replace(found, objects=objects)
