"""Procedural textures at real-world scale: noise, wood, tiles, plaster, wallpaper, printed labels, pictures.

Every maker takes a random generator and a size in metres and returns a `Texture`. They carry detail at
several octaves because structure from motion needs corners at every viewing distance.
"""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np


@dataclass(frozen=True)
class Texture:
    """An image that covers a rectangle of known size; it repeats outside."""

    pixels: np.ndarray  # uint8 (h, w, 3) sRGB, row 0 at the largest v
    width_m: float  # extent along u
    height_m: float  # extent along v

    @property
    def texels_per_m(self) -> float:
        """Return the resolution along u."""
        return self.pixels.shape[1] / self.width_m


def _shape(width_m: float, height_m: float, density: float) -> tuple[int, int]:
    return max(8, round(height_m * density)), max(8, round(width_m * density))


def octave_noise(
    rng: np.random.Generator,
    shape: tuple[int, int],
    coarsest_px: tuple[float, float],
    octaves: int,
    gain: float = 0.6,
) -> np.ndarray:
    """Sum smooth noise; cells start at `coarsest_px` (x, y), halve per octave; float32 (h, w), variance 1."""
    height, width = shape
    total = np.zeros(shape, np.float32)
    for octave in range(octaves):
        cell_x, cell_y = (max(c / 2**octave, 1.0) for c in coarsest_px)
        grid = rng.standard_normal((int(height / cell_y) + 2, int(width / cell_x) + 2)).astype(np.float32)
        total += gain**octave * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
    return total / max(float(total.std()), 1e-6)


def _color_image(shape: tuple[int, int], rgb: tuple[float, float, float]) -> np.ndarray:
    return np.broadcast_to(np.array(rgb, np.float32), (*shape, 3)).copy()


def _to_texture(image: np.ndarray, width_m: float, height_m: float) -> Texture:
    return Texture(np.clip(image, 0, 255).astype(np.uint8), width_m, height_m)


def plain(rgb: tuple[float, float, float]) -> Texture:
    """One colour without any detail: what makes real rooms hard."""
    return _to_texture(_color_image((8, 8), rgb), 1.0, 1.0)


def plaster(
    rng: np.random.Generator,
    width_m: float,
    height_m: float,
    density: float,
    rgb: tuple[float, float, float],
    contrast: float = 9.0,
) -> Texture:
    """Matt paint with blotches, grain and a few specks."""
    shape = _shape(width_m, height_m, density)
    image = _color_image(shape, rgb)
    image += contrast * octave_noise(rng, shape, (0.25 * density, 0.25 * density), 7, 0.75)[..., None]
    specks = (rng.random(shape) > 1 - 0.00035 * (400 / density) ** 2).astype(np.uint8)
    image -= (
        4
        * contrast
        * cv2.GaussianBlur(cv2.dilate(specks, np.ones((3, 3))).astype(np.float32), (0, 0), 0.8)[..., None]
    )
    return _to_texture(image, width_m, height_m)


def wood(
    rng: np.random.Generator,
    width_m: float,
    height_m: float,
    density: float,
    rgb: tuple[float, float, float],
    boards: float = 0.0,
) -> Texture:
    """Wood with grain along u; `boards` (metres) cuts it into planks of that width with staggered ends."""
    shape = _shape(width_m, height_m, density)
    base = np.array(rgb, np.float32)
    grain = octave_noise(rng, shape, (0.5 * density, 0.02 * density), 6, 0.75)
    flow = octave_noise(rng, shape, (0.4 * density, 0.08 * density), 3)
    rings = np.sin(9.0 * flow + 2.0 * grain)
    image = base * (1 + 0.10 * grain + 0.09 * rings)[..., None]
    knots = rng.uniform((0, 0), (shape[1], shape[0]), (int(width_m * height_m * 10) + 2, 2))
    for x, y in knots:
        size = (int(rng.uniform(0.008, 0.02) * density), int(rng.uniform(0.005, 0.011) * density))
        cv2.ellipse(image, (int(x), int(y)), size, 0, 0, 360, (base * 0.52).tolist(), -1, cv2.LINE_AA)
        cv2.ellipse(
            image,
            (int(x), int(y)),
            (size[0] * 2, size[1] * 2),
            0,
            0,
            360,
            (base * 0.72).tolist(),
            1,
            cv2.LINE_AA,
        )
    if boards > 0:
        _cut_into_boards(rng, image, boards * density)
    return _to_texture(image, width_m, height_m)


def _cut_into_boards(rng: np.random.Generator, image: np.ndarray, board_px: float) -> None:
    height, width = image.shape[:2]
    rows = max(1, round(height / board_px))
    edges = np.linspace(0, height, rows + 1).astype(int)
    for top, bottom in pairwise(edges):
        x = int(rng.uniform(0, 6 * board_px))
        start = 0
        while start < width:
            image[top:bottom, start:x] *= rng.uniform(0.78, 1.16) * rng.uniform(0.96, 1.04, 3).astype(
                np.float32
            )
            image[top:bottom, max(x - 1, 0) : x + 1] *= 0.45
            start, x = x, x + int(rng.uniform(5, 11) * board_px)
        image[top : top + 2] *= 0.45


def tiles(
    rng: np.random.Generator,
    width_m: float,
    height_m: float,
    density: float,
    tile_m: float,
    rgb: tuple[float, float, float],
) -> Texture:
    """Stone tiles of varying tone with grout lines."""
    shape = _shape(width_m, height_m, density)
    image = _color_image(shape, rgb)
    step = tile_m * density
    for row in range(int(shape[0] / step) + 1):
        for column in range(int(shape[1] / step) + 1):
            y, x = int(row * step), int(column * step)
            image[y : int(y + step), x : int(x + step)] *= rng.uniform(0.85, 1.1)
    image += 12 * octave_noise(rng, shape, (0.2 * density, 0.12 * density), 7, 0.8)[..., None]
    for k in range(int(max(shape) / step) + 1):
        image[int(k * step) : int(k * step) + 3] *= 0.6
        image[:, int(k * step) : int(k * step) + 3] *= 0.6
    return _to_texture(image, width_m, height_m)


def wallpaper(
    rng: np.random.Generator, width_m: float, height_m: float, density: float, rgb: tuple[float, float, float]
) -> Texture:
    """Leaves and dots scattered at random (a lattice would mislead matching) over faint stripes."""
    shape = _shape(width_m, height_m, density)
    image = _color_image(shape, rgb)
    stripes = np.sin(np.arange(shape[1]) * 2 * np.pi / (0.12 * density)) > 0
    image[:, stripes] *= 0.965
    base = np.array(rgb, np.float32)
    inks = [base * 0.72, base * (0.6, 0.8, 0.7), base * (0.95, 0.75, 0.65), base * 1.12]
    for _ in range(int(width_m * height_m * 90)):
        x, y = int(rng.uniform(0, shape[1])), int(rng.uniform(0, shape[0]))
        length, angle = rng.uniform(0.012, 0.045) * density, rng.uniform(0, 360)
        ink = inks[rng.integers(len(inks))].tolist()
        axes = (max(int(length), 1), max(int(length * rng.uniform(0.18, 0.45)), 1))
        cv2.ellipse(image, (x, y), axes, angle, 0, 360, ink, -1, cv2.LINE_AA)
        tip = (
            int(x + 1.8 * length * np.cos(np.radians(angle))),
            int(y + 1.8 * length * np.sin(np.radians(angle))),
        )
        cv2.line(image, (x, y), tip, (base * 0.6).tolist(), max(1, int(density / 300)), cv2.LINE_AA)
    image += 4 * octave_noise(rng, shape, (0.1 * density, 0.1 * density), 6, 0.8)[..., None]
    return _to_texture(image, width_m, height_m)


def cardboard(
    rng: np.random.Generator, width_m: float, height_m: float, density: float, text: str = ""
) -> Texture:
    """Corrugated board with flutes, stains and, where given, a stencil print."""
    shape = _shape(width_m, height_m, density)
    image = _color_image(shape, (186, 146, 98))
    image += 9 * octave_noise(rng, shape, (0.1 * density, 0.02 * density), 7, 0.8)[..., None]
    image += 5 * np.sin(np.arange(shape[0]) * 2 * np.pi / max(0.008 * density, 3.0))[:, None, None]
    if text:
        _print_lines(
            image,
            [text, "THIS SIDE UP", f"No. {rng.integers(1000, 9999)}"],
            (0.08, 0.2, 0.92, 0.8),
            (70, 52, 40),
        )
    return _to_texture(image, width_m, height_m)


def _print_lines(
    image: np.ndarray, lines: list[str], box: tuple[float, float, float, float], ink: tuple[float, ...]
) -> None:
    """Print lines of text that fill a box (x0, y0, x1, y1, in shares of the image)."""
    height, width = image.shape[:2]
    x0, y0, x1, y1 = box[0] * width, box[1] * height, box[2] * width, box[3] * height
    line_height = (y1 - y0) / len(lines)
    mask = np.zeros((height, width), np.uint8)  # OpenCV 5 prints on bytes only
    for number, line in enumerate(lines):
        (text_width, text_height), _ = cv2.getTextSize(line, cv2.FONT_HERSHEY_DUPLEX, 1.0, 1)
        scale = min((x1 - x0) / text_width, 0.75 * line_height / text_height)
        at = (int(x0 + 0.5 * (x1 - x0 - scale * text_width)), int(y0 + (number + 0.85) * line_height))
        cv2.putText(
            mask, line, at, cv2.FONT_HERSHEY_DUPLEX, scale, 255, max(1, round(2 * scale)), cv2.LINE_AA
        )
    share = mask[..., None].astype(np.float32) / 255
    image[:] = (1 - share) * image + share * np.array(ink, np.float32)


def label(
    rng: np.random.Generator, width_m: float, height_m: float, density: float,
    rgb: tuple[float, float, float], lines: tuple[str, ...], repeats: int = 1,
) -> Texture:  # fmt: skip
    """A printed package: bands, a title, small print, dots and a bar code, `repeats` times around."""
    shape = _shape(width_m, height_m, density)
    image = _color_image(shape, rgb)
    base = np.array(rgb, np.float32)
    dark, light = (base * 0.35).tolist(), (255 - 0.25 * (255 - base)).tolist()
    image[: int(0.14 * shape[0])] = dark
    image[int(0.9 * shape[0]) :] = light
    panel = shape[1] / repeats
    for number in range(repeats):
        x = int(number * panel)
        view = image[:, x : int((number + 1) * panel)]
        size = view.shape[1]
        for _ in range(14):
            center = (int(rng.uniform(0, size)), int(rng.uniform(0.15, 0.88) * shape[0]))
            tone = (base * rng.uniform(0.55, 1.25, 3)).tolist()
            cv2.circle(
                view, center, int(rng.uniform(0.02, 0.09) * min(size, shape[0])), tone, -1, cv2.LINE_AA
            )
        cv2.rectangle(
            view,
            (int(0.06 * size), int(0.18 * shape[0])),
            (int(0.94 * size), int(0.62 * shape[0])),
            light,
            -1,
        )
        _print_lines(view, list(lines), (0.1, 0.2, 0.9, 0.6), tuple(dark))
        small = ["".join(rng.choice(list("abcdefghijklmno rstuvw"), 26)) for _ in range(4)]
        _print_lines(view, small, (0.06, 0.66, 0.62, 0.88), (30, 30, 40))
        bars = np.repeat(rng.random(24) > 0.5, max(int(0.3 * size / 24), 1))[: int(0.3 * size)]
        code = view[
            int(0.68 * shape[0]) : int(0.86 * shape[0]), int(0.66 * size) : int(0.66 * size) + len(bars)
        ]
        code[:] = np.where(bars[: code.shape[1], None], 25.0, 245.0)
    image += 2.5 * octave_noise(rng, shape, (16, 16), 4, 0.8)[..., None]
    return _to_texture(image, width_m, height_m)


def glaze(
    rng: np.random.Generator, width_m: float, height_m: float, density: float, rgb: tuple[float, float, float]
) -> Texture:
    """Speckled ceramic with brushed rings."""
    shape = _shape(width_m, height_m, density)
    image = _color_image(shape, rgb)
    image += 6 * octave_noise(rng, shape, (0.05 * density, 0.01 * density), 5, 0.8)[..., None]
    ink = (np.array(rgb) * 0.45).tolist()
    for _ in range(int(width_m * height_m * 16000) + 20):
        center = (int(rng.uniform(0, shape[1])), int(rng.uniform(0, shape[0])))
        cv2.circle(image, center, max(1, int(rng.uniform(0.0006, 0.0022) * density)), ink, -1, cv2.LINE_AA)
    return _to_texture(image, width_m, height_m)


def picture(rng: np.random.Generator, width_m: float, height_m: float, density: float) -> Texture:
    """A painted landscape: sky, sun, ridges, fields of brush strokes."""
    shape = _shape(width_m, height_m, density)
    rise = np.linspace(0, 1, shape[0], dtype=np.float32)[:, None, None]
    image = (1 - rise) * np.array((92, 142, 205), np.float32) + rise * np.array((238, 205, 160), np.float32)
    image = np.broadcast_to(image, (*shape, 3)).copy()
    cv2.circle(
        image,
        (int(0.72 * shape[1]), int(0.27 * shape[0])),
        int(0.08 * shape[0]),
        (250, 238, 190),
        -1,
        cv2.LINE_AA,
    )
    columns = np.arange(shape[1])
    for layer, tone in enumerate([(120, 128, 160), (86, 112, 104), (70, 96, 52), (150, 118, 54)]):
        ridge = octave_noise(rng, (1, shape[1]), (shape[1] / 3, 1), 5)[0] * 0.05 * shape[0]
        top = ((0.45 + 0.13 * layer) * shape[0] + ridge).astype(int)
        mask = np.arange(shape[0])[:, None] > top[None]
        image[mask] = np.array(tone, np.float32)
        for x in rng.choice(columns, 220):
            y = int(rng.uniform(min(top[x], shape[0] - 2), shape[0]))
            stroke = (np.array(tone) * rng.uniform(0.65, 1.35, 3)).tolist()
            end = (int(x + rng.uniform(-0.02, 0.02) * shape[1]), int(y + rng.uniform(0, 0.05) * shape[0]))
            cv2.line(image, (int(x), y), end, stroke, max(1, int(0.003 * density)), cv2.LINE_AA)
    return _to_texture(image, width_m, height_m)
