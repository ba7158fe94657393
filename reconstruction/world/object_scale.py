"""`--scale object:ID.height=H`: find the scale at which the object, reconstructed at that scale, is H high."""

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

    Thresholds are in metres, so a scene of another size is cut and completed a little differently: the object does
    not grow with the scale alone, and one correction leaves up to a tenth.

    Args:
        provisional_m: the object's height at the provisional scale.
        wanted_m: what the user says that it is.
        height_at: reconstructs with the provisional scale times wanted_m / measured_m, and returns the object's height;
            called with measured_m.
        tolerance: relative error that is good enough.
        passes: how often `height_at` is called at most.
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
