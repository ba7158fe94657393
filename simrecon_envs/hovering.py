"""Choose the yaw of a closed, downward hand with the most clearance above a height map of the scene. NumPy only."""

from dataclasses import dataclass

import numpy as np

from simrecon_envs.occupancy import ConvexSolid
from simrecon_envs.robots import HandShape
from simrecon_envs.surfaces import HeightMap, height_map

_CELL_M = 0.005
_TURNS = 12  # yaws over half a turn


@dataclass(frozen=True)
class Hover:
    """A closed hand above a place."""

    yaw_rad: float  # closing direction of the fingers
    room_m: float  # clearance above the scene; negative if the hand collides


def most_room(solids: list[ConvexSolid], tip: np.ndarray, hand: HandShape) -> Hover:
    """Return the yaw with the most clearance for a closed hand whose tool centre point is at `tip` (3,), world."""
    edge = float(np.hypot(*hand.palm_half_m)) + _CELL_M
    window = tip[:2] - edge, tip[:2] + edge
    near = [s for s in solids if (s.lower[:2] <= window[1]).all() and (s.upper[:2] >= window[0]).all()]
    heights = height_map(near, *window, _CELL_M)
    fingers = (hand.finger_m[1], hand.finger_m[0] / 2)  # half size of both, side by side
    boxes = ((fingers, -hand.tip_below_m), (hand.palm_half_m, hand.palm_above_m))
    found = []
    for yaw in np.arange(_TURNS) * np.pi / _TURNS:
        room = min(tip[2] + above - _highest(heights, tip, yaw, half) for half, above in boxes)
        found.append(Hover(float(yaw), float(room)))
    return max(found, key=lambda hover: round(hover.room_m, 6))


def _highest(heights: HeightMap, tip: np.ndarray, yaw: float, half: tuple[float, float]) -> float:
    c, s = np.cos(yaw), np.sin(yaw)
    along, across = np.meshgrid(
        *(np.linspace(-size, size, int(2 * size / _CELL_M) + 2) for size in half), indexing="ij"
    )
    points = tip[:2] + np.stack([c * along - s * across, s * along + c * across], axis=-1)
    cell = np.floor((points - heights.lower) / _CELL_M).astype(int)
    cell = cell.clip(0, np.array(heights.top.shape) - 1)
    return float(heights.top[cell[..., 0], cell[..., 1]].max())
