"""Where a camera is and looks: a phone's lens, an arc by hand around the table, a turn on the spot."""

import numpy as np

from reconstruction.core.types import Camera


def look_at(position: np.ndarray, target: np.ndarray, roll_rad: float = 0.0) -> np.ndarray:
    """Return world_from_camera (OpenCV axes) of an upright camera at `position` that looks at `target`."""
    forward = np.asarray(target, float) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    out = np.eye(4)
    out[:3, :3] = np.stack([right, down, forward], axis=1)
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    out[:3, :3] = out[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    out[:3, 3] = position
    return out


def handheld_path(
    n_frames: int, *, seed: int = 0, arc_deg: float = 136.0, middle_deg: float = -88.0,
    radius_m: float = 1.42, height_m: float = 1.38,
    target: tuple[float, float, float] = (0.02, 0.08, 0.56), shake: float = 1.0,
) -> np.ndarray:  # fmt: skip
    """Walk an arc around the table as a person does: (n, 4, 4) world_from_camera.

    Slow sways of radius, height and aim, steps at walking pace and a small tremor, all scaled by `shake`.
    """
    rng = np.random.default_rng([seed, 77])
    t = np.linspace(0, 1, n_frames)

    def sway(amplitude: float, cycles: tuple[float, ...]) -> np.ndarray:
        waves = [
            rng.uniform(0.5, 1.0) / (k + 1) * np.sin(2 * np.pi * (c * t + rng.uniform()))
            for k, c in enumerate(cycles)
        ]
        return shake * amplitude * np.sum(waves, axis=0)

    def tremor(amplitude: float) -> np.ndarray:
        noise = rng.standard_normal(n_frames + 4)
        return shake * amplitude * np.convolve(noise, np.ones(5) / 5, "valid")

    ease = t + 0.018 * np.sin(2 * np.pi * 2 * t)
    angle = np.radians(middle_deg + arc_deg * (ease - 0.5))
    radius = radius_m + sway(0.10, (0.9, 2.1))
    x = target[0] + radius * np.cos(angle) + tremor(0.003)
    y = target[1] + radius * np.sin(angle) + tremor(0.003)
    z = height_m + sway(0.08, (0.8, 1.7)) + sway(0.008, (9.0,)) + tremor(0.003)
    aim = np.array(target) + np.stack(
        [sway(0.09, (1.1, 2.3)), sway(0.06, (1.4, 2.9)), sway(0.09, (1.0, 1.9))], -1
    )
    aim += np.stack([tremor(0.006) for _ in range(3)], -1)
    roll = np.radians(sway(1.5, (1.2, 3.1)) + tremor(0.2))
    return np.stack([look_at(np.array(p), a, r) for p, a, r in zip(np.stack([x, y, z], -1), aim, roll)])


def pan_path(
    n_frames: int, *, arc_deg: float = 90.0, position: tuple[float, float, float] = (0.0, -1.6, 1.4)
) -> np.ndarray:
    """Turn on the spot, without any parallax: (n, 4, 4)."""
    angles = np.radians(90 + arc_deg * np.linspace(-0.5, 0.5, n_frames))
    at = np.array(position)
    return np.stack([look_at(at, at + np.array([np.cos(a), np.sin(a), -0.4])) for a in angles])


def phone_camera(width: int, height: int, fov_deg: float = 62.0) -> Camera:
    """Return a camera whose longer side spans `fov_deg`."""
    focal = max(width, height) / 2 / np.tan(np.radians(fov_deg) / 2)
    return Camera(width, height, focal, focal, width / 2, height / 2)
