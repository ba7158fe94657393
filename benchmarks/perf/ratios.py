"""Ratios, the stored ones, and when a kernel counts as slower."""

import json
from dataclasses import dataclass
from pathlib import Path

BASELINE = Path(__file__).with_name("baseline.json")
_TOLERANCE = 1.5  # a kernel that takes this many times as long as stored fails


@dataclass(frozen=True)
class Ratio:
    """How long a kernel took in units of the reference."""

    median: float
    low: float  # first quartile over the rounds
    high: float  # third quartile
    kernel_ms: float  # median, on this machine
    reference_ms: float


def load_stored(path: Path) -> dict:
    """Read the stored ratios by kernel and the tolerance; none are stored where there is no such file."""
    return json.loads(path.read_text()) if path.is_file() else {"tolerance": _TOLERANCE, "ratios": {}}


def complain(name: str, ratio: float, stored: dict) -> str:
    """Return what is wrong with a ratio beside the stored ones, or nothing.

    Args:
        name: of the kernel.
        ratio: as measured now.
        stored: `tolerance` (a factor) and `ratios` by kernel.
    """
    if name not in stored["ratios"]:
        return f"{name}: no stored ratio; store one with python -m benchmarks.perf --save"
    before = stored["ratios"][name]
    if ratio <= stored["tolerance"] * before:
        return ""
    return (
        f"{name}: {ratio:.2f} times the reference, {ratio / before:.2f} times the stored {before:.2f} "
        f"(allowed: {stored['tolerance']:g} times). Slower on purpose? Then store it: python -m benchmarks.perf --save"
    )
