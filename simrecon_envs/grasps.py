"""Find top-down parallel-jaw grasps of an object: convex parts + hand -> ranked grasps. NumPy and SciPy only.

Horizontal sections of the object, at several heights and yaws, are searched for runs of material that fit between the
fingers, with free space for a finger on both sides: a whole narrow object, the neck of a wide one, the wall of an open
one. The vertical approach of fingers and palm must be free.
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy import ndimage

from simrecon_envs.occupancy import ConvexSolid
from simrecon_envs.robots import HandShape
from simrecon_envs.surfaces import height_map

CELL_M = 0.004
_LEVEL_M = 0.008  # spacing of the heights
_BELOW_TOP_M = 0.12  # maximum depth below the top, which the palm limits
_TURNS = 12  # yaws over half a turn
_ROW_CELLS = 2  # spacing of the rows that are searched
_FREE_M = 0.003  # clearance of the fingertips above the support
_SLACK_M = 0.004  # clearance between a finger and the object, at each side
_MAX_SLOPE = 0.7  # of the gripped surface; steeper ones slip (the friction of ManiSkill's fingers is 2)
_MAX_SKEW = 0.6  # slope of the two sides over the fingers' width
_MAX_TORQUE_NM = 1.2  # of the weight about the fingers
_APART_M, _APART_RAD = 0.025, 0.5  # closer grasps are duplicates
_MOST = 6  # grasps returned


@dataclass(frozen=True)
class Grasp:
    """A top-down grasp of an object at its captured pose."""

    offset: np.ndarray  # float64 (3,) from the object's box centre to the tool centre point, world axes
    yaw_rad: float  # closing direction of the fingers
    width_m: float  # of the material between the fingers
    opening_m: float  # between the fingers during the approach
    cost: float  # lower is better; about 1 is doubtful


def find_grasps(
    solids: list[ConvexSolid],
    owner: int,
    center: np.ndarray,
    mass_kg: float,
    center_of_mass: np.ndarray,
    hand: HandShape,
) -> list[Grasp]:
    """Return the grasps of an object, best first.

    Args:
        solids: All convex solids of the scene; those near the object are obstacles.
        owner: Id of the object.
        center: Its box centre (3,), world.
        mass_kg: Its mass.
        center_of_mass: (3,), world; the torque of the weight about the fingers is limited.
        hand: The gripper.
    """
    search = _Search(solids, owner, hand)
    weight_n = 9.81 * mass_kg
    found = [row for level in search.levels() for row in search.at_level(level)]
    if not found:
        return []
    rows = np.concatenate(found)
    arm = np.linalg.norm(rows[:, :2] - center_of_mass[:2], axis=1)
    rows, arm = rows[weight_n * arm <= _MAX_TORQUE_NM], arm[weight_n * arm <= _MAX_TORQUE_NM]
    cost = rows[:, _COST] + weight_n * arm / _MAX_TORQUE_NM + 2.0 * arm
    out: list[Grasp] = []
    for index in np.lexsort((np.arange(len(cost)), cost.round(6))):
        row = rows[index]
        if any(_alike(row[:3] - center, row[_YAW], known) for known in out):
            continue
        if search.palm_is_free(row):
            out.append(Grasp(row[:3] - center, float(row[_YAW]), float(row[_WIDTH]), float(row[_OPENING]),
                             float(cost[index])))  # fmt: skip
        if len(out) == _MOST:
            break
    return out


_YAW, _WIDTH, _OPENING, _COST = 3, 4, 5, 6  # columns of a candidate, after its position
Sections: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray]  # filled cells below, at and above the grip


class _Search:
    """Sections of one object and the height map around it."""

    def __init__(self, solids: list[ConvexSolid], owner: int, hand: HandShape) -> None:
        self._hand = hand
        self._own = [s for s in solids if s.owner == owner]
        lower = np.min([s.lower for s in self._own], axis=0)
        upper = np.max([s.upper for s in self._own], axis=0)
        self._bottom, self._top = float(lower[2]), float(upper[2])
        self._middle = (lower + upper)[:2] / 2
        # The map covers fingers and palm at every yaw.
        reach = float(np.linalg.norm((upper - lower)[:2])) / 2 + hand.opening_m
        self._reach = reach
        edge = reach + max(hand.palm_half_m)
        window = self._middle - edge, self._middle + edge
        near = [s for s in solids if (s.lower[:2] <= window[1]).all() and (s.upper[:2] >= window[0]).all()]
        self._map = height_map([s for s in near if s.owner != owner], *window, CELL_M)
        np.maximum(self._map.top, height_map(self._own, *window, CELL_M).top, out=self._map.top)
        axis = np.arange(-reach, reach + CELL_M / 2, CELL_M)
        self._axis = axis
        # Rows lie across the closing direction, columns along it.
        self._across, self._along = np.meshgrid(axis, axis, indexing="ij")
        self._turned = [self._cells(yaw) for yaw in np.arange(_TURNS) * np.pi / _TURNS]
        self._sections: dict[int, np.ndarray] = {}

    def levels(self) -> range:
        """Return the indices of the heights to try, counted from the bottom."""
        first = max(1, int((self._top - _BELOW_TOP_M - self._bottom) / _LEVEL_M))
        return range(first, max(int((self._top - self._bottom) / _LEVEL_M), first + 1))

    def at_level(self, level: int) -> list[np.ndarray]:
        """Return candidates (k, 7) that grip at one height: tip (3), yaw, width, opening, cost."""
        hand = self._hand
        height = self._bottom + level * _LEVEL_M
        tip = max(height, self._bottom + hand.tip_below_m + _FREE_M + 0.001)
        if tip - height > hand.tip_below_m - 0.003:
            return []
        blocked = self._map.top > tip - hand.tip_below_m - _FREE_M
        sections = [self._section(level + step) for step in (-1, 0, 1)]
        if not sections[1].any():
            return []
        out = []
        for number, cells in enumerate(self._turned):
            masks = [mask[cells] for mask in (blocked, *sections)]
            rows = self._runs(*masks)
            if len(rows):
                yaw = number * np.pi / _TURNS
                along, across = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
                xy = self._middle + rows[:, :1] * along + rows[:, 1:2] * across
                fixed = np.full((len(rows), 2), (tip, yaw))
                out.append(np.column_stack([xy, fixed, rows[:, 2:]]))
        return out

    def palm_is_free(self, row: np.ndarray) -> bool:
        """Return whether the scene below the palm is lower than the palm."""
        c, s = np.cos(row[_YAW]), np.sin(row[_YAW])
        along, across = (np.arange(-half, half + CELL_M, CELL_M) for half in self._hand.palm_half_m)
        a, b = np.meshgrid(along, across, indexing="ij")
        points = row[:2] + np.stack([c * a - s * b, s * a + c * b], axis=-1)
        return bool((self._heights(points) <= row[2] + self._hand.palm_above_m - 0.002).all())

    def _runs(self, blocked: np.ndarray, below: np.ndarray, at: np.ndarray, above: np.ndarray) -> np.ndarray:
        """Return the runs of material that fit at one yaw (k, 5): middle along and across (m), width, opening, cost."""
        hand = self._hand
        width_cells = int(round(hand.finger_m[0] / CELL_M)) | 1
        shut = ndimage.maximum_filter1d(blocked.view(np.uint8), width_cells, axis=0)[::_ROW_CELLS]
        pad = _widened(at, width_cells)
        edges = np.diff(np.pad(shut, ((0, 0), (1, 1))).astype(np.int8), axis=1)
        row, start = np.nonzero(edges == 1)
        _, end = np.nonzero(edges == -1)
        if not len(row):
            return np.zeros((0, 5))
        found = []
        for span in range(3):  # number of gaps inside the run that are too narrow for a finger
            if len(row) <= span:
                break
            found.append(self._fitting(row, start, end, span, pad, (below, at, above)))
        return np.concatenate(found)

    def _fitting(self, row: np.ndarray, start: np.ndarray, end: np.ndarray, span: int, pad: np.ndarray,
                 sections: Sections) -> np.ndarray:  # fmt: skip
        """Return the runs of `span` + 1 neighboring intervals [start, end) of cells in a row, as `_runs` does."""
        hand, size = self._hand, len(self._axis)
        first, last = slice(0, len(row) - span), slice(span, None)
        # Free cells before and after each run; the outer runs of a row have free space to the edge.
        before = np.where(np.roll(row, 1) == row, start - np.roll(end, 1), size)
        after = np.roll(before, -1)
        before[0] = after[-1] = size
        s, e, r = start[first], end[last], row[first]
        width = (e - s) * CELL_M
        room = np.minimum(before[first], after[last]) * CELL_M
        opening = np.minimum(hand.opening_m, width + 2 * (room - hand.finger_m[1] - _FREE_M))
        keep = (row[first] == row[last]) & (opening >= width + 2 * _SLACK_M)
        if not keep.any():
            return np.zeros((0, 5))
        s, e, r = (cells[keep] for cells in (s, e, r))
        width, opening = width[keep], opening[keep]
        # Contact points: the outermost material at this height, not obstacles above or below.
        left, right = _first_met(pad[r * _ROW_CELLS], s, e)
        off = ((left - s) + (e - 1 - right)) * CELL_M
        slope = self._slopes(sections, r * _ROW_CELLS, s, e)
        cost = (
            40 * np.maximum(off - CELL_M, 0) + 0.8 * slope + 4 * np.maximum(width + 0.012 - opening, 0) / 0.01
        )
        skew = self._skew(sections[1], r * _ROW_CELLS, s, e)
        cost += skew
        middle = self._axis[0] + (s + e - 1) / 2 * CELL_M
        out = np.column_stack([middle, self._axis[r * _ROW_CELLS], width, opening, cost])
        return out[(left <= right) & (off < 0.012) & (slope < _MAX_SLOPE) & (skew < _MAX_SKEW)]

    def _slopes(self, sections: Sections, rows: np.ndarray, s: np.ndarray, e: np.ndarray) -> np.ndarray:
        """Return the vertical slope of each run's sides, from the sections below and above."""
        low, high = (_first_met(sections[k][rows], s - 3, e + 3) for k in (0, 2))
        lean = [np.abs(low[k] - high[k]) * CELL_M / (2 * _LEVEL_M) for k in (0, 1)]
        missing = (low[0] > low[1]) | (high[0] > high[1])
        parallel = np.abs((low[1] - low[0]) - (high[1] - high[0])) * CELL_M / (4 * _LEVEL_M)
        return np.where(missing, 0.25, 0.5 * np.maximum(*lean) + parallel)

    def _skew(self, at: np.ndarray, rows: np.ndarray, s: np.ndarray, e: np.ndarray) -> np.ndarray:
        """Return the horizontal slope of each run's sides over the fingers' width."""
        half = max(int(round(self._hand.finger_m[0] / 2 / CELL_M)), 1)
        ends = [_first_met(at[np.clip(rows + step, 0, len(at) - 1)], s, e) for step in (-half, half)]
        here = _first_met(at[rows], s, e)
        out = np.zeros(len(rows))
        for one, other in zip(*ends, strict=True):
            out = np.maximum(out, np.abs(one - other) / (2 * half))
        there = [ends[k][0] <= ends[k][1] for k in (0, 1)]
        # Objects narrower than the fingers end on both sides; rounded ones gripped off their middle end on one.
        out = np.where(there[0] & there[1], out, np.where(there[0] | there[1], 1.0, 0.2))
        return np.where(here[0] <= here[1], out, 1.0)

    def _section(self, level: int) -> np.ndarray:
        """Return the cells of the map (nx, ny) that the object fills at a height."""
        if level not in self._sections:
            filled = np.zeros(self._map.top.shape, bool)
            height = self._bottom + level * _LEVEL_M
            for solid in self._own:
                if not solid.lower[2] <= height <= solid.upper[2]:
                    continue
                low = np.floor((solid.lower[:2] - self._map.lower) / CELL_M).astype(int)
                high = np.ceil((solid.upper[:2] - self._map.lower) / CELL_M).astype(int)
                x, y = (self._map.lower[a] + (np.arange(low[a], high[a]) + 0.5) * CELL_M for a in range(2))
                inside = np.ones((len(x), len(y)), bool)
                for nx, ny, nz, d in solid.half_spaces:
                    inside &= (nx * x)[:, None] + (ny * y)[None, :] + (nz * height + d) <= 0
                filled[low[0] : high[0], low[1] : high[1]] |= inside
            self._sections[level] = filled
        return self._sections[level]

    def _cells(self, yaw: float) -> tuple[np.ndarray, np.ndarray]:
        c, s = np.cos(yaw), np.sin(yaw)
        x = self._middle[0] + c * self._along - s * self._across
        y = self._middle[1] + s * self._along + c * self._across
        return self._index(np.stack([x, y], axis=-1))

    def _index(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        cell = np.floor((points - self._map.lower) / CELL_M).astype(int)
        cell = np.clip(cell, 0, np.array(self._map.top.shape) - 1)
        return cell[..., 0], cell[..., 1]

    def _heights(self, points: np.ndarray) -> np.ndarray:
        return self._map.top[self._index(points)]


def _widened(mask: np.ndarray, cells: int) -> np.ndarray:
    return ndimage.maximum_filter1d(mask.view(np.uint8), cells, axis=0).view(bool)


def _first_met(rows: np.ndarray, s: np.ndarray, e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and last filled column of each row (k, n) within [s, e); first > last if it is empty."""
    columns = np.arange(rows.shape[1])
    filled = rows & (columns >= s[:, None]) & (columns < e[:, None])
    some = filled.any(axis=1)
    left = np.where(some, filled.argmax(axis=1), rows.shape[1])
    right = np.where(some, rows.shape[1] - 1 - filled[:, ::-1].argmax(axis=1), -1)
    return left, right


def _alike(offset: np.ndarray, yaw: float, known: Grasp) -> bool:
    turn = abs((yaw - known.yaw_rad + np.pi / 2) % np.pi - np.pi / 2)
    return bool(np.linalg.norm(offset - known.offset) < _APART_M and turn < _APART_RAD)
