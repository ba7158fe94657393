"""Limits of the figures, fitted on generated films by `python -m benchmarks.check fit`."""

MIN_VIEWS = 8  # fewer are refused by the frames stage (`FramesConfig.min_usable_frames`)
HIGH = ("blur_px", "clipped")  # figures of which more is worse; of all others less is worse
FAIL_LIMITS: dict[str, float] = {
    "matches": 51.5,
    "spread": 0.309,
    "parallax_deg": 0.703,
    "connected": 0.737,
    "clipped": 0.52,
}
"""A film beyond one of these is unlikely to be reconstructed."""
WARN_LIMITS: dict[str, float] = {"bright": 51.0, "blur_px": 4.2}
"""A film beyond one of these gets a warning only: limits fitted to these figures fail good films of the split "choose".
They are middles between good and bad films of the split "fit" in which darkness or blur is the cause."""


def fails(figures: dict[str, float], limits: dict[str, float]) -> list[str]:
    """Return the names of the figures beyond their limit; too few views are beyond any."""
    out = ["views"] if figures["views"] < MIN_VIEWS else []
    for name, limit in limits.items():
        value = figures[name]
        if value > limit if name in HIGH else value < limit:
            out.append(name)
    return out
