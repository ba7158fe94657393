"""The things of generated rooms. Makers return closed parts in object space; parts overlap where they join.

Everything stands on the plane z = 0 of its own space, which is where contact with its support is exact.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from synthetic import textures
from synthetic.shapes import Solid, box, lathe, shifted, tube
from synthetic.textures import Texture


@dataclass
class Model:
    """A thing under construction: overlapping closed parts and the textures that they use."""

    label: str
    parts: list[Solid]
    textures: dict[str, Texture]
    size: tuple[float, float, float]  # metres, in object space
    surfaces: dict[str, float] = field(default_factory=dict)  # heights at which other things may stand


@dataclass(frozen=True)
class Workshop:
    """What makers need: randomness, the fineness of grids and of textures."""

    rng: np.random.Generator
    step_m: float
    density: float = 1.0  # factor on all texture resolutions

    def color(self, rgb: tuple[float, float, float], spread: float = 0.06) -> tuple[float, float, float]:
        """Vary a colour a little."""
        return tuple(float(np.clip(c * (1 + self.rng.uniform(-spread, spread)), 8, 248)) for c in rgb)


Maker = Callable[[Workshop, str], Model]  # (workshop, prefix of its texture names) -> model


def make_table(shop: Workshop, name: str) -> Model:
    """A coffee table: 1.10 x 0.66 m, 0.46 m high, four square legs, apron."""
    width, depth, height, top = 1.10, 0.66, 0.46, 0.028
    wood = {
        "*": textures.wood(shop.rng, 1.3, 0.8, 900 * shop.density, shop.color((176, 122, 74)), boards=0.11),
        "leg": textures.wood(shop.rng, 0.9, 0.3, 700 * shop.density, shop.color((120, 78, 46))),
    }
    parts = [shifted(box((width, depth, top), f"{name}*", shop.step_m), z=height - top)]
    leg, inset, overlap = 0.055, 0.05, 0.008
    reach_x, reach_y = width / 2 - inset - leg / 2, depth / 2 - inset - leg / 2
    for sx in (-1, 1):
        for sy in (-1, 1):
            part = box(
                (leg, leg, height - top + overlap),
                f"{name}leg",
                shop.step_m,
                (0.3 * sx, 0.2 * sy),
                upright=False,
            )
            parts.append(shifted(part, sx * reach_x, sy * reach_y))
    for sign in (-1, 1):
        rail = (2 * reach_x, 0.02, 0.06 + overlap)
        parts.append(
            shifted(
                box(rail, f"{name}leg", shop.step_m, (0.1, sign)), y=sign * reach_y, z=height - top - 0.06
            )
        )
        rail = (0.02, 2 * reach_y, 0.06 + overlap)
        parts.append(
            shifted(
                box(rail, f"{name}leg", shop.step_m, (0.5, sign)), x=sign * reach_x, z=height - top - 0.06
            )
        )
    return Model("table", parts, _prefixed(name, wood), (width, depth, height), {"top": height})


def make_shelf(shop: Workshop, name: str) -> Model:
    """An open shelf with a back: 0.70 x 0.30 m, 0.92 m high, three compartments; the front faces -y."""
    width, depth, height, board = 0.70, 0.30, 0.92, 0.022
    wood = {
        "*": textures.wood(shop.rng, 1.0, 0.8, 700 * shop.density, shop.color((206, 178, 138))),
        "back": textures.plaster(shop.rng, 0.8, 1.0, 600 * shop.density, shop.color((142, 158, 150)), 12),
    }
    parts = []
    for sign in (-1, 1):
        side = box((board, depth, height), f"{name}*", shop.step_m, (0.1 + 0.2 * sign, 0.3), upright=False)
        parts.append(shifted(side, x=sign * (width - board) / 2))
    levels = [0.04, 0.33, 0.62, height - board]
    overlap = 0.004
    for number, level in enumerate(levels):
        inner = box(
            (width - 2 * board + 2 * overlap, depth, board), f"{name}*", shop.step_m, (0.15 * number, 0.2)
        )
        parts.append(shifted(inner, z=level))
    back = box((width - 2 * board + 2 * overlap, 0.012, height - 0.05), f"{name}back", shop.step_m)
    parts.append(shifted(back, y=depth / 2 - 0.006, z=0.045))
    surfaces = {
        "top": height,
        "low": levels[0] + board,
        "middle": levels[1] + board,
        "high": levels[2] + board,
    }
    return Model("shelf", parts, _prefixed(name, wood), (width, depth, height), surfaces)


def make_crate(shop: Workshop, name: str) -> Model:
    """An open wooden crate: 0.40 x 0.30 m, 0.24 m high, 12 mm walls."""
    width, depth, height, wall, overlap = 0.40, 0.30, 0.24, 0.012, 0.003
    look = {
        "*": textures.wood(shop.rng, 0.7, 0.5, 1100 * shop.density, shop.color((190, 150, 96)), boards=0.08),
        "print": textures.cardboard(shop.rng, width, height, 1300 * shop.density, "ORANGES"),
    }
    parts = [box((width, depth, wall), f"{name}*", shop.step_m)]
    for sign in (-1, 1):
        faces = {"*": f"{name}*", "-y" if sign < 0 else "+y": f"{name}print"}
        parts.append(shifted(box((width, wall, height), faces, shop.step_m), y=sign * (depth - wall) / 2))
        end = box((wall, depth - 2 * wall + 2 * overlap, height), f"{name}*", shop.step_m, (0.2, 0.1 * sign))
        parts.append(shifted(end, x=sign * (width - wall) / 2))
    return Model("crate", parts, _prefixed(name, look), (width, depth, height), {"inside": wall})


def _package(
    shop: Workshop,
    name: str,
    kind: str,
    size: tuple[float, float, float],
    rgb: tuple[float, float, float],
    lines: tuple[str, ...],
) -> Model:
    """A printed cuboid with another print on every side."""
    x, y, z = size
    density, color = 2600 * shop.density, shop.color(rgb)
    look = {
        side: textures.label(shop.rng, u, v, density, color, lines if side[0] == "-" else lines[::-1])
        for side, u, v in (("+x", y, z), ("-x", y, z), ("+y", x, z), ("-y", x, z), ("+z", x, y))
    }
    look["*"] = textures.cardboard(shop.rng, 0.3, 0.3, 0.6 * density)
    faces = {side: f"{name}{side}" for side in look}
    return Model(kind, [box(size, faces, shop.step_m)], _prefixed(name, look), size, {"top": z})


def make_box(shop: Workshop, name: str) -> Model:
    """A closed cardboard box: 0.30 x 0.22 x 0.20 m."""
    size = (0.30, 0.22, 0.20)
    look = {
        "-y": textures.cardboard(shop.rng, size[0], size[2], 1500 * shop.density, "FRAGILE"),
        "+y": textures.cardboard(shop.rng, size[0], size[2], 1500 * shop.density, "BOOKS"),
        "+x": textures.cardboard(shop.rng, size[1], size[2], 1500 * shop.density, "ROOM 12"),
        "*": textures.cardboard(shop.rng, 0.6, 0.6, 1200 * shop.density),
    }
    look["*"].pixels[:, ::97] //= 2  # dark tape edges break the uniform board
    faces = {side: f"{name}{side}" for side in look}
    return Model("box", [box(size, faces, shop.step_m)], _prefixed(name, look), size, {"top": size[2]})


def make_carton(shop: Workshop, name: str) -> Model:
    """A crackers carton: 0.11 x 0.06 x 0.17 m, graspable across its depth."""
    return _package(
        shop, name, "carton", (0.11, 0.06, 0.17), (222, 92, 62), ("CRACKERS", "WHOLE GRAIN", "350 g")
    )


def make_tin(shop: Workshop, name: str) -> Model:
    """A square tea tin: 0.065 x 0.065 x 0.085 m."""
    return _package(shop, name, "tin", (0.065, 0.065, 0.085), (64, 128, 118), ("TEA", "EARL GREY"))


def make_book(shop: Workshop, name: str) -> Model:
    """A closed book lying flat: 0.23 x 0.16 x 0.032 m."""
    size = (0.23, 0.16, 0.032)
    cover = shop.color((58, 84, 150))
    look = {
        "+z": textures.label(
            shop.rng, size[0], size[1], 1900 * shop.density, cover, ("SIMULATED", "REALITY", "VOL. II")
        ),
        "-y": textures.label(shop.rng, size[0], size[2], 2200 * shop.density, cover, ("SIMULATED REALITY",)),
        "*": textures.plaster(shop.rng, 0.25, 0.25, 1900 * shop.density, (226, 218, 198), 10),
    }
    look["*"].pixels[::5] = (look["*"].pixels[::5] * 0.86).astype(np.uint8)  # pages
    faces = {side: f"{name}{side}" for side in look}
    return Model("book", [box(size, faces, shop.step_m)], _prefixed(name, look), size, {"top": size[2]})


def make_can(shop: Workshop, name: str) -> Model:
    """A soup can: 66 mm across, 102 mm high."""
    radius, height = 0.033, 0.102
    circumference = 2 * np.pi * radius
    lines = ("TOMATO", "SOUP")
    look = {
        "label": textures.label(
            shop.rng, circumference, height, 2600 * shop.density, shop.color((196, 52, 48)), lines, 2
        ),
        "metal": textures.plaster(shop.rng, 0.1, 0.1, 2600 * shop.density, (176, 178, 182), 12),
    }
    body = [
        (np.array([[0, 0], [radius, 0]]), f"{name}metal"),
        (np.array([[radius, 0], [radius, height]]), f"{name}label"),
        (np.array([[radius, height], [0, height]]), f"{name}metal"),
    ]
    return Model(
        "can",
        [lathe(body, shop.step_m)],
        _prefixed(name, look),
        (2 * radius, 2 * radius, height),
        {"top": height},
    )


def make_mug(shop: Workshop, name: str) -> Model:
    """A hollow mug with a handle towards +x: 80 mm across, 95 mm high, 4 mm wall."""
    radius, height, wall, base = 0.040, 0.095, 0.004, 0.006
    look = {
        "out": textures.label(
            shop.rng,
            2 * np.pi * radius,
            height,
            2400 * shop.density,
            shop.color((236, 196, 88)),
            ("GOOD", "MORNING"),
            2,
        ),
        "in": textures.glaze(shop.rng, 0.3, 0.15, 2200 * shop.density, shop.color((226, 222, 210))),
    }
    inner = radius - wall
    body = [
        (np.array([[0, 0], [radius, 0]]), f"{name}in"),
        (np.array([[radius, 0], [radius, height]]), f"{name}out"),
        (np.array([[radius, height], [inner, height]]), f"{name}in"),
        (np.array([[inner, height], [inner, base]]), f"{name}in"),
        (np.array([[inner, base], [0, base]]), f"{name}in"),
    ]
    angles = np.radians(np.linspace(108, -108, 19))
    # The ends of the handle sink into the wall but not through it.
    path = np.stack(
        [radius + 0.006 + 0.026 * np.cos(angles), np.zeros(19), height / 2 + 0.031 * np.sin(angles)], -1
    )
    path[:, 0] = np.maximum(path[:, 0], radius - 0.0005)
    handle = tube(path, (0.006, 0.0035), f"{name}in")
    size = (2 * radius, 2 * radius, height)
    return Model("mug", [lathe(body, shop.step_m), handle], _prefixed(name, look), size, {"inside": base})


def make_bowl(shop: Workshop, name: str) -> Model:
    """A hollow bowl on a foot ring: 160 mm across, 65 mm high, 5 mm wall."""
    look = {
        "out": textures.glaze(shop.rng, 0.5, 0.15, 1800 * shop.density, shop.color((92, 138, 168))),
        "in": textures.label(
            shop.rng,
            2 * np.pi * 0.075,
            0.11,
            1500 * shop.density,
            shop.color((226, 214, 190)),
            ("BON APPETIT",),
            3,
        ),
    }
    bend = np.linspace(0, np.pi / 2, 12)
    outside = np.stack([0.032 + 0.048 * np.sin(bend), 0.008 + 0.057 * (1 - np.cos(bend))], -1)
    inside = np.stack([0.032 + 0.043 * np.sin(bend), 0.013 + 0.052 * (1 - np.cos(bend))], -1)[::-1]
    foot = np.array([[0, 0], [0.034, 0]])
    body = [
        (foot, f"{name}out"),
        (np.array([[0.034, 0], outside[0] + (0.002, 0.0)]), f"{name}out"),
        (np.concatenate([[outside[0] + (0.002, 0.0)], outside[1:]]), f"{name}out"),
        (np.array([outside[-1], inside[0]]), f"{name}out"),
        (inside, f"{name}in"),
        (np.array([inside[-1], [0, inside[-1, 1]]]), f"{name}in"),
    ]
    return Model(
        "bowl", [lathe(body, shop.step_m)], _prefixed(name, look), (0.16, 0.16, 0.065), {"inside": 0.013}
    )


def make_picture(shop: Workshop, name: str) -> Model:
    """A framed picture: 0.62 x 0.46 m, 25 mm deep; its back is at y = 0, it faces -y, bottom at z = 0."""
    width, height, depth, bar = 0.62, 0.46, 0.025, 0.035
    look = {
        "*": textures.wood(shop.rng, 0.8, 0.4, 1000 * shop.density, shop.color((84, 54, 34))),
        "art": textures.picture(shop.rng, width - 2 * bar, height - 2 * bar, 1100 * shop.density),
    }
    overlap = 0.002
    art = box((width - 2 * bar, 0.012, height - 2 * bar), {"-y": f"{name}art", "*": f"{name}*"}, shop.step_m)
    # The canvas reaches a little under the frame, which hides its edge.
    parts = [shifted(art, y=-0.006, z=bar)]
    for sign in (-1, 1):
        stile = box((bar + overlap, depth, height), f"{name}*", shop.step_m, (0.1, 0.3 * sign), upright=False)
        parts.append(shifted(stile, x=sign * (width - bar - overlap) / 2, y=-depth / 2))
        rail = box((width - 2 * bar, depth, bar + overlap), f"{name}*", shop.step_m, (0.3, 0.1 * sign))
        parts.append(shifted(rail, y=-depth / 2, z=0 if sign < 0 else height - bar - overlap))
    return Model("picture", parts, _prefixed(name, look), (width, depth, height))


def _prefixed(name: str, look: dict[str, Texture]) -> dict[str, Texture]:
    return {f"{name}{key}": value for key, value in look.items()}


MAKERS: dict[str, Maker] = {
    "table": make_table,
    "shelf": make_shelf,
    "crate": make_crate,
    "box": make_box,
    "can": make_can,
    "mug": make_mug,
    "bowl": make_bowl,
    "book": make_book,
    "tin": make_tin,
    "carton": make_carton,
    "picture": make_picture,
}
