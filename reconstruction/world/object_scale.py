"""Solve `--scale object:ID.height=H`: find the scale at which the reconstructed object is H high."""

from collections.abc import Callable


def settle_object_height(
    provisional_m: float,
    wanted_m: float,
    height_at: Callable[[float], float],
    *,
    tolerance: float,
    passes: int,
) -> tuple[float, float]:
    """Return the divisor of the scale that brings the object closest to `wanted_m`, and its relative error there.

    Fixed-point iteration. Thresholds of later stages are in metres, so the object's height is not proportional to the
    scale: a single correction leaves up to a tenth.

    Args:
        provisional_m: height of the object at the provisional scale.
        wanted_m: height given by the user.
        height_at: called with measured_m, reconstructs at the provisional scale times wanted_m / measured_m and returns
            the object's height.
        tolerance: relative error at which to stop.
        passes: largest number of calls of `height_at`.
    """
    measured_m, best = provisional_m, (provisional_m, float("inf"))
    for _ in range(passes):
        height_m = height_at(measured_m)
        error = abs(height_m / wanted_m - 1)
        if error < best[1]:
            best = (measured_m, error)
        if error <= tolerance:
            break
        measured_m *= height_m / wanted_m
    return best
