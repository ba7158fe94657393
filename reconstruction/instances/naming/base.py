"""The seam for labels, and how they get into the instances."""

import re
from dataclasses import dataclass, replace
from typing import Protocol

from reconstruction.core.progress import Progress
from reconstruction.core.types import InstanceSet, PosedFrames

MAX_CONFIDENCE = 0.9  # a picture never proves what a thing is
_WORD = re.compile(r"[a-z0-9][a-z0-9 \-]{0,39}")


@dataclass(frozen=True)
class Name:
    """What a thing is called."""

    label: str  # lower case letters, digits, spaces and hyphens
    confidence: float  # 0 to 1

    def __post_init__(self) -> None:
        """Refuse labels that files and reports could stumble over."""
        if not is_label(self.label):
            raise ValueError(f"{self.label!r} is no label: up to 40 letters, digits, spaces and hyphens")
        if not 0.0 <= self.confidence <= 1.0:
            raise ValueError(f"a confidence of {self.confidence} is not between 0 and 1")


class Namer(Protocol):
    """Names things from pictures of them."""

    name: str

    def name_objects(
        self, found: InstanceSet, posed: PosedFrames, *, progress: Progress
    ) -> list[Name | None]:
        """Return one name for each of `found.objects`, in their order; None where it does not know.

        The keyframes are `posed.images`; `found.id_maps` says which pixels show which object.
        """


def is_label(text: str) -> bool:
    """Tell whether a text may be a label."""
    return _WORD.fullmatch(text) is not None


def apply_names(found: InstanceSet, names: list[Name | None], by: str, *, progress: Progress) -> InstanceSet:
    """Return the instances under new names; those without one keep the label that they have."""
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
