"""Sofas, chairs, stools, beds; they face -y. Cushions and blankets are uneven supports (`Place.sag`)."""

import numpy as np

from synthetic.footprints import disc, rectangle
from synthetic.furniture import Workshop
from synthetic.furniture_kit import (
    OVERLAP_M,
    Carpenter,
    cushion,
    cushion_sag,
    draped,
    rounded_outline,
    waves,
)
from synthetic.shapes import moved
from synthetic.things import Kind, Place, Thing


def _tilted(solid, degrees: float):
    """Lean a part back around the x axis."""
    a = np.radians(degrees)
    turn = np.eye(4)
    turn[1:3, 1:3] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    return moved(solid, turn)


def _couch(c: Carpenter, label: str, seats: int) -> Thing:
    """Base, arms, back, a seat cushion and a back cushion per seat."""
    seat_wide = c.between(0.52, 0.68)
    depth, seat, arm = c.between(0.78, 0.95), c.between(0.38, 0.46), c.between(0.09, 0.2)
    high, arm_high, foot = c.between(0.74, 0.92), c.between(0.52, 0.66), c.between(0.02, 0.12)
    soft, back, puff = c.between(0.12, 0.19), c.between(0.14, 0.22), c.between(0.08, 0.3)
    arms, rounding = c.chance(0.85), c.between(0.25, 0.7)
    inner = seats * seat_wide
    width = inner + (2 * arm if arms else 0.0)
    c.look |= {"*": c.cloth(1.0, 1.0), "leg": c.board(0.3, 0.3)}
    c.look["pillow"] = c.cloth(0.8, 0.8) if c.chance(0.4) else c.look["*"]
    for sx in (-1, 1):
        for sy in (-1, 1):
            c.box((0.05, 0.05, foot + 0.02), sx * (width / 2 - 0.06), sy * (depth / 2 - 0.06), 0, "leg")
    base = seat - soft
    c.box((width, depth, base - foot), z=foot)
    c.add(
        cushion((width - 0.01, back, high - foot), c.tex("*"), rounding, 0.0), 0, depth / 2 - back / 2, foot
    )
    if arms:
        for sign in (-1, 1):
            solid = cushion((arm, depth - 0.02, arm_high - foot), c.tex("*"), rounding, 0.1)
            c.add(solid, sign * (width - arm) / 2, -0.01, foot)
    long = depth - back
    size = (seat_wide - 0.006, long, soft + 0.02)
    area = rectangle(0.86 * size[0], 0.5 * size[1], y=0.0)
    places = []
    for number in range(seats):
        x = (number + 0.5) * seat_wide - inner / 2
        c.add(cushion(size, c.tex("pillow"), 0.45, puff), x, -back / 2 - 0.004, base - 0.02)
        pad = cushion(
            (seat_wide - 0.02, c.between(0.11, 0.17), c.between(0.36, 0.46)), c.tex("pillow"), 0.8, 0.1
        )
        c.add(_tilted(pad, -c.between(6, 14)), x, depth / 2 - back - 0.075, seat - 0.015)
        sag = cushion_sag(size, puff)
        y = -back / 2 - 0.1
        places.append(_soft_place(seat, area + np.array([x, y]), sag, x, -back / 2, f"seat_{number}"))
    return c.finish(label, tuple(places))


def _soft_place(height: float, area: np.ndarray, sag, x: float, y: float, name: str) -> Place:
    return Place(height, area, name=name, sag=lambda px, py: sag(np.asarray(px) - x, np.asarray(py) - y))


def make_sofa(shop: Workshop, name: str) -> Thing:
    """A sofa for two or three."""
    c = Carpenter(shop, name)
    return _couch(c, "sofa", c.count(2, 3))


def make_armchair(shop: Workshop, name: str) -> Thing:
    """A padded chair with arms."""
    return _couch(Carpenter(shop, name), "armchair", 1)


def make_cushion_bench(shop: Workshop, name: str) -> Thing:
    """A bench with a cushion on it."""
    c = Carpenter(shop, name)
    width, depth, height, pad = (
        c.between(0.8, 1.3),
        c.between(0.34, 0.44),
        c.between(0.36, 0.42),
        c.between(0.05, 0.09),
    )
    puff, style = c.between(0.05, 0.25), c.count(0, 3)
    c.look |= {"*": c.cloth(), "leg": c.board(1.2, 0.5)}
    c.box((width, depth, 0.03), z=height - 0.03, look="leg")
    c.legs(width, depth, height - 0.03, c.between(0.04, 0.06), 0.04, style)
    size = (width - 0.03, depth - 0.02, pad)
    c.add(cushion(size, c.tex("*"), 0.6, puff), z=height - 0.002)
    sag = cushion_sag(size, puff)
    area = rectangle(0.85 * width, 0.72 * depth)
    return c.finish("bench", (_soft_place(height - 0.002 + pad, area, sag, 0, 0, "top"),))


def make_office_chair(shop: Workshop, name: str) -> Thing:
    """A swivel chair on a star of five feet with castors."""
    c = Carpenter(shop, name)
    reach, seat, width = c.between(0.27, 0.33), c.between(0.44, 0.52), c.between(0.44, 0.5)
    pad, back, arms, puff = c.between(0.06, 0.09), c.between(0.42, 0.62), c.chance(0.6), c.between(0.1, 0.3)
    turn = c.between(0, 2 * np.pi)
    c.look |= {"*": c.cloth(0.5, 0.5), "leg": c.metal(), "dark": c.paint(0.3, 0.3)}
    for number in range(5):
        yaw = turn + 2 * np.pi * number / 5
        x, y = np.cos(yaw), np.sin(yaw)
        c.box((reach, 0.045, 0.035), 0.5 * reach * x, 0.5 * reach * y, 0.06, "leg", yaw=yaw)
        c.add(
            cushion((0.055, 0.03, 0.064), c.tex("dark"), 0.8, 0.0, middle=2),
            reach * x,
            reach * y,
            0,
            yaw + 1.57,
        )
    c.post(0.032, seat - pad - 0.06 + OVERLAP_M, z=0.06)
    size = (width, width, pad)
    c.add(cushion(size, c.tex("*"), 0.7, puff), z=seat - pad)
    c.add(
        _tilted(cushion((0.92 * width, 0.06, back), c.tex("*"), 0.8, 0.0), -8),
        0,
        width / 2 + 0.02,
        seat + 0.08,
    )
    c.box((0.07, 0.02, 0.34), 0, width / 2 + 0.01, seat - pad + 0.01, "dark")
    if arms:
        for sign in (-1, 1):
            c.box((0.03, 0.04, 0.2 + pad), sign * (width / 2 + 0.02), 0, seat - pad, "dark")
            c.box((0.06, 0.24, 0.03), sign * (width / 2 + 0.02), 0, seat + 0.2 - 0.004, "dark")
            c.box((0.06, 0.04, 0.02), sign * (width / 2), 0, seat - pad + 0.01, "dark")
    area = rectangle(0.7 * width, 0.6 * width, y=-0.05)
    return c.finish("office chair", (_soft_place(seat, area, cushion_sag(size, puff), 0, 0, "seat"),))


def make_stool_family(shop: Workshop, name: str) -> Thing:
    """A stool: round on three or four legs, a padded one, or a hollow cube."""
    c = Carpenter(shop, name)
    side, height, style = c.between(0.3, 0.4), c.between(0.4, 0.66), c.count(0, 2)
    c.look |= {"*": c.board(0.5, 0.5), "leg": c.board(0.5, 0.3)}
    if style == 2:
        height = min(height, 0.48)
        for sign in (-1, 1):
            c.box((0.02, side, height), sign * (side / 2 - 0.01), 0, 0, "*")
        c.box((side - 0.04 + 2 * OVERLAP_M, side, 0.02), 0, 0, height - 0.02, "*")
        c.box((side - 0.04 + 2 * OVERLAP_M, side, 0.02), 0, 0, 0.1, "leg")
        return c.finish("stool", (Place(height, rectangle(side, side)),))
    top = 0.03 if style == 0 else 0.012
    if style == 1:
        c.look["*"] = c.cloth(0.4, 0.4)
    c.turned(
        [[0, 0], [side / 2, 0], [side / 2, top], [0, top]], z=height - top, look="*" if style == 0 else "leg"
    )
    feet = c.count(3, 4)
    for number in range(feet):
        yaw = 2 * np.pi * (number + 0.5) / feet
        c.post(0.017, height - top + OVERLAP_M, 0.36 * side * np.cos(yaw), 0.36 * side * np.sin(yaw))
    if style == 1:
        r, pad = side / 2, 0.05
        c.turned(
            [[0, 0], [r, 0], [r * 1.03, 0.4 * pad], [0.97 * r, 0.8 * pad], [0.85 * r, pad], [0, pad]],
            z=height - 0.002,
        )
        return c.finish("stool", (Place(height - 0.002 + pad, disc(0.84 * r)),))
    return c.finish("stool", (Place(height, disc(side / 2)),))


def make_pouf(shop: Workshop, name: str) -> Thing:
    """A low round or square seat of cloth."""
    c = Carpenter(shop, name)
    radius, height, bulge = c.between(0.2, 0.32), c.between(0.28, 0.42), c.between(0.02, 0.08)
    c.look["*"] = c.cloth(1.2, 0.6)
    if c.chance(0.6):
        t = np.linspace(0, 1, 9)
        side = np.column_stack(
            [radius - bulge + 2 * bulge * np.sqrt(np.maximum(t * (1 - t), 0)), 0.94 * height * t]
        )
        top = np.array([[0.8 * (radius - bulge), height], [0, height]])
        c.turned(np.concatenate([[[0, 0]], side, top]), smooth=False, segments=36)
        return c.finish("pouf", (Place(height, disc(0.78 * (radius - bulge))),))
    size = (2 * radius, 2 * radius, height)
    c.add(cushion(size, c.tex("*"), 0.4, 0.12))
    area = rectangle(1.3 * radius, 1.3 * radius)
    return c.finish("pouf", (_soft_place(height, area, cushion_sag(size, 0.12), 0, 0, "top"),))


def make_style_chair(shop: Workshop, name: str) -> Thing:
    """A chair: ladder back, slats, solid back or padded; some have arms."""
    c = Carpenter(shop, name)
    width, depth, seat = c.between(0.4, 0.48), c.between(0.4, 0.46), c.between(0.42, 0.47)
    back, leg, style, legs = c.between(0.36, 0.56), c.between(0.028, 0.042), c.count(0, 3), c.count(0, 2)
    arms, padded, bars = c.chance(0.3), c.chance(0.4), c.count(2, 5)
    c.look |= {"*": c.board(0.6, 0.6), "leg": c.board(0.8, 0.3), "pad": c.cloth(0.5, 0.5)}
    c.box((width, depth, 0.025), z=seat - 0.025)
    c.legs(width, depth, seat - 0.025, leg, 0.01, legs)
    y = depth / 2 - 0.016
    if style in (0, 1):
        for sign in (-1, 1):
            c.box((leg, 0.025, back + OVERLAP_M), sign * (width - leg) / 2, y, seat - OVERLAP_M, "leg", False)
        if style == 0:
            for z in np.linspace(0.12, back - 0.07, bars):
                c.box((width - leg, 0.016, 0.05), 0, y, seat + float(z), "*")
        else:
            c.box((width - leg, 0.02, 0.06), 0, y, seat + back - 0.07)
            c.box((width - leg, 0.02, 0.03), 0, y, seat + 0.07)
            for x in np.linspace(-0.32, 0.32, bars + 1) * width:
                c.box((0.02, 0.014, back - 0.1), float(x), y, seat + 0.08, "leg", False)
    elif style == 2:
        c.box((width, 0.022, back), 0, y, seat - OVERLAP_M)
    else:
        c.add(_tilted(cushion((width, 0.05, back), c.tex("pad"), 0.7, 0.0), -5), 0, y, seat - 0.01)
    if arms:
        for sign in (-1, 1):
            x = sign * (width / 2 - 0.018)
            c.box((0.03, 0.03, 0.2 + OVERLAP_M), x, -0.3 * depth, seat - OVERLAP_M, "leg")
            c.box((0.04, 0.8 * depth, 0.025), x, 0.1 * depth - 0.012, seat + 0.19, "leg")
    area, high = rectangle(width - 0.1, depth - 0.1, y=-0.03), seat
    if padded:
        size = (width - 0.09, depth - 0.08, 0.04)
        c.add(cushion(size, c.tex("pad"), 0.8, 0.2), 0, -0.02, seat - 0.002)
        high = seat + 0.038
        place = _soft_place(high, 0.75 * area, cushion_sag(size, 0.2), 0, -0.02, "seat")
        return c.finish("chair", (place,))
    return c.finish("chair", (Place(high, area, name="seat"),))


def _bed(c: Carpenter, label: str, width: float, length: float, pillows: int) -> Thing:
    """Frame, mattress, a blanket in folds over the lower part, pillows at the head (+y)."""
    frame, pad, foot = c.between(0.16, 0.3), c.between(0.14, 0.24), c.between(0.0, 0.14)
    head, style, bump = c.between(0.75, 1.15), c.count(0, 2), c.between(0.006, 0.03)
    cover, drop, puff = c.between(0.55, 0.78), c.between(0.05, 0.2), c.between(0.1, 0.4)
    c.look |= {
        "*": c.board(1.2, 0.8),
        "sheet": c.cloth(1.0, 1.0, (226, 224, 218)),
        "cover": c.cloth(1.2, 1.2),
    }
    c.look["pillow"] = c.look["sheet"] if c.chance(0.5) else c.cloth(0.8, 0.6)
    frame = max(frame, foot + 0.08)
    if foot > 0.03:
        c.legs(width, length, foot, 0.07, 0.02, c.count(0, 1), "*")
    low = foot if foot > 0.03 else 0.0
    c.box((width, length, frame - low), z=low)
    top = frame + pad - 0.02
    c.add(cushion((width - 0.06, length - 0.08, pad), c.tex("sheet"), 0.5, 0.0), z=frame - 0.02)
    if style == 0:
        c.box((width, 0.04, head), 0, length / 2 + 0.018, 0)
    elif style == 1:
        c.add(cushion((width, 0.1, head), c.tex("cover"), 0.5, 0.0), 0, length / 2 + 0.045, 0)
    else:
        for x in np.linspace(-0.5, 0.5, 8) * (width - 0.04):
            c.box((0.03, 0.03, head), float(x), length / 2 + 0.012, 0, upright=False)
        c.box((width, 0.036, 0.06), 0, length / 2 + 0.012, head - 0.05)
    wide, long = width - 0.05, cover * (length - 0.08)
    y = -(length - 0.08 - long) / 2 - 0.005
    bumps = waves(c.dims, bump, c.between(0.14, 0.45))
    blanket = draped(
        rounded_outline(wide, long, 0.08), drop, c.tex("cover"), lambda px, py: 0.012 + bumps(px, py),
        c.between(0.004, 0.012), c.count(8, 22), 0.015, c.between(0, 6), 0.012, under=0.01,
    )  # fmt: skip
    c.add(blanket, 0, y, top)
    for number in range(pillows):
        size = (min(0.7, 0.92 * (width - 0.06) / pillows), c.between(0.36, 0.46), c.between(0.1, 0.15))
        x = (number + 0.5 - pillows / 2) * (width - 0.06) / pillows
        at = length / 2 - 0.06 - size[1] / 2
        c.add(cushion(size, c.tex("pillow"), 0.95, puff, 0.06), x, at, top - 0.012, c.between(-0.1, 0.1))
    area = rectangle(wide - 0.14, long - 0.14, y=y)
    place = Place(
        top + 0.012, area, sag=lambda px, py: bumps(np.asarray(px), np.asarray(py) - y), name="blanket"
    )
    return c.finish(label, (place,))


def make_single_bed(shop: Workshop, name: str) -> Thing:
    """A bed for one."""
    c = Carpenter(shop, name)
    return _bed(c, "bed", c.between(0.85, 1.05), c.between(1.85, 2.02), 1)


def make_double_bed(shop: Workshop, name: str) -> Thing:
    """A bed for two."""
    c = Carpenter(shop, name)
    return _bed(c, "bed", c.between(1.35, 1.75), c.between(1.9, 2.05), 2)


def make_daybed(shop: Workshop, name: str) -> Thing:
    """A low couch without back, with a bolster."""
    c = Carpenter(shop, name)
    width, depth, height, pad = (
        c.between(1.6, 1.95),
        c.between(0.75, 0.9),
        c.between(0.2, 0.3),
        c.between(0.1, 0.16),
    )
    puff, radius = c.between(0.02, 0.1), c.between(0.07, 0.11)
    c.look |= {"*": c.board(1.2, 0.6), "pad": c.cloth(1.2, 0.9), "pillow": c.cloth(0.6, 0.6)}
    c.box((width, depth, 0.06), z=height - 0.06)
    c.legs(width, depth, height - 0.06, 0.06, 0.04, c.count(0, 2), "*")
    size = (width - 0.02, depth - 0.02, pad)
    c.add(cushion(size, c.tex("pad"), 0.5, puff, middle=10), z=height - 0.004)
    top = height - 0.004 + pad
    bolster = cushion((2 * radius, 0.85 * depth, 2 * radius), c.tex("pillow"), 0.98, 0.0)
    c.add(bolster, -width / 2 + radius + 0.04, 0, top - 0.02)
    c.add(cushion((0.42, 0.42, 0.13), c.tex("pillow"), 0.95, 0.4, 0.1), 0.3 * width, 0.1, top - 0.012, 0.4)
    area = rectangle(0.5 * width, 0.7 * depth, x=-0.06 * width)
    sag = cushion_sag(size, puff)
    return c.finish("daybed", (_soft_place(top, area, sag, 0, 0, "top"),))


SEATING: dict[str, Kind] = {
    "sofa": Kind("sofa", make_sofa, fixed=True),
    "armchair": Kind("armchair", make_armchair, fixed=True),
    "bench": Kind("bench", make_cushion_bench, fixed=True),
    "office_chair": Kind("office chair", make_office_chair, weight=0.8),
    "stool": Kind("stool", make_stool_family, weight=0.8),
    "pouf": Kind("pouf", make_pouf, weight=0.7),
    "chair": Kind("chair", make_style_chair, weight=1.3),
}
BEDS: dict[str, Kind] = {
    "single": Kind("bed", make_single_bed, fixed=True),
    "double": Kind("bed", make_double_bed, fixed=True),
    "daybed": Kind("daybed", make_daybed, fixed=True, weight=0.7),
}
