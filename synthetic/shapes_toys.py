"""Varied soft things, toys of many parts, and devices with articulated fronts."""

# ruff: noqa: RUF005 - arrays are added here, nothing is concatenated

import numpy as np

from synthetic.footprints import rectangle
from synthetic.furniture import Workshop
from synthetic.shapes_kit import (
    Bench,
    Raw,
    bow,
    gentle,
    grounded,
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
    wobbled,
)  # fmt: skip
from synthetic.things import Kind, Thing

_FLAT_CREASE_DEG = 5.0  # facets stay visible: crumpled things


# Soft things


def make_plush(shop: Workshop, name: str) -> Thing:
    """A plush animal that sits: body, head, ears, snout, four limbs."""
    bench = Bench(shop, name)
    body, look, inner = (
        bench.rng.uniform((0.045, 0.04, 0.05), (0.075, 0.065, 0.09)),
        bench.look(),
        bench.look(),
    )
    bench.put(grounded(wobbled(raw_ellipsoid(body, 3), bench.rng, 0.003, 0.05), 0.14), look)
    head, z = bench.u(0.6, 1.0) * float(body[0]), 1.55 * body[2]
    at = np.array([0, -0.012, z + 0.7 * head])
    bench.put(raw_ellipsoid((head, 0.9 * head, 0.9 * head), 3), look, at)
    bench.put(
        raw_ellipsoid((0.4 * head, 0.45 * head, 0.35 * head)), inner, at + (0, -0.8 * head, -0.2 * head)
    )
    ear, tall = bench.u(0.25, 0.5) * head, bench.u(0.3, 1.6) * head
    limbs = []
    for sign in (-1, 1):
        ear_at = at + (sign * 0.65 * head, 0, 0.6 * head + 0.4 * tall)
        limbs.append(posed(raw_ellipsoid((ear, 0.4 * ear, tall)), ear_at, turn(y=sign * bench.u(0, 40))))
        leg = raw_ellipsoid(np.array([0.28, 0.75, 0.28]) * body[0])
        limbs.append(grounded(posed(leg, (sign * 0.8 * body[0], -0.75 * body[1], 0), turn(z=sign * 20)), 0.1))
        arm = raw_ellipsoid(np.array([0.26, 0.26, 0.75]) * body[0])
        limbs.append(
            posed(
                arm,
                (sign * 1.0 * body[0], -0.3 * body[1], 1.1 * body[2]),
                turn(x=bench.u(-50, 30), y=-sign * bench.u(20, 70)),
            )
        )
    bench.put_all(limbs, bench.pick((look, inner)))
    eyes = [
        posed(raw_ellipsoid((0.09 * head,) * 3, 1), at + (s * 0.35 * head, -0.82 * head, 0.2 * head))
        for s in (-1, 1)
    ]
    bench.put_all(eyes, bench.look("dark"))
    return bench.thing("plush toy", vary=(0.7, 1.4))


def make_blob(shop: Workshop, name: str) -> Thing:
    """A lump of two to six soft balls that run into each other."""
    bench = Bench(shop, name)
    at, look = np.zeros(3), bench.look()
    for _ in range(bench.n(2, 6)):
        size = bench.rng.uniform(0.02, 0.06, 3)
        raw = grounded(wobbled(raw_ellipsoid(size, 3), bench.rng, bench.u(0.0, 0.008), 0.05), 0.2)
        bench.put(raw, look if bench.chance(0.7) else bench.look(), (at[0], at[1], max(at[2], 0.0)))
        at = at + bench.rng.uniform((-0.04, -0.04, -0.01), (0.04, 0.04, 0.04))
        at[2] = min(max(at[2], 0.0), 1.2 * size[2])
    return bench.thing("soft lump")


def _pillow(bench: Bench, wide: float, deep: float, thick: float) -> Raw:
    """Make a pillow that lies: thin and drawn in along its seam, thick in its middle."""
    u, v = np.meshgrid(np.linspace(-1, 1, 18), np.linspace(-1, 1, 18), indexing="ij")
    full = ((1 - np.abs(u) ** 2.5) * (1 - np.abs(v) ** 2.5)) ** 0.55
    draw = 1 - 0.08 * (np.abs(u) < 0.99) * (1 - v**2) * np.abs(u) ** 4
    x, y = wide / 2 * u * draw, deep / 2 * v * (1 - 0.08 * (1 - u**2) * v**4)
    sheet = np.stack([x, y, 0 * x], -1)
    vertices, faces = raw_slab(sheet, 0.004 + thick * full)
    raw = wobbled((vertices, faces), bench.rng, 0.04 * thick, 0.08)
    return grounded(raw, bench.u(0.15, 0.3))


def make_cushion(shop: Workshop, name: str) -> Thing:
    """A cushion that lies, or two on each other."""
    bench = Bench(shop, name)
    wide, deep, z = bench.u(0.12, 0.34), bench.u(0.1, 0.3), 0.0
    for _ in range(bench.n(1, 2)):
        raw = _pillow(bench, wide, deep, bench.u(0.04, 0.1))
        bench.put(
            raw, bench.look(size_m=0.3), (*bench.rng.uniform(-0.01, 0.01, 2), z), turn(z=bench.u(0, 30)), 60
        )
        z, wide, deep = z + 0.72 * float(raw[0][:, 2].max()), 0.85 * wide, 0.85 * deep
    return bench.thing("cushion")


def make_towels(shop: Workshop, name: str) -> Thing:
    """A stack of folded towels or blankets with round folds."""
    bench = Bench(shop, name)
    wide, deep, z = bench.u(0.12, 0.3), bench.u(0.1, 0.22), 0.0
    looks = [bench.look(size_m=0.25) for _ in range(3)]
    for _ in range(bench.n(1, 5)):
        layers, thick = bench.n(2, 4), bench.u(0.008, 0.018)
        tall, outline = layers * thick, []
        for layer in range(layers):  # the folds bulge to the left, the ends step back to the right
            outline.append((-wide / 2 - 0.4 * thick, (layer + 0.5) * thick))
            outline.append((-wide / 2, (layer + 1) * thick - (0.0008 if layer < layers - 1 else 0.0)))
        right = [
            (wide / 2 - bench.u(0, 0.01), (layer + f) * thick) for layer in range(layers) for f in (0.1, 0.9)
        ]
        shape = np.array(
            [
                (-wide / 2, 0.0),
                (0.47 * wide, 0.0),
                *right,
                (0.3 * wide, tall + bench.u(-0.3, 0.3) * thick),
                (-0.2 * wide, tall + bench.u(0, 0.4) * thick),
                *outline[::-1][1:],
            ]
        )
        raw = raw_extrude(shape, deep, layers=6)
        raw = posed(raw, (0, deep / 2, 0), turn(x=90))
        wave = 0.0025 * np.sin(raw[0][:, :1] * 40 + raw[0][:, 1:2] * bench.u(20, 60)) * (raw[0][:, 2:] / tall)
        raw = (raw[0] + np.concatenate([0 * wave, 0 * wave, wave], 1), raw[1])
        bench.put(
            raw,
            bench.pick(looks),
            (*bench.rng.uniform(-0.006, 0.006, 2), z),
            turn(z=bench.u(-4, 4) + 180 * bench.n(0, 1)),
            50,
        )
        z += 0.96 * tall
    return bench.thing("towels", vary=(0.8, 1.3))


def make_sack(shop: Workshop, name: str) -> Thing:
    """A bag that bulges, some tied at the neck, some with two loops."""
    bench = Bench(shop, name)
    radii = bench.rng.uniform((0.04, 0.03, 0.05), (0.12, 0.09, 0.13))
    raw = raw_superquadric(radii, bench.u(0.5, 0.9), bench.u(0.5, 1.0), 26, 36)
    raw = grounded(wobbled(raw, bench.rng, bench.u(0.003, 0.012), bench.u(0.03, 0.08), 7), bench.u(0.08, 0.2))
    high, look = float(raw[0][:, 2].max()), bench.look(size_m=0.25)
    bench.put(raw, look, crease_deg=60)
    if bench.chance(0.5):
        neck = gentle([(0.6, 0), (0.3, 0.4), (0.25, 0.5), (bench.u(0.6, 1.2), 1)], 14) * (
            0.45 * radii[1],
            0.06,
        )
        profile = np.concatenate([[[0, 0]], neck, [[0, 0.05]]])
        vertices, faces = raw_lathe(profile, 28)
        angle = np.arctan2(vertices[:, 1], vertices[:, 0])
        vertices[:, :2] *= 1 + 0.15 * np.sin(bench.n(4, 8) * angle)[:, None]
        bench.put((vertices, faces), look, (0, 0, 0.93 * high), crease_deg=60)
    elif bench.chance(0.7):
        loop = bench.look()
        for sign in (-1, 1):
            path = bow(
                (-0.35 * radii[0], sign * 0.4 * radii[1], 0.85 * high),
                (0.35 * radii[0], sign * 0.4 * radii[1], 0.85 * high),
                (0, sign * 0.01, bench.u(0.04, 0.1)),
            )
            bench.put(raw_sweep(path, 0.004, 8, 0.7), loop)
    return bench.thing("bag")


def make_crumple(shop: Workshop, name: str) -> Thing:
    """A crumpled ball of paper or foil: sharp facets."""
    bench = Bench(shop, name)
    vertices, faces = raw_ellipsoid(bench.rng.uniform(0.025, 0.07, 3), bench.n(2, 3))
    dents = bench.rng.standard_normal((len(vertices), 1)).clip(-1.5, 1.5)
    vertices = vertices * (1 + bench.u(0.03, 0.09) * dents)
    raw = wobbled((vertices, faces), bench.rng, 0.004, 0.02, 9)
    bench.put(
        grounded(raw, bench.u(0.12, 0.25)),
        bench.look(bench.pick(("white", "print", "plain", "metal", ""))),
        crease_deg=_FLAT_CREASE_DEG,
    )
    return bench.thing("crumpled paper")


def make_shoes(shop: Workshop, name: str) -> Thing:
    """One shoe or a pair: sole, upper with an opening, heel, a tongue or a boot leg."""
    bench = Bench(shop, name)
    long, wide, boot = bench.u(0.18, 0.28), bench.u(0.07, 0.1), bench.u(0.06, 0.2)
    looks = [bench.look(), bench.look(), bench.look()]
    right = smooth(
        [
            (-0.5, 0),
            (-0.42, -0.36),
            (0, -0.34),
            (0.3, -0.48),
            (0.5, -0.1),
            (0.42, 0.25),
            (0.2, 0.4),
            (0, 0.36),
            (-0.42, 0.34),
        ],
        44,
        closed=True,
    )
    thick, rise, arch = bench.u(0.01, 0.03), bench.u(0.05, 0.085), bench.u(0.0, 0.35)
    is_boot = bench.chance(0.35)
    for sign in (1, -1)[: bench.n(1, 2)]:
        outline = right * (long, sign * wide)
        at, spin = (bench.u(-0.02, 0.02), -sign * 0.62 * wide, 0), turn(z=bench.u(-12, 12))
        bench.put(raw_extrude(outline, thick, layers=2, taper=0.97), looks[1], at, spin)
        body = raw_extrude(outline * 0.97, rise, layers=8)
        vertices = body[0].copy()
        share, x = vertices[:, 2] / rise, vertices[:, 0] / long
        vertices[:, 1] *= 1 - 0.45 * share**2
        vertices[:, 2] *= np.interp(x, [-0.5, -0.1, 0.15, 0.5], [1.0, 1 - 0.3 * arch, 0.8, 0.42])
        vertices[:, 0] -= 0.06 * long * share**2 * (x > 0)
        bench.put(posed((vertices, body[1]), (0, 0, thick - 0.001)), looks[0], at, spin, 50)
        shaft, tall = 0.31 * wide, (boot if is_boot else 0.012)
        z = thick + 0.8 * rise
        tube = np.array(
            [
                (1.0, 0),
                (bench.u(0.9, 1.2), tall + 0.15 * rise),
                (0.82, tall + 0.15 * rise),
                (0.82, 0.3 * tall + 0.08 * rise),
                (0, 0.3 * tall + 0.08 * rise),
            ]
        ) * (shaft, 1)
        leg = raw_lathe(np.concatenate([[[0, 0]], tube]), 24)
        leg = (leg[0] * ((1.9, 1, 1) if not is_boot else (1.45, 1.1, 1)), leg[1])
        bench.put(posed(leg, (-0.26 * long, 0, z)), looks[0], at, spin, 50)
        laces = [
            posed(
                rod((0, -0.25 * wide, 0), (0, 0.25 * wide, 0), 0.0025, 6), (x0 * long, 0, thick + z0 * rise)
            )
            for x0, z0 in ((0.04, 0.82), (0.1, 0.77), (0.16, 0.73))
        ]
        bench.put_all([posed(lace, at, spin) for lace in laces], looks[2])
    return bench.thing("shoes", vary=(0.6, 1.2))


def make_hat(shop: Workshop, name: str) -> Thing:
    """A hat: brim, crown with a dent, ribbon; or a cap with a visor, or a woolen hat with a bobble."""
    bench = Bench(shop, name)
    radius, tall, kind, look = bench.u(0.07, 0.1), bench.u(0.06, 0.13), bench.n(0, 2), bench.look(size_m=0.25)
    press = bench.u(0.75, 1.0)
    if kind == 0:
        brim = radius * bench.u(1.3, 1.9)
        outline = [
            (0, 0.001),
            (radius, 0),
            (brim, bench.u(0.0, 0.02)),
            (brim, bench.u(0.021, 0.026)),
            (radius, 0.006),
        ]
        crown = gentle(
            [
                (1, 0.006),
                (bench.u(0.85, 1), 0.6 * tall),
                (bench.u(0.6, 0.95), tall),
                (0.3, tall * bench.u(0.8, 1.0)),
                (0.02, tall * 0.85),
            ],
            24,
        )
        raw = raw_lathe(np.concatenate([outline, crown[1:] * (radius, 1), [[0, 0.85 * tall]]]), 40)
        band = np.array([[0.93, 0.007], [1.03, 0.007], [1.01, 0.03], [0.9, 0.03]]) * (radius, 1)
        bench.put((raw[0] * (1, press, 1), raw[1]), look, crease_deg=50)
        hoop = raw_lathe(band, 40, closed=True)
        bench.put((hoop[0] * (1, press, 1), hoop[1]), bench.look())
        return bench.thing("hat", vary=(0.7, 1.2))
    dome = grounded(
        wobbled(
            raw_superquadric((radius, radius * press, tall), bench.u(0.6, 1.0), 1.0, 22, 32),
            bench.rng,
            0.003,
            0.05,
        ),
        0.5,
    )
    bench.put(dome, look, crease_deg=50)
    high = float(dome[0][:, 2].max())
    if kind == 1:
        t = np.linspace(-1.1, 1.1, 14)
        outer = np.column_stack(
            [radius * (0.8 * np.cos(t) + bench.u(0.7, 1.0)), 0.95 * radius * press * np.sin(t)]
        )
        visor = np.concatenate(
            [outer, np.column_stack([0.75 * radius * np.cos(t), 0.8 * radius * press * np.sin(t)])[::-1]]
        )
        bench.put(raw_extrude(visor, 0.005), bench.look(), (0, 0, 0.001), turn(y=-bench.u(0, 3)))
        bench.put(raw_ellipsoid((0.008, 0.008, 0.005), 1), look, (0, 0, high))
    else:
        fold = np.array([[0.9, 0], [1.05, 0.0], [1.07, 0.02], [1.02, 0.035], [0.88, 0.035]]) * (radius, 1)
        hoop = raw_lathe(fold, 40, closed=True)
        bench.put((hoop[0] * (1, press, 1), hoop[1]), bench.look())
        bobble = raw_ellipsoid((bench.u(0.015, 0.035),) * 3, 3)
        jagged = bobble[0] * (1 + 0.08 * bench.rng.standard_normal((len(bobble[0]), 1)).clip(-2, 2))
        bench.put((jagged, bobble[1]), bench.look(), (0, 0, high + 0.01))
    return bench.thing("hat", vary=(0.7, 1.2))


def make_draped_cloth(shop: Workshop, name: str) -> Thing:
    """A heap of cloth: a sheet with folds that falls from a middle to the support."""
    bench = Bench(shop, name)
    radius, tall, folds = bench.u(0.08, 0.18), bench.u(0.03, 0.12), bench.n(3, 8)
    vertices, faces = raw_superquadric(
        (radius, radius * bench.u(0.6, 1), tall), bench.u(0.9, 1.7), 1.0, 30, 72
    )
    angle, share = np.arctan2(vertices[:, 1], vertices[:, 0]), np.clip(vertices[:, 2] / tall, 0, 1)
    phase = bench.u(0, 6)
    wave = np.sin(folds * angle + phase + 1.5 * np.sin(2 * angle)) * bench.u(0.08, 0.3)
    vertices[:, :2] *= 1 + (wave * (1 - share))[:, None]
    raw = wobbled((vertices, faces), bench.rng, 0.006, 0.05, 7)
    bench.put(grounded(raw, 0.53), bench.look(size_m=0.3), crease_deg=60)
    return bench.thing("cloth")


# Toys of many parts


def _wheels(bench: Bench, spots: list[tuple[float, float]], radius: float, wide: float) -> None:
    """Add wheels at (x, y) with hubs; they stand on z = 0 with a hair of flat."""
    tires, hubs = [], []
    for x, y in spots:
        tire = grounded(
            posed(
                raw_lathe(
                    np.array([[0, -0.5], [0.85, -0.5], [1, -0.3], [1, 0.3], [0.85, 0.5], [0, 0.5]])
                    * (radius, wide),
                    24,
                ),
                (0, 0, 0),
                turn(x=90),
            ),
            0.01,
        )
        tires.append(posed(tire, (x, y, 0)))
        hubs.append(
            rod((x, y - 0.58 * wide, 0.98 * radius), (x, y + 0.58 * wide, 0.98 * radius), 0.5 * radius, 14)
        )
    bench.put_all(tires, bench.look("dark" if bench.chance(0.6) else ""))
    bench.put_all(hubs, bench.look())


def make_toy_car(shop: Workshop, name: str) -> Thing:
    """A toy car: a body of any side view, a cabin, wheels, bumpers, lamps."""
    bench = Bench(shop, name)
    long, wide, tall, radius = (
        bench.u(0.1, 0.2),
        bench.u(0.045, 0.08),
        bench.u(0.025, 0.05),
        bench.u(0.013, 0.024),
    )
    look, z = bench.look(), 0.7 * radius
    body = gentle(
        [
            (-0.5, bench.u(0.5, 0.9)),
            (-0.3, 1),
            (0.1, 1),
            (0.35, bench.u(0.6, 0.95)),
            (0.5, bench.u(0.4, 0.6)),
        ],
        16,
    ) * (long, tall)
    shape = np.concatenate(
        [
            [[-0.5 * long, 0.1 * tall], [-0.45 * long, 0], [0.47 * long, 0], [0.5 * long, 0.15 * tall]],
            body[::-1],
        ]
    )
    bench.put(raw_extrude(shape, wide), look, (0, wide / 2, z), turn(x=90))
    back, front, roof = bench.u(-0.45, -0.2), bench.u(0.1, 0.3), bench.u(0.5, 1.0)
    cabin = (
        np.array(
            [
                (back, 0),
                (front, 0),
                (front - bench.u(0.05, 0.18), roof * 0.2),
                (back + bench.u(0.0, 0.12), roof * 0.2),
            ]
        )
        * long
    )
    bench.put(
        raw_extrude(cabin, 0.86 * wide),
        bench.pick((look, bench.look("dark"))),
        (0, 0.43 * wide, z + 0.93 * tall),
        turn(x=90),
    )
    spots = [(x * long, sign * 0.5 * wide) for x in (-0.3, 0.3) for sign in (-1, 1)]
    _wheels(bench, spots, radius, bench.u(0.008, 0.016))
    bench.put_all(
        [posed(raw_box(0.01, wide * 1.02, 0.008), (s * 0.49 * long, 0, z + 0.1 * tall)) for s in (-1, 1)],
        bench.look("metal"),
    )
    lamps = [
        posed(raw_ellipsoid((0.005, 0.006, 0.006), 1), (0.5 * long, s * 0.33 * wide, z + 0.4 * tall))
        for s in (-1, 1)
    ]
    bench.put_all(lamps, bench.look("white"))
    return bench.thing("toy car", vary=(0.6, 1.6))


def make_toy_truck(shop: Workshop, name: str) -> Thing:
    """A toy truck: cabin, chassis, a box, an open bed or a tank, six wheels."""
    bench = Bench(shop, name)
    long, wide, radius = bench.u(0.18, 0.3), bench.u(0.06, 0.09), bench.u(0.014, 0.022)
    z = radius
    bench.put(raw_box(long, 0.7 * wide, 0.012), bench.look("dark"), (0, 0, z))
    cab, tall = bench.u(0.18, 0.28) * long, bench.u(0.06, 0.09)
    side = np.array([(0, 0), (cab, 0), (cab, 0.5 * tall), (bench.u(0.6, 1) * cab, tall), (0, tall)])
    bench.put(raw_extrude(side, wide), bench.look(), (long / 2 - cab, wide / 2, z + 0.008), turn(x=90))
    bench.put(
        raw_box(0.012, 0.8 * wide, 0.3 * tall),
        bench.look("dark"),
        (long / 2 - 0.22 * cab, 0, z + 0.58 * tall),
    )
    load, x, high, kind = 0.98 * (long - cab) - 0.004, -cab / 2, bench.u(0.04, 0.11), bench.n(0, 2)
    if kind == 0:
        bench.put(
            raw_box(load, wide, high), bench.look("print" if bench.chance(0.4) else ""), (x, 0, z + 0.011)
        )
    elif kind == 1:
        outline, hole = rounded(load, wide, 0.002), rounded(load - 0.01, wide - 0.01, 0.002)
        bench.put(raw_extrude(outline, 0.5 * high, [hole]), bench.look(), (x, 0, z + 0.011))
        bench.put(raw_box(load - 0.004, wide - 0.004, 0.005), bench.look(), (x, 0, z + 0.011))
        lumps = [
            posed(raw_ellipsoid(bench.rng.uniform(0.015, 0.03, 3)), (x + f * load, 0, z + 0.025))
            for f in (-0.3, 0.0, 0.3)
        ]
        bench.put_all(lumps, bench.look())
    else:
        tank = raw_superquadric((load / 2, wide / 2, wide / 2), 0.9, 0.3, 20, 24)
        bench.put(tank, bench.look(), (x, 0, z + 0.005 + wide / 2))
    spots = [(f * long, s * 0.39 * wide) for f in (-0.4, -0.26, 0.36) for s in (-1, 1)]
    _wheels(bench, spots, radius, 0.013)
    return bench.thing("toy truck", vary=(0.7, 1.4))


def make_toy_train(shop: Workshop, name: str) -> Thing:
    """A locomotive with one to three waggons on rails or on the support."""
    bench = Bench(shop, name)
    unit, wide, radius, gap = bench.u(0.08, 0.11), bench.u(0.04, 0.055), bench.u(0.009, 0.014), 0.012
    count = bench.n(1, 3)
    start, spots = -(count - 1) * (unit + gap) / 2, []
    for index in range(count):
        x = start + index * (unit + gap)
        spots += [(x + f * unit, s * 0.46 * wide) for f in (-0.33, 0, 0.33) for s in (-1, 1)]
        bench.put(raw_box(unit, 0.8 * wide, 0.008), bench.look(), (x, 0, radius))
        if index == count - 1:
            boiler, look = 0.42 * wide, bench.look()
            bench.put(
                rod((x - 0.2 * unit, 0, 0), (x + 0.48 * unit, 0, 0), boiler, 24),
                look,
                (0, 0, radius + 0.006 + boiler),
            )
            bench.put(
                raw_box(0.35 * unit, wide, bench.u(0.05, 0.07)),
                bench.look(),
                (x - 0.32 * unit, 0, radius + 0.005),
            )
            stack = gentle([(0.8, 0), (0.6, 0.5), (bench.u(0.6, 1.5), 1)], 8) * (0.012, bench.u(0.025, 0.045))
            bench.put(
                raw_lathe(np.concatenate([[[0, 0]], stack, [[0, stack[-1, 1]]]]), 16),
                bench.look("dark"),
                (x + 0.32 * unit, 0, radius + 1.85 * boiler),
            )
        elif bench.chance(0.5):
            bench.put(raw_box(0.92 * unit, wide, bench.u(0.02, 0.05)), bench.look(), (x, 0, radius + 0.006))
        else:
            logs = [rod((x - 0.42 * unit, y, 0), (x + 0.42 * unit, y, 0), 0.01, 10) for y in (-0.012, 0.007)]
            bench.put_all([posed(log, (0, 0, radius + 0.015)) for log in logs], bench.look("wood"))
        if index:
            bench.put(
                rod(
                    (x - unit / 2 - gap - 0.003, 0, radius + 0.004),
                    (x - unit / 2 + 0.003, 0, radius + 0.004),
                    0.003,
                    8,
                ),
                bench.look("metal"),
            )
    _wheels(bench, spots, radius, 0.007)
    return bench.thing("toy train", vary=(0.7, 1.5))


def make_robot(shop: Workshop, name: str) -> Thing:
    """A toy robot: feet, legs, body with a panel, jointed arms, head with eyes and antennas."""
    bench = Bench(shop, name)
    look, joint, wide, tall = bench.look(), bench.look("metal"), bench.u(0.05, 0.09), bench.u(0.05, 0.09)
    deep, leg = bench.u(0.03, 0.06), bench.u(0.03, 0.08)
    parts, joints = [], []
    for sign in (-1, 1):
        x = sign * 0.28 * wide
        parts.append(posed(raw_extrude(rounded(0.4 * wide, 1.3 * deep, 0.006), 0.014), (x, -0.1 * deep, 0)))
        joints.append(rod((x, 0, 0.01), (x, 0, leg + 0.004), 0.12 * wide, 12))
        shoulder = np.array([sign * 0.56 * wide, 0, leg + 0.82 * tall])
        elbow = shoulder + bench.u(0.03, 0.05) * np.array(
            [sign * bench.u(0.1, 0.9), bench.u(-0.5, 0.3), bench.u(-1, 0.4)]
        )
        hand = elbow + bench.u(0.03, 0.045) * np.array([sign * 0.2, -bench.u(0.2, 1), bench.u(-0.6, 0.6)])
        joints += [
            rod((0.3 * shoulder[0], *shoulder[1:]), shoulder, 0.008, 10),
            rod(shoulder, elbow, 0.007, 10),
            rod(elbow, hand, 0.007, 10),
        ]
        joints.append(posed(raw_ellipsoid((0.01, 0.01, 0.01), 2), elbow))
        parts.append(posed(raw_box(0.022, 0.022, 0.02), hand - (0, 0, 0.01)))
    bench.put_all(joints, joint)
    bench.put_all(parts, bench.look())
    body = raw_extrude(rounded(wide, deep, bench.u(0.001, 0.02)), tall, layers=3, taper=bench.u(0.7, 1.2))
    bench.put(body, look, (0, 0, leg))
    bench.put(raw_box(0.5 * wide, 0.01, 0.4 * tall), bench.look("print"), (0, -0.46 * deep, leg + 0.3 * tall))
    head = bench.rng.uniform((0.5, 0.6, 0.35), (0.9, 1.0, 0.7)) * (wide, deep, tall)
    z = leg + tall + 0.006
    bench.put(rod((0, 0, leg + tall - 0.005), (0, 0, z + 0.004), 0.01, 12), joint)
    bench.put(
        raw_superquadric(head / 2, bench.u(0.25, 0.9), bench.u(0.25, 1.0), 16, 24),
        look,
        (0, 0, z + head[2] / 2),
    )
    eyes = [
        rod(
            (s * 0.22 * head[0], 0, z + 0.6 * head[2]),
            (s * 0.22 * head[0], -0.54 * head[1], z + 0.6 * head[2]),
            0.12 * head[0],
            12,
        )
        for s in (-1, 1)
    ]
    bench.put_all(eyes, bench.look())
    if bench.chance(0.7):
        antennas = [
            rod(
                (s * 0.2 * head[0], 0, z + 0.85 * head[2]),
                (s * 0.35 * head[0], 0, z + head[2] + 0.03),
                0.002,
                6,
            )
            for s in (-1, 1)
        ]
        bench.put_all(antennas, joint)
    return bench.thing("robot", vary=(0.7, 1.6))


def make_toy_house(shop: Workshop, name: str) -> Thing:
    """A model house: walls, a gabled, hipped or flat roof, chimney, door, windows, perhaps a tower."""
    bench = Bench(shop, name)
    wide, deep, tall, rise = bench.u(0.09, 0.2), bench.u(0.07, 0.14), bench.u(0.05, 0.14), bench.u(0.03, 0.09)
    bench.put(raw_box(wide, deep, tall), bench.look())
    roof, kind, eaves = bench.look(), bench.n(0, 2), bench.u(0.004, 0.02)
    if kind == 0:
        shape = np.array([(-deep / 2 - eaves, 0), (deep / 2 + eaves, 0), (0, rise)])
        bench.put(
            raw_extrude(shape, wide + 2 * eaves),
            roof,
            (-wide / 2 - eaves, 0, tall - 0.001),
            turn(z=90) @ turn(x=90),
        )
    elif kind == 1:
        base = rounded(wide + 2 * eaves, deep + 2 * eaves, 0.0005)
        bench.put(raw_extrude(base, rise, taper=bench.u(0.05, 0.6)), roof, (0, 0, tall - 0.001))
    else:
        bench.put(raw_box(wide + eaves, deep + eaves, 0.008), roof, (0, 0, tall - 0.002))
    bench.put(
        raw_box(0.018, 0.018, rise + 0.02),
        bench.look(),
        (bench.u(-0.35, 0.35) * wide, 0.15 * deep, tall - 0.005),
    )
    pane = bench.look("dark" if bench.chance(0.6) else "")
    bench.put(
        raw_box(0.2 * wide, 0.006, 0.55 * tall), bench.look(), (bench.u(-0.3, 0.3) * wide, -deep / 2, 0.0)
    )
    windows = []
    for y in (-deep / 2, deep / 2):
        for x in (-0.33, 0.0, 0.33):
            if bench.chance(0.7):
                windows.append(posed(raw_box(0.16 * wide, 0.005, 0.25 * tall), (x * wide, y, 0.62 * tall)))
    bench.put_all(windows, pane)
    if bench.chance(0.35):
        radius, high = bench.u(0.018, 0.035), tall * bench.u(1.1, 1.8)
        at = (wide / 2, bench.u(-0.4, 0.4) * deep, 0)
        bench.put(rod((0, 0, 0), (0, 0, high), radius, 16), bench.look(), at)
        bench.put(
            raw_lathe(np.array([[0, 0], [1.2 * radius, 0], [0, 2.4 * radius]]), 16),
            roof,
            (*at[:2], high - 0.001),
        )
    return bench.thing("toy house")


def make_brick_tower(shop: Workshop, name: str) -> Thing:
    """A tower of toy bricks with studs, turned and shifted on each other."""
    bench = Bench(shop, name)
    unit, tall = bench.u(0.012, 0.02), bench.u(0.014, 0.022)
    looks = [bench.look("plain") for _ in range(4)]
    width = [bench.n(3, 6), bench.n(2, 5)]
    at, z = np.zeros(2), 0.0
    stud = raw_extrude(ring(0.3 * unit, 10), 0.22 * tall + 0.0005)
    for _ in range(bench.n(3, 8)):
        look = bench.pick(looks)
        bench.put(raw_box(width[0] * unit, width[1] * unit, tall), look, (*at, z))
        x, y = ((np.arange(w) - (w - 1) / 2) * unit for w in width)
        bench.put_all([posed(stud, (at[0] + a, at[1] + b, z + tall - 0.0005)) for a in x for b in y], look)
        new = [max(1, w - bench.n(0, 1)) if bench.chance(0.6) else w for w in width]
        room = (np.array(width) - new) / 2
        at = at + np.round(bench.rng.uniform(-room, room) * 2) / 2 * unit
        width, z = new, z + tall
    return bench.thing("brick tower", vary=(0.9, 2.4))


def make_doll(shop: Workshop, name: str) -> Thing:
    """A doll or a peg figure: skirt or legs, body, arms, head, hair or hat."""
    bench = Bench(shop, name)
    tall, look, skin = bench.u(0.1, 0.2), bench.look(), bench.look("plain")
    wide = bench.u(0.16, 0.24) * tall
    if bench.chance(0.5):
        skirt = gentle(
            [(bench.u(1.0, 1.9), 0), (bench.u(0.7, 1.3), 0.25), (0.65, 0.5), (0.85, 0.65), (0.3, 0.75)], 18
        ) * (wide, tall)
        bench.put(raw_lathe(np.concatenate([[[0, 0]], skirt, [[0, 0.75 * tall]]]), 28), look)
    else:
        legs = [
            grounded(
                rod((s * 0.4 * wide, 0, 0), (s * 0.35 * wide, 0, 0.42 * tall), 0.3 * wide, 12, 1.1), 0.01
            )
            for s in (-1, 1)
        ]
        shoes = [
            grounded(
                posed(raw_ellipsoid((0.35 * wide, 0.6 * wide, 0.3 * wide)), (s * 0.4 * wide, -0.2 * wide, 0)),
                0.3,
            )
            for s in (-1, 1)
        ]
        bench.put_all(legs, bench.look())
        bench.put_all(shoes, bench.look("dark"))
        bench.put(
            raw_superquadric((0.85 * wide, 0.6 * wide, 0.2 * tall), 0.7, 0.9, 16, 20),
            look,
            (0, 0, 0.56 * tall),
        )
    arms = []
    for s in (-1, 1):
        hand = (s * wide * bench.u(1.1, 2.2), -bench.u(0, 1) * wide, tall * bench.u(0.3, 0.95))
        arms.append(rod((s * 0.5 * wide, 0, 0.68 * tall), hand, 0.2 * wide, 10, 0.8))
        arms.append(posed(raw_ellipsoid((0.22 * wide,) * 3, 1), hand))
    bench.put_all(arms, bench.pick((look, skin)))
    head = bench.u(0.12, 0.19) * tall
    at = np.array([0, 0, 0.74 * tall + 0.9 * head])
    bench.put(raw_ellipsoid((head, head, 1.05 * head), 3), skin, at)
    hair = bench.look()
    if bench.chance(0.6):
        bench.put(
            raw_ellipsoid((1.08 * head, 1.05 * head, 0.9 * head), 3), hair, at + (0, 0.2 * head, 0.3 * head)
        )
        bench.put_all(
            [
                posed(
                    raw_ellipsoid((0.4 * head,) * 3, 1),
                    at + (s * head, 0.1 * head, bench.u(-0.4, 0.6) * head),
                )
                for s in (-1, 1)
            ],
            hair,
        )
    else:
        hat = (
            np.array(
                [[0, 0], [1.5, 0], [1.5, 0.15], [0.8, 0.2], [bench.u(0.05, 0.8), bench.u(0.9, 1.6)], [0, 1.6]]
            )
            * head
        )
        bench.put(raw_lathe(hat, 24), hair, at + (0, 0, 0.55 * head))
    return bench.thing("doll", vary=(0.7, 1.6))


def make_guitar(shop: Workshop, name: str) -> Thing:
    """A guitar or a fiddle that lies, or stands in a holder: waisted body, neck, head, strings."""
    bench = Bench(shop, name)
    long, thick, look = (
        bench.u(0.26, 0.42),
        bench.u(0.015, 0.04),
        bench.look("wood" if bench.chance(0.6) else ""),
    )
    half = [(0.0, -0.5), (0.16, -0.46), (0.19, -0.32), (0.12, -0.2), (0.15, -0.08), (0.09, 0.0)]
    outline = smooth(np.array(half + [(-x, y) for x, y in half[::-1][:-1]]), 48, closed=True) * long
    outline *= (bench.u(0.85, 1.15), 1)
    raws = [(raw_extrude(outline, thick), look)]
    face = thick - 0.0005
    raws.append(
        (posed(raw_extrude(ring(0.05 * long, 20), 0.002), (0, -0.14 * long, face)), bench.look("dark"))
    )
    raws.append(
        (posed(raw_box(0.12 * long, 0.02 * long, 0.007), (0, -0.33 * long, face)), bench.look("dark"))
    )
    raws.append(
        (posed(raw_box(0.05 * long, 0.5 * long, 0.008), (0, 0.18 * long, face - 0.005)), bench.look())
    )
    raws.append(
        (
            posed(
                raw_extrude(rounded(0.085 * long, 0.12 * long, 0.01), 0.008), (0, 0.47 * long, face - 0.006)
            ),
            look,
        )
    )
    wires = [
        rod((x * long, -0.33 * long, face + 0.006), (x * long, 0.45 * long, face + 0.005), 0.0006, 4)
        for x in (-0.015, -0.005, 0.005, 0.015)
    ]
    pegs = [
        posed(rod((0, 0, 0), (s * 0.06 * long, 0, 0), 0.003, 6), (0, y * long, face))
        for s in (-1, 1)
        for y in (0.43, 0.47, 0.51)
    ]
    metal = bench.look("metal")
    raws += [(raw, metal) for raw in wires + pegs]
    if bench.chance(0.5):
        lean = bench.u(8, 20)
        spin, at = turn(x=90 - lean), np.array([0, 0, 0.5 * long + 0.012])
        for raw, own in raws:
            bench.put(raw, own, at, spin)
        stand, slope = bench.look(), np.array([0, np.sin(np.radians(lean)), np.cos(np.radians(lean))])
        low, high = -0.5 * long * slope[1], at - 0.05 * long * slope  # the lower end and the back
        feet = [posed(raw_box(0.012, 0.15, 0.014), (s * 0.11 * long, low + 0.025, 0)) for s in (-1, 1)]
        feet.append(posed(raw_box(0.26 * long, 0.014, 0.012), (0, low + 0.09, 0.0)))
        feet.append(rod((0, low + 0.09, 0.006), high - (0, 0.001, 0), 0.005))
        bench.put_all(feet, stand)
    else:
        for raw, own in raws:
            bench.put(raw, own)
    return bench.thing("guitar", vary=(0.6, 1.05))


def make_excavator(shop: Workshop, name: str) -> Thing:
    """A toy excavator or crane: tracks, cabin, jointed boom with a shovel or a hook."""
    bench = Bench(shop, name)
    long, wide, look = bench.u(0.08, 0.13), bench.u(0.06, 0.09), bench.look()
    track, tall = bench.look("dark"), bench.u(0.02, 0.03)
    for s in (-1, 1):
        bench.put(
            raw_extrude(rounded(long, tall, 0.48 * tall, 6), 0.25 * wide),
            track,
            (0, s * 0.38 * wide + 0.125 * wide, tall / 2),
            turn(x=90),
        )
    bench.put(rod((0, 0, 0.4 * tall), (0, 0, 1.3 * tall), 0.35 * wide, 20), bench.look("metal"))
    yaw, z = turn(z=bench.u(-70, 70)), 1.25 * tall
    bench.put(raw_extrude(rounded(0.85 * long, 0.9 * wide, 0.006), 0.35 * wide), look, (0, 0, z), yaw)
    cab = raw_extrude(np.array([(0, 0), (0.4, 0), (0.4, 0.35), (0.3, 0.6), (0, 0.6)]) * long, 0.4 * wide)
    bench.put(posed(cab, (0, -0.02 * wide, 0.33 * wide), turn(x=90)), bench.look(), (0, 0, z), yaw)
    a = np.array([0.38 * long, 0.22 * wide, z + 0.3 * wide])
    b = a + bench.u(0.08, 0.14) * np.array([bench.u(0.3, 0.8), 0, 1.0])
    c = b + bench.u(0.07, 0.11) * np.array([1.0, 0, bench.u(-1.0, 0.2)])
    arms = [rod(a, b, 0.009, 4), rod(b, c, 0.007, 4)]
    arms.append(rod(a + (0.008, 0, -0.01), 0.5 * (a + b) + (0.009, 0, 0), 0.004, 8))
    bench.put_all([posed(arm, (0, 0, 0), yaw) for arm in arms], look)
    if bench.chance(0.6):
        scoop = (
            np.array(
                [
                    (0, 0.3),
                    (0.1, -0.5),
                    (0.7, -0.9),
                    (1.0, -0.6),
                    (0.95, -0.5),
                    (0.65, -0.7),
                    (0.25, -0.4),
                    (0.15, 0.3),
                ]
            )
            * 0.035
        )
        bench.put(
            posed(raw_extrude(scoop, 0.045), c + (-0.006, 0.022, 0), turn(x=90)),
            bench.look("metal"),
            rotation=yaw,
        )
    else:
        bench.put(posed(rod(c, c - (0, 0, min(0.05, c[2] - 0.02)), 0.0018, 6), (0, 0, 0), yaw), track)
        bench.put(
            posed(raw_ellipsoid((0.008, 0.008, 0.011), 1), c - (0, 0, min(0.05, c[2] - 0.02))),
            track,
            rotation=yaw,
        )
    return bench.thing("excavator", vary=(0.7, 1.5))


def make_plane(shop: Workshop, name: str) -> Thing:
    """A toy plane: hull, one or two pairs of wings, tail, propeller, wheels or a stand."""
    bench = Bench(shop, name)
    long, radius, span = bench.u(0.14, 0.3), bench.u(0.012, 0.028), bench.u(0.16, 0.34)
    z, look, wing_look = bench.u(0.03, 0.05) + radius, bench.look(), bench.look()
    t = np.linspace(-0.5, 0.5, 20)
    hull = np.interp(t, [-0.5, -0.3, 0.2, 0.42, 0.5], [0.25, 0.7, 1.0, 0.8, 0.25]) * radius
    bench.put(raw_sweep(np.column_stack([t * long, 0 * t, z + 0 * t]), hull, 18), look)
    chord, sweep = bench.u(0.16, 0.28) * long, bench.u(-0.05, 0.3) * long
    wing = np.array(
        [
            (0.1 * long, 0),
            (0.1 * long - sweep, span / 2),
            (0.1 * long - sweep - 0.6 * chord, span / 2),
            (0.1 * long - chord, 0),
        ]
    )
    wing = np.concatenate([wing[:3], [(0.1 * long - chord, 0)], wing[:3][::-1][:2] * (1, -1)])
    for level in (-0.5, 1.3)[: bench.n(1, 2)]:
        bench.put(raw_extrude(wing, 0.005), wing_look, (0, 0, z + level * radius))
        if level > 0:
            struts = [
                rod(
                    (0.05 * long - 0.5 * sweep, s * 0.25 * span, z - 0.45 * radius),
                    (0.05 * long - 0.5 * sweep, s * 0.25 * span, z + 1.35 * radius),
                    0.0022,
                    6,
                )
                for s in (-1, 1)
            ]
            bench.put_all(struts, look)
    bench.put(
        raw_extrude(np.array([(-0.5, -0.13), (-0.38, -0.1), (-0.38, 0.1), (-0.5, 0.13)]) * long, 0.004),
        wing_look,
        (0, 0, z),
    )
    fin = np.array([(-0.5, 0), (-0.36, 0), (-0.46, bench.u(0.1, 0.18)), (-0.52, bench.u(0.1, 0.18))]) * long
    bench.put(raw_extrude(fin, 0.004), wing_look, (0, 0.002, z), turn(x=90))
    blades = bench.n(2, 4)
    props = [posed(raw_box(0.003, 0.01, 1.6 * radius), (0, 0, 0)) for _ in range(blades)]
    bench.put_all(
        [posed(p, (0.5 * long, 0, z), turn(x=20 + 360 * i / blades)) for i, p in enumerate(props)],
        bench.look(),
    )
    bench.put(raw_ellipsoid((0.012, 0.008, 0.008)), look, (0.5 * long, 0, z))
    if bench.chance(0.5):
        wheel = 0.5 * (z - radius)
        _wheels(bench, [(0.15 * long, s * 1.2 * radius) for s in (-1, 1)] + [(-0.4 * long, 0)], wheel, 0.007)
        gear = [
            rod(
                (0.15 * long, s * 1.2 * radius, wheel),
                (0.13 * long, s * 0.4 * radius, z - 0.5 * radius),
                0.0025,
                6,
            )
            for s in (-1, 1)
        ]
        gear.append(rod((-0.4 * long, 0, wheel), (-0.4 * long, 0, z), 0.0025, 6))
        bench.put_all(gear, bench.look("metal"))
    else:
        bench.put(raw_extrude(ring(0.04, 24), 0.008), bench.look("dark"))
        bench.put(rod((0, 0, 0.004), (0, 0, z), 0.004, 8), bench.look("metal"))
    return bench.thing("toy plane", vary=(0.7, 1.3))


def make_chess_figure(shop: Workshop, name: str) -> Thing:
    """One to five chess figures: turned feet with heads of any kind, on a board or not."""
    bench = Bench(shop, name)
    looks, radius, z = [bench.look(), bench.look()], bench.u(0.013, 0.028), 0.0
    count, pitch = bench.n(1, 5), 2.6 * radius
    if count > 1 and bench.chance(0.6):
        bench.put(raw_extrude(rounded(3.2 * pitch, 3.2 * pitch, 0.004), 0.01), bench.look("pattern"))
        z = 0.0095
    cells = bench.rng.permutation(9)[:count]
    for cell in cells:
        at, look = np.array([(cell % 3 - 1) * pitch, (cell // 3 - 1) * pitch, z]), bench.pick(looks)
        tall = radius * bench.u(2.2, 4.8)
        foot = gentle(
            [
                (1, 0),
                (1, 0.08),
                (0.75, 0.14),
                (bench.u(0.3, 0.5), 0.4),
                (0.32, 0.7),
                (0.6, 0.74),
                (0.35, 0.8),
                (bench.u(0.35, 0.7), 1),
            ],
            30,
        ) * (radius, tall)
        bench.put(raw_lathe(np.concatenate([[[0, 0]], foot, [[0, tall]]]), 24), look, at)
        kind = bench.n(0, 3)
        if kind == 0:
            bench.put(raw_ellipsoid((0.55 * radius,) * 3, 2), look, at + (0, 0, tall + 0.25 * radius))
        elif kind == 1:
            head = (
                np.array(
                    [
                        (-0.5, 0),
                        (0.5, 0),
                        (0.35, 0.5),
                        (0.9, 0.8),
                        (0.8, 1.15),
                        (0.1, 1.5),
                        (-0.3, 1.3),
                        (-0.55, 0.7),
                    ]
                )
                * radius
            )
            bench.put(
                raw_extrude(head, 0.5 * radius), look, at + (0, 0.25 * radius, tall - 0.002), turn(x=90)
            )
        elif kind == 2:
            crown = ring(0.62 * radius, 12)
            bench.put(raw_extrude(crown, 0.5 * radius), look, at + (0, 0, tall - 0.001))
            bench.put_all(
                [
                    posed(
                        raw_box(0.25 * radius, 0.25 * radius, 0.3 * radius),
                        (*(at[:2] + 0.8 * crown[i]), at[2] + tall + 0.35 * radius),
                    )
                    for i in range(0, 12, 3)
                ],
                look,
            )
        else:
            bench.put_all(
                [
                    posed(raw_box(0.25 * radius, 0.25 * radius, radius), at + (0, 0, tall - 0.001)),
                    posed(
                        raw_box(0.75 * radius, 0.24 * radius, 0.25 * radius),
                        at + (0, 0, tall + 0.45 * radius),
                    ),
                ],
                look,
            )
    return bench.thing("chess figures", vary=(0.8, 1.6))


# Devices


def _case_look(bench: Bench) -> str:
    """Draw what cases are made of: often white or dark without any detail."""
    return bench.look(bench.pick(("white", "white", "dark", "plain", "metal", "paint", "wood", "")))


def _front(raw: Raw, x: float, y: float, z: float) -> Raw:
    """Put what was extruded upwards onto a front that faces -y: its middle comes to (x, y, z)."""
    return posed(raw, (x, y, z), turn(x=90))


def _knob(bench: Bench, radius: float, tall: float) -> Raw:
    return raw_lathe(
        np.array([[0, 0], [radius, 0], [bench.u(0.75, 1) * radius, tall], [0, tall]]), bench.pick((8, 20, 20))
    )


def make_oven(shop: Workshop, name: str) -> Thing:
    """A microwave or a small oven: case, sunk door with a dark pane, handle, knobs, buttons, feet."""
    bench = Bench(shop, name)
    wide, deep, tall, look = bench.u(0.26, 0.42), bench.u(0.18, 0.3), bench.u(0.16, 0.26), _case_look(bench)
    foot = 0.008
    feet = [
        posed(raw_extrude(ring(0.012, 12), foot + 0.001), (sx * 0.42 * wide, sy * 0.4 * deep, 0))
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    bench.put_all(feet, bench.look("dark"))
    frame = raw_extrude(rounded(wide, tall, bench.u(0.001, 0.02)), deep)
    bench.put(_front(frame, 0, deep / 2, foot + tall / 2), look)
    door, x = bench.u(0.66, 0.8) * wide, -0.5 * wide + bench.u(0.34, 0.4) * wide
    z, front = foot + tall / 2, -deep / 2
    bench.put(
        _front(raw_extrude(rounded(door, 0.9 * tall, 0.008), 0.012), x, front + 0.002, z),
        bench.pick((look, bench.look("dark"))),
    )
    bench.put(
        _front(raw_extrude(rounded(0.75 * door, 0.62 * tall, 0.012), 0.003), x, front - 0.0085, z),
        bench.look("dark"),
    )
    grip, at = bench.look("metal"), x + 0.43 * door
    if bench.chance(0.5):
        path = bow((at, front - 0.008, z - 0.32 * tall), (at, front - 0.008, z + 0.32 * tall), (0, -0.025, 0))
    else:
        path = bow(
            (x - 0.4 * door, front - 0.008, z + 0.4 * tall),
            (x + 0.4 * door, front - 0.008, z + 0.4 * tall),
            (0, -0.025, 0),
        )
    bench.put(raw_sweep(path, 0.005, 8), grip)
    panel = (x + door / 2 + wide / 2) / 2
    if bench.chance(0.5):
        knobs = [
            _front(_knob(bench, 0.016, 0.016), panel, front + 0.001, foot + f * tall)
            for f in np.linspace(0.2, 0.8, bench.n(2, 3))
        ]
        bench.put_all(knobs, bench.look())
    else:
        bench.put(
            _front(raw_extrude(rounded(0.04, 0.02, 0.002), 0.002), panel, front + 0.001, foot + 0.82 * tall),
            bench.look("dark"),
        )
        keys = [
            _front(
                raw_extrude(rounded(0.011, 0.011, 0.002), 0.003), panel + dx, front + 0.001, foot + f * tall
            )
            for dx in (-0.014, 0, 0.014)
            for f in (0.2, 0.33, 0.46, 0.59)
        ]
        bench.put_all(keys, bench.look())
    return bench.thing("oven", top(foot + tall, rectangle(0.9 * wide, 0.9 * deep)), vary=(0.6, 1.1))


def make_radio(shop: Workshop, name: str) -> Thing:
    """A radio or loudspeaker: round cones or a grille of bars, dial, knobs, antenna, bow handle."""
    bench = Bench(shop, name)
    wide, tall, deep = bench.u(0.1, 0.3), bench.u(0.08, 0.2), bench.u(0.05, 0.14)
    bench.put(
        _front(raw_extrude(rounded(wide, tall, bench.u(0.001, 0.06)), deep), 0, deep / 2, tall / 2),
        _case_look(bench),
    )
    front, dark = -deep / 2, bench.look("dark")
    cone = 0.36 * min(tall, wide / 2)
    profile = (
        np.array(
            [[0, 0], [1.1, 0], [1.12, 0.05], [1.0, 0.12], [0.95, 0.06], [0.4, 0.03], [0.3, 0.1], [0, 0.14]]
        )
        * cone
    )
    spots = (
        [(-0.25 * wide, tall / 2), (0.25 * wide, tall / 2)]
        if wide > 1.4 * tall
        else [(0, 0.35 * tall), (0, 0.75 * tall)]
    )
    for x, z in spots[: bench.n(1, 2)]:
        bench.put(_front(raw_lathe(profile, 28), x, front + 0.001, z), dark)
    if bench.chance(0.6):
        bars = [
            posed(raw_box(0.35 * wide, 0.006, 0.004), (0.22 * wide, front, z))
            for z in np.linspace(0.2, 0.8, bench.n(4, 9)) * tall
        ]
        bench.put_all(bars, bench.look())
    knobs = [
        _front(_knob(bench, 0.05 * wide, 0.012), x * wide, front + 0.001, 0.14 * tall)
        for x in bench.rng.uniform(-0.4, 0.4, bench.n(1, 4))
    ]
    bench.put_all(knobs, bench.look())
    if bench.chance(0.5):
        bench.put(
            raw_sweep(
                bow((-0.4 * wide, 0, 0.92 * tall), (0.4 * wide, 0, 0.92 * tall), (0, 0, 0.4 * tall)),
                0.006,
                8,
                1.4,
            ),
            bench.look(),
        )
    elif bench.chance(0.6):
        bench.put(
            rod(
                (0.38 * wide, 0.2 * deep, 0.9 * tall),
                (bench.u(0.0, 0.9) * wide, 0.25 * deep, tall + bench.u(0.08, 0.2)),
                0.0025,
                8,
                0.5,
            ),
            bench.look("metal"),
        )
    return bench.thing("radio")


def make_drawers(shop: Workshop, name: str) -> Thing:
    """A unit of small drawers with grooves between them, grips of three kinds, some pulled out."""
    bench = Bench(shop, name)
    wide, deep, tall = bench.u(0.12, 0.34), bench.u(0.1, 0.24), bench.u(0.12, 0.36)
    rows, columns, gap, wall = bench.n(1, 5), bench.n(1, 3), bench.u(0.002, 0.005), bench.u(0.004, 0.01)
    bench.put(raw_box(wide, deep, tall), _case_look(bench))
    looks = [_case_look(bench) for _ in range(bench.n(1, 2))]
    cell = (np.array([wide, tall]) - 2 * wall) / (columns, rows)
    kind, grips, grip = bench.n(0, 2), [], bench.look("metal" if bench.chance(0.5) else "")
    for row in range(rows):
        for column in range(columns):
            x, z = -wide / 2 + wall + (column + 0.5) * cell[0], wall + (row + 0.5) * cell[1]
            out = bench.u(0.02, 0.5) * deep if bench.chance(0.15) else bench.u(0.001, 0.006)
            size = cell - gap
            look = looks[(row + column) % len(looks)]
            y = -deep / 2 - out
            if out > 0.012:  # an open drawer: tray and front
                bench.put(
                    posed(
                        raw_extrude(
                            rounded(size[0] - 0.004, out + 0.01, 0.001),
                            0.7 * size[1],
                            [rounded(size[0] - 0.012, out, 0.001)],
                        ),
                        (x, y + out / 2, z - 0.45 * size[1]),
                    ),
                    look,
                )
                bench.put(
                    raw_box(size[0] - 0.006, out + 0.006, 0.004), look, (x, y + out / 2, z - 0.45 * size[1])
                )
            bench.put(raw_box(size[0], 0.008, size[1]), look, (x, y + 0.003, z - size[1] / 2))
            if kind == 0:
                grips.append(_front(_knob(bench, min(0.012, 0.25 * size[1]), 0.016), x, y, z))
            elif kind == 1:
                half = 0.25 * size[0]
                grips.append(raw_sweep(bow((x - half, y, z), (x + half, y, z), (0, -0.02, 0)), 0.003, 8))
            else:
                grips.append(posed(raw_box(0.5 * size[0], 0.016, 0.006), (x, y - 0.004, z + 0.3 * size[1])))
    bench.put_all(grips, grip)
    return bench.thing("drawers", top(tall, rectangle(0.95 * wide, 0.9 * deep)))


def make_printer(shop: Workshop, name: str) -> Thing:
    """A printer: rounded case, paper tray behind, slot with a sheet in front, panel."""
    bench = Bench(shop, name)
    wide, deep, tall, look = bench.u(0.24, 0.4), bench.u(0.18, 0.3), bench.u(0.08, 0.17), _case_look(bench)
    side = np.array(
        [
            (-deep / 2, 0),
            (deep / 2, 0),
            (deep / 2, tall),
            (-bench.u(0.0, 0.3) * deep, tall),
            (-deep / 2, bench.u(0.5, 0.9) * tall),
        ]
    )
    bench.put(raw_extrude(side, wide), look, (-wide / 2, 0, 0), turn(z=90) @ turn(x=90))
    bench.put(raw_box(0.8 * wide, 0.02, 0.35 * tall), bench.look("dark"), (0, -deep / 2 + 0.009, 0.1 * tall))
    bench.put(
        raw_box(0.75 * wide, bench.u(0.05, 0.14), 0.005), bench.look(), (0, -deep / 2 - 0.02, 0.09 * tall)
    )
    bench.put(
        raw_box(0.6 * wide, 0.12, 0.0015),
        bench.look("print", 0.2),
        (0, -deep / 2 - 0.02, 0.09 * tall + 0.0045),
    )
    tray = raw_extrude(rounded(0.7 * wide, bench.u(0.1, 0.2), 0.01) + (0, 0.06), 0.005)
    bench.put(tray, look, (0, 0.38 * deep, tall - 0.01), turn(x=bench.u(55, 80)))
    bench.put_all(
        [
            posed(raw_extrude(ring(0.006, 12), 0.006), (x, 0.2 * deep, tall - 0.002))
            for x in np.linspace(0.2, 0.4, 4) * wide
        ],
        bench.look(),
    )
    bench.put(
        raw_box(0.12 * wide, 0.12 * deep, 0.003), bench.look("dark"), (0.05 * wide, 0.2 * deep, tall - 0.001)
    )
    return bench.thing("printer", vary=(0.6, 1.05))


def make_monitor(shop: Workshop, name: str) -> Thing:
    """A screen on a stand: flat or curved panel with a frame, neck, plate or legs."""
    bench = Bench(shop, name)
    wide, tall, thick, look = bench.u(0.22, 0.42), bench.u(0.14, 0.26), bench.u(0.01, 0.03), _case_look(bench)
    neck, lean, edge = bench.u(0.04, 0.12), bench.u(-4, 14), bench.u(0.003, 0.015)
    z = neck + tall / 2
    spin = turn(x=-lean)
    panel = raw_extrude(rounded(wide, tall, bench.u(0.001, 0.02)), thick)
    bench.put(_front(panel, 0, 0, 0), look, (0, 0, z), spin)
    face = raw_extrude(rounded(wide - 2 * edge, tall - 2 * edge, 0.003), 0.002)
    bench.put(
        _front(face, 0, -thick + 0.001, 0),
        bench.look("dark" if bench.chance(0.65) else "", 0.3),
        (0, 0, z),
        spin,
    )
    bench.put(raw_box(0.4 * wide, bench.u(0.01, 0.05), 0.4 * tall), look, (0, 0.008, z - 0.2 * tall))
    if bench.chance(0.7):
        bench.put(rod((0, 0.05, 0.008), (0, 0.015, z), bench.u(0.01, 0.02), 10), look)
        foot = bench.pick(
            (
                ring(0.09, 32),
                rounded(0.2, 0.13, 0.02),
                np.array([(-0.1, -0.05), (0.1, -0.05), (0.03, 0.08), (-0.03, 0.08)]),
            )
        )
        bench.put(raw_extrude(foot, 0.008), look, (0, 0.02, 0))
    else:
        legs = [
            grounded(
                rod(
                    (sx * 0.38 * wide, sy * 0.07 + 0.005, 0), (sx * 0.3 * wide, 0.002, neck + 0.02), 0.006, 8
                ),
                0.03,
            )
            for sx in (-1, 1)
            for sy in (-1, 1)
        ]
        bench.put_all(legs, look)
    return bench.thing("monitor", vary=(0.6, 1.05))


def make_keyboard(shop: Workshop, name: str) -> Thing:
    """A keyboard of keys, or of a piano; a little higher behind."""
    bench = Bench(shop, name)
    wide, deep, tall = bench.u(0.2, 0.42), bench.u(0.08, 0.15), bench.u(0.01, 0.03)
    side = np.array([(-deep / 2, 0), (deep / 2, 0), (deep / 2, tall), (-deep / 2, bench.u(0.5, 1.0) * tall)])
    bench.put(raw_extrude(side, wide), _case_look(bench), (-wide / 2, 0, 0), turn(z=90) @ turn(x=90))
    low = float(side[3, 1])
    slope = (tall - low) / deep
    z_at = lambda y: low + slope * (y + deep / 2) - 0.003  # noqa: E731
    keys, darks = [], []
    if bench.chance(0.65):
        rows = bench.n(4, 5)
        pitch = 0.86 * deep / rows
        columns = int(0.94 * wide / pitch)
        for row in range(rows):
            y = -0.43 * deep + (row + 0.5) * pitch
            for column in range(columns):
                x = (column - (columns - 1) / 2) * pitch
                keys.append(
                    posed(
                        raw_extrude(rounded(0.84 * pitch, 0.84 * pitch, 0.001, 2), 0.008, taper=0.85),
                        (x, y, z_at(y)),
                    )
                )
        bench.put_all(keys[: len(keys) // 3 * 2], bench.look("dark" if bench.chance(0.5) else ""))
        bench.put_all(keys[len(keys) // 3 * 2 :], bench.look())
    else:
        count = bench.n(10, 20)
        pitch = 0.94 * wide / count
        for index in range(count):
            x = (index - (count - 1) / 2) * pitch
            keys.append(posed(raw_box(0.92 * pitch, 0.6 * deep, 0.008), (x, -0.17 * deep, z_at(-0.4 * deep))))
            if index % 7 not in (2, 6):
                darks.append(
                    posed(
                        raw_box(0.5 * pitch, 0.36 * deep, 0.015),
                        (x + pitch / 2, -0.05 * deep, z_at(-0.3 * deep)),
                    )
                )
        bench.put_all(keys, bench.look("white"))
        bench.put_all(darks, bench.look("dark"))
    return bench.thing("keyboard", vary=(0.7, 1.05))


def make_console(shop: Workshop, name: str) -> Thing:
    """A mixing desk or control box: slanted panel with knobs, sliders, lamps, a display, grooves."""
    bench = Bench(shop, name)
    wide, deep, low, high = bench.u(0.12, 0.34), bench.u(0.1, 0.22), bench.u(0.015, 0.05), bench.u(0.05, 0.12)
    side = np.array([(-deep / 2, 0), (deep / 2, 0), (deep / 2, high), (-deep / 2, low)])
    bench.put(raw_extrude(side, wide), _case_look(bench), (-wide / 2, 0, 0), turn(z=90) @ turn(x=90))
    slope = float(np.degrees(np.arctan2(high - low, deep)))
    long = float(np.hypot(deep, high - low))
    tilt, at = turn(x=slope), (0, -deep / 2, low)
    looks = [bench.look(), bench.look("dark"), bench.look("plain")]
    rows, columns = bench.n(2, 4), bench.n(3, 7)
    groups: list[list[Raw]] = [[], [], []]
    for row in range(rows):
        kind = bench.n(0, 3)
        for column in range(columns):
            x, y = ((column + 0.5) / columns - 0.5) * 0.92 * wide, (row + 0.5) / rows * long
            size = 0.3 * min(0.92 * wide / columns, long / rows)
            if kind == 0:
                groups[0].append(posed(_knob(bench, size, 1.1 * size), (x, y, -0.001)))
            elif kind == 1:
                groups[1].append(posed(raw_box(0.25 * size, 2.4 * size, 0.002), (x, y, -0.001)))
                groups[0].append(
                    posed(raw_box(1.1 * size, 0.5 * size, 0.01), (x, y + bench.u(-1, 1) * size, -0.001))
                )
            elif kind == 2:
                groups[2].append(
                    posed(raw_extrude(rounded(1.5 * size, 1.2 * size, 0.002), 0.006), (x, y, -0.001))
                )
            elif column == 0:
                groups[1].append(
                    posed(raw_extrude(rounded(0.85 * wide, 2.0 * size, 0.003), 0.003), (0, y, -0.001))
                )
    for look, raws in zip(looks, groups):
        bench.put_all([posed(raw, at, tilt) for raw in raws], look)
    return bench.thing("console")


def make_toaster(shop: Workshop, name: str) -> Thing:
    """A toaster: round case with two slots, bread in them, lever, knob."""
    bench = Bench(shop, name)
    wide, deep, tall, look = bench.u(0.2, 0.3), bench.u(0.12, 0.18), bench.u(0.14, 0.2), _case_look(bench)
    slots = [rounded(0.75 * wide, 0.022, 0.004) + (0, s * 0.2 * deep) for s in (-1, 1)]
    corner = bench.u(0.01, 0.05)
    bench.put(raw_extrude(rounded(wide, deep, corner), tall, slots), look)
    bench.put(
        raw_extrude(rounded(0.98 * wide, 0.98 * deep, corner), 0.5 * tall), bench.look("dark"), (0, 0, 0.003)
    )
    if bench.chance(0.6):
        for s in (-1, 1):
            bread = raw_extrude(rounded(0.5 * wide, 0.62 * tall, 0.02), 0.013)
            bench.put(
                _front(bread, bench.u(-0.1, 0.1) * wide, s * 0.2 * deep + 0.0065, bench.u(0.77, 0.81) * tall),
                bench.look("noise"),
            )
    bench.put(raw_box(0.03, 0.03, 0.012), bench.look("dark"), (wide / 2 + 0.004, 0, bench.u(0.4, 0.8) * tall))
    bench.put(_front(_knob(bench, 0.014, 0.014), 0, -deep / 2 + 0.001, 0.25 * tall), bench.look())
    return bench.thing("toaster", vary=(0.7, 1.2))


def make_router(shop: Workshop, name: str) -> Thing:
    """A flat box with antennas, lamps and vents."""
    bench = Bench(shop, name)
    wide, deep, tall = bench.u(0.12, 0.24), bench.u(0.08, 0.16), bench.u(0.02, 0.045)
    bench.put(
        raw_extrude(rounded(wide, deep, bench.u(0.002, 0.03)), tall, layers=3, taper=bench.u(0.8, 1.0)),
        _case_look(bench),
    )
    count, long = bench.n(1, 4), bench.u(0.07, 0.16)
    masts = []
    for x in np.linspace(-0.38, 0.38, count) * wide if count > 1 else [0.3 * wide]:
        tip = (x + bench.u(-0.3, 0.3) * long, 0.45 * deep + bench.u(-0.2, 0.4) * long, tall + long)
        masts.append(rod((x, 0.36 * deep, 0.6 * tall), tip, 0.006, 8, 0.6))
    bench.put_all(masts, bench.look("dark"))
    bench.put_all(
        [
            posed(raw_box(0.6 * wide, 0.003, 0.002), (0, y * deep, tall - 0.001))
            for y in np.linspace(-0.2, 0.2, bench.n(3, 7))
        ],
        bench.look(),
    )
    return bench.thing("router")


def make_coffee_machine(shop: Workshop, name: str) -> Thing:
    """A coffee machine: back column, head with spouts, drip tray with a cup, knobs."""
    bench = Bench(shop, name)
    wide, deep, tall, look = bench.u(0.12, 0.24), bench.u(0.16, 0.26), bench.u(0.2, 0.34), _case_look(bench)
    head, foot, back = bench.u(0.25, 0.4) * tall, bench.u(0.02, 0.05), bench.u(0.4, 0.55)
    side = np.array(
        [
            (-0.5, 0),
            (0.5, 0),
            (0.5, 1),
            (-0.45, 1),
            (-0.45, 1 - head / tall),
            (0.5 - back, 1 - head / tall),
            (0.5 - back, foot / tall),
            (-0.5, foot / tall),
        ]
    ) * (deep, tall)
    bench.put(raw_extrude(side, wide), look, (-wide / 2, 0, 0), turn(z=90) @ turn(x=90))
    z = tall - head
    bench.put_all(
        [rod((x, -0.22 * deep, z + 0.004), (x, -0.22 * deep, z - 0.02), 0.007, 10) for x in (-0.012, 0.012)],
        bench.look("metal"),
    )
    bench.put(
        raw_box(0.85 * wide, (0.9 - back) * deep, 0.004),
        bench.look("dark"),
        (0, (-0.5 + (1 - back) / 2) * deep, foot - 0.001),
    )
    if bench.chance(0.6):
        radius = min(0.03, 0.3 * wide)
        cup = np.array([[0, 0], [0.7, 0], [1, 1.5], [0.88, 1.5], [0.6, 0.15], [0, 0.15]]) * radius
        bench.put(raw_lathe(cup, 24), bench.look(), (0, -0.22 * deep, foot + 0.0025))
    knobs = [
        _front(_knob(bench, 0.09 * wide, 0.014), x * wide, -0.45 * deep + 0.001, tall - 0.5 * head)
        for x in (-0.3, 0.3)
    ]
    bench.put_all(knobs, bench.look())
    bench.put(
        _front(
            raw_extrude(rounded(0.25 * wide, 0.3 * head, 0.003), 0.003),
            0,
            -0.45 * deep + 0.001,
            tall - 0.5 * head,
        ),
        bench.look("dark"),
    )
    return bench.thing("coffee machine", vary=(0.6, 1.2))


SOFT_KINDS: dict[str, Kind] = {
    "plush": Kind("plush toy", make_plush),
    "soft_lump": Kind("soft lump", make_blob),
    "cushion": Kind("cushion", make_cushion),
    "towels": Kind("towels", make_towels),
    "sack": Kind("bag", make_sack),
    "crumple": Kind("crumpled paper", make_crumple),
    "shoes": Kind("shoes", make_shoes),
    "hat": Kind("hat", make_hat),
    "draped_cloth": Kind("cloth", make_draped_cloth),
}
MANYPART_KINDS: dict[str, Kind] = {
    "toy_car": Kind("toy car", make_toy_car),
    "toy_truck": Kind("toy truck", make_toy_truck),
    "toy_train": Kind("toy train", make_toy_train),
    "robot": Kind("robot", make_robot),
    "toy_house": Kind("toy house", make_toy_house),
    "brick_tower": Kind("brick tower", make_brick_tower),
    "doll": Kind("doll", make_doll),
    "guitar": Kind("guitar", make_guitar),
    "excavator": Kind("excavator", make_excavator),
    "toy_plane": Kind("toy plane", make_plane),
    "chess_figures": Kind("chess figures", make_chess_figure),
}
DEVICE_KINDS: dict[str, Kind] = {
    "oven": Kind("oven", make_oven),
    "radio": Kind("radio", make_radio),
    "drawers": Kind("drawers", make_drawers),
    "printer": Kind("printer", make_printer),
    "monitor": Kind("monitor", make_monitor),
    "keyboard": Kind("keyboard", make_keyboard),
    "console": Kind("console", make_console),
    "toaster": Kind("toaster", make_toaster),
    "router": Kind("router", make_router),
    "coffee_machine": Kind("coffee machine", make_coffee_machine),
}
