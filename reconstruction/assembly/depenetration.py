"""Move an object out of penetration by the smallest translation."""

import numpy as np
from scipy.optimize import nnls

from reconstruction.assembly.workbench import Workbench

_MOST_SINK_M = 0.002  # largest move downwards
_LIFT_COST = 0.5  # of a move up, relative to one sideways, if settling undoes it
_RINGS_M = (0.0, 0.002, 0.004, 0.006, 0.008, 0.011, 0.015, 0.02, 0.03)
_LIFTS_M = (0.0, 0.002, 0.005, 0.01, 0.015, 0.02, 0.03, 0.045, 0.06)


def make_clear(
    bench: Workbench,
    body_id: int,
    pose: np.ndarray,
    *,
    max_lift_m: float,
    max_shift_m: float,
    tolerance_m: float,
    settles: bool = True,
) -> tuple[np.ndarray, bool]:
    """Translate an object as little as possible until nothing penetrates it: (pose, whether it is clear).

    Contacts are accumulated as half-space constraints on the translation, and the shortest feasible one is taken until
    no contact is left. If there is none within the bounds, or it does not converge, a lattice of lifts and sideways
    shifts is searched, cheapest first.

    Args:
        bench: the object and its surroundings.
        body_id: id of the object.
        pose: initial pose (4, 4).
        max_lift_m: bound of the move upwards.
        max_shift_m: bound of the move sideways.
        tolerance_m: penetration depth that counts as contact.
        settles: the object is simulated afterwards, so that lifts are undone and cost less.
    """
    lift_cost = _LIFT_COST if settles else 1.0
    normals: list[np.ndarray] = []
    least: list[float] = []
    shift = np.zeros(3)
    for _ in range(12):
        contacts = bench.probe(body_id, shifted(pose, shift), tolerance_m)
        if not contacts:
            return shifted(pose, shift), True
        for c in contacts:
            normals.append(c.normal)
            least.append(float(c.normal @ shift) - c.separation_m + 0.5 * tolerance_m)
        found = least_move(np.array(normals), np.array(least), lift_cost)
        if found is None or np.hypot(found[0], found[1]) > max_shift_m:
            break
        if not -_MOST_SINK_M <= found[2] <= max_lift_m or np.linalg.norm(found - shift) < 0.25 * tolerance_m:
            break
        shift = found
    return _searched(bench, body_id, pose, max_lift_m, max_shift_m, tolerance_m, lift_cost)


def least_move(normals: np.ndarray, least: np.ndarray, lift_cost: float = 1.0) -> np.ndarray | None:
    """Return the shortest translation d (3,) with normals @ d >= least; None if there is none.

    Least distance programming by non-negative least squares (Lawson and Hanson, chapter 23).

    Args:
        normals: (n, 3) unit.
        least: (n,) metres.
        lift_cost: weight of z, relative to x and y.
    """
    weight = np.array([1.0, 1.0, lift_cost])
    system = np.vstack([(normals / weight).T, 1e3 * least])
    target = np.array([0.0, 0.0, 0.0, 1.0])
    residual = system @ nnls(system, target)[0] - target
    if np.linalg.norm(residual) < 1e-7 or residual[3] > -1e-9:
        return None
    return -residual[:3] / residual[3] / weight * 1e-3


def shifted(pose: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return a pose (4, 4) translated by `shift` (3,)."""
    out = pose.copy()
    out[:3, 3] += shift
    return out


def _searched(
    bench: Workbench,
    body_id: int,
    pose: np.ndarray,
    max_lift_m: float,
    max_shift_m: float,
    tolerance_m: float,
    lift_cost: float,
) -> tuple[np.ndarray, bool]:
    """Return the first clear pose of the lattice, or the one with the least penetration."""
    best, best_depth = pose, np.inf
    for shift in _lattice(max_lift_m, max_shift_m, lift_cost):
        candidate = shifted(pose, shift)
        contacts = bench.probe(body_id, candidate, tolerance_m)
        if not contacts:
            return candidate, True
        depth = max(-c.separation_m for c in contacts)
        if depth < best_depth:
            best, best_depth = candidate, depth
    return best, False


def _lattice(max_lift_m: float, max_shift_m: float, lift_cost: float) -> list[np.ndarray]:
    """Return shifts (3,) within the bounds, cheapest first."""
    lifts = np.unique(np.clip(_LIFTS_M, 0, max_lift_m))
    shifts = []
    for ring in (r for r in _RINGS_M if r <= max_shift_m + 1e-9):
        for angle in np.arange(8 if ring else 1) * np.pi / 4:
            x, y = ring * np.cos(angle), ring * np.sin(angle)
            shifts += [(ring + lift_cost * lift, x, y, lift) for lift in lifts]
    shifts.sort(key=lambda s: s[0])
    return [np.array(s[1:]) for s in shifts]
