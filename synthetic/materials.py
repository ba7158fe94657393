"""Other materials for a furnished room: photographs, text, noise, blank and dark paint, gloss, gradients.

`repaint` draws them at random, so that what learns from films of such rooms meets more than one painter's prints.
Shapes and texture coordinates stay as they are; only textures change.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np

from synthetic import textures
from synthetic.model_library import PREFIX as MODELS
from synthetic.room import Room
from synthetic.textures import Texture, octave_noise

_MOST_TEXELS = 700_000  # of one texture: time and memory
_MODELS_KEPT = 0.85  # share of the models that keep their own look
_BASE_DENSITY, _THING_DENSITY = 340.0, 1100.0  # texels per metre


@dataclass(frozen=True)
class Finish:
    """How a surface shines."""

    gloss: float = 0.0
    """0: matt; 1: as polished stone or glass."""
    sharpness: float = 60.0
    """Power of the highlight: 10 for satin, 60 for varnish, 600 for polish."""


@dataclass(frozen=True)
class MaterialMix:
    """How often each family of materials is drawn; weights need no sum. 0 holds a family out."""

    print: float = 1.0
    """What the room's makers painted."""
    photograph: float = 1.0
    """Pieces of photographs; without photographs none."""
    text: float = 0.5
    """Pages, posters."""
    noise: float = 1.0
    """Octaves of noise, marble, terrazzo, weave, carpet, stripes, checks, dots."""
    blank: float = 1.6
    """Plain paint, at most with faint blotches."""
    dark: float = 0.5
    """Nearly black."""
    gloss: float = 0.7
    """Plain and shining; also lets other families shine."""
    gradient: float = 0.4
    """From one color into another."""
    wood: float = 0.7
    tiles: float = 0.4

    def without(self, *families: str) -> "MaterialMix":
        """Return the mix with these families held out."""
        return replace(self, **{name: 0.0 for name in families})


FAMILIES: tuple[str, ...] = tuple(f.name for f in fields(MaterialMix))

_LIKED = {
    "wall": {"print": 0.5, "photograph": 0.35, "text": 0.1, "noise": 0.5, "blank": 4.0, "dark": 0.5,
             "gloss": 0.4, "gradient": 0.8, "wood": 0.3, "tiles": 0.5},
    "floor": {"print": 0.7, "photograph": 0.5, "text": 0.0, "noise": 1.3, "blank": 0.9, "dark": 0.7,
              "gloss": 1.2, "gradient": 0.3, "wood": 2.5, "tiles": 2.5},
    "furniture": {"print": 0.6, "photograph": 0.35, "text": 0.15, "noise": 0.8, "blank": 1.6, "dark": 1.2,
                  "gloss": 1.4, "gradient": 0.4, "wood": 3.0, "tiles": 0.2},
    "thing": {"tiles": 0.15, "photograph": 1.5},
}  # fmt: skip
_GLOSS_OF = {"print": 0.25, "photograph": 0.3, "text": 0.2, "noise": 0.15, "blank": 0.12, "dark": 0.5,
             "gradient": 0.4, "wood": 0.4, "tiles": 0.5}  # fmt: skip


def repaint(
    room: Room,
    rng: np.random.Generator,
    mix: MaterialMix | None = None,
    photographs: Sequence[np.ndarray] | None = None,
) -> tuple[Room, dict[str, Finish]]:
    """Draw new materials for a room.

    Args:
        room: Furnished; it stays as it is.
        rng: Draws everything.
        mix: How often each family is drawn.
        photographs: uint8 (h, w, 3) each, as from `photographs.load_photographs`; None: no photographs.

    Returns:
        The room with other textures, and the finish of those that shine, for `film.prepare`.
    """
    mix = mix or MaterialMix()
    painter = _Painter(rng, tuple(photographs or ()))
    looks, finishes = dict(room.textures), {}
    walls_alike = None
    for entity in room.entities:
        names = sorted({p.texture for p in entity.patches} - {"edge"})
        if not names or (entity.name.startswith(f"{MODELS}_") and rng.random() < _MODELS_KEPT):
            continue
        role = "thing"
        if entity.base:
            role = "floor" if entity.name == "floor" else "wall"
        elif entity.fixed and entity.relation == "supported_by":
            role = "furniture"
        together = rng.random() < (0.85 if role == "furniture" else 0.45)
        shared = _draw_family(rng, mix, role, painter)
        tone = painter.tone(role)
        if role == "wall":
            if walls_alike is None:
                walls_alike = (shared, tone) if rng.random() < 0.6 else ()
            if walls_alike and rng.random() < 0.8:
                shared, tone = walls_alike
        for name in names:
            family = shared if together or role == "wall" else _draw_family(rng, mix, role, painter)
            old = room.textures[name]
            if family != "print":
                if not together:
                    tone = painter.tone(role)
                looks[name] = painter.paint(family, role, _size(old, entity, role), tone)
            finish = _draw_finish(rng, family, role, mix)
            if finish is not None:
                finishes[name] = finish
    return replace(room, textures=looks), finishes


def _draw_family(rng: np.random.Generator, mix: MaterialMix, role: str, painter: "_Painter") -> str:
    weights = np.array([getattr(mix, name) * _LIKED[role].get(name, 1.0) for name in FAMILIES])
    if not painter.photographs:
        weights[FAMILIES.index("photograph")] = 0.0
    draw = rng.random()
    if weights.sum() <= 0:
        return "print"
    return FAMILIES[int(np.searchsorted(np.cumsum(weights) / weights.sum(), draw))]


def _draw_finish(rng: np.random.Generator, family: str, role: str, mix: MaterialMix) -> Finish | None:
    gloss, sharpness = float(rng.uniform(0.35, 1.0)), float(np.exp(rng.uniform(np.log(12), np.log(900))))
    draw = rng.random()
    if family == "gloss":
        return Finish(gloss, max(sharpness, 40.0))
    share = _GLOSS_OF[family] * min(mix.gloss, 1.0) * (0.4 if role == "wall" else 1.0)
    if draw >= share:
        return None
    return Finish(0.6 * gloss, sharpness)


def _size(old: Texture, entity, role: str) -> tuple[float, float]:
    """Return the size in metres that a new texture should cover: that of the old one, unless it was plain."""
    if old.pixels.shape[0] > 8 or old.pixels.shape[1] > 8:
        return old.width_m, old.height_m
    if role in ("wall", "floor"):
        spans = sorted(entity.size)[1:]
        if role == "wall":
            return max(entity.size[:2]), entity.size[2]
        return spans[1], spans[0]
    reach = float(np.clip(max(entity.size), 0.1, 1.0))
    return reach, reach


class _Painter:
    """Makes textures of every family."""

    def __init__(self, rng: np.random.Generator, photographs: tuple[np.ndarray, ...]) -> None:
        self.rng = rng
        self.photographs = photographs

    def tone(self, role: str) -> np.ndarray:
        """Draw a color: walls mostly pale, floors gray or brown, things of any color, many white or gray."""
        rng = self.rng
        hue, draw = rng.uniform(0, 360), rng.random()
        if role == "wall":
            value = rng.uniform(190, 245) if draw < 0.8 else rng.uniform(60, 190)
            strength = rng.uniform(0, 0.08) if rng.random() < 0.7 else rng.uniform(0.1, 0.5)
            hue = rng.uniform(20, 60) if rng.random() < 0.5 else hue
        elif role == "floor":
            value = rng.uniform(60, 215)
            strength = rng.uniform(0, 0.1) if draw < 0.5 else rng.uniform(0.1, 0.5)
            hue = rng.uniform(10, 50) if rng.random() < 0.8 else hue
        elif role == "furniture":
            value = rng.uniform(185, 245) if draw < 0.35 else rng.uniform(40, 225)
            strength = rng.uniform(0, 0.12) if rng.random() < 0.65 else rng.uniform(0.1, 0.6)
            hue = rng.uniform(10, 50) if rng.random() < 0.4 else hue
        else:
            value = rng.uniform(185, 245) if draw < 0.35 else rng.uniform(40, 245)
            strength = rng.uniform(0, 0.1) if draw < 0.55 else rng.uniform(0.1, 0.85)
        return _rgb(hue, strength, value)

    def paint(self, family: str, role: str, size: tuple[float, float], tone: np.ndarray) -> Texture:
        """Paint a texture of this family for a surface of this size in metres."""
        most = _BASE_DENSITY if role in ("wall", "floor") else _THING_DENSITY
        density = float(np.clip(np.sqrt(_MOST_TEXELS / (size[0] * size[1])), 40, most))
        maker = getattr(self, f"_{family}")
        image = maker(size, density, tone, role)
        if isinstance(image, Texture):
            return image
        return Texture(np.clip(image, 0, 255).astype(np.uint8), *size)

    def _blank(self, size, density, tone, role):
        draw = self.rng.random()
        if draw < 0.4:
            return textures.plain(tuple(tone.tolist()))
        shape = _texels(size, min(density, 60.0))
        strength = self.rng.uniform(0.6, 3.0)
        cell = self.rng.uniform(0.15, 0.5) * min(density, 60.0) * min(max(size), 2.0)
        image = tone + strength * octave_noise(self.rng, shape, (cell, cell), 2)[..., None]
        if role != "wall" or draw < 0.75:
            return image
        # A rolled wall: a very faint fine grain.
        shape = _texels(size, density)
        image = cv2.resize(image.astype(np.float32), shape[::-1])
        grain = cv2.resize(_normal(self.rng, (shape[0] // 2 + 1, shape[1] // 2 + 1)), shape[::-1])
        return image + self.rng.uniform(0.5, 2.5) * grain[..., None]

    def _gloss(self, size, density, tone, role):
        if self.rng.random() < 0.3:
            tone = tone * self.rng.uniform(0.1, 0.4)
        return self._blank(size, density, tone, "thing")

    def _dark(self, size, density, tone, role):
        base = self.rng.uniform(4, 38) * (0.8 + 0.4 * tone / max(float(tone.max()), 1.0))
        if self.rng.random() < 0.5:
            return textures.plain(tuple(base.tolist()))
        shape = _texels(size, density)
        cell = self.rng.uniform(0.01, 0.2) * density
        return base + self.rng.uniform(0.8, 5.0) * octave_noise(self.rng, shape, (cell, cell), 4)[..., None]

    def _gradient(self, size, density, tone, role):
        shape = _texels(size, min(density, 120.0))
        other = self.tone(role)
        if self.rng.random() < 0.5:  # rather a change of brightness
            other = np.clip(tone * self.rng.uniform(0.4, 1.6), 0, 255)
        y, x = np.mgrid[0 : 1 : shape[0] * 1j, 0 : 1 : shape[1] * 1j].astype(np.float32)
        if self.rng.random() < 0.5:
            turn = self.rng.uniform(0, 2 * np.pi)
            share = 0.5 + (np.cos(turn) * (x - 0.5) + np.sin(turn) * (y - 0.5)) / 1.3
        else:
            cx, cy = self.rng.uniform(0, 1, 2)
            share = np.sqrt((x - cx) ** 2 + (y - cy) ** 2) / self.rng.uniform(0.5, 1.2)
        share = np.clip(share, 0, 1)[..., None]
        return (1 - share) * tone + share * other

    def _wood(self, size, density, tone, role):
        hue, strength, value = (
            self.rng.uniform(16, 40),
            self.rng.uniform(0.2, 0.65),
            self.rng.uniform(60, 225),
        )
        color = _rgb(hue, strength, value)
        boards = 0.0
        if role == "floor" or self.rng.random() < 0.3:
            boards = float(self.rng.uniform(0.06, 0.2))
        full = textures.wood(self.rng, *size, density, tuple(color.tolist()), boards=boards)
        keep = self.rng.uniform(0.25, 1.1)  # many real surfaces show little grain
        mean = full.pixels.reshape(-1, 3).mean(0)
        return _mixed(full.pixels, mean, keep)

    def _tiles(self, size, density, tone, role):
        rng = self.rng
        shape = _texels(size, density)
        tile = np.array([rng.uniform(0.08, 0.6), 0.0])
        tile[1] = tile[0] * (1.0 if rng.random() < 0.6 else rng.uniform(0.4, 2.5))
        if role not in ("wall", "floor"):
            tile *= 0.3
        rows, columns = (max(round(s / t), 1) for s, t in zip(reversed(size), tile))
        spread = rng.uniform(0, 0.1)
        grid = (1 + spread * _normal(rng, (rows, columns)))[..., None] * tone
        if rng.random() < 0.25:  # a chessboard
            other = self.tone(role)
            odd = (np.add.outer(np.arange(rows), np.arange(columns)) % 2)[..., None]
            grid = np.where(odd, grid, other)
        image = cv2.resize(grid.astype(np.float32), shape[::-1], interpolation=cv2.INTER_NEAREST)
        cell = rng.uniform(0.05, 0.4) * density
        image += (
            rng.uniform(0, 8) * octave_noise(rng, shape, (cell, cell * rng.uniform(0.3, 1)), 4)[..., None]
        )
        wide = max(1, round(rng.uniform(0.002, 0.006) * density))
        grout = float(rng.uniform(0.5, 0.95)) if rng.random() < 0.8 else 1.15
        for k in range(rows):
            at = int(k * shape[0] / rows)
            image[at : at + wide] *= grout
        for k in range(columns):
            at = int(k * shape[1] / columns)
            image[:, at : at + wide] *= grout
        return image

    def _photograph(self, size, density, tone, role):
        rng = self.rng
        photo = self.photographs[int(rng.integers(len(self.photographs)))]
        height, width = photo.shape[:2]
        shape = _texels(size, density)
        # A piece of any size; of large surfaces a repeating one, as on cloth and wallpaper.
        repeat = 1
        if max(size) > 1.2 and rng.random() < 0.6:
            repeat = int(rng.integers(2, 5))
        want = shape[1] / shape[0]
        share = rng.uniform(0.35, 1.0)
        high = int(min(height, width / want) * share)
        wide = int(min(width, height * want) * share)
        high, wide = max(high, 8), max(wide, 8)
        y, x = int(rng.integers(height - high + 1)), int(rng.integers(width - wide + 1))
        piece = photo[y : y + high, x : x + wide]
        if rng.random() < 0.5:
            piece = piece[:, ::-1]
        to = (max(shape[1] // repeat, 8), max(shape[0] // repeat, 8))
        # Never much finer than the photograph is.
        scale = min(1.0, 1.5 * max(high / to[1], wide / to[0]))
        to = (max(round(to[0] * scale), 8), max(round(to[1] * scale), 8))
        image = cv2.resize(np.ascontiguousarray(piece), to, interpolation=cv2.INTER_AREA).astype(np.float32)
        if rng.random() < 0.4:
            gray = image.mean(2, keepdims=True)
            image = gray + rng.uniform(0, 0.8) * (image - gray)
        if rng.random() < 0.5:
            image *= 1 + rng.uniform(0, 0.6) * (tone / max(float(tone.mean()), 1.0) - 1)
        contrast = rng.uniform(0.35, 1.1)
        level = float(image.mean())
        image = (image - level) * contrast + np.clip(level * rng.uniform(0.7, 1.5), 40, 210)
        return np.tile(image, (repeat, repeat, 1)) if repeat > 1 else image

    def _text(self, size, density, tone, role):
        rng = self.rng
        shape = _texels(size, density)
        paper = tone if rng.random() < 0.4 else _rgb(rng.uniform(0, 360), rng.uniform(0, 0.08), 240)
        dark = float(paper.mean()) > 110
        ink = _rgb(rng.uniform(0, 360), rng.uniform(0, 0.9), rng.uniform(5, 90) if dark else 235)
        mask = np.zeros(shape, np.uint8)
        fonts = (cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_COMPLEX,
                 cv2.FONT_HERSHEY_TRIPLEX)  # fmt: skip
        image = np.broadcast_to(paper.astype(np.float32), (*shape, 3)).copy()
        poster = rng.random() < 0.45
        y = 0.06 * shape[0]
        lines = 0
        while y < 0.95 * shape[0] and lines < 70:
            lines += 1
            high = (rng.uniform(0.05, 0.2) if poster else rng.uniform(0.02, 0.03)) * min(shape)
            high = max(high, 5.0)
            font = fonts[int(rng.integers(len(fonts)))] if poster or lines == 1 else fonts[0]
            if not poster and lines == 1:
                high *= 2
            letters = "".join(rng.choice(list("abcdefghijklmnoprstuvwxyzAEKMRST0123456789     "), 60))
            (wide, _), _ = cv2.getTextSize(letters, font, high / 24, 1)
            keep = int(60 * min(1.0, rng.uniform(0.5, 0.92) * shape[1] / max(wide, 1)))
            at = (int(rng.uniform(0.03, 0.1) * shape[1]), int(y + high))
            cv2.putText(
                mask, letters[: max(keep, 1)], at, font, high / 24, 255, max(1, round(high / 14)), cv2.LINE_AA
            )
            y += high * rng.uniform(1.4, 2.2)
            if poster and rng.random() < 0.3:
                corner = (int(rng.uniform(0, 0.6) * shape[1]), int(y))
                end = (
                    int(corner[0] + rng.uniform(0.1, 0.6) * shape[1]),
                    int(y + rng.uniform(0.05, 0.3) * shape[0]),
                )
                cv2.rectangle(image, corner, end, self.tone("thing").tolist(), -1)
                y = end[1] + 0.02 * shape[0]
        share = mask[..., None].astype(np.float32) / 255
        return image + share * (ink.astype(np.float32) - image)

    def _noise(self, size, density, tone, role):
        makers = (self._cloud, self._marble, self._terrazzo, self._weave, self._carpet, self._stripes, self._checks,
                  self._dots)  # fmt: skip
        weights = np.array([1.5, 1.0, 1.0, 1.2, 1.5, 0.8, 0.7, 0.8])
        if role in ("wall", "floor"):
            weights *= (1.5, 0.8, 1.0, 0.6, 2.0 if role == "floor" else 0.5, 0.6, 0.4, 0.4)
        maker = makers[int(self.rng.choice(len(makers), p=weights / weights.sum()))]
        return maker(_texels(size, density), density, tone, role)

    def _cloud(self, shape, density, tone, role):
        rng = self.rng
        cell = np.exp(rng.uniform(np.log(0.01), np.log(0.5))) * density
        flat = np.exp(rng.uniform(-1.2, 1.2))
        noise = octave_noise(
            rng,
            shape,
            (max(cell * flat, 2), max(cell / flat, 2)),
            int(rng.integers(1, 7)),
            rng.uniform(0.4, 0.95),
        )
        tilt = rng.uniform(-1, 1, 3) * 0.3 + 1
        return tone + rng.uniform(3, 26) * noise[..., None] * tilt

    def _marble(self, shape, density, tone, role):
        rng = self.rng
        cell = rng.uniform(0.15, 0.6) * density
        veins = np.abs(octave_noise(rng, shape, (cell, cell), 5, 0.6))
        share = np.exp(-(veins**2) / rng.uniform(0.005, 0.06))[..., None] * rng.uniform(0.2, 0.9)
        other = tone * rng.uniform(0.4, 0.8) if tone.mean() > 90 else np.clip(tone + 120, 0, 255)
        clouds = octave_noise(rng, shape, (cell, cell), 3)[..., None] * rng.uniform(1, 7)
        return tone + clouds + share * (other - tone)

    def _terrazzo(self, shape, density, tone, role):
        rng = self.rng
        image = np.broadcast_to(tone.astype(np.float32), (*shape, 3)).copy()
        inks = [np.clip(tone + rng.normal(0, 45, 3), 0, 255).tolist() for _ in range(5)]
        reach = rng.uniform(0.004, 0.02) * density
        for _ in range(int(min(shape[0] * shape[1] / max(reach, 1.5) ** 2 / 9, 2500))):
            at = (int(rng.integers(shape[1])), int(rng.integers(shape[0])))
            axes = (max(int(reach * rng.uniform(0.3, 1.2)), 1), max(int(reach * rng.uniform(0.3, 1.0)), 1))
            cv2.ellipse(image, at, axes, rng.uniform(0, 180), 0, 360, inks[int(rng.integers(5))], -1)
        return image

    def _weave(self, shape, density, tone, role):
        rng = self.rng
        thread = max(rng.uniform(0.0015, 0.01) * density, 2.5)
        x = np.sin(np.arange(shape[1], dtype=np.float32) * 2 * np.pi / thread)
        y = np.sin(np.arange(shape[0], dtype=np.float32) * 2 * np.pi / (thread * rng.uniform(0.7, 1.4)))
        pattern = np.multiply.outer(y, x) + 0.4 * octave_noise(rng, shape, (0.1 * density, 0.02 * density), 3)
        return tone * (1 + rng.uniform(0.03, 0.14) * pattern[..., None])

    def _carpet(self, shape, density, tone, role):
        rng = self.rng
        grain = cv2.GaussianBlur(_normal(rng, shape), (0, 0), rng.uniform(0.6, 1.6))
        grain /= grain.std()
        blotch = octave_noise(rng, shape, (0.4 * density, 0.4 * density), 3)
        return tone + (rng.uniform(3, 20) * grain + rng.uniform(0, 5) * blotch)[..., None]

    def _stripes(self, shape, density, tone, role):
        rng = self.rng
        colors = [tone, self.tone(role), np.clip(tone * rng.uniform(0.6, 1.3), 0, 255)]
        along = int(rng.integers(2))
        line = np.zeros((shape[along], 3), np.float32)
        start, widths = 0, [max(int(rng.uniform(0.006, 0.12) * density), 2) for _ in range(4)]
        for k in range(100_000):
            if start >= len(line):
                break
            line[start : start + widths[k % 4]] = colors[(k % 4) % 3]
            start += widths[k % 4]
        image = np.broadcast_to(line[:, None] if along == 0 else line[None], (*shape, 3))
        return _mixed(image, tone.astype(np.float32), rng.uniform(0.25, 1.0))

    def _checks(self, shape, density, tone, role):
        rng = self.rng
        cell = max(rng.uniform(0.01, 0.12) * density, 3)
        x = ((np.arange(shape[1]) / cell).astype(int) % 2).astype(np.float32)
        y = ((np.arange(shape[0]) / cell).astype(int) % 2).astype(np.float32)
        both = (
            np.add.outer(y, x)[..., None] / 2
            if rng.random() < 0.6
            else np.abs(np.subtract.outer(y, x))[..., None]
        )
        other = self.tone(role)
        return tone + rng.uniform(0.2, 1.0) * both * (other - tone)

    def _dots(self, shape, density, tone, role):
        rng = self.rng
        image = np.broadcast_to(tone.astype(np.float32), (*shape, 3)).copy()
        step = max(rng.uniform(0.015, 0.12) * density, 7)
        radius, ink, loose = step * rng.uniform(0.12, 0.4), self.tone("thing").tolist(), rng.uniform(0, 0.5)
        for row in range(min(int(shape[0] / step) + 1, 70)):
            for column in range(min(int(shape[1] / step) + 1, 70)):
                x, y = (np.array([column + 0.5 * (row % 2), row]) + loose * rng.uniform(-1, 1, 2)) * step
                cv2.circle(image, (int(x), int(y)), max(int(radius), 1), ink, -1, cv2.LINE_AA)
        return image


def _texels(size: tuple[float, float], density: float) -> tuple[int, int]:
    return max(9, round(size[1] * density)), max(9, round(size[0] * density))


def _normal(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return rng.standard_normal(shape, np.float32)


def _mixed(image: np.ndarray, mean: np.ndarray, keep: float) -> np.ndarray:
    """Keep a share of an image's contrast around a color."""
    return mean + np.float32(keep) * (image.astype(np.float32) - mean)


def _rgb(hue: float, strength: float, value: float) -> np.ndarray:
    """Return a color 0..255 of a hue in degrees, a saturation 0..1 and a brightness 0..255."""
    turns = (np.array([5.0, 3.0, 1.0]) + hue / 60) % 6
    return value - value * strength * np.clip(np.minimum(turns, 4 - turns), 0, 1)
