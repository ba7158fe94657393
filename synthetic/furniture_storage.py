"""Shelves, wardrobes, drawers, kitchen counters, fridges; they face -y. Wall cabinets have their back at y = 0."""

from itertools import pairwise

import numpy as np

from synthetic.footprints import rectangle
from synthetic.furniture import Workshop
from synthetic.furniture_kit import OVERLAP_M, Carpenter
from synthetic.things import Kind, Place, Thing

_SEEN_M = 1.4  # what stands higher is not seen by a person's camera


def _seen(*places: Place) -> tuple[Place, ...]:
    return tuple(p for p in places if p.height_m <= _SEEN_M)


def make_open_shelf(shop: Workshop, name: str) -> Thing:
    """A shelf with compartments of unlike heights and widths, with or without a back."""
    c = Carpenter(shop, name)
    width, depth, height = c.between(0.6, 1.15), c.between(0.26, 0.38), c.between(0.7, 1.85)
    board, backed = c.between(0.016, 0.03), c.chance(0.6)
    c.look |= {"*": c.board(), "back": c.paint(1.0, 1.0)}
    for sign in (-1, 1):
        c.box((board, depth, height), sign * (width - board) / 2, 0, 0, upright=False)
    inner, low, places = width - 2 * board, c.between(0.03, 0.1), []
    levels = [low]
    while height - board - levels[-1] > 0.62:
        levels.append(levels[-1] + c.between(0.22, 0.4))
    if height - board - levels[-1] > 0.44:
        levels.append(levels[-1] + 0.5 * (height - board - levels[-1]))
    levels.append(height - board)
    y, deep = (-0.007, depth - 0.014) if backed else (0.0, depth)
    for number, level in enumerate(levels):
        c.box((inner + 2 * OVERLAP_M, depth, board), 0, 0, level)
        if number + 1 == len(levels):
            break
        free = levels[number + 1] - level - board
        floor = level + board
        split = c.between(-0.25, 0.25) * inner if c.chance(0.5) else None
        if split is None:
            places.append(Place(floor, rectangle(inner, deep, y=y), free, name=f"board_{number}"))
            continue
        c.box((board, depth - 0.012, free + 2 * OVERLAP_M), split, -0.004, floor - OVERLAP_M, upright=False)
        for side, (a, b) in enumerate(((-inner / 2, split - board / 2), (split + board / 2, inner / 2))):
            area = rectangle(b - a, deep, (a + b) / 2, y)
            places.append(Place(floor, area, free, name=f"board_{number}_{side}"))
    if backed:
        c.box((inner + 2 * OVERLAP_M, 0.012, height - low), 0, depth / 2 - 0.006, low, "back")
    shown = [p for p in places if p.height_m > 0.2]
    return c.finish("shelf", _seen(*shown, Place(height, rectangle(width, depth))))


def make_wardrobe(shop: Workshop, name: str) -> Thing:
    """A tall closed cupboard with two to four doors."""
    c = Carpenter(shop, name)
    columns = c.count(2, 4)
    width, depth, height = columns * c.between(0.38, 0.5), c.between(0.5, 0.62), c.between(1.75, 2.15)
    plinth = c.between(0.03, 0.1)
    c.look |= {"*": c.board(1.0, 1.2), "front": c.board(1.0, 1.2), "knob": c.metal()}
    c.box((width - 0.02, depth - 0.06, plinth + OVERLAP_M), 0, 0.01, 0)
    c.box((width, depth - 0.016, height - plinth), 0, 0.008, plinth)
    c.doors(
        width - 0.01,
        height - plinth - 0.02,
        -depth / 2 + 0.012,
        plinth + 0.01,
        columns,
        c.count(0, 1),
        c.chance(0.4),
    )
    return c.finish("wardrobe")


def make_dresser(shop: Workshop, name: str) -> Thing:
    """A chest of drawers."""
    c = Carpenter(shop, name)
    rows, columns = c.count(2, 5), c.count(1, 2)
    width, depth = c.between(0.42, 0.6) * columns + 0.05, c.between(0.38, 0.5)
    height, foot = rows * c.between(0.17, 0.23) + 0.06, c.between(0.0, 0.14)
    c.look |= {"*": c.board(), "front": c.board(), "knob": c.metal(), "leg": c.board(0.3, 0.3)}
    if foot > 0.05:
        c.legs(width, depth, foot, 0.05, 0.02, c.count(0, 2))
    else:
        foot = 0.0
    c.box((width, depth - 0.016, height), 0, 0.008, foot)
    c.drawers(width - 0.03, height - 0.05, -depth / 2 + 0.012, foot + 0.02, rows, columns, c.count(0, 3))
    top = foot + height
    return c.finish("dresser", _seen(Place(top, rectangle(width, depth - 0.02, y=0.01))))


def make_nightstand(shop: Workshop, name: str) -> Thing:
    """A small chest beside a bed, closed or with an open compartment."""
    c = Carpenter(shop, name)
    width, depth, height, board = c.between(0.36, 0.52), c.between(0.32, 0.42), c.between(0.42, 0.62), 0.018
    c.look |= {"*": c.board(), "front": c.board(0.5, 0.4), "knob": c.metal()}
    if c.chance(0.5):
        c.box((width, depth - 0.016, height), 0, 0.008, 0)
        c.drawers(width - 0.03, height - 0.06, -depth / 2 + 0.012, 0.04, c.count(1, 3), 1, c.count(0, 3))
        return c.finish("nightstand", (Place(height, rectangle(width, depth - 0.02, y=0.01)),))
    for sign in (-1, 1):
        c.box((board, depth, height - board + OVERLAP_M), sign * (width - board) / 2, 0, 0, upright=False)
    c.box((width, depth, board), z=height - board)
    inner, floor = width - 2 * board, c.between(0.1, 0.2)
    c.box((inner + 2 * OVERLAP_M, depth, board), z=floor)
    c.box((inner + 2 * OVERLAP_M, 0.012, height - floor - OVERLAP_M), 0, depth / 2 - 0.006, floor)
    drawer = 0.13
    c.box((inner - 0.008, depth - 0.04, drawer), 0, 0.005, height - board - drawer + OVERLAP_M, "front")
    c.handle(0.1, 0, -depth / 2 + 0.025, height - board - 0.06, c.count(0, 2))
    room = height - 2 * board - drawer - floor
    area = rectangle(inner, depth - 0.014, y=-0.007)
    return c.finish(
        "nightstand", (Place(height, rectangle(width, depth)), Place(floor + board, area, room, name="board"))
    )


def make_counter(shop: Workshop, name: str) -> Thing:
    """One element of a kitchen: body on a plinth, doors or drawers, a worktop that reaches to its sides."""
    c = Carpenter(shop, name)
    width, depth, height = c.between(0.45, 0.8), c.between(0.56, 0.64), c.between(0.84, 0.94)
    thick, plinth, style = c.between(0.025, 0.04), c.between(0.08, 0.14), c.count(0, 2)
    c.look |= {
        "*": c.paint(), "front": c.paint() if c.chance(0.7) else c.wood(), "top": c.board(1.0, 0.8), "knob": c.metal(),
    }  # fmt: skip
    c.box((width, depth - 0.1, plinth + OVERLAP_M), 0, 0.05, 0)
    c.box((width, depth - 0.04, height - thick - plinth), 0, 0.02, plinth)
    c.box((width, depth, thick + OVERLAP_M), 0, 0, height - thick - OVERLAP_M, "top")
    front, high = -depth / 2 + 0.03, height - thick - plinth - 0.02
    if style == 0:
        c.doors(width - 0.004, high, front, plinth + 0.01, 1 + (width > 0.6), c.count(0, 1), c.chance(0.3))
    elif style == 1:
        c.drawers(width - 0.004, high, front, plinth + 0.01, c.count(2, 4), 1, c.count(0, 3))
    else:
        c.doors(width - 0.004, 0.74 * high, front, plinth + 0.01, 1 + (width > 0.6), c.count(0, 1), False)
        c.drawers(width - 0.004, 0.25 * high, front, plinth + 0.01 + 0.75 * high, 1, 1, c.count(0, 2))
    return c.finish("counter", (Place(height, rectangle(width, depth)),))


def make_fridge(shop: Workshop, name: str) -> Thing:
    """A fridge with one or two doors."""
    c = Carpenter(shop, name)
    width, depth, height = c.between(0.52, 0.66), c.between(0.56, 0.66), c.between(0.82, 1.9)
    split = c.between(0.3, 0.65) if height > 1.2 else 0.0
    c.look |= {"*": c.paint(), "knob": c.metal()}
    c.look["front"] = c.look["*"] if c.chance(0.7) else c.metal()
    c.box((width - 0.02, depth - 0.1, 0.04 + OVERLAP_M), 0, 0.04, 0, "knob")
    c.box((width, depth - 0.05, height - 0.04), 0, 0.025, 0.04)
    for low, high in ((0.05, height * split - 0.004), (max(height * split, 0.046) + 0.004, height - 0.002)):
        if high - low < 0.1:
            continue
        c.box((width - 0.004, 0.05, high - low), 0, -depth / 2 + 0.029, low, "front")
        long = min(0.35, 0.5 * (high - low))
        c.box((0.016, 0.03, long), width / 2 - 0.05, -depth / 2 - 0.005, (low + high - long) / 2, "knob")
    return c.finish("fridge", _seen(Place(height, rectangle(width, depth - 0.06, y=0.03))))


def make_trolley(shop: Workshop, name: str) -> Thing:
    """A shelf on wheels: boards between four posts."""
    c = Carpenter(shop, name)
    width, depth, height = c.between(0.4, 0.7), c.between(0.32, 0.42), c.between(0.6, 0.9)
    board, levels, style = 0.018, c.count(2, 4), c.chance(0.5)
    c.look |= {
        "*": c.board(0.8, 0.5),
        "leg": c.metal() if style else c.board(0.6, 0.3),
        "wheel": c.paint(0.2, 0.2),
    }
    wheel, post = 0.05, 0.028
    x, y = width / 2 - post / 2, depth / 2 - post / 2
    for sx in (-1, 1):
        for sy in (-1, 1):
            c.box((0.018, 0.05, wheel + OVERLAP_M), sx * x, sy * (y - 0.01), 0, "wheel")
            c.box((post, post, height - wheel), sx * x, sy * y, wheel, "leg", upright=False)
    bottoms = np.linspace(0.12, height - board, levels)
    places = []
    for number, level in enumerate(bottoms):
        last = number + 1 == levels
        lift = 0.002 if last else 0.0
        c.box((width - 0.006, depth - 0.006, board), 0, 0, float(level) + lift)
        free = np.inf if last else float(bottoms[number + 1] - level) - board
        size = (width - 0.01, depth - 0.01) if last else (width - 2 * post, depth - 0.01)
        if float(level) > 0.3 or last:
            places.append(Place(float(level) + lift + board, rectangle(*size), free, name=f"board_{number}"))
    return c.finish("trolley", tuple(places))


def make_sideboard(shop: Workshop, name: str) -> Thing:
    """A long low cupboard, part doors, part drawers, part open."""
    c = Carpenter(shop, name)
    width, depth, height, foot = (
        c.between(1.1, 1.7),
        c.between(0.36, 0.46),
        c.between(0.4, 0.62),
        c.between(0.0, 0.18),
    )
    board, fields = 0.02, c.count(2, 4)
    c.look |= {"*": c.board(1.4, 0.7), "front": c.board(), "knob": c.metal(), "leg": c.board(0.3, 0.3)}
    if foot > 0.06:
        c.legs(width, depth, foot, 0.045, 0.04, c.count(0, 2))
    else:
        foot = 0.0
    style, free, places = c.count(0, 3), height - 2 * board, []
    c.box((width, depth, board), z=foot)
    c.box((width, depth, board), z=foot + height - board)
    c.box((width, 0.012, height - 2 * board + 2 * OVERLAP_M), 0, depth / 2 - 0.006, foot + board - OVERLAP_M)
    edges = np.linspace(-width / 2, width / 2, fields + 1)
    for number, x in enumerate(edges):
        at = float(x) + (board / 2 if number == 0 else -board / 2 if number == fields else 0.0)
        c.box((board, depth - 0.02, free + 2 * OVERLAP_M), at, 0.0, foot + board - OVERLAP_M, upright=False)
    for a, b in pairwise(edges):
        kind, x, wide = c.count(0, 2), float(a + b) / 2, float(b - a)
        if kind == 0:
            area = rectangle(wide - 2 * board, depth - 0.03, x, -0.01)
            places.append(Place(foot + board, area, free, name=f"field_{len(places)}"))
            continue
        y = -depth / 2 + 0.012
        c.box((wide - 0.006, 0.016, height - 0.012), x, y - 0.006, foot + 0.006, "front")
        rows = 1 if kind == 1 else 2
        for row in range(rows):
            c.handle(0.1, x, y - 0.014, foot + (row + 0.6) * height / rows, style)
    return c.finish("sideboard", (Place(foot + height, rectangle(width, depth)), *places))


def make_wall_cabinet(shop: Workshop, name: str) -> Thing:
    """A cupboard that hangs: one or two doors."""
    c = Carpenter(shop, name)
    width, depth, height = c.between(0.5, 0.9), c.between(0.28, 0.36), c.between(0.45, 0.7)
    c.look |= {"*": c.paint(), "front": c.paint() if c.chance(0.6) else c.wood(), "knob": c.metal()}
    c.box((width, depth - 0.016, height), 0, -(depth - 0.016) / 2, 0)
    c.doors(
        width - 0.006, height - 0.008, -depth + 0.012, 0.004, 1 + (width > 0.55), c.count(0, 1), c.chance(0.4)
    )
    return c.finish("wall cabinet")


STORAGE: dict[str, Kind] = {
    "open_shelf": Kind("shelf", make_open_shelf, fixed=True, weight=1.5),
    "wardrobe": Kind("wardrobe", make_wardrobe, fixed=True, weight=0.7),
    "dresser": Kind("dresser", make_dresser, fixed=True),
    "nightstand": Kind("nightstand", make_nightstand, fixed=True),
    "counter": Kind("counter", make_counter, fixed=True),
    "fridge": Kind("fridge", make_fridge, fixed=True, weight=0.6),
    "trolley": Kind("trolley", make_trolley, fixed=True),
    "sideboard": Kind("sideboard", make_sideboard, fixed=True),
    "wall_cabinet": Kind("wall cabinet", make_wall_cabinet, fixed=True, weight=0.6),
}
