"""How the camera goes through a procedural room: by hand, on the band around the middle that stays free.

"arc", "loop" and "two_heights" go around at 1.2 to 1.6 m and look at things. The other ways, for training data,
draw height, direction, speed and what they look at.
"""

from typing import Literal, get_args

import numpy as np

from registry.errors import UsageError
from synthetic.camera_paths import look_at
from synthetic.layout import RoomShape

WalkKind = Literal["arc", "loop", "two_heights", "near", "strafe", "pan", "sit", "handheld_wander", "visit"]
WALKS: tuple[str, ...] = get_args(WalkKind)
_TABLE_HALF_M = 0.78  # from the middle of the band to the edge of the middle group
_ARM_M = 0.28  # from a visitor's axis to the phone
_SWAY_OUT_M = 0.16  # stays inside the band that layout keeps free (0.36 m to each side)


def walk_path(
    shape: RoomShape, kind: str, n_frames: int, seed: int, shake: float = 1.0, *, top_m: float = 0.56
) -> np.ndarray:
    """Return world_from_camera (n, 4, 4), OpenCV axes.

    Args:
        shape: Of the room; the walk stays on its free band.
        kind: "arc": once around the open side; "two_heights": the same there and, lower, back; "loop": all
            around, for rooms with four walls; "near": low and close to the middle table; "strafe": sideways
            along one side; "pan": partly turning on the spot; "sit": at the height of a seated person's eyes;
            "handheld_wander": anywhere on the band, from one thing to the next; "visit": walks on, turns around once on
            the spot with the phone at arm's length, walks on, for rooms with four walls.
        n_frames: Length of the film.
        seed: Of the hand.
        shake: Factor on sway, steps and tremor.
        top_m: Height of the middle table, for "near".
    """
    if kind not in WALKS:
        raise UsageError(f"unknown path {kind!r}; there are {list(WALKS)}")
    if kind in ("loop", "visit") and "wall_south" not in shape.walls:
        raise UsageError(
            f"a {kind} looks out of the open side of a room with 3 walls: set walls=4 or path='arc'"
        )
    hand = _Hand(n_frames, seed, shake)
    if kind == "visit":
        return _visit_path(shape, hand, np.random.default_rng([seed, 81]))
    if kind not in ("arc", "loop", "two_heights"):
        return _drawn_path(shape, kind, hand, np.random.default_rng([seed, 80]), top_m)
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


def draw_walk(
    rng: np.random.Generator, shape: RoomShape, n_frames: int, *, top_m: float = 0.56
) -> np.ndarray:
    """Draw a kind of walk, a hand and a seed; return world_from_camera (n, 4, 4)."""
    shares = {"arc": 0.14, "two_heights": 0.06, "near": 0.2, "strafe": 0.13, "pan": 0.12, "sit": 0.1,
              "handheld_wander": 0.25}  # fmt: skip
    kind = str(rng.choice(list(shares), p=list(shares.values())))
    if kind == "arc" and "wall_south" in shape.walls and rng.random() < 0.5:
        kind = "loop"
    seed, shake = int(rng.integers(2**31)), float(rng.uniform(0.5, 1.6))
    path = walk_path(shape, kind, n_frames, seed, shake, top_m=top_m)
    return path[::-1].copy() if rng.random() < 0.5 else path


def _drawn_path(
    shape: RoomShape, kind: str, hand: "_Hand", rng: np.random.Generator, top_m: float
) -> np.ndarray:
    """Return one of the ways whose every feature is drawn."""
    t = hand.t
    direction = float(rng.choice([-1.0, 1.0]))
    # Where the south is open, the camera stays there: from the north it would look out.
    low, high = (0.0, 360.0) if "wall_south" in shape.walls else (-166.0, -14.0)
    if shape.free_deg != (-180.0, 180.0):  # furniture takes the rest of the band
        low, high = shape.free_deg[0] + 4.0, shape.free_deg[1] - 4.0
    span = {"near": (25, 110), "strafe": (25, 70), "pan": (15, 70), "sit": (30, 140),
            "handheld_wander": (50, 180)}[kind]  # fmt: skip
    reach = min(rng.uniform(*span), high - low)
    start = rng.uniform(low, high - reach) if high - low < 360 else rng.uniform(0, 360)
    progress, turn = t, np.zeros(len(t))
    if kind == "pan":
        progress, turn = _stop_and_turn(t, rng)
    elif kind == "handheld_wander":
        progress = _between_0_and_1(_spline(rng.uniform(0, 1, int(rng.integers(3, 6))), t))
    else:
        progress = _between_0_and_1(t + hand.sway(0.03, (1.3, 2.4)))
    angle = np.radians(start + reach * (progress if direction > 0 else 1 - progress))
    sway = np.clip(
        rng.uniform(-0.08, 0.08) + hand.sway(0.06, (0.9, 2.1)) + hand.tremor(0.002),
        -_SWAY_OUT_M,
        _SWAY_OUT_M,
    )
    if kind == "near":
        sway = sway - rng.uniform(0.42, 0.56)  # still beside the table: its edge is 0.78 m inwards
    ground = _outwards(shape, angle, sway)
    if kind == "near":
        z = top_m + np.clip(rng.uniform(0.27, 0.65) + hand.sway(0.08, (0.7, 1.6)), 0.25, 0.7)
    elif kind == "sit":
        z = np.clip(rng.uniform(0.93, 1.07) + hand.sway(0.03, (0.8, 1.7)) + hand.tremor(0.002), 0.9, 1.1)
    else:
        rise = (
            rng.uniform(-0.25, 0.25) * (t - 0.5) if kind != "handheld_wander" else hand.sway(0.2, (0.6, 1.3))
        )
        z = rng.uniform(1.05, 1.65) + rise + hand.sway(0.04, (0.8, 1.7)) + hand.sway(0.008, (9.0,))
        z = np.clip(z + hand.tremor(0.003), 0.8, 1.8)
    positions = np.column_stack([ground, z])
    aim = _drawn_aim(shape, kind, positions, t, rng, top_m)
    aim = aim + np.stack([hand.sway(0.05, (1.1, 2.3)) + hand.tremor(0.005) for _ in range(3)], -1)
    roll = np.radians(np.clip(hand.sway(2.0, (1.2, 3.1)) + hand.tremor(0.2), -12, 12))
    return np.stack([look_at(p, a, r) for p, a, r in zip(positions, _gentle(positions, aim, turn), roll)])


def _visit_path(shape: RoomShape, hand: "_Hand", rng: np.random.Generator) -> np.ndarray:
    """Return the way of a visitor: an eighth of the round, once around the visitor, an eighth of the round."""
    from scipy.ndimage import gaussian_filter1d

    t, smooth = hand.t, len(hand.t) / 40
    side, around = rng.choice([-1.0, 1.0], 2) * [1.0, rng.uniform(220, 330)]
    walked = gaussian_filter1d(np.interp(t, [0, 0.3, 0.72, 1], [0, 45, 45, 90]), smooth, mode="nearest")
    turned = gaussian_filter1d(np.interp(t, [0.27, 0.75], [0, around]), smooth, mode="nearest")
    body = _outwards(shape, np.radians(rng.uniform(-150, -30) + side * walked), np.full(len(t), 0.05))
    inwards = np.arctan2(-body[:, 1], -body[:, 0])
    heading = inwards + np.radians(turned + hand.sway(8, (1.3, 2.7)))
    view = np.stack([np.cos(heading), np.sin(heading)], -1)
    ground = body + _ARM_M * view + np.stack([hand.sway(0.03, (2.0, 5.0)), hand.sway(0.03, (2.3, 4.0))], -1)
    ground += np.stack([hand.tremor(0.003), hand.tremor(0.003)], -1)
    z = 1.45 + hand.sway(0.05, (0.8, 1.7)) + hand.sway(0.01, (9.0,)) + hand.tremor(0.003)
    pitch = np.radians(-22 + hand.sway(9, (1.5, 3.3)))
    aim = np.column_stack([ground + view, z + np.tan(pitch)])
    roll = np.radians(hand.sway(1.5, (1.2, 3.1)))
    return np.stack([look_at(p, a, r) for p, a, r in zip(np.column_stack([ground, z]), aim, roll)])


def _drawn_aim(
    shape: RoomShape, kind: str, positions: np.ndarray, t: np.ndarray, rng: np.random.Generator, top_m: float
) -> np.ndarray:
    """Return the points (n, 3) that a drawn way looks at."""
    reach = np.array([max(h - _TABLE_HALF_M, 0.2) for h in shape.half])
    ground = positions[:, :2]
    follow = np.clip(ground, -0.8 * reach, 0.8 * reach)
    if kind == "near":
        spots = follow + _spline(rng.uniform(-0.15, 0.15, (4, 2)), t)
        return np.column_stack([spots, top_m + _spline(rng.uniform(-0.02, 0.22, 4), t)])
    inwards = -ground / np.linalg.norm(ground, axis=1, keepdims=True)
    if kind == "strafe":
        # Straight ahead, turning slowly: across the middle, or at the wall behind where there is one.
        middle = ground[len(ground) // 2]
        ahead = -middle / np.linalg.norm(middle)
        if "wall_south" in shape.walls and rng.random() < 0.5:
            ahead = -ahead
        angle = np.radians(rng.uniform(-12, 12) + rng.uniform(-25, 25) * (t - 0.5))
        c, s = np.cos(angle), np.sin(angle)
        ahead = np.stack([c * ahead[0] - s * ahead[1], s * ahead[0] + c * ahead[1]], -1)
        return np.column_stack([ground + 1.5 * ahead, positions[:, 2] - rng.uniform(0.0, 0.75)])
    if kind == "pan":
        height = positions[:, 2] - rng.uniform(0.1, 0.8)
        return np.column_stack([ground + 1.5 * inwards, height])
    count = int(rng.integers(3, 8)) if kind == "handheld_wander" else 4
    spots = []
    for _ in range(count):
        draw = rng.random()
        if draw < 0.55:  # on the table, on or under its edge
            spot = [*(rng.uniform(-0.8, 0.8, 2) * reach), rng.uniform(0.2, top_m + 0.25)]
        else:  # at a wall, or what stands before it
            walls = [w for w in shape.walls if "wall_south" in shape.walls or w != "wall_south"]
            at, long = shape.wall(walls[int(rng.integers(len(walls)))])
            along = rng.uniform(-0.4, 0.4) * long
            across = np.array([1.0, 0.0]) if abs(at[1]) > abs(at[0]) else np.array([0.0, 1.0])
            spot = [*(0.85 * (at + along * across)), rng.uniform(0.1, 1.7)]
        spots.append(spot)
    aim = _spline(np.array(spots), t)
    # Not over the shoulder: what lies behind is seen as far ahead.
    ahead = np.einsum("nk,nk->n", aim[:, :2] - ground, inwards)
    aim[:, :2] += np.maximum(0.35 - ahead, 0.0)[:, None] * inwards
    return aim


def _outwards(shape: RoomShape, angle: np.ndarray, out_m: np.ndarray) -> np.ndarray:
    ground = shape.walk(angle)
    return ground + ground / np.linalg.norm(ground, axis=1, keepdims=True) * out_m[:, None]


def _stop_and_turn(t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return progress (n,) that rests once or twice, and the turn in radians meanwhile."""
    stops = np.sort(rng.uniform(0.15, 0.85, int(rng.integers(1, 3))))
    speed, turn = np.ones(len(t)), np.zeros(len(t))
    for stop in stops:
        rest = np.exp(-(((t - stop) / 0.13) ** 4))
        speed *= 1 - rest
        turn += np.radians(rng.uniform(-70, 70)) * np.sin(np.pi * np.clip((t - stop) / 0.3 + 0.5, 0, 1)) ** 2
    progress = np.cumsum(speed)
    return progress / max(progress[-1], 1e-9), turn


def _gentle(positions: np.ndarray, aim: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Turn the views about the vertical and keep them from looking straight down or up."""
    view = aim - positions
    c, s = np.cos(turn), np.sin(turn)
    flat = np.stack([c * view[:, 0] - s * view[:, 1], s * view[:, 0] + c * view[:, 1]], -1)
    length = np.linalg.norm(flat, axis=1)
    flat = flat / np.maximum(length, 1e-6)[:, None]
    pitch = np.clip(np.arctan2(view[:, 2], length), np.radians(-58), np.radians(22))
    return positions + np.column_stack([np.cos(pitch)[:, None] * flat, np.sin(pitch)])


def _spline(knots: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Go smoothly through evenly spaced knots (k,) or (k, d)."""
    from scipy.interpolate import PchipInterpolator

    return PchipInterpolator(np.linspace(0, 1, len(knots)), knots)(t)


def _between_0_and_1(values: np.ndarray) -> np.ndarray:
    return np.clip(values, 0, 1)


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
