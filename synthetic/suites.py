"""Named captures: a small one for continuous integration, a suite of harder ones, and presets to draw from."""

from dataclasses import replace

import numpy as np

from registry.errors import UsageError
from synthetic.benchmark_capture import CaptureSpec
from synthetic.procedural import RoomSpec

_SMALL = CaptureSpec(frames=50, width=480, height=360, noise=1.4)

CI_CAPTURES: dict[str, CaptureSpec] = {
    "ci_stack": replace(
        _SMALL, room=RoomSpec(seed=4, objects=8, stacks=0.4, containers=0.12, clutter_gap_m=0.08)
    ),
}
"""Small enough that `simrecon reconstruct --preset fast` takes about a minute on two cores."""

PRESETS: dict[str, CaptureSpec] = {
    "easy": CaptureSpec(RoomSpec(stacks=0.0, containers=0.0, clutter_gap_m=0.1)),
    "default": CaptureSpec(),
    "cluttered": CaptureSpec(
        RoomSpec(clutter_gap_m=0.012, crowding=0.9, containers=0.12, stacks=0.2, side_furniture=0.05)
    ),
    "stacked": CaptureSpec(RoomSpec(stacks=0.65, containers=0.0, wall_things=0.08)),
    "containers": CaptureSpec(RoomSpec(containers=0.25, stacks=0.1)),
    "textureless": CaptureSpec(RoomSpec(textureless_share=0.7)),
    "shaky": CaptureSpec(exposure_drift=0.15, motion_blur_s=0.025, noise=3.0, shake=1.6),
}
"""Starting points for `python -m benchmarks.generate --preset`; each makes one thing hard."""


def _named(preset: str, objects: int, seed: int, frames: int = 140, path: str = "arc", **room) -> CaptureSpec:
    base = PRESETS[preset]
    return replace(
        base, room=replace(base.room, objects=objects, seed=seed, **room), frames=frames, path=path, seed=seed
    )


SUITE: dict[str, CaptureSpec] = {
    "easy05": _named("easy", 5, 11),
    "shaky08": _named("shaky", 8, 12),
    "stacked12": _named("stacked", 12, 13),
    "textureless12": _named("textureless", 12, 15),
    "cluttered16": _named("cluttered", 16, 16, path="two_heights"),
    "containers20": _named("containers", 20, 14, 160),
    "room30": _named("default", 30, 17, 180, "two_heights"),
    "room40": _named("default", 40, 18, 220, "loop", walls=4),
}
"""Harder captures at 640x480."""


def drawn_captures(
    preset: str, rooms: int, objects: tuple[int, int], seed: int, **film: object
) -> dict[str, CaptureSpec]:
    """Draw captures from a preset.

    Args:
        preset: Of `PRESETS`.
        rooms: How many.
        objects: Fewest and most things in a room; sizes are spread evenly between, in random order.
        seed: Of the draw; room seeds follow from it.
        **film: Other fields of `CaptureSpec` (frames, width, ...) or, as `room`, a dict of fields of `RoomSpec`.

    Returns:
        Specs by name, "<preset>_<objects>_<seed>".
    """
    if preset not in PRESETS:
        raise UsageError(f"unknown preset {preset!r}; there are {sorted(PRESETS)}")
    if not 3 <= objects[0] <= objects[1]:
        raise UsageError(f"objects {objects[0]}-{objects[1]}: expected a range like 5-40, from 3 up")
    room_fields = film.pop("room", {})
    rng = np.random.default_rng(seed)
    sizes = rng.permutation(np.round(np.linspace(*objects, rooms)).astype(int)).tolist()
    out = {}
    for number, size in enumerate(sizes):
        room_seed = 1000 * seed + number
        spec = PRESETS[preset]
        room = replace(spec.room, objects=size, seed=room_seed, **room_fields)
        out[f"{preset}_{size:02d}_{room_seed}"] = replace(spec, room=room, seed=room_seed, **film)
    return out
