"""How the camera goes through a procedural room: by hand, around the middle, at 1.2 to 1.6 m, looking at things."""

from typing import Literal, get_args

import numpy as np

from registry.errors import UsageError
from synthetic.film import look_at
from synthetic.layout import RoomShape

WalkKind = Literal["arc", "loop", "two_heights"]
WALKS: tuple[str, ...] = get_args(WalkKind)
_SWAY_OUT_M = 0.16  # stays inside the band that layout keeps free (0.36 m to each side)


def walk_path(shape: RoomShape, kind: str, n_frames: int, seed: int, shake: float = 1.0) -> np.ndarray:
    """Return world_from_camera (n, 4, 4), OpenCV axes.

    Args:
        shape: Of the room; the walk stays on its free band.
        kind: "arc": once around the open side; "two_heights": the same there and, lower, back; "loop": all
            around, for rooms with four walls.
        n_frames: Length of the film.
        seed: Of the hand.
        shake: Factor on sway, steps and tremor.
    """
    if kind not in WALKS:
        raise UsageError(f"unknown path {kind!r}; there are {list(WALKS)}")
    if kind == "loop" and "wall_south" not in shape.walls:
        raise UsageError(
            "a loop looks out of the open side of a room with 3 walls: set walls=4 or path='arc'"
        )
    hand = _Hand(n_frames, seed, shake)
    t = np.linspace(0, 1, n_frames)
    pace = t + 0.012 * np.sin(2 * np.pi * 2 * t)
    if kind == "loop":
        angle, height, looks_up = -90 + 350 * pace, np.full(n_frames, 1.42), 4.0
    elif kind == "arc":
        angle, height, looks_up = -164 + 148 * pace, np.full(n_frames, 1.42), 2.0
    else:
        there = 0.5 - 0.5 * np.cos(2 * np.pi * pace)  # turns back gently
        angle, height, looks_up = -164 + 148 * there, 1.58 - 0.36 * _ease(pace), 3.0
    ground = shape.walk(np.radians(angle))
    out = ground / np.linalg.norm(ground, axis=1, keepdims=True)
    ground = ground + out * np.clip(hand.sway(0.08, (0.9, 2.1)), -_SWAY_OUT_M, _SWAY_OUT_M)[:, None]
    ground = ground + np.stack([hand.tremor(0.003), hand.tremor(0.003)], -1)
    z = height + hand.sway(0.05, (0.8, 1.7)) + hand.sway(0.008, (9.0,)) + hand.tremor(0.003)
    aim = _aim(shape, ground, t, looks_up)
    aim += np.stack(
        [hand.sway(0.07, (1.1, 2.3)), hand.sway(0.06, (1.4, 2.9)), hand.sway(0.05, (1.0, 1.9))], -1
    )
    aim += np.stack([hand.tremor(0.006) for _ in range(3)], -1)
    roll = np.radians(hand.sway(1.5, (1.2, 3.1)) + hand.tremor(0.2))
    positions = np.column_stack([ground, z])
    return np.stack([look_at(p, a, r) for p, a, r in zip(positions, aim, roll)])


def _aim(shape: RoomShape, ground: np.ndarray, t: np.ndarray, looks_up: float) -> np.ndarray:
    """Look down at the middle and up at what stands behind it, in turn; returns points (n, 3)."""
    reach = np.array([max(h - 0.8, 0.0) for h in shape.half])
    follow = np.clip(ground, -0.6 * reach, 0.6 * reach)  # along a long row of tables, look at the near one
    near = np.column_stack([follow, np.full(len(t), 0.52)])
    away = -ground / np.linalg.norm(ground, axis=1, keepdims=True)
    far = np.column_stack([0.4 * follow + away * (np.mean(shape.half) + 0.2), np.full(len(t), 0.78)])
    share = 0.85 * (0.5 - 0.5 * np.cos(2 * np.pi * looks_up * t))[:, None]
    return (1 - share) * near + share * far


def _ease(t: np.ndarray) -> np.ndarray:
    """Go from 0 to 1 around the middle of the way."""
    s = np.clip((t - 0.35) / 0.3, 0, 1)
    return s * s * (3 - 2 * s)


class _Hand:
    """Sways and tremors of a hand-held camera."""

    def __init__(self, n_frames: int, seed: int, shake: float) -> None:
        self.rng = np.random.default_rng([seed, 78])
        self.t = np.linspace(0, 1, n_frames)
        self.shake = shake

    def sway(self, amplitude: float, cycles: tuple[float, ...]) -> np.ndarray:
        """Slow waves."""
        waves = [
            self.rng.uniform(0.5, 1.0) / (k + 1) * np.sin(2 * np.pi * (c * self.t + self.rng.uniform()))
            for k, c in enumerate(cycles)
        ]
        return self.shake * amplitude * np.sum(waves, axis=0)

    def tremor(self, amplitude: float) -> np.ndarray:
        """Fast noise, a little smoothed."""
        noise = self.rng.standard_normal(len(self.t) + 4)
        return self.shake * amplitude * np.convolve(noise, np.ones(5) / 5, "valid")
