"""Forward and inverse kinematics of an arm, in Numba, on the CPU.

Only environments with a hand-pose controller import this module, and Numba with it. Kernels are compiled at the first
call and cached on disk. They use explicit loops, because the compilation of array expressions would delay the first
`gym.make` by seconds.

Joints are screws in base space (product of exponentials; Lynch and Park, Modern Robotics, chapters 4 to 6). An
iteration is the damped least-squares step of ManiSkill's solver (pinocchio's closed loop with log6), with another step
size: a share of the screw motion from the current hand pose to the goal.
"""

import math

import numba
import numpy as np

_DAMPING = 1e-6  # as in ManiSkill's solver
_SMALL_RAD = 1e-4  # below this sine, limits replace quotients


def _compiled(function):
    # Inlined by Numba, so that LLVM optimizes one function.
    options = {"error_model": "numpy", "nogil": True, "inline": "always"}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # "no locator available": no writable cache folder
        return numba.njit(**options)(function)


def motions(screws: np.ndarray) -> np.ndarray:
    """Return the matrices S, C, L (n, 3, 3, 4) of screws (n, 6): exp(q) = I + sin q S + (1 - cos q) C + q L."""
    along, about = screws[:, :3, None], screws[:, 3:]
    cross = np.zeros((len(screws), 3, 3))
    for row, column, axis in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        cross[:, row, column], cross[:, column, row] = -about[:, axis], about[:, axis]
    twice = cross @ cross
    parts = (cross, -twice @ along), (twice, cross @ along), (0 * cross, along + twice @ along)
    return np.stack([np.concatenate(part, axis=2) for part in parts], axis=1)


@_compiled
def place(moving, angles, base_from):
    """Compute the forward kinematics: accumulated rigid transforms before the first joint, ..., after the last one.

    Args:
        moving: `motions` of the joints, in the order of the chain.
        angles: Joint positions (n,), rad or m.
        base_from: Output (n + 1, 3, 4).
    """
    for row in range(3):
        for column in range(4):
            base_from[0, row, column] = 1.0 if row == column else 0.0
    for joint in range(len(angles)):
        q = angles[joint]
        s, c = math.sin(q), 1.0 - math.cos(q)
        for row in range(3):
            for column in range(4):
                total = base_from[joint, row, column]
                for k in range(3):
                    total += base_from[joint, row, k] * (
                        s * moving[joint, 0, k, column]
                        + c * moving[joint, 1, k, column]
                        + q * moving[joint, 2, k, column]
                    )
                base_from[joint + 1, row, column] = total


@_compiled
def product(one, other, out):
    """Write the product of two rigid transforms (3, 4) to `out`, which must not alias them."""
    for row in range(3):
        for column in range(4):
            total = one[row, 3] if column == 3 else 0.0
            for k in range(3):
                total += one[row, k] * other[k, column]
            out[row, column] = total


@_compiled
def away(here, goal, twist):
    """Write the twist (6,) from a pose to a goal (3, 4) (log6), in base axes at the pose; return its norm."""
    trace = 0.0
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn = 0.0  # antisymmetric part of goal @ inverse(here)
        for k in range(3):
            turn += goal[j, k] * here[i, k] - goal[i, k] * here[j, k]
            trace += goal[axis, k] * here[axis, k]
        twist[3 + axis] = 0.5 * turn
    s, c = math.sqrt(twist[3] * twist[3] + twist[4] * twist[4] + twist[5] * twist[5]), 0.5 * (trace - 1.0)
    angle = math.atan2(s, c)
    scale, bend = 1.0, 1.0 / 12.0
    if c < 0.0 and s <= _SMALL_RAD:
        return np.inf  # half a turn: the axis is undefined
    if s > _SMALL_RAD:
        scale = angle / s
        half = (1.0 + c) / s if c > 0.0 else s / (1.0 - c)  # cotangent of the half angle
        bend = (1.0 - 0.5 * angle * half) / (angle * angle)
    size, dot, squared = 0.0, 0.0, 0.0
    for axis in range(3):
        twist[3 + axis] *= scale
        dot += twist[3 + axis] * (goal[axis, 3] - here[axis, 3])
        squared += twist[3 + axis] * twist[3 + axis]
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        p = goal[axis, 3] - here[axis, 3]
        across = twist[3 + i] * (goal[j, 3] - here[j, 3]) - twist[3 + j] * (goal[i, 3] - here[i, 3])
        twist[axis] = p - 0.5 * across + bend * (dot * twist[3 + axis] - squared * p)
        size += twist[axis] * twist[axis]
    return math.sqrt(size + squared)


@_compiled
def jacobian(screws, free, base_from, tip, out):
    """Write the Jacobian (6, n) of the hand, in base axes at the hand; columns of fixed joints are 0."""
    for joint in range(len(screws)):
        for row in range(6):
            total = 0.0
            if free[joint]:
                for k in range(3):
                    total += base_from[joint, row % 3, k] * screws[joint, k + 3 * (row // 3)]
            out[row, joint] = total
        for row in range(3):
            i, j = (row + 1) % 3, (row + 2) % 3
            out[row, joint] += out[3 + i, joint] * (tip[j, 3] - base_from[joint, j, 3]) - out[
                3 + j, joint
            ] * (tip[i, 3] - base_from[joint, i, 3])


@_compiled
def move(matrix, twist, share, angles, factor):
    """Apply a damped least-squares step towards a twist (6,) to the joints (n,).

    Args:
        matrix: Jacobian (6, n).
        twist: Twist of the hand; overwritten.
        share: Step size, as a share of the twist.
        angles: Joint positions, changed in place.
        factor: Work space (6, 6) for the Cholesky factor of J J^T + damping.
    """
    for row in range(6):
        for column in range(row + 1):
            total = _DAMPING if row == column else 0.0
            for k in range(len(angles)):
                total += matrix[row, k] * matrix[column, k]
            for k in range(column):
                total -= factor[row, k] * factor[column, k]
            factor[row, column] = math.sqrt(total) if row == column else total / factor[column, column]
    for row in range(6):
        for k in range(row):
            twist[row] -= factor[row, k] * twist[k]
        twist[row] /= factor[row, row]
    for row in range(5, -1, -1):
        for k in range(row + 1, 6):
            twist[row] -= factor[k, row] * twist[k]
        twist[row] /= factor[row, row]
    for joint in range(len(angles)):
        for row in range(6):
            angles[joint] += share * matrix[row, joint] * twist[row]


@_compiled
def aim(scale, action, tip, goal):
    """Write the goal pose (3, 4) of a delta action for a hand at `tip` (3, 4).

    Args:
        scale: (3, 3): centre (m) and half range (m) of shifts, and three times the maximum rotation (rad).
        action: Shift (3,), optionally followed by rotations (3,) about base x, y, z; z is applied first.
        tip: Current pose of the hand.
        goal: Output.
    """
    size = 1.0
    if len(action) > 3:
        size = max(1.0, math.sqrt(action[3] * action[3] + action[4] * action[4] + action[5] * action[5]))
    for row in range(3):
        for column in range(3):
            goal[row, column] = tip[row, column]
        goal[row, 3] = tip[row, 3] + scale[0, row] + scale[1, row] * min(max(action[row], -1.0), 1.0)
    for axis in range(len(action) - 4, -1, -1):  # z, y, x; none if the action has three numbers
        i, j, angle = (axis + 1) % 3, (axis + 2) % 3, scale[2, axis] * action[3 + axis] / size
        s, c = math.sin(angle), math.cos(angle)
        for column in range(3):
            one, other = goal[i, column], goal[j, column]
            goal[i, column], goal[j, column] = c * one - s * other, s * one + c * other


@_compiled
def follow(screws, moving, free, home, phases, within, scale, known, qpos, action, angles):
    """Solve the inverse kinematics of a delta action; return whether it converged.

    Args:
        screws: Screws (n, 6) of the joints in the order of the chain: linear part (m/rad, or unit), axis (unit, or 0).
        moving: Their `motions`.
        free: Whether a joint may move (n,).
        home: Pose of the hand (3, 4) with all joints at 0.
        phases: (p, 3): step size, maximum steps and tolerance. A phase starts from the best joints of the one before;
            the last one starts from the initial joints.
        within: The last phase runs only if the error of the one before is at most this.
        scale: As in `aim`.
        known: Indices (n,) of these joints in `qpos`.
        qpos: Positions (d,) of all joints of the robot.
        action: As in `aim`.
        angles: Output (n,).
    """
    n, last = len(screws), len(phases) - 1
    base_from, tip, goal = np.empty((n + 1, 3, 4)), np.empty((3, 4)), np.empty((3, 4))
    twist, matrix, factor, nearest = np.empty(6), np.empty((6, n)), np.empty((6, 6)), np.empty(n)
    left, least = 0.0, np.inf
    for phase in range(last + 1):
        if phase == last and least > within:
            break
        for joint in range(n):
            angles[joint] = qpos[known[joint]] if phase in (0, last) else nearest[joint]
        least = np.inf
        for step in range(int(phases[phase, 1]) + 1):
            if step > 0:
                jacobian(screws, free, base_from, tip, matrix)
                move(matrix, twist, phases[phase, 0], angles, factor)
            place(moving, angles, base_from)
            product(base_from[n], home, tip)
            if phase == 0 and step == 0:
                aim(scale, action, tip, goal)
            left = away(tip, goal, twist)
            if left < least:
                least = left
                for joint in range(n):
                    nearest[joint] = angles[joint]
            if left < phases[phase, 2]:
                return True
    return False
