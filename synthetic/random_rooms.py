"""Rooms drawn at random: a seed and families in, a room's specification out."""

from collections.abc import Sequence

import numpy as np

from registry.errors import UsageError
from synthetic.arrangements import LAYOUTS, NEEDED_FAMILY
from synthetic.furniture_families import FURNITURE_FAMILIES
from synthetic.procedural import RoomSpec


def draw_room(
    seed: int, *, shapes: Sequence[str], furniture: Sequence[str] = tuple(FURNITURE_FAMILIES),
    layouts: Sequence[str] = LAYOUTS, objects: tuple[int, int] = (5, 24), household: float = 0.5,
    step_m: float = 0.03, density: float = 1.0, walls: int = 3,
) -> RoomSpec:  # fmt: skip
    """Draw a room: layout, number of things, families, clutter, stacks, containers, plainness.

    Args:
        seed: Of the drawing, and of the room.
        shapes: Families of small things to draw from (2 to 5 of them).
        furniture: Families of furniture to draw from; what a layout needs is always taken where it is listed.
        layouts: To draw from; those whose family of furniture is not listed are left out.
        objects: Smallest and largest number of things.
        household: Share of the rooms that mix the household's own kinds in.
        step_m: See `RoomSpec`.
        density: See `RoomSpec`.
        walls: See `RoomSpec`.

    Returns:
        The room's specification.
    """
    rng = np.random.default_rng([seed, 4711])
    possible = [name for name in layouts if NEEDED_FAMILY.get(name, "") in ("", *furniture)]
    if not possible:
        raise UsageError(
            f"draw_room: none of the layouts {list(layouts)} can do with furniture={list(furniture)}"
        )
    layout = str(possible[int(rng.integers(len(possible)))])
    taken = [f for f in furniture if rng.random() < 0.7 or f == NEEDED_FAMILY.get(layout)]
    count = min(int(rng.integers(2, 6)), len(shapes))
    families = [str(shapes[k]) for k in sorted(rng.permutation(len(shapes))[:count])]
    lowest = {"dining": 7, "corner": 8, "bedroom": 6, "living": 6}.get(layout, 3)
    number = int(rng.integers(max(objects[0], lowest), max(objects[1], lowest) + 1))
    plain = float(rng.uniform(0, 0.6)) if rng.random() < 0.7 else 0.0
    return RoomSpec(
        seed=seed,
        objects=number,
        max_stack=int(rng.integers(1, 4)),
        stacks=float(rng.uniform(0, 0.35)) * float(rng.random() < 0.7),
        containers=float(rng.uniform(0, 0.15)),
        side_furniture=float(rng.uniform(0.05, 0.22)),
        wall_things=float(rng.uniform(0.05, 0.22)),
        textureless_share=plain,
        blank_walls=bool(rng.random() < 0.35),
        clutter_gap_m=float(np.exp(rng.uniform(np.log(0.01), np.log(0.05)))),
        crowding=float(rng.uniform(0, 0.9)) if layout != "tabletop" else float(rng.uniform(0.4, 0.95)),
        walls=walls,
        step_m=step_m,
        density=density,
        families=tuple(families),
        furniture=tuple(taken),
        household=bool(rng.random() < household),
        layout=layout,
        uneven=float(rng.uniform(0.2, 0.8)) if rng.random() < 0.45 else 0.0,
    )
