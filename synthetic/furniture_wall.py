"""What belongs to walls: curtains, shelves, frames, radiators, doors, windows, boards, devices.

The back is at y = 0, the front faces -y, the bottom is at z = 0. `HANG_M` says how high each may hang.
"""

import numpy as np

from synthetic import textures
from synthetic.footprints import rectangle
from synthetic.furniture import Workshop
from synthetic.furniture_kit import OVERLAP_M, Carpenter, slab
from synthetic.textures import Texture
from synthetic.things import Kind, Place, Thing


def _frame(c: Carpenter, width: float, height: float, bar: float, depth: float, look: str = "*") -> None:
    """Four bars around an opening."""
    for sign in (-1, 1):
        c.box((bar, depth, height), sign * (width - bar) / 2, -depth / 2, 0, look, upright=False)
        size = (width - 2 * bar + 2 * OVERLAP_M, depth - 0.001, bar)
        c.box(size, 0, -(depth - 0.001) / 2, 0 if sign < 0 else height - bar, look)


def make_curtain(shop: Workshop, name: str) -> Thing:
    """A curtain in folds below a rod."""
    c = Carpenter(shop, name)
    width, height, fold = c.between(0.5, 1.3), c.between(1.2, 2.1), c.between(0.012, 0.035)
    count, phase, thick = round(width / c.between(0.07, 0.15)), c.between(0, 6), 0.005
    c.look |= {"*": c.cloth(1.0, 1.4), "rod": c.metal()}
    x = np.linspace(-0.5, 0.5, 8 * count + 1)
    z = np.linspace(0, 1, 11)
    turn = 2 * np.pi * count * (x + 0.04 * np.sin(2 * np.pi * (x + phase)))
    swell = 0.55 + 0.45 * (1 - z[:, None]) + 0.12 * np.sin(5 * z[:, None] + phase + 6 * x[None])
    wave = np.sin(turn + phase)[None] * fold * swell
    front = np.stack(
        np.broadcast_arrays(width * x[None], -0.065 - wave - thick / 2, height * z[:, None]), -1
    )  # fmt: skip
    back = front + np.array([0.0, thick, 0.0])
    length = np.concatenate([[0], np.cumsum(np.hypot(np.diff(width * x), np.diff(wave[0])))])
    uvs = np.stack(np.broadcast_arrays(length[None], height * z[:, None]), -1)
    c.add(slab(front, back, c.tex("*"), uvs))
    c.box((width + 0.16, 0.022, 0.022), 0, -0.065, height - 0.006, "rod")
    for sign in (-1, 1):
        c.box((0.02, 0.07, 0.03), sign * (width / 2 + 0.04), -0.035, height - 0.012, "rod")
    return c.finish("curtain")


def make_long_shelf(shop: Workshop, name: str) -> Thing:
    """One or two boards on brackets, or a box without front."""
    c = Carpenter(shop, name)
    width, depth, board, boxed = (
        c.between(0.5, 1.1),
        c.between(0.16, 0.26),
        c.between(0.018, 0.04),
        c.chance(0.35),
    )
    c.look |= {"*": c.board(1.0, 0.4), "leg": c.metal()}
    if boxed:
        high, y = c.between(0.22, 0.34), -depth / 2
        for z in (0.0, high - board):
            c.box((width, depth, board), 0, y, z)
        for sign in (-1, 1):
            size = (board, depth, high - 2 * board + 2 * OVERLAP_M)
            c.box(size, sign * (width - board) / 2, y, board - OVERLAP_M, upright=False)
        area = rectangle(width - 2 * board, depth - 0.01, y=y - 0.005)
        top = Place(high, rectangle(width, depth - 0.01, y=y - 0.005), name="board")
        return c.finish("wall shelf", (Place(board, area, high - 2 * board, name="board"), top))
    drop = c.between(0.06, 0.16)
    places, levels = [], c.count(1, 2)
    for level in range(levels):
        z = drop + 0.34 * level
        c.box((width, depth, board), 0, -depth / 2, z)
        free = np.inf if level + 1 == levels else 0.34 - board - 0.02
        area = rectangle(width, depth - 0.01, y=-depth / 2 - 0.005)
        places.append(Place(z + board, area, free, name="board"))
    for sign in (-1, 1):
        x = sign * (width / 2 - 0.1)
        c.box((0.022, 0.016, drop + 0.34 * (levels - 1) + OVERLAP_M), x, -0.008, 0, "leg")
        for level in range(levels):
            c.box((0.022, 0.8 * depth, 0.016), x, -0.4 * depth, drop + 0.34 * level - 0.012, "leg")
    return c.finish("wall shelf", tuple(places))


def make_frame(shop: Workshop, name: str) -> Thing:
    """A framed picture, with or without a mat."""
    c = Carpenter(shop, name)
    width, height, bar, depth = (
        c.between(0.24, 0.8),
        c.between(0.24, 0.7),
        c.between(0.012, 0.06),
        c.between(0.018, 0.04),
    )
    mat = c.between(0.0, 0.07)
    c.look |= {"*": c.board(0.6, 0.3), "mat": textures.plain((232, 230, 222))}
    inner = (width - 2 * bar, height - 2 * bar)
    art = (max(inner[0] - 2 * mat, 0.05), max(inner[1] - 2 * mat, 0.05))
    c.look["art"] = _art(shop, *art)
    _frame(c, width, height, bar, depth)
    c.box((inner[0] + 0.002, 0.008, inner[1] + 0.002), 0, -0.004, bar - 0.001, "mat")
    size = (art[0], 0.006, art[1])
    c.printed(size, {"-y": "art", "*": "mat"}, 0, -0.0085, bar + (inner[1] - art[1]) / 2)
    return c.finish("picture")


def _art(shop: Workshop, width: float, height: float) -> Texture:
    """A landscape, a print, a cloth, or blotches of paint."""
    kind, density = int(shop.rng.integers(4)), 700 * shop.density
    if kind == 0:
        return textures.picture(shop.rng, width, height, density)
    rgb = tuple(float(v) for v in shop.rng.uniform(40, 230, 3))
    if kind == 1:
        return textures.label(shop.rng, width, height, density, rgb, ("GALLERY", "1974"))
    if kind == 2:
        return textures.plaster(shop.rng, width, height, density, rgb, 40)
    return textures.wallpaper(shop.rng, width, height, density, rgb)


def make_panel(shop: Workshop, name: str) -> Thing:
    """A plain bright panel as a mirror would be, round or square, framed or not."""
    c = Carpenter(shop, name)
    width, height, depth = c.between(0.35, 0.7), c.between(0.45, 1.2), c.between(0.015, 0.03)
    tone = float(shop.rng.uniform(120, 225))
    c.look |= {
        "glass": textures.plain((tone, min(tone + 6, 250), min(tone + 10, 250))),
        "*": c.board(0.6, 0.3),
    }
    if c.chance(0.35):
        r = width / 2
        c.turned([[0, 0], [r, 0], [r, depth], [0.93 * r, depth], [0, depth]], 0, 0, r, "*", 40, hang=True)
        c.turned(
            [[0, 0], [0.9 * r, 0], [0.9 * r, 0.004], [0, 0.004]], 0, -depth + 0.001, r, "glass", 40, hang=True
        )
        return c.finish("mirror")
    bar = c.between(0.01, 0.05)
    _frame(c, width, height, bar, depth)
    c.box((width - 2 * bar + 0.002, 0.01, height - 2 * bar + 0.002), 0, -0.005, bar - 0.001, "glass")
    return c.finish("mirror")


def make_radiator(shop: Workshop, name: str) -> Thing:
    """A ribbed radiator."""
    c = Carpenter(shop, name)
    height, pitch, ribs = c.between(0.4, 0.65), c.between(0.035, 0.07), c.count(8, 20)
    depth, gap, style = c.between(0.08, 0.13), 0.03, c.chance(0.5)
    c.look["*"] = c.paint(0.5, 0.5)
    width = ribs * pitch
    y = -gap - depth / 2
    for number in range(ribs):
        x = (number + 0.5) * pitch - width / 2
        if style:
            c.box((0.7 * pitch, depth, height), x, y, 0, upright=False)
        else:
            c.box((0.55 * pitch, depth, height - 0.03), x, y, 0.015, upright=False)
    for z in (0.05, height - 0.09):
        c.box((width - 0.004, 0.6 * depth, 0.035), 0, y, z)
    if not style:
        c.box((width, 0.3 * depth, height), 0, y, 0)
    for sign in (-1, 1):
        c.box((0.03, gap + 0.03, 0.03), sign * 0.35 * width, -(gap + 0.03) / 2, 0.6 * height)
    return c.finish("radiator")


def make_door(shop: Workshop, name: str) -> Thing:
    """A door in its frame, plain or with panels, with a handle."""
    c = Carpenter(shop, name)
    width, height, bar = c.between(0.78, 0.95), c.between(1.98, 2.1), c.between(0.05, 0.09)
    c.look |= {"*": c.board(0.6, 0.6), "leaf": c.board(1.0, 1.6), "knob": c.metal()}
    depth, rows = 0.035, c.count(0, 3)
    for sign in (-1, 1):
        c.box((bar, depth, height), sign * (width - bar) / 2, -depth / 2, 0, upright=False)
    c.box((width - 2 * bar + 2 * OVERLAP_M, depth - 0.001, bar), 0, -(depth - 0.001) / 2, height - bar)
    inner = width - 2 * bar
    c.box((inner - 0.006, 0.02, height - bar - 0.008), 0, -0.01, 0.003, "leaf", upright=False)
    for row in range(rows):
        high = (height - bar - 0.2) / rows
        size = (0.66 * inner, 0.008, high - 0.12)
        c.box(size, 0, -0.022, 0.14 + row * high, "leaf", upright=False)
    side = 1 if c.chance(0.5) else -1
    x = side * (inner / 2 - 0.06)
    c.box((0.03, 0.008, 0.16), x, -0.023, 0.96, "knob")
    c.box((0.016, 0.05, 0.016), x, -0.045, 1.03, "knob")
    c.box((0.12, 0.014, 0.018), x - side * 0.05, -0.067, 1.03, "knob")
    return c.finish("door")


def make_window(shop: Workshop, name: str) -> Thing:
    """A window: bright panes, a frame with bars, a sill."""
    c = Carpenter(shop, name)
    width, height, bar = c.between(0.6, 1.3), c.between(0.7, 1.15), c.between(0.035, 0.06)
    columns, rows, sill = c.count(1, 3), c.count(1, 2), c.between(0.06, 0.2)
    glow = np.array((188, 212, 240)) + shop.rng.uniform(-14, 14, 3) + float(shop.rng.uniform(-30, 14))
    c.look |= {"*": c.paint(0.6, 0.4), "pane": textures.plain(tuple(np.clip(glow, 60, 252).tolist()))}
    depth, thick = 0.045, 0.025
    base = thick - 0.002
    for sign in (-1, 1):
        c.box((bar, depth, height), sign * (width - bar) / 2, -depth / 2, base, upright=False)
        size = (width - 2 * bar + 2 * OVERLAP_M, depth - 0.001, bar)
        c.box(size, 0, -(depth - 0.001) / 2, base + (0 if sign < 0 else height - bar))
    c.box((width - 2 * bar + 0.002, 0.008, height - 2 * bar + 0.002), 0, -0.004, base + bar - 0.001, "pane")
    for x in np.linspace(-0.5, 0.5, columns + 1)[1:-1] * width:
        c.box((0.035, 0.028, height - bar), float(x), -0.014, base + bar / 2, upright=False)
    for z in np.linspace(0, 1, rows + 1)[1:-1] * height:
        c.box((width - bar, 0.026, 0.03), 0, -0.013, base + float(z))
    c.box((width + 0.08, sill, thick), 0, -sill / 2, 0)
    if sill < 0.13:
        return c.finish("window")
    room = sill - depth - 0.01
    area = rectangle(width - 0.04, room, y=-sill + room / 2)
    return c.finish("window", (Place(thick, area, name="board"),))


def make_whiteboard(shop: Workshop, name: str) -> Thing:
    """A white board in a thin frame, with some writing, and a ledge."""
    c = Carpenter(shop, name)
    width, height = c.between(0.7, 1.3), c.between(0.5, 0.85)
    cork = c.chance(0.3)
    c.look |= {"*": c.metal(), "board": _writing(shop, width, height, cork)}
    _frame(c, width, height, 0.018, 0.022)
    faces = {"-y": "board", "*": "*"}
    c.printed((width - 0.034, 0.012, height - 0.034), faces, 0, -0.006, 0.017)
    c.box((0.4 * width, 0.06, 0.012), 0, -0.03, 0.006)
    return c.finish("whiteboard")


def _writing(shop: Workshop, width: float, height: float, cork: bool) -> Texture:
    import cv2

    density = 500 * shop.density
    if cork:
        return textures.plaster(shop.rng, width, height, density, (186, 140, 94), 22)
    shape = max(8, round(height * density)), max(8, round(width * density))
    image = np.full((*shape, 3), 240, np.uint8)
    for _ in range(int(shop.rng.integers(0, 14))):
        ink = tuple(int(v) for v in shop.rng.uniform(20, 160, 3))
        points = np.cumsum(shop.rng.normal(0, 0.03, (12, 2)), axis=0) + shop.rng.uniform(0.1, 0.9, 2)
        points = (points * (shape[1], shape[0])).astype(np.int32)
        cv2.polylines(image, [points], False, ink, max(1, round(0.006 * density)), cv2.LINE_AA)
    return Texture(image, width, height)


def make_aircon(shop: Workshop, name: str) -> Thing:
    """The box of an air conditioner, or a cupboard of fuses."""
    c = Carpenter(shop, name)
    c.look |= {"*": textures.plain(shop.color((228, 228, 222))), "dark": textures.plain((60, 62, 66))}
    if c.chance(0.6):
        width, height, depth = c.between(0.7, 0.95), c.between(0.24, 0.32), c.between(0.17, 0.24)
        c.box((width, depth, height), 0, -depth / 2, 0)
        for number in range(c.count(1, 4)):
            c.box((0.86 * width, 0.02, 0.012), 0, -depth, 0.03 + 0.025 * number, "dark")
        c.box((0.96 * width, 0.012, 0.5 * height), 0, -depth - 0.004, 0.42 * height)
    else:
        width, height, depth = c.between(0.25, 0.4), c.between(0.3, 0.55), c.between(0.09, 0.14)
        c.box((width, depth, height), 0, -depth / 2, 0)
        c.box((width - 0.03, 0.014, height - 0.03), 0, -depth - 0.005, 0.015)
        c.box((0.02, 0.02, 0.05), 0.38 * width, -depth - 0.015, 0.5 * height, "dark")
    return c.finish("wall box")


WALL: dict[str, Kind] = {
    "curtain": Kind("curtain", make_curtain, fixed=True),
    "long_shelf": Kind("wall shelf", make_long_shelf, fixed=True, weight=1.3),
    "frame": Kind("picture", make_frame, fixed=True, weight=1.3),
    "panel": Kind("mirror", make_panel, fixed=True, weight=0.8),
    "radiator": Kind("radiator", make_radiator, fixed=True, weight=0.8),
    "door": Kind("door", make_door, fixed=True, weight=0.8),
    "window": Kind("window", make_window, fixed=True),
    "whiteboard": Kind("whiteboard", make_whiteboard, fixed=True, weight=0.8),
    "aircon": Kind("wall box", make_aircon, fixed=True, weight=0.6),
}
HANG_M: dict[str, tuple[float, float]] = {
    "curtain": (0.04, 0.25), "long_shelf": (0.85, 1.25), "frame": (0.9, 1.4), "panel": (0.7, 1.1),
    "radiator": (0.1, 0.16), "door": (0.0, 0.0), "window": (0.8, 1.0), "whiteboard": (0.9, 1.2),
    "aircon": (1.3, 1.9), "wall_cabinet": (1.35, 1.5),
}  # fmt: skip
"""Between which heights the bottom of a kind hangs."""
