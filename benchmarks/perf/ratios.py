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
    least: (
        float  # least time of the kernel over least time of the reference: what other programs disturb least
    )
    kernel_ms: float  # median, on this machine
    reference_ms: float


def compare(before: list[dict[str, float]], now: list[dict[str, float]]) -> list[str]:
    """Return a line for each kernel, and `FAILS` in that of each kernel that became slower by more than `TOLERANCE`.

    Args:
        before: ratio of each kernel, one entry for each time it was measured; the least counts.
        now: the same of the present code.
    """
    out = []
    for name in now[0]:
        after = min(ratios[name] for ratios in now)
        if name not in before[0]:
            out.append(f"{name:<18}{'-':>9}{after:>9.2f}   new")
            continue
        first = min(ratios[name] for ratios in before)
        word = "   FAILS" if after > TOLERANCE * first else ""
        out.append(f"{name:<18}{first:>9.2f}{after:>9.2f}{after / first - 1:>+9.0%}{word}")
    gone = [name for name in before[0] if name not in now[0]]
    return out + [f"{name:<18}{min(r[name] for r in before):>9.2f}{'-':>9}   gone" for name in gone]


def ratio(kernel_s: np.ndarray, reference_s: np.ndarray) -> Ratio:
    """Compare the times of each round, kernel and reference (n,)."""
    low, median, high = np.percentile(kernel_s / reference_s, [25, 50, 75])
    in_ms = (1e3 * float(np.median(times)) for times in (kernel_s, reference_s))
    least = float(kernel_s.min() / reference_s.min())
    return Ratio(float(median), float(low), float(high), least, *in_ms)
