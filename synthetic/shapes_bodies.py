"""Varied bodies: superquadrics, turned shapes, extruded outlines, vessels with handles and spouts, hollow things."""

# ruff: noqa: RUF005 - arrays are added here, nothing is concatenated

import numpy as np

from synthetic.footprints import disc, rectangle
from synthetic.furniture import Workshop
from synthetic.shapes_kit import (
    Bench,
    Raw,
    bow,
    cut_below,
    gentle,
    grounded,
    inside,
    posed,
    raw_box,
    raw_ellipsoid,
    raw_extrude,
    raw_lathe,
    raw_slab,
    raw_superquadric,
    raw_sweep,
    ring,
    rod,
    rounded,
    smooth,
    top,
    turn,
)  # fmt: skip
from synthetic.things import Kind, Thing

_EXPONENTS = (0.25, 1.8)


def _super(bench: Bench, low: float, high: float, cut: tuple[float, float] = (0.05, 0.3)) -> Raw:
    """Draw a superquadric with half axes of `low` to `high` that stands on a flat foot."""
    radii = bench.rng.uniform(low, high, 3)
    upright, level = bench.rng.uniform(*_EXPONENTS, 2)
    return grounded(raw_superquadric(radii, upright, level), bench.u(*cut))


def make_superblock(shop: Workshop, name: str) -> Thing:
    """A superellipsoid of any exponents, cut flat at the bottom."""
    bench = Bench(shop, name)
    bench.put(_super(bench, 0.03, 0.16), bench.look())
    return bench.thing("shape")


def make_superstack(shop: Workshop, name: str) -> Thing:
    """Two to four superellipsoids on each other, sunk in a little."""
    bench = Bench(shop, name)
    z, wide = 0.0, bench.u(0.05, 0.12)
    for _ in range(bench.n(2, 4)):
        raw = _super(bench, 0.5 * wide, wide, (0.1, 0.3))
        bench.put(raw, bench.look(), (0, 0, z))
        z, wide = z + 0.85 * float(raw[0][:, 2].max()), wide * bench.u(0.6, 1.0)
    return bench.thing("stacked shape")


def make_supertaper(shop: Workshop, name: str) -> Thing:
    """A superellipsoid that tapers and twists upwards."""
    bench = Bench(shop, name)
    vertices, faces = _super(bench, 0.04, 0.14)
    share = vertices[:, 2:] / vertices[:, 2].max()
    vertices[:, :2] *= 1 + share * bench.u(-0.75, 0.7)
    angle = share[:, 0] * bench.u(-2.2, 2.2)
    x, y = vertices[:, 0].copy(), vertices[:, 1].copy()
    vertices[:, 0], vertices[:, 1] = (
        np.cos(angle) * x - np.sin(angle) * y,
        np.sin(angle) * x + np.cos(angle) * y,
    )
    bench.put((vertices, faces), bench.look())
    return bench.thing("tapered shape")


def make_superbend(shop: Workshop, name: str) -> Thing:
    """A long superellipsoid that bends sideways, as a horn or a banana on its end."""
    bench = Bench(shop, name)
    radii = bench.rng.uniform((0.03, 0.03, 0.09), (0.07, 0.07, 0.18))
    raw = raw_superquadric(radii, bench.u(0.25, 1.1), bench.u(*_EXPONENTS), rings=28)
    vertices, faces = grounded(raw, bench.u(0.04, 0.15))
    height = float(vertices[:, 2].max())
    angle = bench.u(0.3, 1.5)
    radius = max(height / angle, 1.15 * radii[0])
    phi = vertices[:, 2] / radius
    away = radius - vertices[:, 0]
    taper = 1 - bench.u(0.0, 0.6) * vertices[:, 2] / height
    vertices = np.stack([radius - away * np.cos(phi), vertices[:, 1] * taper, away * np.sin(phi)], -1)
    bench.put((vertices, faces), bench.look())
    return bench.thing("bent shape")


def make_superegg(shop: Workshop, name: str) -> Thing:
    """An egg, a pear or a pebble: rounder below than above."""
    bench = Bench(shop, name)
    vertices, faces = raw_superquadric(bench.rng.uniform(0.03, 0.11, 3), bench.u(0.7, 1.2), bench.u(0.6, 1.3))
    share = vertices[:, 2:] / vertices[:, 2].max()
    vertices[:, :2] *= np.exp(-bench.u(-0.1, 0.7) * share)
    raw = grounded((vertices, faces), bench.u(0.04, 0.15))
    bench.put(raw, bench.look())
    return bench.thing("egg")


def make_supertoroid(shop: Workshop, name: str) -> Thing:
    """A ring of any cross-section, square or pinched, lying."""
    bench = Bench(shop, name)
    large, thick, tall = bench.u(0.05, 0.13), bench.u(0.3, 0.7), bench.u(0.015, 0.06)
    section, plan = bench.u(0.3, 1.4), bench.u(0.4, 1.5)
    t = np.linspace(0, 2 * np.pi, 20, endpoint=False) + 0.1
    c, s = (np.sign(f(t)) * np.abs(f(t)) ** section for f in (np.cos, np.sin))
    profile = np.stack([large * (1 + thick * 0.9 * c), tall * s], -1)
    vertices, faces = grounded(raw_lathe(profile, 40, closed=True), bench.u(0.03, 0.2))
    radius = np.linalg.norm(vertices[:, :2], axis=1, keepdims=True)
    flat = vertices[:, :2] / radius
    flat = np.sign(flat) * np.abs(flat) ** plan * (1.0, bench.u(0.5, 1.0))
    bench.put((np.column_stack([radius * flat, vertices[:, 2]]), faces), bench.look())
    return bench.thing("ring")


def make_supercross(shop: Workshop, name: str) -> Thing:
    """Two or three superellipsoids pushed into each other."""
    bench = Bench(shop, name)
    for _ in range(bench.n(2, 3)):
        raw = _super(bench, 0.02, 0.12)
        bench.put(raw, bench.look(), (*bench.rng.uniform(-0.04, 0.04, 2), 0), turn(z=bench.u(0, 180)))
    return bench.thing("joined shapes")


# Turned shapes


def _outline(bench: Bench, radius: float, height: float, points: int, least: float = 0.25) -> np.ndarray:
    """Draw the outside of a turned body (k, 2), smooth or angular, from the foot up."""
    z = np.concatenate([[0], np.sort(bench.rng.uniform(0.08, 0.92, points)), [1]])
    z = 0.5 * z + 0.5 * np.linspace(0, 1, points + 2)
    r = np.append(bench.rng.uniform(max(least, 0.45), 1.0), bench.rng.uniform(least, 1.0, points + 1))
    outline = np.column_stack([radius * r, height * z])
    return outline if bench.chance(0.3) else gentle(outline, 28)


def _solid_profile(outline: np.ndarray) -> np.ndarray:
    return np.concatenate([[[0, outline[0, 1]]], outline, [[0, outline[-1, 1]]]])


def _hollow_profile(outline: np.ndarray, wall: float, base: float) -> np.ndarray:
    """Return the closed-off profile of a vessel with this outside: down again on the inside to its floor."""
    heights = np.concatenate([[base], outline[outline[:, 1] > 1.05 * base, 1]])
    inner = np.interp(heights, outline[:, 1], outline[:, 0])
    inner = np.column_stack([np.maximum(inner - wall, 0.3 * inner), heights])
    return np.concatenate([[[0, 0]], outline, inner[::-1], [[0, base]]])


def _segments(bench: Bench) -> int:
    return bench.pick((5, 6, 8, 10, 36, 36, 36, 36))


def make_turned_vase(shop: Workshop, name: str) -> Thing:
    """A vase of any profile, round or faceted, open on top."""
    bench = Bench(shop, name)
    radius, height = bench.u(0.04, 0.13), bench.u(0.08, 0.38)
    outline = _outline(bench, radius, height, bench.n(1, 4))
    bench.put(
        raw_lathe(_hollow_profile(outline, bench.u(0.003, 0.008), 0.01), _segments(bench)), bench.look()
    )
    return bench.thing("vase")


def make_flask(shop: Workshop, name: str) -> Thing:
    """A bottle or flask: a belly of any shape, a shoulder, a neck, a cap or a cork."""
    bench = Bench(shop, name)
    radius, height, neck = bench.u(0.03, 0.08), bench.u(0.12, 0.34), bench.u(0.18, 0.5)
    shoulder = bench.u(0.35, 0.7)
    belly = gentle(
        [(bench.u(0.6, 1), 0), (1, 0.1), (bench.u(0.75, 1), 0.6 * shoulder), (1, shoulder), (neck, shoulder + 0.2),
         (neck, 0.95), (neck * bench.u(1, 1.3), 1)], 30,
    )  # fmt: skip
    segments = _segments(bench)
    bench.put(raw_lathe(_solid_profile(belly * (radius, height)), segments), bench.look())
    if bench.chance(0.7):
        wide = radius * neck * bench.u(0.8, 1.5)
        cap = np.array([[0, 0], [wide, 0], [wide, 0.6], [wide * bench.u(0.4, 1), 1], [0, 1]]) * (
            1,
            bench.u(0.015, 0.05),
        )
        bench.put(raw_lathe(cap, segments), bench.look(), (0, 0, 0.985 * height))
    return bench.thing("flask")


def make_goblet(shop: Workshop, name: str) -> Thing:
    """A goblet: foot, stem with a knot, hollow bowl."""
    bench = Bench(shop, name)
    radius, height, stem = bench.u(0.03, 0.07), bench.u(0.1, 0.22), bench.u(0.004, 0.01)
    low, knot = bench.u(0.3, 0.55) * height, bench.u(1.0, 3.0)
    outline = gentle(
        [(bench.u(0.6, 1.1) * radius, 0), (bench.u(0.4, 0.6) * radius, 0.01), (stem, 0.025), (knot * stem, 0.5 * low),
         (stem, 0.85 * low), (bench.u(0.7, 1) * radius, low + 0.35 * (height - low)), (radius, height)], 36,
    )  # fmt: skip
    bench.put(raw_lathe(_hollow_profile(outline, 0.003, low + 0.01), _segments(bench)), bench.look())
    return bench.thing("goblet")


def make_spinning_top(shop: Workshop, name: str) -> Thing:
    """A spinning top, a weight or a chess-like button: wide belly, small foot, thin grip."""
    bench = Bench(shop, name)
    radius, height, belly = bench.u(0.03, 0.09), bench.u(0.05, 0.16), bench.u(0.25, 0.55)
    points = [(bench.u(0.12, 0.35), 0), (1, belly), (bench.u(0.3, 0.9), belly + 0.1), (0.12, belly + 0.2), (0.1, 0.93),
              (bench.u(0.1, 0.25), 1)]  # fmt: skip
    outline = np.array(points) * (radius, height)
    if bench.chance(0.5):
        outline = gentle(outline, 26)
    bench.put(raw_lathe(_solid_profile(outline), 32), bench.look())
    return bench.thing("spinning top")


def make_table_lamp(shop: Workshop, name: str) -> Thing:
    """A lamp: turned foot and a conical shade that is open above and below."""
    bench = Bench(shop, name)
    height, foot = bench.u(0.16, 0.3), bench.u(0.04, 0.09)
    outline = _outline(bench, foot, height, bench.n(2, 4), 0.12)
    outline[-1, 0] = 0.01
    bench.put(raw_lathe(_solid_profile(outline), _segments(bench)), bench.look())
    low, high, tall, wall = bench.u(0.07, 0.14), bench.u(0.03, 0.1), bench.u(0.08, 0.16), 0.002
    shade = np.array([[low, 0], [high, tall], [high - wall, tall], [low - wall, 0]])
    at = (0, 0, height - bench.u(0.2, 0.6) * tall)
    bench.put(raw_lathe(shade, bench.pick((4, 6, 36, 36)), closed=True), bench.look(), at)
    spokes = [
        rod(
            (0, 0, height - 0.005),
            (0.97 * (low + high) / 2 * c, 0.97 * (low + high) / 2 * s, at[2] + 0.5 * tall),
            0.002,
        )
        for c, s in ring(1.0, 3)
    ]
    bench.put_all(spokes, bench.look("metal"))
    return bench.thing("lamp")


def make_bell(shop: Workshop, name: str) -> Thing:
    """A bell, hollow from below, with a grip."""
    bench = Bench(shop, name)
    radius, height, wall = bench.u(0.04, 0.09), bench.u(0.06, 0.14), 0.004
    waist = bench.u(0.45, 0.75)
    outside = gentle([(1, 0), (0.88, 0.08), (waist, 0.45), (0.8 * waist, 0.85), (0.15, 1)], 22) * (
        radius,
        height,
    )
    inner = np.column_stack([np.maximum(outside[:-3, 0] - wall, 0.004), outside[:-3, 1]])
    profile = np.concatenate([[[0, inner[-1, 1]]], inner[::-1], outside, [[0, height]]])
    bench.put(raw_lathe(profile, 32), bench.look())
    tall = bench.u(0.03, 0.12)
    grip = gentle([(0.3, 0), (bench.u(0.5, 1), 0.4), (0.5, 0.6), (bench.u(0.6, 1.2), 0.9), (0.3, 1)], 16) * (
        0.012,
        tall,
    )
    bench.put(raw_lathe(_solid_profile(grip), 16), bench.look(), (0, 0, height - 0.008))
    return bench.thing("bell")


def make_pin(shop: Workshop, name: str) -> Thing:
    """A bowling pin or a skittle figure, some with a ball as head."""
    bench = Bench(shop, name)
    radius, height, waist = bench.u(0.02, 0.06), bench.u(0.12, 0.36), bench.u(0.3, 0.6)
    points = [
        (bench.u(0.5, 0.8), 0),
        (1, 0.3),
        (waist, 0.68),
        (bench.u(0.4, 0.7), 0.84),
        (0.3, 0.97),
        (0.08, 1),
    ]
    bench.put(raw_lathe(_solid_profile(gentle(points, 30) * (radius, height)), 28), bench.look())
    if bench.chance(0.4):
        head = bench.u(0.5, 0.9) * radius
        bench.put(raw_ellipsoid((head, head, head), 3), bench.look(), (0, 0, height))
    return bench.thing("pin")


def make_totem(shop: Workshop, name: str) -> Thing:
    """A turned post of discs, cones and beads in several colors, flat on top."""
    bench = Bench(shop, name)
    z, looks = 0.0, [bench.look() for _ in range(3)]
    for _ in range(bench.n(3, 7)):
        tall, low, high = bench.u(0.01, 0.06), bench.u(0.02, 0.07), bench.u(0.02, 0.07)
        piece = np.array([[0, 0], [low, 0], [high, tall], [0, tall]])
        if bench.chance(0.3):
            piece = _solid_profile(gentle([(0.6 * low, 0), (low, tall / 2), (0.6 * low, tall)], 12))
        bench.put(raw_lathe(piece, _segments(bench)), bench.pick(looks), (0, 0, z - 0.0005 * (z > 0)))
        z += tall - 0.0005 * (z > 0)
    return bench.thing("turned post")


def make_pot(shop: Workshop, name: str) -> Thing:
    """An open pot or bowl of straight or bent sides; things can lie in it."""
    bench = Bench(shop, name)
    radius, height, foot = bench.u(0.06, 0.17), bench.u(0.05, 0.15), bench.u(0.55, 1.0)
    middle = bench.u(min(foot, 0.85), 1.05)
    outline = np.array([(foot, 0), (middle, 0.5), (1, 0.92), (bench.u(1.0, 1.1), 1)]) * (radius, height)
    wall, base, segments = bench.u(0.004, 0.01), bench.u(0.006, 0.012), _segments(bench)
    bench.put(raw_lathe(_hollow_profile(gentle(outline, 18), wall, base), segments), bench.look())
    area = disc((foot * radius - wall) * np.cos(np.pi / segments))
    return bench.thing("pot", inside(base, area, height - base))


def make_candlestick(shop: Workshop, name: str) -> Thing:
    """A candlestick of thin necks and wide discs, with or without its candle."""
    bench = Bench(shop, name)
    radius, height = bench.u(0.03, 0.06), bench.u(0.1, 0.3)
    outline = _outline(bench, radius, height, bench.n(4, 7), 0.15)
    outline[0, 0], outline[-1, 0] = radius * 1.1, 0.016
    bench.put(raw_lathe(_solid_profile(outline), 28), bench.look())
    if bench.chance(0.6):
        bench.put(rod((0, 0, height - 0.01), (0, 0, height + bench.u(0.04, 0.18)), 0.011, 16), bench.look())
    return bench.thing("candlestick")


# Extruded outlines


def _extruded(bench: Bench, outline: np.ndarray, label: str, holes: tuple[np.ndarray, ...] = ()) -> Thing:
    """Extrude an outline of about 1 m; it lies, or stands on its lowest side, plain, tapered or twisted."""
    size, look = bench.u(0.05, 0.3), bench.look()
    if bench.chance(0.5):
        height = size * bench.u(0.08, 0.9)
        layers, taper, twist = 1, 1.0, 0.0
        if bench.chance(0.35):
            layers, taper, twist = 10, bench.u(0.5, 1.15), bench.u(-90, 90)
        raw = raw_extrude(size * outline, height, [size * h for h in holes], layers, taper, twist)
        bench.put(raw, look)
        # The middle is level, but only an outline without holes is surely solid there.
        area = disc(0.3 * size * taper)
        return bench.thing(label, () if holes else top(height, area))
    tilted = turn(z=bench.u(-25, 25))[:2, :2]
    outline, holes = outline @ tilted.T, tuple(h @ tilted.T for h in holes)
    low, high = outline[:, 1].min(), outline[:, 1].max()
    level = low + bench.u(0.04, 0.1) * (high - low)
    if holes:
        level = min(level, 0.4 * low + 0.6 * min(h[:, 1].min() for h in holes))
    raw = raw_extrude(size * cut_below(outline, level), size * bench.u(0.12, 0.6), [size * h for h in holes])
    bench.put(raw, look, rotation=turn(x=90))
    return bench.thing(label)


def make_star(shop: Workshop, name: str) -> Thing:
    """A star of 4 to 9 points."""
    bench = Bench(shop, name)
    points = bench.n(4, 9)
    outline = ring(0.5, 2 * points)
    outline[1::2] *= bench.u(0.3, 0.75)
    return _extruded(bench, outline, "star")


_LETTERS = {
    "L": "0 0 3 0 3 1 1 1 1 4 0 4", "U": "0 0 3 0 3 4 2 4 2 1 1 1 1 4 0 4", "T": "1 0 2 0 2 3 3 3 3 4 0 4 0 3 1 3",
    "E": "0 0 3 0 3 1 1 1 1 1.6 2.5 1.6 2.5 2.5 1 2.5 1 3.1 3 3.1 3 4 0 4",
    "H": "0 0 1 0 1 1.5 2 1.5 2 0 3 0 3 4 2 4 2 2.5 1 2.5 1 4 0 4",
    "Z": "0 0 3 0 3 1 1.3 1 3 3 3 4 0 4 0 3 1.7 3 0 1",
    "V": "1 0 2 0 3 4 2 4 1.5 1.6 1 4 0 4", "N": "0 0 1 0 1 2.3 2 0 3 0 3 4 2 4 2 1.7 1 4 0 4",
    "F": "0 0 1 0 1 1.6 2.5 1.6 2.5 2.5 1 2.5 1 3.1 3 3.1 3 4 0 4",
    "+": "1 0 2 0 2 1 3 1 3 2 2 2 2 3 1 3 1 2 0 2 0 1 1 1",
    "stairs": "0 0 4 0 4 1 3 1 3 2 2 2 2 3 1 3 1 4 0 4", "house": "0 0 4 0 4 2.4 2 4 0 2.4",
    "arrow": "0 1.5 2 1.5 2 0.5 4 2.1 2 3.7 2 2.7 0 2.7", "bolt": "1 0 3.2 2.4 2 2.4 3 4.4 1.4 4.4 0.4 1.9 1.6 1.9",
    "crown": "0 0 4 0 4.4 3 3 1.6 2 3.4 1 1.6 -0.4 3",
}  # fmt: skip


def make_letter(shop: Workshop, name: str) -> Thing:
    """A letter, a sign, stairs, an arrow, a crown: outlines of straight edges."""
    bench = Bench(shop, name)
    outline = np.array(_LETTERS[bench.pick(list(_LETTERS))].split(), float).reshape(
        -1, 2
    ) * bench.rng.uniform(0.7, 1.3, 2)
    outline = (outline - outline.mean(0)) / np.ptp(outline, axis=0).max()
    return _extruded(bench, outline, "letter")


def make_gear(shop: Workshop, name: str) -> Thing:
    """A gear wheel with a bore and some more holes."""
    bench = Bench(shop, name)
    teeth, deep = bench.n(7, 18), bench.u(0.78, 0.92)
    outline = ring(0.5, 4 * teeth)
    outline[0::4] *= deep
    outline[3::4] *= deep
    bore, more = bench.u(0.06, 0.14), bench.n(0, 6)
    holes = (
        [ring(bore, 16), *(ring(0.055, 12) + at for at in ring(0.25, more))] if more > 2 else [ring(bore, 16)]
    )
    return _extruded(bench, outline, "gear", tuple(holes))


def make_heart(shop: Workshop, name: str) -> Thing:
    """A heart, wide or slim."""
    bench = Bench(shop, name)
    t = np.linspace(0, 2 * np.pi, 41)[:-1] + 0.01
    x = 16 * np.sin(t) ** 3
    y = 13 * np.cos(t) - 5 * np.cos(2 * t) - 2 * np.cos(3 * t) - np.cos(4 * t)
    return _extruded(bench, np.stack([x * bench.u(0.7, 1.2), y + 2], -1) / 36, "heart")


def make_spline_block(shop: Workshop, name: str) -> Thing:
    """An extruded amoeba: a smooth outline through random points."""
    bench = Bench(shop, name)
    count = bench.n(5, 10)
    outline = ring(0.5, count) * bench.rng.uniform(0.4, 1.0, (count, 1))
    outline = smooth(outline, 56, closed=True)
    holes = (ring(bench.u(0.05, 0.1), 16),) if bench.chance(0.4) else ()
    return _extruded(bench, outline, "spline block", holes)


def make_arch(shop: Workshop, name: str) -> Thing:
    """An arch, a bridge or a rainbow that stands on its two legs."""
    bench = Bench(shop, name)
    outer, depth, look = bench.u(0.06, 0.2), bench.u(0.03, 0.12), bench.look()
    bend = np.linspace(0, np.pi, 25)
    arc, rise = np.stack([np.cos(bend), np.sin(bend)], -1), bench.u(0.6, 1.4)
    legs = bench.u(0.0, 0.08)
    for _ in range(bench.n(1, 3)):
        inner = outer * bench.u(0.55, 0.85)
        shape = np.concatenate([outer * arc * (1, rise) + (0, legs), [[-outer, 0], [-inner, 0]]])
        shape = np.concatenate([shape, (inner * arc * (1, rise) + (0, legs))[::-1], [[inner, 0], [outer, 0]]])
        if legs < 1e-3:
            shape = np.concatenate([outer * arc * (1, rise), (inner * arc * (1, rise))[::-1]])
        bench.put(raw_extrude(shape, depth), look, (0, depth / 2, 0), turn(x=90))
        outer, depth, look = inner * bench.u(0.85, 1.001), depth * bench.u(0.7, 1.0), bench.look()
    return bench.thing("arch")


def make_crescent(shop: Workshop, name: str) -> Thing:
    """A crescent, a C or an open ring."""
    bench = Bench(shop, name)
    span = np.radians(bench.u(150, 310))
    t = np.linspace(-span / 2, span / 2, 30)
    arc = np.stack([np.cos(t), np.sin(t)], -1)
    thick = bench.u(0.12, 0.3) * (np.maximum(np.cos(np.pi * t / span), 0) ** bench.u(0.1, 1.0) + 0.08)
    outline = 0.5 * np.concatenate([arc, (arc * (1 - thick[:, None]))[::-1]])
    return _extruded(bench, outline, "crescent")


def make_pierced(shop: Workshop, name: str) -> Thing:
    """A plate or block with round, square or many holes: a frame, a grid, a shape sorter."""
    bench = Bench(shop, name)
    rows, columns = bench.n(1, 3), bench.n(1, 4)
    cell = 1.0 / max(rows, columns)
    outline = rounded(columns * cell, rows * cell, bench.u(0.01, 0.2) * cell)
    holes = []
    for row in range(rows):
        for column in range(columns):
            at = ((column - (columns - 1) / 2) * cell, (row - (rows - 1) / 2) * cell)
            wide = cell * bench.u(0.3, 0.75)
            shape = bench.pick(
                (ring(wide / 2, 20), rounded(wide, wide, 0.02 * cell), ring(wide / 2, 3), ring(wide / 2, 6))
            )
            holes.append(shape + at)
    return _extruded(bench, outline, "pierced block", tuple(holes))


# Bodies with handles and spouts


def make_teapot(shop: Workshop, name: str) -> Thing:
    """A teapot: belly, curved spout, ear, lid with a knob."""
    bench = Bench(shop, name)
    radius, height, look = bench.u(0.05, 0.09), bench.u(0.07, 0.15), bench.look()
    mouth = bench.u(0.35, 0.6)
    outline = gentle([(bench.u(0.5, 0.8), 0), (1, bench.u(0.3, 0.5)), (0.85, 0.75), (mouth, 1)], 22) * (
        radius,
        height,
    )
    bench.put(raw_lathe(_solid_profile(outline), _segments(bench)), look)
    low, high = bench.u(0.25, 0.5) * height, bench.u(0.85, 1.1) * height
    reach = bench.u(1.6, 2.0) * radius
    spout = smooth(
        [
            (0.6 * radius, 0, low),
            (1.25 * radius, 0, low + 0.01),
            (0.86 * reach, 0, 0.6 * high),
            (reach, 0, high),
        ],
        14,
    )
    bench.put(raw_sweep(spout, np.linspace(0.02, bench.u(0.006, 0.012), 14), 14), look)
    ear = bow(
        (-0.7 * radius, 0, 0.75 * height),
        (-0.8 * radius, 0, 0.25 * height),
        (-bench.u(0.6, 1.1) * radius, 0, 0.01),
    )
    bench.put(raw_sweep(ear, bench.u(0.005, 0.009), 10, bench.u(0.6, 1.6)), bench.pick((look, bench.look())))
    lid = gentle(
        [(mouth * 0.98, 0), (0.7 * mouth, 0.5), (0.08, 0.62), (bench.u(0.1, 0.2), 0.9), (0.02, 1)], 18
    )
    bench.put(
        raw_lathe(_solid_profile(lid * (radius, bench.u(0.03, 0.06))), 28), look, (0, 0, 0.985 * height)
    )
    return bench.thing("teapot")


def make_watering_can(shop: Workshop, name: str) -> Thing:
    """A watering can: body, long straight spout with a rose, a big bow as handle."""
    bench = Bench(shop, name)
    radius, height, look = bench.u(0.05, 0.08), bench.u(0.09, 0.16), bench.look()
    outline = np.array(
        [(bench.u(0.85, 1.1) * radius, 0), (radius, 0.5 * height), (bench.u(0.7, 1) * radius, height)]
    )
    bench.put(raw_lathe(_solid_profile(gentle(outline, 14)), 32), look)
    tip = np.array([bench.u(2.3, 3.0) * radius, 0, bench.u(0.95, 1.3) * height])
    start = np.array([0.7 * radius, 0, 0.2 * height])
    bench.put(rod(start, tip, 0.014, 14, bench.u(0.45, 0.8)), look)
    if bench.chance(0.7):
        along = (tip - start) / np.linalg.norm(tip - start)
        bench.put(rod(tip - 0.01 * along, tip + 0.025 * along, 0.009, 16, bench.u(2.0, 3.2)), bench.look())
    bend = bow(
        (0.3 * radius, 0, 0.97 * height),
        (-0.85 * radius, 0, 0.35 * height),
        (-0.8 * radius, 0, bench.u(0.5, 0.9) * height),
    )
    bench.put(raw_sweep(bend, bench.u(0.004, 0.008), 10), bench.look())
    return bench.thing("watering can")


def make_kettle(shop: Workshop, name: str) -> Thing:
    """A kettle: squat body, short beak, a bow over the lid."""
    bench = Bench(shop, name)
    radius, height, look = bench.u(0.07, 0.11), bench.u(0.08, 0.16), bench.look()
    outline = gentle([(0.95, 0), (1, 0.25), (bench.u(0.6, 0.95), 0.75), (0.4, 0.97), (0.25, 1)], 22) * (
        radius,
        height,
    )
    bench.put(raw_lathe(_solid_profile(outline), 36), look)
    beak = rod(
        (0.6 * radius, 0, 0.4 * height),
        (bench.u(1.3, 1.5) * radius, 0, bench.u(0.75, 0.95) * height),
        0.022,
        12,
        0.4,
    )
    bench.put(beak, look)
    rise = bench.u(0.4, 0.8) * height + 0.03
    span = bench.u(0.5, 0.75) * radius
    bench.put(
        raw_sweep(
            bow((-span, 0, 0.7 * height), (span, 0, 0.7 * height), (0, 0, rise + 0.3 * height)), 0.006, 10
        ),
        bench.look(),
    )
    bench.put(raw_ellipsoid((0.014, 0.014, 0.014)), bench.look("dark"), (0, 0, height + 0.006))
    return bench.thing("kettle")


def make_jug(shop: Workshop, name: str) -> Thing:
    """A hollow jug with an ear; its mouth is drawn out to a lip."""
    bench = Bench(shop, name)
    radius, height, look = bench.u(0.045, 0.08), bench.u(0.12, 0.26), bench.look()
    outline = gentle(
        [(bench.u(0.6, 0.9), 0), (1, 0.3), (bench.u(0.5, 0.8), 0.75), (bench.u(0.65, 0.9), 1)], 20
    ) * (radius, height)
    vertices, faces = raw_lathe(_hollow_profile(outline, 0.005, 0.008), 36)
    high = np.clip((vertices[:, 2] / height - 0.7) / 0.3, 0, 1)
    ahead = np.clip(vertices[:, 0] / radius, 0, 1) ** 3
    vertices[:, 0] += bench.u(0.3, 0.7) * radius * high**2 * ahead
    bench.put((vertices, faces), look)
    at = lambda share: float(np.interp(share * height, outline[:, 1], outline[:, 0])) - 0.003  # noqa: E731
    ear = bow(
        (-at(0.85), 0, 0.85 * height), (-at(0.3), 0, 0.3 * height), (-bench.u(0.5, 0.9) * radius, 0, 0.02)
    )
    bench.put(raw_sweep(ear, 0.0045, 10, bench.u(1, 1.8)), look)
    return bench.thing("jug")


def make_saucepan(shop: Workshop, name: str) -> Thing:
    """A saucepan or a frying pan with a long handle."""
    bench = Bench(shop, name)
    radius, height, foot = bench.u(0.06, 0.11), bench.u(0.03, 0.12), bench.u(0.75, 1.0)
    outline = np.array([(foot * radius, 0), (radius, height)])
    bench.put(raw_lathe(_hollow_profile(gentle(outline, 8), 0.005, 0.007), 40), bench.look())
    long, z = bench.u(0.1, 0.18), bench.u(0.6, 0.85) * height
    start = (foot + (1 - foot) * z / height) * radius - 0.004
    grip = smooth(
        [(start, 0, z), (start + 0.5 * long, 0, z + 0.015), (start + long, 0, z + bench.u(-0.005, 0.05))], 10
    )
    bench.put(raw_sweep(grip, np.linspace(0.006, bench.u(0.007, 0.012), 10), 10, 0.6), bench.look())
    area = disc(foot * radius - 0.008)
    return bench.thing("saucepan", inside(0.007, area, height - 0.007))


def make_big_cup(shop: Workshop, name: str) -> Thing:
    """A cup of any profile with one or two oversized ears."""
    bench = Bench(shop, name)
    radius, height, look = bench.u(0.035, 0.06), bench.u(0.06, 0.12), bench.look()
    foot = bench.u(0.6, 1.0)
    outline = gentle([(foot, 0), (bench.u(0.8, 1.05), 0.5), (1, 1)], 14) * (radius, height)
    bench.put(
        raw_lathe(_hollow_profile(outline, 0.005, 0.006), _segments(bench) if bench.chance(0.3) else 36), look
    )
    ear_look = bench.pick((look, bench.look()))
    low, high = bench.u(0.15, 0.3), bench.u(0.75, 0.92)
    reach = bench.u(0.025, 0.06)
    for sign in (1, -1)[: bench.n(1, 2)]:
        ends = [
            float(np.interp(s * height, outline[:, 1], outline[:, 0])) * 0.96 - 0.001 for s in (high, low)
        ]
        ear = bow((sign * ends[0], 0, high * height), (sign * ends[1], 0, low * height), (sign * reach, 0, 0))
        bench.put(raw_sweep(ear, bench.u(0.003, 0.0045), 10, bench.u(1, 2)), ear_look)
    return bench.thing("cup")


def make_bow_basket(shop: Workshop, name: str) -> Thing:
    """A basket of rings and posts, round or oval, with an arch over it."""
    bench = Bench(shop, name)
    radius, height, press = bench.u(0.08, 0.14), bench.u(0.06, 0.14), bench.u(0.65, 1.0)
    flare, look = bench.u(1.0, 1.35), bench.look()
    oval = np.array([1.0, press])
    bench.put(raw_extrude(radius * ring(1.0, 32) * oval, 0.008), look)
    hoops, posts = bench.n(3, 7), bench.n(8, 18)
    hoop = []
    for share in np.linspace(0.12, 1, hoops):
        wide = radius * (1 + (flare - 1) * share)
        path = np.column_stack([wide * ring(1.0, 32) * oval, np.full(32, share * height)])
        hoop.append(raw_sweep(path, 0.004, 6, closed=True))
    bench.put_all(hoop, look)
    feet = 0.97 * radius * ring(1.0, posts) * oval
    bench.put_all([rod((*f, 0.003), (*(f * flare), height), 0.0045, 6) for f in feet], bench.look())
    wide = radius * flare
    bow_path = bow((-wide, 0, height - 0.01), (wide, 0, height - 0.01), (0, 0, bench.u(0.1, 0.2)), 20)
    bench.put(raw_sweep(bow_path, 0.006, 8, bench.u(0.6, 1)), look)
    return bench.thing("basket", inside(0.008, rectangle(1.2 * radius, 1.2 * radius * press), height - 0.008))


def make_spray_bottle(shop: Workshop, name: str) -> Thing:
    """A spray bottle: body, neck, a head with nozzle and trigger."""
    bench = Bench(shop, name)
    wide, deep, height = bench.u(0.06, 0.09), bench.u(0.035, 0.06), bench.u(0.12, 0.2)
    bench.put(
        raw_extrude(rounded(wide, deep, 0.4 * deep), height, layers=4, taper=bench.u(0.5, 1.0)), bench.look()
    )
    z, look = height + 0.03, bench.look()
    bench.put(rod((0, 0, height - 0.005), (0, 0, z + 0.01), 0.013, 16), look)
    shape = np.array([(-0.035, 0), (0.03, 0), (0.05, 0.012), (0.05, 0.028), (-0.02, 0.034), (-0.045, 0.018)])
    bench.put(raw_extrude(shape, 0.026), look, (0, 0.013, z), turn(x=90))
    bench.put(rod((0.045, 0, z + 0.02), (0.065, 0, z + 0.02), 0.008, 12), bench.look())
    pull = smooth([(0.025, 0, z + 0.005), (0.035, 0, z - 0.02), (0.03, 0, z - bench.u(0.04, 0.06))], 8)
    bench.put(raw_sweep(pull, 0.005, 8, 1.4), bench.look())
    return bench.thing("spray bottle")


def make_headphone_stand(shop: Workshop, name: str) -> Thing:
    """Headphones that hang on a stand."""
    bench = Bench(shop, name)
    height, look = bench.u(0.2, 0.28), bench.look()
    foot = raw_extrude(bench.pick((ring(0.06, 32), rounded(0.12, 0.1, 0.02))), 0.012)
    bench.put(foot, look)
    bench.put(rod((0, 0, 0.006), (0, 0, height), bench.u(0.006, 0.014), 12), look)
    bench.put(raw_box(0.03, bench.u(0.04, 0.07), 0.012), look, (0, 0, height - 0.006))
    wide, drop = bench.u(0.065, 0.085), bench.u(0.1, 0.14)
    band = bow((-wide, 0, height - drop), (wide, 0, height - drop), (0, 0, drop + 0.012), 22)
    bench.put(raw_sweep(band, 0.006, 8, bench.u(1.2, 2.5)), bench.look())
    cup, thick = bench.u(0.03, 0.042), bench.u(0.014, 0.022)
    shell, pad = bench.look(), bench.look("dark")
    for sign in (-1, 1):
        at = (sign * wide, 0, height - drop)
        round_cup = raw_superquadric((cup, cup * bench.u(1, 1.25), thick), 0.5, 1.0, 14, 24)
        bench.put(round_cup, shell, at, turn(y=90))
        bench.put(raw_superquadric((0.8 * cup, 0.9 * cup, 0.6 * thick), 0.5, 1.0, 12, 24), pad,
                  (at[0] - sign * 0.8 * thick, 0, at[2]), turn(y=90))  # fmt: skip
    return bench.thing("headphones")


# Hollow things


def _walls(outline: np.ndarray, shrink: float, height: float, base: float) -> tuple[Raw, Raw]:
    """Return wall and floor of an open prism; the inside is the outline shrunk around the origin."""
    wall = raw_extrude(outline, height, [shrink * outline])
    return wall, raw_extrude(0.5 * (1 + shrink) * outline, base)


def make_open_case(shop: Workshop, name: str) -> Thing:
    """An open box with round or sharp corners, some with a lid that stands open."""
    bench = Bench(shop, name)
    wide, deep, height = bench.u(0.1, 0.3), bench.u(0.08, 0.2), bench.u(0.03, 0.16)
    corner, wall, base, look = bench.u(0.002, 0.04), bench.u(0.003, 0.01), bench.u(0.003, 0.01), bench.look()
    outline = rounded(wide, deep, corner)
    inner = rounded(wide - 2 * wall, deep - 2 * wall, max(corner - wall, 0.001))
    bench.put(raw_extrude(outline, height, [inner]), look)
    bench.put(raw_extrude(rounded(wide - wall, deep - wall, corner), base), bench.look())
    if bench.chance(0.45):
        angle = bench.u(60, 125)
        bench.put(
            raw_extrude(outline + (0, -deep / 2), wall + 0.002),
            look,
            (0, deep / 2 - wall, height - 0.001),
            turn(x=-angle),
        )
    return bench.thing(
        "open case", inside(base, rectangle(0.9 * wide - 2 * wall, 0.9 * deep - 2 * wall), height - base)
    )


def make_drum(shop: Workshop, name: str) -> Thing:
    """A drum: a hollow cylinder with hoops, closed by a skin or open as a bin."""
    bench = Bench(shop, name)
    radius, height = bench.u(0.05, 0.14), bench.u(0.06, 0.26)
    outline = gentle([(1, 0), (bench.u(0.9, 1.15), 0.5), (bench.u(0.9, 1.1), 1)], 12) * (radius, height)
    is_open = bench.chance(0.6)
    profile = _hollow_profile(outline, 0.005, 0.008) if is_open else _solid_profile(outline)
    bench.put(raw_lathe(profile, 40), bench.look())
    look = bench.look()
    for share in bench.rng.uniform(0.03, 0.97, bench.n(0, 3)):
        wide, tall = float(np.interp(share * height, outline[:, 1], outline[:, 0])), bench.u(0.004, 0.012)
        hoop = np.array([[wide - 0.003, 0], [wide + 0.004, 0], [wide + 0.004, tall], [wide - 0.003, tall]])
        bench.put(raw_lathe(hoop, 40, closed=True), look, (0, 0, min(share * height, height - tall)))
    places = (
        inside(0.008, disc(0.85 * radius - 0.005), height - 0.008)
        if is_open
        else top(height, disc(0.8 * outline[-1, 0]))
    )
    return bench.thing("drum", places)


def make_cubby(shop: Workshop, name: str) -> Thing:
    """A box that is open at its front, with boards inside; some with things in it."""
    bench = Bench(shop, name)
    wide, deep, height, wall = (
        bench.u(0.12, 0.3),
        bench.u(0.06, 0.16),
        bench.u(0.12, 0.32),
        bench.u(0.006, 0.014),
    )
    look, corner = bench.look(), bench.u(0.003, 0.05)
    bench.put(
        raw_extrude(
            rounded(wide, height, corner),
            deep,
            [rounded(wide - 2 * wall, height - 2 * wall, max(corner - wall, 0.001))],
        ),
        look,
        (0, deep / 2, height / 2),
        turn(x=90),
    )
    if bench.chance(0.8):
        back = raw_extrude(rounded(wide - wall, height - wall, corner), 0.004)
        bench.put(back, bench.look(), (0, deep / 2 - 0.002, height / 2), turn(x=90))
    rows, columns, inner = bench.n(0, 2), bench.n(0, 2), bench.look()
    for row in range(rows):
        bench.put(raw_box(wide - wall, deep - 0.006, 0.006), inner, (0, 0, (row + 1) * height / (rows + 1)))
    for column in range(columns):
        bench.put(
            raw_box(0.006, deep - 0.006, height - wall),
            inner,
            ((column + 1) * wide / (columns + 1) - wide / 2, 0, wall / 2),
        )
    if bench.chance(0.5):
        size = (
            bench.rng.uniform(0.35, 0.6) * np.array([wide / (columns + 1), deep, height / (rows + 1)]) - wall
        )
        at = wide / (columns + 1) / 2 - wide / 2
        bench.put(raw_box(*np.maximum(size, 0.01)), bench.look(), (at, 0, wall - 0.0005))
    return bench.thing("cubby", top(height, rectangle(0.7 * wide, deep)))


def make_pen_holder(shop: Workshop, name: str) -> Thing:
    """A holder of any outline with pens, brushes and a ruler in it."""
    bench = Bench(shop, name)
    radius, height, sides = bench.u(0.03, 0.045), bench.u(0.07, 0.12), bench.pick((3, 4, 5, 6, 24, 24, 24))
    wall, floor = _walls(radius * ring(1.0, sides), 0.9, height, 0.005)
    look = bench.look()
    bench.put(wall, look)
    bench.put(floor, look)
    free = 0.9 * radius * np.cos(np.pi / sides) - 0.007
    pens, tips = [], []
    for _ in range(bench.n(2, 8)):
        a, b = bench.rng.uniform(0, 2 * np.pi, 2)
        start = np.array([0.6 * free * np.cos(a), 0.6 * free * np.sin(a), 0.006])
        rim = np.array([free * np.cos(b), free * np.sin(b), height])
        along = (rim - start) / np.linalg.norm(rim - start)
        end = start + along * bench.u(0.12, 0.19)
        pens.append(rod(start, end, bench.u(0.0025, 0.0045), bench.pick((6, 8, 12))))
        tips.append(rod(end - 0.002 * along, end + 0.02 * along, bench.u(0.003, 0.006), 8, bench.u(0.1, 1.0)))
    for pair in range(len(pens)):
        bench.put(pens[pair], bench.look())
    bench.put_all(tips, bench.look())
    return bench.thing("pen holder", vary=(0.9, 1.3))


def make_hinged(shop: Workshop, name: str) -> Thing:
    """Two hinged slabs, open as a laptop, a case or a mirror is; a darker field on each."""
    bench = Bench(shop, name)
    wide, deep = bench.u(0.14, 0.36), bench.u(0.1, 0.24)
    low, high, angle, edge = (
        bench.u(0.008, 0.025),
        bench.u(0.005, 0.018),
        bench.u(80, 130),
        bench.u(0.006, 0.02),
    )
    look, corner = bench.look(), bench.u(0.001, 0.02)
    bench.put(raw_extrude(rounded(wide, deep, corner), low), look)
    keys = bench.look("dark" if bench.chance(0.6) else "")
    bench.put(raw_box(wide - 2 * edge, 0.5 * deep, 0.002), keys, (0, 0.16 * deep, low - 0.001))
    if bench.chance(0.6):
        bench.put(raw_box(0.3 * wide, 0.25 * deep, 0.0015), bench.look(), (0, -0.3 * deep, low - 0.001))
    panel, hinge = rounded(wide, deep, corner) + (0, deep / 2), turn(x=180 - angle)
    at = np.array([0, deep / 2 - 0.004, low - 0.002])
    screen = bench.look("dark" if bench.chance(0.6) else "")
    bench.put(raw_extrude(panel, high), look, at, hinge)
    face = raw_extrude(rounded(wide - 2 * edge, deep - 2 * edge, 0.004) + (0, deep / 2), 0.002)
    bench.put(posed(face, (0, 0, high - 0.001)), screen, at, hinge)
    return bench.thing("hinged case", vary=(0.7, 1.2))


def make_open_book(shop: Workshop, name: str) -> Thing:
    """An open book that lies on its back: two bulging blocks of pages on a cover."""
    bench = Bench(shop, name)
    wide, deep, thick = bench.u(0.1, 0.2), bench.u(0.12, 0.26), bench.u(0.01, 0.035)
    x = np.linspace(0, 1, 12)
    bulge = np.sin(np.pi * np.clip(x, 0, 1) ** 0.45) * 0.6 + 0.4 * (1 - x)
    pages = bench.look("print" if bench.chance(0.5) else "white", 0.3)
    cover = bench.look()
    bench.put(raw_box(2.06 * wide, 1.03 * deep, 0.003), cover)
    for sign, share in ((1, bench.u(0.4, 1)), (-1, bench.u(0.4, 1))):
        upper = np.column_stack([sign * wide * x, 0.004 + share * thick * (0.25 + bulge)])
        outline = np.concatenate([[[0, 0.002]], [[sign * wide, 0.002]], upper[::-1]])
        bench.put(raw_extrude(outline, deep), pages, (0, deep / 2, 0), turn(x=90))
    return bench.thing("open book", vary=(0.7, 1.2))


def make_slat_crate(shop: Workshop, name: str) -> Thing:
    """A crate of slats with gaps between them."""
    bench = Bench(shop, name)
    wide, deep, height, wall = (
        bench.u(0.15, 0.36),
        bench.u(0.12, 0.24),
        bench.u(0.08, 0.2),
        bench.u(0.005, 0.009),
    )
    looks = [bench.look("wood" if bench.chance(0.6) else "") for _ in range(2)]
    parts, post = [raw_box(wide, deep, wall)], 2.2 * wall
    rows = bench.n(2, 4)
    pitch = (height - wall) / rows
    for row in range(rows):
        z, tall = wall + (row + 0.3) * pitch, bench.u(0.45, 0.62) * pitch
        for sign in (-1, 1):
            parts.append(posed(raw_box(wide, wall, tall), (0, sign * (deep - wall) / 2, z)))
            parts.append(
                posed(raw_box(wall, deep - 0.5 * wall, tall), (sign * (wide - wall) / 2, 0, z + 0.0004))
            )
    bench.put_all(parts, looks[0])
    x, y = wide / 2 - wall - post / 2 + 0.001, deep / 2 - wall - post / 2 + 0.001
    posts = [posed(raw_box(post, post, height), (sx * x, sy * y, 0.0003)) for sx in (-1, 1) for sy in (-1, 1)]
    bench.put_all(posts, looks[1])
    free = rectangle(wide - 2 * wall - 2 * post, deep - 2 * wall - 2 * post)
    return bench.thing("crate", inside(wall, free, height - wall))


def make_magazine_holder(shop: Workshop, name: str) -> Thing:
    """A holder for magazines: slanted sides, open above and in front; some with magazines."""
    bench = Bench(shop, name)
    wide, deep, height, wall = (
        bench.u(0.06, 0.12),
        bench.u(0.18, 0.26),
        bench.u(0.2, 0.3),
        bench.u(0.003, 0.006),
    )
    low, look = bench.u(0.25, 0.6) * height, bench.look()
    side = np.array(
        [
            (-deep / 2, 0),
            (deep / 2, 0),
            (deep / 2, height),
            (bench.u(-0.1, 0.3) * deep, height),
            (-deep / 2, low),
        ]
    )
    for sign in (-1, 1):
        bench.put(
            raw_extrude(side, wall),
            look,
            (sign * (wide - wall) / 2 - wall / 2, 0, 0),
            turn(z=90) @ turn(x=90),
        )
    bench.put(raw_box(wide - wall, deep, wall), look)
    bench.put(raw_box(wide - wall, wall, height), look, (0, (deep - wall) / 2, 0))
    bench.put(raw_box(wide - wall, wall, low), look, (0, (wall - deep) / 2, 0))
    for number in range(bench.n(0, 3)):
        thick = bench.u(0.004, 0.014)
        at = (-wide / 2 + wall + 0.012 + 0.017 * number, 0.0, wall - 0.0005)
        bench.put(raw_box(thick, 0.85 * deep, height * bench.u(0.7, 1.1)), bench.look(), at)
    return bench.thing("magazine holder", vary=(0.7, 1.2))


def make_odd_cup(shop: Workshop, name: str) -> Thing:
    """A cup or bin of an odd outline: star, amoeba, triangle, twisted or widened."""
    bench = Bench(shop, name)
    radius, height, count = bench.u(0.03, 0.11), bench.u(0.06, 0.2), bench.n(3, 9)
    outline = ring(1.0, count)
    kind = bench.n(0, 2)
    if kind == 0:
        outline = smooth(outline * bench.rng.uniform(0.7, 1.0, (count, 1)), 40, closed=True)
    elif kind == 1:
        outline = ring(1.0, 2 * count)
        outline[1::2] *= bench.u(0.65, 0.9)
    taper, twist, shrink = bench.u(0.75, 1.5), bench.u(-50, 50) * bench.chance(0.5), bench.u(0.82, 0.93)
    rim = raw_extrude(radius * outline, height, [shrink * radius * outline], 10, taper, twist)
    look = bench.look()
    bench.put(rim, look, crease_deg=45.0)
    bench.put(raw_extrude(0.5 * (1 + shrink) * radius * outline, 0.007), look)
    return bench.thing("odd cup", inside(0.007, disc(0.45 * radius), height - 0.007))


def make_half_pipe(shop: Workshop, name: str) -> Thing:
    """A gutter, a cradle or a phone rest: a bent sheet between two cheeks."""
    bench = Bench(shop, name)
    wide, size, thick = bench.u(0.06, 0.2), bench.u(0.05, 0.12), bench.u(0.003, 0.01)
    points = [(-1, bench.u(0.6, 1.2)), (-0.7, 0.15), (0, 0), (0.7, 0.1), (1, bench.u(0.3, 1.2))]
    section = gentle(np.array(points), 18) * size
    y = np.array([-0.5, 0.0, 0.5]) * wide
    grid = np.empty((18, 3, 3))
    grid[..., 0], grid[..., 1], grid[..., 2] = section[:, :1], y[None], section[:, 1:] + thick / 2
    bench.put(raw_slab(grid, thick), bench.look())
    cheek = bench.look()
    outline = np.concatenate([section[2:-2] + (0, 0.5 * thick), [[0.8 * size, -0.02], [-0.8 * size, -0.02]]])
    for sign in (-1, 1):
        bench.put(raw_extrude(outline, 0.008), cheek, (0, sign * 0.42 * wide + 0.004, 0.004), turn(x=90))
    return bench.thing("cradle")


SUPERQUADRIC_KINDS: dict[str, Kind] = {
    "superblock": Kind("shape", make_superblock),
    "superstack": Kind("stacked shape", make_superstack),
    "supertaper": Kind("tapered shape", make_supertaper),
    "superbend": Kind("bent shape", make_superbend),
    "superegg": Kind("egg", make_superegg),
    "supertoroid": Kind("ring", make_supertoroid),
    "supercross": Kind("joined shapes", make_supercross),
}
LATHED_KINDS: dict[str, Kind] = {
    "turned_vase": Kind("vase", make_turned_vase),
    "flask": Kind("flask", make_flask),
    "goblet": Kind("goblet", make_goblet),
    "spinning_top": Kind("spinning top", make_spinning_top),
    "table_lamp": Kind("lamp", make_table_lamp),
    "bell": Kind("bell", make_bell),
    "pin": Kind("pin", make_pin),
    "totem": Kind("turned post", make_totem),
    "pot": Kind("pot", make_pot),
    "candlestick": Kind("candlestick", make_candlestick),
}
EXTRUDED_KINDS: dict[str, Kind] = {
    "star": Kind("star", make_star),
    "letter": Kind("letter", make_letter),
    "gear": Kind("gear", make_gear),
    "heart": Kind("heart", make_heart),
    "spline_block": Kind("spline block", make_spline_block),
    "arch": Kind("arch", make_arch),
    "crescent": Kind("crescent", make_crescent),
    "pierced": Kind("pierced block", make_pierced),
}
UNION_KINDS: dict[str, Kind] = {
    "teapot": Kind("teapot", make_teapot),
    "watering_can": Kind("watering can", make_watering_can),
    "kettle": Kind("kettle", make_kettle),
    "jug": Kind("jug", make_jug),
    "saucepan": Kind("saucepan", make_saucepan),
    "big_cup": Kind("cup", make_big_cup),
    "bow_basket": Kind("basket", make_bow_basket),
    "spray_bottle": Kind("spray bottle", make_spray_bottle),
    "headphone_stand": Kind("headphones", make_headphone_stand),
}
HOLLOW_KINDS: dict[str, Kind] = {
    "open_case": Kind("open case", make_open_case),
    "drum": Kind("drum", make_drum),
    "cubby": Kind("cubby", make_cubby),
    "pen_holder": Kind("pen holder", make_pen_holder),
    "hinged": Kind("hinged case", make_hinged),
    "open_book": Kind("open book", make_open_book),
    "slat_crate": Kind("crate", make_slat_crate),
    "magazine_holder": Kind("magazine holder", make_magazine_holder),
    "odd_cup": Kind("odd cup", make_odd_cup),
    "half_pipe": Kind("cradle", make_half_pipe),
}
