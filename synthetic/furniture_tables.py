"""Tables and desks of many builds; they face -y."""

import numpy as np

from synthetic.footprints import disc, rectangle
from synthetic.furniture import Workshop
from synthetic.furniture_kit import OVERLAP_M, Carpenter, draped, rounded_outline
from synthetic.things import Kind, Place, Thing


def _top(c: Carpenter, width: float, depth: float, height: float, thick: float) -> None:
    c.look["*"] = c.board(1.4, 0.9)
    c.box((width, depth, thick), z=height - thick)


def make_dining_table(shop: Workshop, name: str) -> Thing:
    """A rectangular table to sit at, with or without an apron."""
    c = Carpenter(shop, name)
    width, depth, height = c.between(1.05, 1.75), c.between(0.7, 0.95), c.between(0.71, 0.77)
    thick, leg, inset, style = (
        c.between(0.02, 0.05),
        c.between(0.045, 0.085),
        c.between(0.0, 0.07),
        c.count(0, 2),
    )
    _top(c, width, depth, height, thick)
    c.look["leg"] = c.board(0.8, 0.3)
    c.legs(width, depth, height - thick, leg, inset, style)
    if c.chance(0.6):
        high = c.between(0.05, 0.09)
        x, y = width / 2 - inset - leg / 2, depth / 2 - inset - leg / 2
        for sign in (-1, 1):
            c.box((2 * x, 0.02, high + OVERLAP_M), 0, sign * y, height - thick - high, "leg")
            c.box((0.02, 2 * y, high + OVERLAP_M), sign * x, 0, height - thick - high, "leg")
    return c.finish("table", (Place(height, rectangle(width, depth)),))


def make_pedestal_table(shop: Workshop, name: str) -> Thing:
    """A round top on one turned foot."""
    c = Carpenter(shop, name)
    radius, height, thick = c.between(0.34, 0.56), c.between(0.42, 0.76), c.between(0.018, 0.04)
    column, foot = c.between(0.03, 0.07), c.between(0.55, 0.7) * radius
    c.look |= {"*": c.board(1.2, 1.2), "leg": c.paint() if c.chance(0.5) else c.wood(0.7, 0.5)}
    c.turned([[0, 0], [radius, 0], [radius, thick], [0, thick]], z=height - thick, segments=48)
    under, swell = height - thick, c.between(0.8, 1.6)
    if c.chance(0.5):
        c.turned(
            [[0, 0], [foot, 0], [foot, 0.02], [column, 0.05], [swell * column, 0.4 * under], [column, 0.75 * under],
             [1.8 * column, under + OVERLAP_M], [0, under + OVERLAP_M]], look="leg",
        )  # fmt: skip
    else:
        c.post(column, under + OVERLAP_M - 0.02, z=0.02)
        for turn in range(c.count(3, 5)):
            yaw = 2 * np.pi * turn / 4
            c.box((foot, 0.06, 0.04), 0.5 * foot * np.cos(yaw), 0.5 * foot * np.sin(yaw), 0, "leg", yaw=yaw)
    return c.finish("table", (Place(height, disc(radius)),))


def make_oval_table(shop: Workshop, name: str) -> Thing:
    """An oval top on four legs."""
    c = Carpenter(shop, name)
    a, b, height = c.between(0.5, 0.8), c.between(0.34, 0.48), c.between(0.4, 0.76)
    thick, style = c.between(0.02, 0.04), c.count(0, 2)
    c.look |= {"*": c.board(1.6, 1.0), "leg": c.board(0.8, 0.3)}
    c.turned([[0, 0], [1, 0], [1, thick], [0, thick]], z=height - thick, segments=64, stretch=(a, b))
    c.legs(1.25 * a, 1.25 * b, height - thick, c.between(0.035, 0.06), 0.0, style)
    return c.finish("table", (Place(height, disc(1.0, 32) * (a, b)),))


def make_trestle_table(shop: Workshop, name: str) -> Thing:
    """A board on two trestles with splayed legs."""
    c = Carpenter(shop, name)
    width, depth, height = c.between(1.0, 1.6), c.between(0.6, 0.8), c.between(0.68, 0.76)
    thick, leg, reach = c.between(0.02, 0.035), c.between(0.035, 0.05), c.between(0.24, 0.36)
    _top(c, width, depth, height, thick)
    c.look["leg"] = c.board(0.8, 0.3)
    under, span = height - thick, min(0.8 * depth, 2 * reach)
    for sx in (-1, 1):
        x = sx * c.between(0.3, 0.36) * width
        c.box((leg, 0.85 * depth, 0.05 + OVERLAP_M), x, 0, under - 0.05, "leg")
        for sy in (-1, 1):
            low, high = sy * span / 2, sy * span / 5
            c.add(_leaning(c, leg, low, high, under - 0.05 + OVERLAP_M), x)
        c.box((0.7 * leg, 0.72 * span, 0.035), x, 0, 0.3 * under, "leg")
    return c.finish("table", (Place(height, rectangle(width, depth)),))


def _leaning(c: Carpenter, thick: float, low: float, high: float, height: float):
    """Return a leg in the yz plane from y = low at the floor to y = high."""
    from synthetic.shapes import moved
    from synthetic.things import prism

    half = thick / 2
    outline = np.array([[low - half, 0], [low + half, 0], [high + half, height], [high - half, height]])
    solid = prism(outline, thick, (c.tex("leg"), c.tex("leg")), c.shop.step_m)
    turn = np.eye(4)
    turn[:2, :2] = [[0, -1], [1, 0]]
    return moved(solid, turn)


def make_coffee_table(shop: Workshop, name: str) -> Thing:
    """A low table with a second board below."""
    c = Carpenter(shop, name)
    width, depth, height = c.between(0.75, 1.25), c.between(0.48, 0.7), c.between(0.34, 0.5)
    thick, leg, style, low = (
        c.between(0.018, 0.05),
        c.between(0.035, 0.06),
        c.count(0, 3),
        c.between(0.07, 0.15),
    )
    _top(c, width, depth, height, thick)
    c.look |= {"leg": c.board(0.7, 0.3), "low": c.board(1.2, 0.7)}
    c.legs(width, depth, height - thick, leg, 0.02, style)
    inner = (width - 2 * (leg + 0.02) + 2 * OVERLAP_M, depth - 0.08)
    c.box((*inner, 0.018), z=low, look="low")
    for sign in (-1, 1):  # bars that carry the lower board
        if style != 3:
            c.box(
                (leg * 0.5, depth - 2 * leg, 0.018),
                sign * (width / 2 - 0.02 - leg / 2),
                0,
                low - 0.004,
                "leg",
            )
    room = height - thick - low - 0.018
    shelf = Place(low + 0.018, rectangle(inner[0] - 0.04, depth - 0.1), room, name="low")
    return c.finish("coffee table", (Place(height, rectangle(width, depth)), shelf))


def make_drawer_desk(shop: Workshop, name: str) -> Thing:
    """A desk with a block of drawers on one side or both."""
    c = Carpenter(shop, name)
    width, depth, height = c.between(1.05, 1.5), c.between(0.55, 0.75), c.between(0.71, 0.77)
    thick, block, style, rows = c.between(0.02, 0.04), c.between(0.32, 0.42), c.count(0, 2), c.count(2, 4)
    both, side = c.chance(0.35), -1 if c.chance(0.5) else 1
    _top(c, width, depth, height, thick)
    c.look |= {"body": c.board(), "front": c.board(0.6, 0.5), "leg": c.board(0.7, 0.3), "knob": c.metal()}
    under = height - thick
    for sign in (-1, 1):
        x = sign * (width / 2 - block / 2 - 0.01)
        if both or sign == side:
            y = -depth / 2 + 0.05
            c.box((block, depth - 0.07, under + OVERLAP_M), x, 0.015, 0, "body")
            c.drawers(block - 0.02, under - 0.09, y, 0.07, rows, 1, style, x)
        else:
            for sy in (-1, 1):
                at = sign * (width / 2 - 0.05), sy * (depth / 2 - 0.05)
                c.box((0.05, 0.05, under + OVERLAP_M), *at, 0, "leg", upright=False)
    if not both:
        c.box((width - 0.2, 0.02, 0.2), 0, depth / 2 - 0.05, under - 0.2 + OVERLAP_M, "body")
    return c.finish("desk", (Place(height, rectangle(width, depth)),))


def make_panel_desk(shop: Workshop, name: str) -> Thing:
    """A desk on two side panels, at times with a raised shelf along its back."""
    c = Carpenter(shop, name)
    width, depth, height = c.between(0.95, 1.45), c.between(0.5, 0.7), c.between(0.7, 0.76)
    thick, raised = c.between(0.018, 0.03), c.chance(0.5)
    _top(c, width, depth, height, thick)
    c.look |= {"leg": c.board(), "back": c.paint()}
    for sign in (-1, 1):
        c.box((thick, depth - 0.04, height - thick + OVERLAP_M), sign * (width / 2 - thick), 0, 0, "leg")
    c.box((width - 2 * thick, 0.018, 0.34), 0, depth / 2 - 0.06, height - thick - 0.34 + OVERLAP_M, "back")
    if not raised:
        return c.finish("desk", (Place(height, rectangle(width, depth)),))
    rise, shelf = c.between(0.16, 0.3), c.between(0.16, 0.22)
    y = depth / 2 - shelf / 2
    for x in np.linspace(-0.5, 0.5, c.count(2, 4)) * (width - thick):
        c.box((thick, shelf, rise + OVERLAP_M), float(x), y, height - 0.002, "leg")
    c.box((width, shelf, thick), 0, y, height + rise, "*")
    front = depth - shelf - 0.03
    places = (
        Place(height, rectangle(width, front, y=-depth / 2 + front / 2)),
        Place(height + rise + thick, rectangle(width, shelf, y=y), name="raised"),
    )
    return c.finish("desk", places)


def make_bar_table(shop: Workshop, name: str) -> Thing:
    """A high small table."""
    c = Carpenter(shop, name)
    side, height, thick, style = (
        c.between(0.48, 0.66),
        c.between(0.95, 1.08),
        c.between(0.02, 0.035),
        c.count(0, 2),
    )
    c.look |= {"*": c.board(0.8, 0.8), "leg": c.metal() if c.chance(0.5) else c.board(0.8, 0.3)}
    if c.chance(0.5):
        c.turned([[0, 0], [side / 2, 0], [side / 2, thick], [0, thick]], z=height - thick, segments=48)
        c.post(c.between(0.025, 0.05), height - thick - 0.015 + OVERLAP_M, z=0.015)
        c.turned([[0, 0], [0.36 * side, 0], [0.36 * side, 0.012], [0.05, 0.03], [0, 0.03]], look="leg")
        area = disc(side / 2)
    else:
        c.box((side, side, thick), z=height - thick)
        c.legs(side, side, height - thick, 0.045, 0.01, style)
        for sign in (-1, 1):
            c.box((side - 0.05, 0.02, 0.03), 0, sign * (side / 2 - 0.033), 0.25, "leg")
        area = rectangle(side, side)
    return c.finish("bar table", (Place(height, area),))


def make_nested_tables(shop: Workshop, name: str) -> Thing:
    """Two or three tables of one build, the smaller ones drawn out from below."""
    c = Carpenter(shop, name)
    width, depth, height = c.between(0.6, 0.85), c.between(0.4, 0.5), c.between(0.46, 0.56)
    thick, out = c.between(0.018, 0.025), 0.0
    c.look |= {"*": c.board(1.0, 0.6), "1": c.board(0.8, 0.5), "2": c.board(0.6, 0.5)}
    places = []
    for number in range(c.count(2, 3)):
        look = ("*", "1", "2")[number]
        c.box((width, depth, thick), 0, -out, height - thick, look)
        for sign in (-1, 1):
            size = (thick, depth - 0.04, height - thick + OVERLAP_M)
            c.box(size, sign * (width / 2 - thick), -out, 0, look)
        step = 0.0 if number == 0 else places[-1][2]
        places.append((height, width, out, depth, step))
        out += c.between(0.14, 0.24)
        width, height, depth = width - 5 * thick, height - thick - c.between(0.03, 0.05), depth - 0.03
    made, front = [], None
    for high, wide, shift, deep, _ in places:
        low = -shift - deep / 2
        free = deep if front is None else front - 0.01 - low
        made.append(Place(high, rectangle(wide, free, y=low + free / 2), name=f"top_{len(made)}"))
        front = low
    return c.finish("nested tables", tuple(p for p in made if np.ptp(p.area[:, 1]) > 0.08))


def make_cloth_table(shop: Workshop, name: str) -> Thing:
    """A table under a cloth that hangs over its edge in folds."""
    c = Carpenter(shop, name)
    round_top, height, drop = c.chance(0.45), c.between(0.62, 0.77), c.between(0.1, 0.42)
    width = c.between(0.75, 1.1) if round_top else c.between(0.95, 1.5)
    depth = width if round_top else c.between(0.65, 0.85)
    c.look |= {"*": c.cloth(1.0, 1.0), "leg": c.board(0.7, 0.3)}
    thick = 0.025
    radius = 0.5 * min(width, depth) * (1.0 if round_top else 0.06)
    outline = disc(width / 2, 96) if round_top else rounded_outline(width, depth, radius)
    cloth = draped(
        outline, drop, c.tex("*"), fold=c.between(0.004, 0.03), folds=c.count(9, 30), flare=c.between(0, 0.04),
        phase=c.between(0, 6),
    )  # fmt: skip
    c.add(cloth, z=height)
    if round_top:
        r = width / 2 - 0.008
        c.turned([[0, 0], [r, 0], [r, thick], [0, thick]], z=height - thick - 0.003, look="leg", segments=48)
        c.legs(1.2 * r, 1.2 * r, height - thick - 0.003, 0.05, 0.0, c.count(0, 2))
    else:
        size = (width - 0.02, depth - 0.02, thick)
        c.box(size, z=height - thick - 0.003, look="leg")
        c.legs(width - 0.03, depth - 0.03, height - thick - 0.003, 0.05, 0.01, c.count(0, 2))
    area = disc(0.96 * width / 2) if round_top else rectangle(width - 0.05, depth - 0.05)
    return c.finish("table with cloth", (Place(height, area),))


TABLES: dict[str, Kind] = {
    "dining": Kind("table", make_dining_table, fixed=True, weight=1.5),
    "pedestal": Kind("table", make_pedestal_table, fixed=True),
    "oval": Kind("table", make_oval_table, fixed=True),
    "trestle": Kind("table", make_trestle_table, fixed=True),
    "coffee": Kind("coffee table", make_coffee_table, fixed=True, weight=1.3),
    "drawer_desk": Kind("desk", make_drawer_desk, fixed=True),
    "panel_desk": Kind("desk", make_panel_desk, fixed=True),
    "bar": Kind("bar table", make_bar_table, fixed=True, weight=0.6),
    "nested": Kind("nested tables", make_nested_tables, fixed=True, weight=0.6),
    "cloth": Kind("table with cloth", make_cloth_table, fixed=True),
}
