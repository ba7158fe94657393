"""Furniture of procedural rooms, and what hangs on their walls; sizes and looks vary.

Furniture faces -y: its back may stand towards a wall. What hangs has its back at y = 0 and its bottom at z = 0.
"""

import numpy as np

from synthetic import textures
from synthetic.footprints import disc, rectangle
from synthetic.furniture import Workshop
from synthetic.shapes import Solid, box, lathe, moved, shifted
from synthetic.textures import Texture
from synthetic.things import PALETTE, Kind, Place, Thing, pick_color, prefixed

_WOODS = ((176, 122, 74), (206, 178, 138), (120, 78, 46), (150, 108, 76), (196, 160, 110))
_OVERLAP_M = 0.004


def _wood(
    shop: Workshop, width: float, height: float, density: float = 700.0, boards: float = 0.0
) -> Texture:
    """Wood of a common tone, or painted."""
    rgb = _WOODS[int(shop.rng.integers(len(_WOODS)))]
    if shop.rng.random() < 0.25:
        rgb = PALETTE[int(shop.rng.integers(len(PALETTE)))]
    return textures.wood(shop.rng, width, height, density * shop.density, shop.color(rgb), boards=boards)


def _legs(
    shop: Workshop, name: str, width: float, depth: float, height: float, leg: float, inset: float
) -> list[Solid]:
    """Four square legs that reach a little into what they carry."""
    parts = []
    x, y = width / 2 - inset - leg / 2, depth / 2 - inset - leg / 2
    for sx in (-1, 1):
        for sy in (-1, 1):
            part = box(
                (leg, leg, height + _OVERLAP_M),
                f"{name}leg",
                shop.step_m,
                (0.3 * sx, 0.2 * sy),
                upright=False,
            )
            parts.append(shifted(part, sx * x, sy * y))
    return parts


def make_table(shop: Workshop, name: str) -> Thing:
    """A low table with four legs and an apron."""
    width, depth, height = shop.rng.uniform((0.98, 0.6, 0.42), (1.2, 0.74, 0.54)).tolist()
    top, leg, inset = 0.028, 0.055, 0.05
    look = {"*": _wood(shop, 1.3, 0.8, 850, 0.11), "leg": _wood(shop, 0.9, 0.3)}
    parts = [shifted(box((width, depth, top), f"{name}*", shop.step_m), z=height - top)]
    parts += _legs(shop, name, width, depth, height - top, leg, inset)
    x, y = width / 2 - inset - leg / 2, depth / 2 - inset - leg / 2
    for sign in (-1, 1):
        rail = box((2 * x, 0.02, 0.06 + _OVERLAP_M), f"{name}leg", shop.step_m, (0.1, sign))
        parts.append(shifted(rail, 0, sign * y, height - top - 0.06))
        rail = box((0.02, 2 * y, 0.06 + _OVERLAP_M), f"{name}leg", shop.step_m, (0.5, sign))
        parts.append(shifted(rail, sign * x, 0, height - top - 0.06))
    place = Place(height, rectangle(width, depth))
    return Thing("table", parts, prefixed(name, look), (width, depth, height), places=(place,))


def make_round_table(shop: Workshop, name: str) -> Thing:
    """A round top on four legs."""
    radius, height = shop.rng.uniform((0.4, 0.44), (0.5, 0.56)).tolist()
    top = 0.026
    look = {"*": _wood(shop, 1.2, 1.2, 850), "leg": _wood(shop, 0.9, 0.3)}
    body = [
        (np.array([[0, 0], [radius, 0]]), f"{name}leg"),
        (np.array([[radius, 0], [radius, top]]), f"{name}leg"),
        (np.array([[radius, top], [0, top]]), f"{name}*"),
    ]
    parts = [shifted(lathe(body, shop.step_m), z=height - top)]
    parts += _legs(shop, name, 1.3 * radius, 1.3 * radius, height - top, 0.05, 0.0)
    size = (2 * radius, 2 * radius, height)
    return Thing("table", parts, prefixed(name, look), size, places=(Place(height, disc(radius)),))


def make_bookcase(shop: Workshop, name: str) -> Thing:
    """An open shelf with a back and two or three compartments."""
    width, depth, height = shop.rng.uniform((0.62, 0.29, 0.78), (0.86, 0.34, 1.02)).tolist()
    board, levels = 0.022, int(shop.rng.integers(2, 4))
    look = {
        "*": _wood(shop, 1.0, 0.8),
        "back": textures.plaster(shop.rng, 0.9, 1.1, 500 * shop.density, pick_color(shop), 12),
    }
    parts = []
    for sign in (-1, 1):
        side = box((board, depth, height), f"{name}*", shop.step_m, (0.1 + 0.2 * sign, 0.3), upright=False)
        parts.append(shifted(side, x=sign * (width - board) / 2))
    bottoms = np.linspace(0.04, height - board, levels + 1)
    inner = width - 2 * board
    for number, level in enumerate(bottoms):
        plank = box((inner + 2 * _OVERLAP_M, depth, board), f"{name}*", shop.step_m, (0.15 * number, 0.2))
        parts.append(shifted(plank, z=float(level)))
    back = box((inner + 2 * _OVERLAP_M, 0.012, height - 0.05), f"{name}back", shop.step_m)
    parts.append(shifted(back, y=depth / 2 - 0.006, z=0.045))
    area = rectangle(inner, depth - 0.014, y=-0.007)
    headroom = float(bottoms[1] - bottoms[0]) - board
    places = [Place(height, rectangle(width, depth))]
    for number, level in enumerate(bottoms[1:-1]):  # the lowest compartment is too dark to be seen well
        places.append(Place(float(level) + board, area, headroom, name=f"board_{number + 1}"))
    return Thing("bookshelf", parts, prefixed(name, look), (width, depth, height), places=tuple(places))


def make_cabinet(shop: Workshop, name: str) -> Thing:
    """A closed cabinet on a plinth with two doors and knobs."""
    width, depth, height = shop.rng.uniform((0.66, 0.36, 0.56), (0.95, 0.42, 0.74)).tolist()
    look = {"*": _wood(shop, 1.2, 0.9), "door": _wood(shop, 1.0, 0.8), "leg": _wood(shop, 0.4, 0.3)}
    plinth, door = 0.06, 0.016
    parts = [box((width - 0.08, depth - 0.08, plinth + _OVERLAP_M), f"{name}leg", shop.step_m)]
    body = box((width, depth - door, height - plinth), f"{name}*", shop.step_m)
    parts.append(shifted(body, y=door / 2, z=plinth))
    panel = (width / 2 - 0.016, door + _OVERLAP_M, height - plinth - 0.05)
    for sign in (-1, 1):
        faces = box(panel, f"{name}door", shop.step_m, (0.3 * sign, 0.2), upright=False)
        y = -depth / 2 + panel[1] / 2
        parts.append(shifted(faces, sign * (width / 4 - 0.002), y, plinth + 0.02))
        knob = box((0.018, 0.03, 0.05), f"{name}leg", shop.step_m)
        parts.append(shifted(knob, sign * 0.05, -depth / 2 - 0.01, plinth + 0.55 * panel[2]))
    size = (width, depth, height)
    place = Place(height, rectangle(width, depth - door, y=door / 2))
    return Thing("cabinet", parts, prefixed(name, look), size, places=(place,))


def make_bench(shop: Workshop, name: str) -> Thing:
    """A board on two panels with a rail between them."""
    width, depth, height = shop.rng.uniform((0.8, 0.3, 0.4), (1.1, 0.36, 0.48)).tolist()
    look = {"*": _wood(shop, 1.2, 0.5, 800, 0.1), "leg": _wood(shop, 0.9, 0.4)}
    top, panel = 0.035, 0.03
    parts = [shifted(box((width, depth, top), f"{name}*", shop.step_m), z=height - top)]
    x = width / 2 - 0.1
    for sign in (-1, 1):
        side = box(
            (panel, depth - 0.05, height - top + _OVERLAP_M), f"{name}leg", shop.step_m, (0.2 * sign, 0.1)
        )
        parts.append(shifted(side, sign * x))
    rail = box((2 * x, 0.025, 0.07), f"{name}leg", shop.step_m)
    parts.append(shifted(rail, z=0.5 * height))
    place = Place(height, rectangle(width, depth))
    return Thing("bench", parts, prefixed(name, look), (width, depth, height), places=(place,))


def make_stool(shop: Workshop, name: str) -> Thing:
    """A square or round stool."""
    side, height, kind = shop.rng.uniform((0.32, 0.42, 0.0), (0.38, 0.5, 1.0)).tolist()
    top = 0.03
    look = {"*": _wood(shop, 0.5, 0.5, 900), "leg": _wood(shop, 0.6, 0.3)}
    if kind < 0.5:
        seat, area = box((side, side, top), f"{name}*", shop.step_m), rectangle(side, side)
        parts = _legs(shop, name, side, side, height - top, 0.035, 0.015)
    else:
        body = [
            (np.array([[0, 0], [side / 2, 0]]), f"{name}leg"),
            (np.array([[side / 2, 0], [side / 2, top]]), f"{name}leg"),
            (np.array([[side / 2, top], [0, top]]), f"{name}*"),
        ]
        seat, area = lathe(body, shop.step_m), disc(side / 2)
        parts = _legs(shop, name, 0.72 * side, 0.72 * side, height - top, 0.035, 0.0)
    parts.append(shifted(seat, z=height - top))
    size = (side, side, height)
    return Thing("stool", parts, prefixed(name, look), size, places=(Place(height, area),))


def make_chair(shop: Workshop, name: str) -> Thing:
    """A plain chair; its back is towards +y."""
    width, depth, seat = shop.rng.uniform((0.4, 0.4, 0.42), (0.45, 0.44, 0.47)).tolist()
    back, top, leg = 0.42, 0.03, 0.04
    look = {"*": _wood(shop, 0.6, 0.6, 800), "leg": _wood(shop, 1.0, 0.3)}
    parts = [shifted(box((width, depth, top), f"{name}*", shop.step_m), z=seat - top)]
    parts += _legs(shop, name, width, depth, seat - top, leg, 0.01)
    for sign in (-1, 1):
        post = box(
            (leg, 0.025, back + _OVERLAP_M), f"{name}leg", shop.step_m, (0.1 * sign, 0.4), upright=False
        )
        parts.append(shifted(post, sign * (width - leg) / 2, (depth - 0.025) / 2, seat - _OVERLAP_M))
    for z in (0.12, 0.28):
        rail = box((width - leg, 0.018, 0.1), f"{name}*", shop.step_m, (0.2, z))
        parts.append(shifted(rail, 0, (depth - 0.025) / 2, seat + z))
    place = Place(seat, rectangle(width, depth - 0.03, y=-0.015))
    return Thing("chair", parts, prefixed(name, look), (width, depth, seat + back), places=(place,))


def _hung(solid: Solid) -> Solid:
    """Turn a body that was turned around z so that its axis points to -y."""
    tilt = np.eye(4)
    tilt[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # +z becomes -y ... and -y becomes -z
    return moved(solid, tilt)


def make_picture(shop: Workshop, name: str) -> Thing:
    """A framed painting."""
    width, height = shop.rng.uniform((0.42, 0.34), (0.66, 0.5)).tolist()
    depth, bar, overlap = 0.03, 0.035, 0.002
    look = {
        "*": _wood(shop, 0.8, 0.4, 900),
        "art": textures.picture(shop.rng, width - 2 * bar, height - 2 * bar, 900 * shop.density),
    }
    art = box((width - 2 * bar, 0.012, height - 2 * bar), {"-y": f"{name}art", "*": f"{name}*"}, shop.step_m)
    parts = [shifted(art, y=-0.006, z=bar)]
    for sign in (-1, 1):
        stile = box((bar + overlap, depth, height), f"{name}*", shop.step_m, (0.1, 0.3 * sign), upright=False)
        parts.append(shifted(stile, x=sign * (width - bar - overlap) / 2, y=-depth / 2))
        rail = box((width - 2 * bar, depth, bar + overlap), f"{name}*", shop.step_m, (0.3, 0.1 * sign))
        parts.append(shifted(rail, y=-depth / 2, z=0 if sign < 0 else height - bar - overlap))
    return Thing("painting", parts, prefixed(name, look), (width, depth, height))


def make_poster(shop: Workshop, name: str) -> Thing:
    """A printed board."""
    width, height = shop.rng.uniform((0.3, 0.4), (0.42, 0.56)).tolist()
    depth = 0.02
    look = {
        "-y": textures.label(
            shop.rng, width, height, 900 * shop.density, pick_color(shop), ("SUMMER", "FAIR", "JULY")
        ),
        "*": textures.plaster(shop.rng, 0.4, 0.4, 600 * shop.density, pick_color(shop), 8),
    }
    solid = box((width, depth, height), {side: f"{name}{side}" for side in look}, shop.step_m)
    return Thing("poster", [shifted(solid, y=-depth / 2)], prefixed(name, look), (width, depth, height))


def make_clock(shop: Workshop, name: str) -> Thing:
    """A round wall clock with hands."""
    radius, depth = float(shop.rng.uniform(0.13, 0.18)), 0.04
    hour, minute = shop.rng.uniform(0, 360, 2)
    look = {
        "rim": textures.glaze(shop.rng, 1.0, 0.1, 1000 * shop.density, pick_color(shop)),
        "face": _clock_face(shop, radius),
        "hand": textures.plain((30, 30, 34)),
    }
    body = [
        (np.array([[0, 0], [radius, 0]]), f"{name}rim"),
        (np.array([[radius, 0], [radius, depth]]), f"{name}rim"),
        (np.array([[radius, depth], [0, depth]]), f"{name}face"),
    ]
    parts = [shifted(_hung(lathe(body, shop.step_m)), z=radius)]
    for angle, length in ((hour, 0.5 * radius), (minute, 0.78 * radius)):
        a = np.radians(angle)
        turn = np.eye(4)
        turn[:3, :3] = [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
        turn[:3, 3] = 0, -depth - 0.002, radius
        parts.append(moved(box((0.014, 0.008, length), f"{name}hand", shop.step_m), turn))
    size = (2 * radius, depth + 0.006, 2 * radius)
    return Thing("clock", parts, prefixed(name, look), size)


def _clock_face(shop: Workshop, radius: float) -> Texture:
    import cv2

    pixels = max(8, round(2 * radius * 1000 * shop.density))
    image = np.full((pixels, pixels, 3), 236, np.uint8)
    middle = pixels / 2
    for tick in range(12):
        a, size = np.radians(30 * tick), 0.08 if tick % 3 else 0.13
        ends = [
            (int(middle * (1 + r * np.sin(a))), int(middle * (1 - r * np.cos(a)))) for r in (0.9 - size, 0.9)
        ]
        cv2.line(image, ends[0], ends[1], (40, 40, 46), max(1, pixels // 40), cv2.LINE_AA)
    ink = tuple(int(c) for c in pick_color(shop))
    cv2.circle(image, (int(middle), int(middle * 0.62)), max(1, pixels // 16), ink, -1, cv2.LINE_AA)
    noise = 4 * textures.octave_noise(shop.rng, image.shape[:2], (20, 20), 4, 0.8)[..., None]
    return Texture(np.clip(image + noise, 0, 255).astype(np.uint8), 2 * radius, 2 * radius)


def make_wall_shelf(shop: Workshop, name: str) -> Thing:
    """A board on two brackets; things may stand on it."""
    width, depth = shop.rng.uniform((0.55, 0.19), (0.8, 0.24)).tolist()
    board, bracket = 0.024, 0.12
    look = {
        "*": _wood(shop, 1.0, 0.4, 800),
        "leg": textures.plaster(shop.rng, 0.3, 0.3, 600 * shop.density, pick_color(shop)),
    }
    parts = [shifted(box((width, depth, board), f"{name}*", shop.step_m), y=-depth / 2, z=bracket)]
    for sign in (-1, 1):
        x = sign * (width / 2 - 0.08)
        post = box((0.025, 0.018, bracket + _OVERLAP_M), f"{name}leg", shop.step_m)
        parts.append(shifted(post, x, -0.009))
        arm = box((0.025, 0.8 * depth, 0.018 + _OVERLAP_M), f"{name}leg", shop.step_m)
        parts.append(shifted(arm, x, -0.4 * depth, bracket - 0.018))
    height = bracket + board
    place = Place(height, rectangle(width, depth - 0.01, y=-depth / 2 - 0.005), name="board")
    return Thing("wall shelf", parts, prefixed(name, look), (width, depth, height), places=(place,))


def make_hook_rack(shop: Workshop, name: str) -> Thing:
    """A rail with pegs."""
    width, pegs = float(shop.rng.uniform(0.42, 0.64)), int(shop.rng.integers(3, 6))
    height, depth = 0.11, 0.024
    look = {
        "*": _wood(shop, 0.8, 0.3, 900),
        "peg": textures.glaze(shop.rng, 0.2, 0.2, 1000 * shop.density, pick_color(shop)),
    }
    parts = [shifted(box((width, depth, height), f"{name}*", shop.step_m), y=-depth / 2)]
    reach, radius = 0.065, 0.013
    body = [
        (np.array([[0, 0], [radius, 0]]), f"{name}peg"),
        (np.array([[radius, 0], [1.3 * radius, reach]]), f"{name}peg"),
        (np.array([[1.3 * radius, reach], [0, reach]]), f"{name}peg"),
    ]
    for x in np.linspace(-0.38, 0.38, pegs) * width:
        parts.append(
            shifted(_hung(lathe(body, shop.step_m, segments=16)), float(x), -depth + 0.004, height / 2)
        )
    size = (width, depth + reach - 0.004, height)
    return Thing("hook rack", parts, prefixed(name, look), size)


CENTER_KINDS: dict[str, Kind] = {
    "table": Kind("table", make_table, fixed=True, weight=3.0),
    "round_table": Kind("table", make_round_table, fixed=True),
}
"""What the camera walks around."""

SIDE_KINDS: dict[str, Kind] = {
    "bookshelf": Kind("bookshelf", make_bookcase, fixed=True, weight=1.3),
    "cabinet": Kind("cabinet", make_cabinet, fixed=True, weight=1.3),
    "bench": Kind("bench", make_bench, fixed=True),
    "stool": Kind("stool", make_stool, weight=0.7),
    "chair": Kind("chair", make_chair, weight=0.7),
}
"""What stands along the walls."""

WALL_KINDS: dict[str, Kind] = {
    "painting": Kind("painting", make_picture, fixed=True, weight=1.2),
    "poster": Kind("poster", make_poster, fixed=True, weight=0.8),
    "clock": Kind("clock", make_clock, fixed=True),
    "wall_shelf": Kind("wall shelf", make_wall_shelf, fixed=True, weight=1.2),
    "hook_rack": Kind("hook rack", make_hook_rack, fixed=True, weight=0.8),
}
"""What hangs on walls."""
