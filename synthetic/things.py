"""Small things of procedural rooms: packages, books, cans, bottles, toys, fruit; sizes and looks vary.

Every maker draws its dimensions before anything else, so that the fine version for drawing and the coarse true
mesh, made from the same stream of random numbers, have the same shape.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from synthetic import textures
from synthetic.footprints import disc, rectangle
from synthetic.furniture import Model, Workshop
from synthetic.shapes import Solid, box, grid_patch, lathe, moved
from synthetic.textures import Texture

PALETTE = (
    (196, 52, 48), (222, 122, 46), (232, 190, 70), (122, 160, 66), (52, 128, 88), (56, 132, 150),
    (58, 92, 164), (108, 84, 156), (176, 84, 130), (120, 82, 54), (206, 196, 176), (92, 98, 108),
)  # fmt: skip
_TITLES = (
    ("CRACKERS", "WHOLE GRAIN"), ("GREEN TEA", "JASMINE"), ("MUESLI", "NUTS & FRUIT"), ("SUGAR", "FINE"),
    ("PASTA", "FUSILLI", "500 g"), ("RICE", "BASMATI"), ("COCOA", "DARK ROAST"), ("SOAP", "OLIVE"),
    ("PUZZLE", "1000 PIECES"), ("BATTERIES", "AA 8x"), ("COFFEE", "ESPRESSO"), ("LENTILS", "RED"),
)  # fmt: skip
_BOOKS = (
    ("SIMULATED", "REALITY"), ("THE LONG", "WAY HOME"), ("ATLAS OF", "THE SEA"), ("ROBOTS", "AND ROOMS"),
    ("COOKING", "WITH SALT"), ("A SHORT", "HISTORY"), ("GEOMETRY", "BY HAND"), ("NIGHT TRAIN", "TO OSLO"),
)  # fmt: skip


@dataclass(frozen=True)
class Place:
    """A level area on or in a thing where others may stand."""

    height_m: float
    area: np.ndarray  # float64 (k, 2) convex, object space: where a whole silhouette must stay
    headroom_m: float = np.inf
    inside: bool = False  # of an open container
    rim_m: float = 0.0  # height of the walls above the place
    stack: bool = False  # a thing on top counts as stacked; it may overhang a little
    name: str = "top"
    sag: Callable[[float, float], float] | None = None  # height over (x, y) above `height_m`; None: level


@dataclass
class Thing(Model):
    """A model that also knows where others may stand, and its convex pieces."""

    places: tuple[Place, ...] = ()
    pieces: tuple[np.ndarray, ...] = field(default=())  # (v, 3) each; empty: every part is convex


@dataclass(frozen=True)
class Kind:
    """A kind of thing and how it may be used."""

    label: str
    make: Callable[[Workshop, str], Thing]
    fixed: bool = False  # furniture that nobody lifts
    rolls: bool = False  # only ever put into containers
    weight: float = 1.0  # how often it is drawn


def pick_color(shop: Workshop, spread: float = 0.12) -> tuple[float, float, float]:
    """Draw a color that is not the same twice."""
    return shop.color(PALETTE[int(shop.rng.integers(len(PALETTE)))], spread)


def prefixed(name: str, look: dict[str, Texture]) -> dict[str, Texture]:
    """Give textures names that are unique in the room."""
    return {f"{name}{key}": value for key, value in look.items()}


def _flat_top(height: float, polygon: np.ndarray) -> tuple[Place, ...]:
    return (Place(height, polygon, stack=True),)


def printed_box(
    shop: Workshop, name: str, label: str, size: tuple[float, float, float], lines: tuple[str, ...]
) -> Thing:
    """A package with another print on each visible side."""
    x, y, z = size
    density, color = 2000 * shop.density, pick_color(shop)
    sides = (("+x", y, z), ("-x", y, z), ("+y", x, z), ("-y", x, z), ("+z", x, y))
    look = {
        side: textures.label(shop.rng, u, v, density, color, lines if side[0] == "-" else lines[::-1])
        for side, u, v in sides
    }
    look["*"] = textures.cardboard(shop.rng, 0.3, 0.3, 600 * shop.density)
    faces = {side: f"{name}{side}" for side in look}
    return Thing(
        label,
        [box(size, faces, shop.step_m)],
        prefixed(name, look),
        size,
        places=_flat_top(z, rectangle(x, y)),
    )


def make_carton(shop: Workshop, name: str) -> Thing:
    """An upright package, 14 to 21 cm high."""
    size = tuple(shop.rng.uniform((0.085, 0.05, 0.14), (0.135, 0.075, 0.21)).tolist())
    return printed_box(shop, name, "carton", size, _TITLES[int(shop.rng.integers(len(_TITLES)))])


def make_package(shop: Workshop, name: str) -> Thing:
    """A flat package, 4 to 7 cm high."""
    size = tuple(shop.rng.uniform((0.12, 0.09, 0.04), (0.19, 0.13, 0.07)).tolist())
    return printed_box(shop, name, "package", size, _TITLES[int(shop.rng.integers(len(_TITLES)))])


def make_tin(shop: Workshop, name: str) -> Thing:
    """A square tin, 7 to 10 cm high."""
    side = shop.rng.uniform(0.055, 0.08)
    size = (side, side, float(shop.rng.uniform(0.07, 0.1)))
    return printed_box(shop, name, "tin", size, _TITLES[int(shop.rng.integers(len(_TITLES)))])


def make_cardboard_box(shop: Workshop, name: str) -> Thing:
    """A closed cardboard box, 12 to 24 cm wide."""
    size = tuple(shop.rng.uniform((0.16, 0.12, 0.09), (0.26, 0.2, 0.16)).tolist())
    x, y, z = size
    look = {
        side: textures.cardboard(shop.rng, u, v, 1500 * shop.density, text)
        for side, u, v, text in (
            ("+x", y, z, "FRAGILE"), ("-x", y, z, ""), ("+y", x, z, "BOX"), ("-y", x, z, "PARTS"),
            ("+z", x, y, "STORE"), ("*", x, y, ""),
        )
    }  # fmt: skip
    faces = {side: f"{name}{side}" for side in look}
    solid = box(size, faces, shop.step_m)
    return Thing("cardboard box", [solid], prefixed(name, look), size, places=_flat_top(z, rectangle(x, y)))


def make_book(shop: Workshop, name: str) -> Thing:
    """A closed book that lies flat."""
    x, y, z = shop.rng.uniform((0.19, 0.135, 0.018), (0.28, 0.2, 0.042)).tolist()
    cover, title = pick_color(shop), _BOOKS[int(shop.rng.integers(len(_BOOKS)))]
    look = {
        "+z": textures.label(shop.rng, x, y, 1700 * shop.density, cover, title),
        "-y": textures.label(shop.rng, x, z, 2000 * shop.density, cover, (" ".join(title),)),
        "-z": textures.plaster(shop.rng, x, y, 800 * shop.density, cover, 8),
        "*": textures.plaster(shop.rng, 0.3, 0.3, 1700 * shop.density, (226, 218, 198), 10),
    }
    look["*"].pixels[::5] = (look["*"].pixels[::5] * 0.86).astype(np.uint8)  # pages
    faces = {side: f"{name}{side}" for side in look}
    solid = box((x, y, z), faces, shop.step_m)
    return Thing("book", [solid], prefixed(name, look), (x, y, z), places=_flat_top(z, rectangle(x, y)))


def make_block(shop: Workshop, name: str) -> Thing:
    """A toy block of painted wood."""
    x, y, z = shop.rng.uniform((0.045, 0.045, 0.045), (0.075, 0.06, 0.06)).tolist()
    look = {
        "*": textures.wood(shop.rng, 0.3, 0.3, 1500 * shop.density, pick_color(shop)),
        "-y": textures.label(shop.rng, x, z, 1800 * shop.density, pick_color(shop), ("A B",)),
        "+y": textures.label(shop.rng, x, z, 1800 * shop.density, pick_color(shop), ("C 3",)),
        "+z": textures.label(shop.rng, x, y, 1800 * shop.density, pick_color(shop), ("7 K",)),
    }
    faces = {side: f"{name}{side}" for side in look}
    solid = box((x, y, z), faces, shop.step_m)
    return Thing("block", [solid], prefixed(name, look), (x, y, z), places=_flat_top(z, rectangle(x, y)))


def turned_pieces(profile: np.ndarray, corners: int = 24) -> tuple[np.ndarray, ...]:
    """Cut a solid turned body, outline (k, 2) of (radius, height) from the bottom up, into convex frusta.

    Heights must rise. The pieces use every other corner of the 48-sided mesh.
    """
    ring = disc(1.0, corners)
    pieces = []
    for (r0, z0), (r1, z1) in pairwise(profile):
        if z1 - z0 > 1e-6:
            low = np.column_stack([r0 * ring, np.full(corners, z0)])
            high = np.column_stack([r1 * ring, np.full(corners, z1)])
            pieces.append(np.concatenate([low, high]))
    return tuple(pieces)


def make_can(shop: Workshop, name: str) -> Thing:
    """A food can."""
    radius, height = shop.rng.uniform((0.03, 0.075), (0.042, 0.12)).tolist()
    title = _TITLES[int(shop.rng.integers(len(_TITLES)))]
    around = 2 * np.pi * radius
    look = {
        "label": textures.label(
            shop.rng, around, height, 2200 * shop.density, pick_color(shop), title[:2], 2
        ),
        "metal": textures.plaster(shop.rng, 0.1, 0.1, 2200 * shop.density, (176, 178, 182), 12),
    }
    body = [
        (np.array([[0, 0], [radius, 0]]), f"{name}metal"),
        (np.array([[radius, 0], [radius, height]]), f"{name}label"),
        (np.array([[radius, height], [0, height]]), f"{name}metal"),
    ]
    size = (2 * radius, 2 * radius, height)
    top = _flat_top(height, disc(radius))
    return Thing("can", [lathe(body, shop.step_m)], prefixed(name, look), size, places=top)


def make_bottle(shop: Workshop, name: str) -> Thing:
    """A bottle with a neck, a label and a cap."""
    radius, height, shoulder = shop.rng.uniform((0.03, 0.2, 0.55), (0.041, 0.28, 0.66)).tolist()
    neck, z = 0.4 * radius, shoulder * height
    glass, cap = pick_color(shop), pick_color(shop)
    title = _TITLES[int(shop.rng.integers(len(_TITLES)))]
    bend = np.linspace(0, np.pi / 2, 6)
    rise = 0.16 * height
    curve = np.stack([neck + (radius - neck) * np.cos(bend), z + rise * np.sin(bend)], -1)
    low, high = 0.12 * z, 0.9 * z
    look = {
        "glass": textures.glaze(shop.rng, 0.3, 0.3, 1600 * shop.density, glass),
        "print": textures.label(
            shop.rng, 2 * np.pi * radius, high - low, 2000 * shop.density, pick_color(shop), title[:2], 2
        ),
        "cap": textures.plaster(shop.rng, 0.1, 0.1, 1500 * shop.density, cap, 8),
    }
    glass_name, top = f"{name}glass", 0.93 * height
    body = [
        (np.array([[0, 0], [radius, 0]]), glass_name),
        (np.array([[radius, 0], [radius, low]]), glass_name),
        (np.array([[radius, low], [radius, high]]), f"{name}print"),
        (np.array([[radius, high], [radius, z]]), glass_name),
        (np.concatenate([curve, [[neck, top]]]), glass_name),
        (np.array([[neck, top], [1.25 * neck, top]]), f"{name}cap"),
        (np.array([[1.25 * neck, top], [1.25 * neck, height]]), f"{name}cap"),
        (np.array([[1.25 * neck, height], [0, height]]), f"{name}cap"),
    ]
    outline = np.concatenate([[[radius, 0]], curve, [[neck, top], [1.25 * neck, top], [1.25 * neck, height]]])
    size = (2 * radius, 2 * radius, height)
    return Thing(
        "bottle", [lathe(body, shop.step_m)], prefixed(name, look), size, pieces=turned_pieces(outline)
    )


def make_jar(shop: Workshop, name: str) -> Thing:
    """A jar with a wide lid: flat on top."""
    radius, height = shop.rng.uniform((0.034, 0.09), (0.048, 0.14)).tolist()
    z, lid = 0.8 * height, 0.92 * radius
    title = _TITLES[int(shop.rng.integers(len(_TITLES)))]
    look = {
        "glass": textures.label(
            shop.rng, 2 * np.pi * radius, z, 2000 * shop.density, pick_color(shop), title[:1], 3
        ),
        "lid": textures.glaze(shop.rng, 0.3, 0.1, 1800 * shop.density, pick_color(shop)),
    }
    body = [
        (np.array([[0, 0], [radius, 0]]), f"{name}lid"),
        (np.array([[radius, 0], [radius, z]]), f"{name}glass"),
        (np.array([[radius, z], [lid, z + 0.008]]), f"{name}lid"),
        (np.array([[lid, z + 0.008], [lid, height]]), f"{name}lid"),
        (np.array([[lid, height], [0, height]]), f"{name}lid"),
    ]
    outline = np.array([[radius, 0], [radius, z], [lid, z + 0.008], [lid, height]])
    size = (2 * radius, 2 * radius, height)
    solid, top = lathe(body, shop.step_m), _flat_top(height, disc(lid))
    return Thing("jar", [solid], prefixed(name, look), size, places=top, pieces=turned_pieces(outline))


def make_candle(shop: Workshop, name: str) -> Thing:
    """A thick candle: a plain cylinder with drops of wax."""
    radius, height = shop.rng.uniform((0.028, 0.08), (0.042, 0.16)).tolist()
    look = {"*": textures.glaze(shop.rng, 0.3, 0.3, 1400 * shop.density, pick_color(shop))}
    body = [
        (np.array([[0, 0], [radius, 0]]), f"{name}*"),
        (np.array([[radius, 0], [radius, height]]), f"{name}*"),
        (np.array([[radius, height], [0, height]]), f"{name}*"),
    ]
    size = (2 * radius, 2 * radius, height)
    return Thing("candle", [lathe(body, shop.step_m)], prefixed(name, look), size)


def prism(outline: np.ndarray, depth: float, textures_of: tuple[str, str], step_m: float) -> Solid:
    """Extrude a convex outline (k, 2) of (x, z), counter-clockwise, along y, centered; (side, cap) textures."""
    side, cap = textures_of
    patches = []
    half = depth / 2
    for a, b in zip(outline, np.roll(outline, -1, axis=0)):
        # Prints stand upright: v rises with z, and u runs to the right for who looks at the face.
        a, b, right = (a, b, -1.0) if b[1] >= a[1] else (b, a, 1.0)
        length = float(np.linalg.norm(b - a))
        s = np.linspace(0, 1, int(np.ceil(length / step_m)) + 1)
        t = np.linspace(0, 1, int(np.ceil(depth / step_m)) + 1)
        flat = a + s[:, None] * (b - a)
        y = right * (depth * t - half)
        points = np.empty((len(s), len(t), 3))
        points[..., 0], points[..., 1], points[..., 2] = flat[:, None, 0], y[None], flat[:, None, 1]
        uvs = np.stack(np.broadcast_arrays(t[None] * depth, s[:, None] * length), -1)
        outward = -right * np.array([(b - a)[1], 0, -(b - a)[0]])
        patches.append(_outward(points, uvs, side, outward))
    closed = np.concatenate([outline, outline[:1]])
    for sign in (-1, 1):
        rim = np.column_stack([closed[:, 0], np.full(len(closed), sign * half), closed[:, 1]])
        middle = np.repeat(rim[:-1].mean(0)[None], len(rim), 0)
        uvs = np.stack([middle[:, [0, 2]], rim[:, [0, 2]]]) - outline.min(0)
        patches.append(_outward(np.stack([middle, rim]), uvs, cap, np.array([0, sign, 0.0])))
    return tuple(patches)


def _outward(points: np.ndarray, uvs: np.ndarray, texture: str, outward: np.ndarray):
    """Make a flat patch whose normals agree with a direction."""
    patch = grid_patch(points, uvs, texture)
    if np.sum(patch.normals @ outward) < 0:
        patch = grid_patch(points[:, ::-1], uvs[:, ::-1], texture)
    return patch


def make_wedge(shop: Workshop, name: str) -> Thing:
    """A wedge: a ramp or a slice of cheese."""
    x, y, z = shop.rng.uniform((0.11, 0.06, 0.05), (0.16, 0.1, 0.085)).tolist()
    look = {
        "side": textures.glaze(shop.rng, 0.5, 0.3, 1500 * shop.density, pick_color(shop)),
        "cap": textures.plaster(shop.rng, 0.3, 0.2, 1500 * shop.density, pick_color(shop), 16),
    }
    outline = np.array([[-x / 2, 0], [x / 2, 0], [x / 2, 0.25 * z], [-x / 2, z]])
    solid = prism(outline, y, (f"{name}side", f"{name}cap"), shop.step_m)
    return Thing("wedge", [solid], prefixed(name, look), (x, y, z))


def make_calendar(shop: Workshop, name: str) -> Thing:
    """A desk calendar: a tent of two printed faces."""
    x, y, z = shop.rng.uniform((0.07, 0.13, 0.1), (0.09, 0.19, 0.15)).tolist()
    look = {
        "side": textures.label(shop.rng, y, z, 1800 * shop.density, pick_color(shop), ("NOVEMBER", "21"), 1),
        "cap": textures.plaster(shop.rng, 0.3, 0.2, 1500 * shop.density, pick_color(shop), 10),
    }
    outline = np.array([[-x / 2, 0], [x / 2, 0], [0.006, z], [-0.006, z]])
    solid = prism(outline, y, (f"{name}side", f"{name}cap"), shop.step_m)
    turn = np.eye(4)
    turn[:2, :2] = [[0, -1], [1, 0]]  # its long side along x, as everything else
    return Thing("calendar", [moved(solid, turn)], prefixed(name, look), (y, x, z))


def _fruit(shop: Workshop, name: str, label: str, radius: float, stretch: float, rgb) -> Thing:
    """A turned fruit, a little flat where it lies; `stretch` is its height over its width."""
    start = np.radians(-62.0)
    angles = np.linspace(start, np.pi / 2, 12)
    curve = np.stack([radius * np.cos(angles), radius * stretch * (np.sin(angles) - np.sin(start))], -1)
    curve[-1, 0] = 0.0
    look = {"*": textures.glaze(shop.rng, 0.4, 0.2, 1600 * shop.density, shop.color(rgb, 0.1))}
    foot = np.array([[0, 0], curve[0]])
    solid = lathe([(foot, f"{name}*"), (curve, f"{name}*")], shop.step_m, segments=24)
    size = (2 * radius, 2 * radius, float(curve[-1, 1]))
    return Thing(label, [solid], prefixed(name, look), size, pieces=_sliced(curve))


def _sliced(curve: np.ndarray) -> tuple[np.ndarray, ...]:
    """One convex piece: rings of the curve, its last point on the axis."""
    ring = disc(1.0, 20)
    rings = [np.column_stack([r * ring, np.full(20, z)]) for r, z in curve[:-1]]
    return (np.concatenate([*rings, [[0, 0, curve[-1, 1]]]]),)


def make_ball(shop: Workshop, name: str) -> Thing:
    """A ball or an orange."""
    radius = float(shop.rng.uniform(0.03, 0.042))
    return _fruit(shop, name, "ball", radius, 1.0, PALETTE[int(shop.rng.integers(len(PALETTE)))])


def make_lemon(shop: Workshop, name: str) -> Thing:
    """A lemon that stands on its stalk end."""
    return _fruit(shop, name, "lemon", float(shop.rng.uniform(0.026, 0.032)), 1.3, (226, 200, 70))


SMALL_KINDS: dict[str, Kind] = {
    "carton": Kind("carton", make_carton),
    "package": Kind("package", make_package),
    "tin": Kind("tin", make_tin, weight=0.8),
    "box": Kind("cardboard box", make_cardboard_box, weight=0.7),
    "book": Kind("book", make_book, weight=1.2),
    "block": Kind("block", make_block, weight=0.6),
    "can": Kind("can", make_can),
    "bottle": Kind("bottle", make_bottle),
    "jar": Kind("jar", make_jar, weight=0.8),
    "candle": Kind("candle", make_candle, weight=0.6),
    "wedge": Kind("wedge", make_wedge, weight=0.6),
    "calendar": Kind("calendar", make_calendar, weight=0.5),
    "ball": Kind("ball", make_ball, rolls=True, weight=1.0),
    "lemon": Kind("lemon", make_lemon, rolls=True, weight=1.0),
}
"""Things that stand on or in others, besides the vessels of `containers`."""
