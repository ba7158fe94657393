"""What a phone makes of light: shutter, lens, exposure, colors, noise and packing of a film's frames."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from numba import njit, prange

from reconstruction.core.types import Camera

_BANDS = 6  # of a rolling shutter

Draw = Callable[[Camera, np.ndarray, int], np.ndarray]
"""Draws a picture without noise, float32 (h, w, 3), for a camera, its pose and samples per pixel's side."""


@dataclass(frozen=True)
class Sensor:
    """What a phone does to light.

    The truth of a frame (`film.render_truth`) is that of its pose: the middle of a blurred exposure, the middle row of
    a rolling shutter. Other moments and rows differ by the little that the camera moves meanwhile.
    """

    noise: float = 1.6
    """Standard deviation of the noise, in 8-bit steps."""
    exposure_drift: float = 0.06
    """Amplitude of the slow change of exposure, relative."""
    blur_shutter: float = 0.0
    """Share of the time between two frames that the shutter is open; 0 draws sharp frames."""
    blur_samples: int = 3
    """Positions along the motion that a blurred frame averages."""
    blur_jitter: bool = False
    """Draw each of those positions unsupersampled, shifted by its share of a pixel: as smooth, and much faster."""
    rolling_shutter: float = 0.0
    """Share of the time between two frames that passes from the first to the last row."""
    exposure: float = 1.0
    """Factor on all light."""
    exposure_mean: float = 0.0
    """Level (0..255) that the camera turns the mean of its frames to, with some delay; 0: it does not."""
    exposure_steps: float = 0.0
    """Size of sudden changes of exposure, a few in a film, relative."""
    clip_level: float = 255.0
    """What is brighter than this becomes white; below 255: overexposed."""
    vignetting: float = 0.0
    """Share of the light that is lost in the corners."""
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors on red, green and blue."""
    white_drift: float = 0.0
    """Amplitude of the slow change between warm and cool, relative."""
    gamma: float = 1.0
    """Power of the values; below 1 lifts shadows."""
    contrast: float = 0.0
    """Share of an S-shaped curve; below 0 flattens."""
    saturation: float = 1.0
    """Factor on colorfulness."""
    defocus_px: float = 0.0
    """Standard deviation of the blur of the lens."""
    sharpening: float = 0.0
    """Strength of the edges' exaggeration by the camera's software."""
    shot_noise: float = 0.0
    """Noise at full brightness that grows with the square root of the signal, in 8-bit steps."""
    chroma_noise: float = 0.0
    """Blotchy noise of color, in 8-bit steps."""
    noise_grain_px: float = 0.0
    """How far all noise is smeared; its strength stays."""
    jpeg_quality: int | None = None
    """Pack every frame at this quality (1..100); None: not at all."""


def draw_sensor(rng: np.random.Generator) -> Sensor:
    """Draw a phone and how well it is used: from nearly perfect to dim, noisy and badly packed."""

    def sometimes(share: float, low: float, high: float) -> float:
        return float(rng.uniform(low, high)) if rng.random() < share else 0.0

    bad = float(rng.uniform(0, 1)) ** 2
    warm = float(rng.normal(0, 0.05))
    blurred = sometimes(0.4, 0.1, 0.6)
    return Sensor(
        noise=float(rng.uniform(0.3, 1.5 + 4 * bad)),
        exposure_drift=float(rng.uniform(0, 0.08)),
        blur_shutter=blurred,
        blur_samples=3,
        blur_jitter=True,
        rolling_shutter=sometimes(0.25, 0.1, 0.5),
        exposure_mean=float(rng.uniform(75, 150)),
        exposure_steps=sometimes(0.2, 0.03, 0.15),
        clip_level=float(rng.uniform(190, 255)) if rng.random() < 0.3 else 255.0,
        vignetting=sometimes(0.6, 0.02, 0.35),
        white_balance=(1 + warm, 1 + float(rng.normal(0, 0.02)), 1 - warm),
        white_drift=sometimes(0.4, 0.01, 0.05),
        gamma=float(np.exp(rng.normal(0, 0.16))),
        contrast=float(rng.uniform(-0.25, 0.6)),
        saturation=float(rng.uniform(0.6, 1.35)),
        defocus_px=sometimes(0.6, 0.3, 0.8 + 0.8 * bad),
        sharpening=sometimes(0.4, 0.1, 0.9),
        shot_noise=float(rng.uniform(0, 2 + 6 * bad)),
        chroma_noise=sometimes(0.5, 0.3, 1 + 3 * bad),
        noise_grain_px=sometimes(0.6, 0.4, 1.0),
        jpeg_quality=int(rng.integers(35, 96)) if rng.random() < 0.8 else None,
    )


def expose(
    draw: Draw, camera: Camera, world_from_camera: np.ndarray, number: int, sensor: Sensor, supersample: int
) -> np.ndarray:
    """Draw a frame as the shutter sees it, moving and row by row, without noise."""
    if sensor.rolling_shutter <= 0:
        return _open_shutter(draw, camera, world_from_camera, number, sensor, supersample)
    edges = np.linspace(0, camera.height, _BANDS + 1).astype(int)
    bands = []
    for top, bottom in pairwise(edges):
        lens = replace(camera, height=int(bottom - top), cy=camera.cy - int(top))
        late = sensor.rolling_shutter * ((top + bottom) / 2 / camera.height - 0.5)
        bands.append(_open_shutter(draw, lens, world_from_camera, number + late, sensor, supersample))
    return np.concatenate(bands)


def _open_shutter(
    draw: Draw, camera: Camera, path: np.ndarray, time: float, sensor: Sensor, supersample: int
) -> np.ndarray:
    """Draw what is seen while the shutter is open; `time`, in frames, is the middle of the exposure."""
    if sensor.blur_shutter <= 0:
        return draw(camera, _pose_at(path, time), supersample)
    times = time + sensor.blur_shutter * np.linspace(-0.5, 0.5, sensor.blur_samples)
    shots = [(_pose_at(path, t), *_shot(camera, k, sensor, supersample)) for k, t in enumerate(times)]
    pictures = [draw(lens, pose, samples) for pose, lens, samples in shots]
    return np.mean(pictures, axis=0)


def _shot(camera: Camera, number: int, sensor: Sensor, supersample: int) -> tuple[Camera, int]:
    """Return camera and supersampling of one of the pictures that make a blurred frame."""
    if not sensor.blur_jitter:
        return camera, supersample
    # A lattice of rank 1 spreads any number of samples over the pixel; together they must not shift the frame.
    order = np.arange(sensor.blur_samples)
    x, y = (order + 0.5) / len(order) - 0.5, order * 0.618034 % 1.0
    y = y - y.mean()
    return replace(camera, cx=camera.cx + float(x[number]), cy=camera.cy + float(y[number])), 1


def _pose_at(path: np.ndarray, time: float) -> np.ndarray:
    """Interpolate poses (n, 4, 4) at a time in frames; before the first and after the last the motion goes on."""
    from scipy.spatial.transform import Rotation

    if len(path) == 1 or (time == round(time) and 0 <= time < len(path)):
        return path[min(round(time), len(path) - 1)]
    row = int(np.clip(np.floor(time), 0, len(path) - 2))
    (a, b), share = path[row : row + 2], time - row
    step = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).as_rotvec()
    out = np.eye(4)
    out[:3, :3] = a[:3, :3] @ Rotation.from_rotvec(share * step).as_matrix()
    out[:3, 3] = (1 - share) * a[:3, 3] + share * b[:3, 3]
    return out


@njit(cache=True, parallel=True)
def _toned(image, factor, shading, table, saturation, out):  # pragma: no cover - compiled
    """Shade, weight the colors, look the curve up (with more steps than are seen) and saturate."""
    steps = (len(table) - 1) / 255.0
    for y in prange(image.shape[0]):
        for x in range(image.shape[1]):
            mean = 0.0
            for k in range(3):
                value = image[y, x, k] * factor[k] * shading[y, x]
                value = table[int(min(max(value, 0.0), 255.0) * steps + 0.5)]
                out[y, x, k] = value
                mean += value / 3
            for k in range(3):
                out[y, x, k] = mean + saturation * (out[y, x, k] - mean)


@njit(cache=True, parallel=True)
def _add_noise(image, field, row, sign, noise, shot, out):  # pragma: no cover - compiled
    """Add noise whose variance grows with the signal."""
    for y in prange(image.shape[0]):
        for x in range(image.shape[1]):
            for k in range(3):
                signal = min(max(image[y, x, k], 0.0), 255.0) / 255.0
                strength = sign * np.sqrt(noise * noise + shot * shot * signal)
                out[y, x, k] = image[y, x, k] + strength * field[y + row, x, k]


class Electronics:
    """What happens to a frame after the lens; a neutral `Sensor` changes nothing."""

    def __init__(self, sensor: Sensor, count: int, seed: int) -> None:
        self.sensor = sensor
        self.rng = np.random.default_rng([seed, 79])  # its own stream: the old noise stays as it is
        self.count = max(count, 1)
        self.phase = float(self.rng.uniform(0, 2 * np.pi))
        jumps = self.rng.uniform(0, 1, 3)
        steps = self.rng.choice([-1.0, 1.0], 3) * sensor.exposure_steps
        self.jumps = [(float(at), float(step)) for at, step in zip(jumps, steps)]
        self.gain = 0.0
        self.shading: np.ndarray | None = None
        self.field: np.ndarray | None = None
        level = np.linspace(0, 1, 4096)
        curve = level**sensor.gamma
        curve = curve + sensor.contrast * (curve * curve * (3 - 2 * curve) - curve)
        self.table = (255 * curve).astype(np.float32)

    def develop(self, image: np.ndarray, number: int) -> np.ndarray:
        """Apply lens shading, exposure, colors, curves, blur and sharpening to values of 0..255."""
        s = self.sensor
        t = number / self.count
        gain = s.exposure
        if s.exposure_mean > 0:
            wanted = s.exposure_mean / max(float(np.minimum(image[::4, ::4], 255).mean()), 1.0)
            wanted = float(np.clip(wanted, 0.4, 3.0))
            self.gain = wanted if self.gain == 0.0 else self.gain + 0.15 * (wanted - self.gain)
            gain *= self.gain
        for at, step in self.jumps:
            gain *= 1 + step if t > at else 1.0
        factor = np.array(s.white_balance, np.float32) * np.float32(gain * 255.0 / s.clip_level)
        if s.white_drift > 0:
            swing = s.white_drift * np.sin(self.phase + 2 * np.pi * 0.8 * t)
            factor = factor * np.array([1 + swing, 1.0, 1 - swing], np.float32)
        if s.defocus_px > 0:
            image = cv2.GaussianBlur(np.minimum(image, 400.0).astype(np.float32), (0, 0), s.defocus_px)
        curved = s.gamma != 1.0 or s.contrast != 0.0 or s.saturation != 1.0
        if curved or s.vignetting > 0:
            out = np.empty(image.shape, np.float32)
            _toned(
                image,
                factor.astype(np.float32),
                self._vignette(image.shape[:2]),
                self.table,
                s.saturation,
                out,
            )
            image = out
        elif np.any(factor != 1.0):
            image = image * factor
        if s.sharpening > 0:
            image = np.clip(image, 0, 255)
            image = cv2.addWeighted(
                image, 1 + s.sharpening, cv2.GaussianBlur(image, (0, 0), 1.2), -s.sharpening, 0
            )
        return image

    def _vignette(self, shape: tuple[int, int]) -> np.ndarray:
        if self.shading is None or self.shading.shape[:2] != shape:
            y, x = np.mgrid[-1 : 1 : shape[0] * 1j, -1 : 1 : shape[1] * 1j]
            self.shading = (1 - self.sensor.vignetting * ((x * x + y * y) / 2) ** 1.5).astype(np.float32)
        return self.shading

    def noisy(self, image: np.ndarray, noise: float) -> np.ndarray:
        """Add noise of even strength, that of the light and that of color; one field is used again and again."""
        s = self.sensor
        if noise <= 0 and s.shot_noise <= 0 and s.chroma_noise <= 0:
            return image
        height, width = image.shape[:2]
        if self.field is None or self.field.shape[1] != width:
            self.field = self._noise_field((height + 128, width, 3))
        row = int(self.rng.integers(129))
        sign = float(self.rng.choice([-1.0, 1.0]))
        out = np.empty(image.shape, np.float32)
        _add_noise(image, self.field, row, sign, noise, s.shot_noise, out)
        if s.chroma_noise > 0:
            small = self.rng.standard_normal((height // 3 + 1, width // 3 + 1, 3), np.float32)
            small -= small.mean(2, keepdims=True)
            small *= np.float32(1.6 * s.chroma_noise)
            out += cv2.resize(small, (width, height))
        return out

    def _noise_field(self, shape: tuple[int, int, int]) -> np.ndarray:
        """Return noise of variance 1, smeared over its neighbors where the sensor says so."""
        noise = self.rng.standard_normal(shape, np.float32)
        if self.sensor.noise_grain_px > 0:
            noise = cv2.GaussianBlur(noise, (0, 0), self.sensor.noise_grain_px)
            noise /= noise.std()
        return noise

    def packed(self, frame: np.ndarray) -> np.ndarray:
        """Pack and unpack a frame."""
        if self.sensor.jpeg_quality is None:
            return frame
        options = [cv2.IMWRITE_JPEG_QUALITY, int(self.sensor.jpeg_quality)]
        ok, data = cv2.imencode(".jpg", frame[..., ::-1], options)
        assert ok, "OpenCV packs every frame"
        return np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])
