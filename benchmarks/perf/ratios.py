"""Ratios of kernels to the reference, and when a kernel counts as slower than it was."""

from dataclasses import dataclass

import numpy as np

TOLERANCE = 1.2  # a kernel that takes this many times as long as before fails


@dataclass(frozen=True)
class Ratio:
    """How long a kernel took in units of the reference."""

    median: float
    low: float  # first quartile over the rounds
    high: float  # third quartile
    least: float  # of the least times of both, which other programs disturb least
    kernel_ms: float  # median, on this machine
    reference_ms: float


def compare(before: list[dict[str, float]], now: list[dict[str, float]]) -> tuple[list[str], list[str]]:
    """Return a line for each kernel, and the names of those that take more than `TOLERANCE` times as long as before.

    Args:
        before: ratios by kernel, one entry for each time that they were measured. The median of each kernel counts:
            a process in which the reference was slow has a low ratio, one with a slow kernel a high one.
        now: the same of the present code.
    """
    first, after = _medians(before), _medians(now)
    out, slower = [], []
    for name, value in after.items():
        if name not in first:
            out.append(f"{name:<18}{'-':>9}{value:>9.2f}   new")
            continue
        if value > TOLERANCE * first[name]:
            slower.append(name)
        out.append(f"{name:<18}{first[name]:>9.2f}{value:>9.2f}{value / first[name] - 1:>+9.0%}")
    out += [f"{name:<18}{first[name]:>9.2f}{'-':>9}   gone" for name in first if name not in after]
    return out, slower


def _medians(found: list[dict[str, float]]) -> dict[str, float]:
    return {name: float(np.median([ratios[name] for ratios in found if name in ratios])) for name in found[0]}


def ratio(kernel_s: np.ndarray, reference_s: np.ndarray) -> Ratio:
    """Compare the times of each round, kernel and reference (n,)."""
    low, median, high = np.percentile(kernel_s / reference_s, [25, 50, 75])
    in_ms = (1e3 * float(np.median(times)) for times in (kernel_s, reference_s))
    least = float(kernel_s.min() / reference_s.min())
    return Ratio(float(median), float(low), float(high), least, *in_ms)
