"""Acts that a scene does not have yet, and the changes that they make."""

from dataclasses import dataclass, field

import numpy as np

from registry import SceneBundle


@dataclass
class Preview:
    """Changes of the objects of the revision shown, by their ids."""

    pending: int = 0  # entries that the scene does not have yet
    taken_back: bool = False  # the file has fewer or other entries than the scene was made with
    labels: dict[int, str] = field(default_factory=dict)
    hidden: set[int] = field(default_factory=set)
    merged: list[set[int]] = field(default_factory=list)
    split: set[int] = field(default_factory=set)
    poses: dict[int, np.ndarray] = field(default_factory=dict)
    sizes: dict[int, np.ndarray] = field(
        default_factory=dict
    )  # sides (3,) of the box along the object's axes, metres
    parts: list[np.ndarray] = field(default_factory=list)  # points (n, 3) of each part of the split objects
    error: str = ""  # of the first entry that cannot be applied


def pending_entries(entries: list[dict], bundle: SceneBundle) -> tuple[list[dict], bool]:
    """Return the entries that a scene was not made with, and whether it was made with others that are gone."""
    applied = bundle.scene["report"].get("overrides", [])
    same = len(entries) >= len(applied) and repr(entries[: len(applied)]) == repr(applied)
    return (entries[len(applied) :], False) if same else (entries, True)
