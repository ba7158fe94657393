"""Varied thin things: racks, stands, cutlery, sheets; potted plants; cables, ropes and chains."""

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
    inside,
    posed,
    raw_box,
    raw_ellipsoid,
    raw_extrude,
    raw_lathe,
    raw_leaf,
    raw_slab,
    raw_superquadric,
    raw_sweep,
    ring,
    rod,
    rounded,
    smooth,
    turn,
    wobbled,
)  # fmt: skip
from synthetic.things import Kind, Thing

# Thin things


def make_plate_rack(shop: Workshop, name: str) -> Thing:
    """A rack of rods with plates or boards on their edges."""
    bench = Bench(shop, name)
    slots, pitch, deep, tall = bench.n(2, 6), bench.u(0.025, 0.045), bench.u(0.07, 0.1), bench.u(0.05, 0.1)
    long, look, lift = (slots + 1) * pitch, bench.look(), 0.026
    x = (np.arange(slots + 1) - slots / 2) * pitch
    parts = [posed(raw_box(long, 0.01, 0.01), (0, sign * deep / 2, lift)) for sign in (-1, 1)]
    for sign in (-1, 1):
        y, middle = sign * deep / 2, lift + 0.005
        parts += [rod((at, y, middle), (at, y, lift + tall), 0.003, 6) for at in x]
        parts += [posed(raw_box(0.012, 0.012, lift + 0.001), (end * 0.45 * long, y, 0)) for end in (-1, 1)]
    parts += [rod((at, -deep / 2, lift + 0.005), (at, deep / 2, lift + 0.005), 0.003, 6) for at in x]
    bench.put_all(parts, look)
    for at in x[:-1] + pitch / 2:
        if bench.chance(0.8):
            radius, thick, lean = bench.u(0.07, 0.13), bench.u(0.003, 0.008), bench.u(-8, 8)
            # Its edge rests on both rails; a round one hangs down between them.
            shape, half = ring(radius, 36), np.sqrt(radius**2 - (deep / 2) ** 2)
            if bench.chance(0.3):
                shape, half = rounded(1.5 * radius, 2 * radius, bench.u(0.002, 0.015)), 0.75 * radius
            plate = raw_extrude(shape, thick, taper=bench.u(0.8, 1.0))
            bench.put(plate, bench.look(), (at, 0, lift + 0.0075 + float(half)), turn(y=90 + lean))
    return bench.thing("plate rack", vary=(0.8, 1.2))


def make_leaning_frame(shop: Workshop, name: str) -> Thing:
    """A picture frame or mirror on a strut, leaning back."""
    bench = Bench(shop, name)
    wide, high, edge, lean = bench.u(0.08, 0.3), bench.u(0.1, 0.34), bench.u(0.006, 0.03), bench.u(8, 28)
    thick, back = bench.u(0.008, 0.02), turn(x=90 - lean)
    outline, hole = (
        rounded(wide, high, 0.002),
        rounded(wide - 2 * edge, high - 2 * edge, bench.u(0.001, 0.04)),
    )
    up = (0, high / 2, 0)
    bench.put(posed(raw_extrude(outline, thick, [hole]), up), bench.look(), rotation=back)
    bench.put(
        posed(raw_extrude(rounded(wide - edge, high - edge, 0.002), 0.4 * thick), up),
        bench.look(size_m=0.3),
        rotation=back,
    )
    # The strut goes from the back of the frame down to the support.
    top_y, top_z = 0.7 * high * np.sin(np.radians(lean)), 0.7 * high * np.cos(np.radians(lean))
    foot_y = top_y + bench.u(0.25, 0.5) * high
    strut = np.array([(top_y - 0.004, top_z), (foot_y - 0.02, 0), (foot_y, 0), (top_y + 0.004, top_z + 0.01)])
    bench.put(raw_extrude(strut, 0.25 * wide), bench.look(), (-0.125 * wide, 0, 0), turn(z=90) @ turn(x=90))
    bench.put(raw_box(wide, thick, 0.004), bench.look("dark"), (0, -0.3 * thick, 0))
    return bench.thing("frame")


def make_easel(shop: Workshop, name: str) -> Thing:
    """A small easel of three legs with a board or a canvas on it."""
    bench = Bench(shop, name)
    high, spread, back, look = bench.u(0.2, 0.4), bench.u(0.06, 0.12), bench.u(0.08, 0.16), bench.look("wood")
    radius = bench.u(0.003, 0.007)
    head = (0, 0.02, high)
    legs = [rod((sign * spread, -0.03, 0), (0.01 * sign, 0.02, high), radius, 8) for sign in (-1, 1)]
    legs.append(rod((0, back, 0), head, radius, 8))
    legs = [grounded(leg, 0.012) for leg in legs]
    ledge = bench.u(0.15, 0.3) * high
    slope = 0.05 / high
    y = -0.03 + slope * ledge
    legs.append(posed(raw_box(2.2 * spread, 0.035, 0.008), (0, y - 0.012, ledge)))
    bench.put_all(legs, look)
    board = raw_extrude(rounded(bench.u(1.4, 2.6) * spread, 0.6 * high, 0.002), bench.u(0.004, 0.012))
    lean = float(np.degrees(np.arctan(slope)))
    bench.put(
        posed(board, (0, 0.3 * high, 0)),
        bench.look(size_m=0.3),
        (0, y - 0.007, ledge + 0.005),
        turn(x=90 - lean),
    )
    return bench.thing("easel")


def make_desk_lamp(shop: Workshop, name: str) -> Thing:
    """A desk lamp: foot, two thin arms with a joint, a tilted shade."""
    bench = Bench(shop, name)
    look, radius = bench.look(), bench.u(0.003, 0.006)
    bench.put(raw_lathe(np.array([[0, 0], [0.06, 0], [0.055, 0.015], [0, 0.02]]), 32), look)
    low = np.array([0, 0, 0.01])
    elbow = low + bench.u(0.13, 0.2) * np.array([-bench.u(0, 0.6), 0, 1.0])
    head = elbow + bench.u(0.1, 0.18) * np.array([1.0, 0, bench.u(-0.2, 0.7)])
    offset = np.array([0, 0.008, 0]) if bench.chance(0.5) else np.zeros(3)
    arms = [
        rod(low + sign * offset, elbow + sign * offset, radius)
        for sign in ((-1, 1) if offset.any() else (1,))
    ]
    bench.put_all([*arms, rod(elbow, head, radius)], bench.pick((look, bench.look("metal"))))
    joint = [posed(rod((0, -0.013, 0), (0, 0.013, 0), 0.008, 12), at) for at in (elbow, head)]
    bench.put_all(joint, bench.look("dark"))
    wide, tall = bench.u(0.03, 0.06), bench.u(0.05, 0.08)
    profile = np.array(
        [
            [0, 0.6 * tall],
            [0.35 * wide, 0.85 * tall],
            [0.95 * wide, 0.02],
            [wide, 0],
            [0.5 * wide, tall],
            [0, 1.1 * tall],
        ]
    )
    bench.put(raw_lathe(profile, 32), look, head - (0, 0, 0.7 * tall), turn(y=-bench.u(0, 40)))
    return bench.thing("desk lamp")


def make_wire_rack(shop: Workshop, name: str) -> Thing:
    """A wire basket or a wire shelf: two frames and many thin rods."""
    bench = Bench(shop, name)
    wide, deep, height, wire = (
        bench.u(0.14, 0.34),
        bench.u(0.1, 0.24),
        bench.u(0.05, 0.16),
        bench.u(0.0015, 0.003),
    )
    flare, look = bench.u(1.0, 1.3), bench.look()
    low, high = rounded(wide, deep, 0.03), rounded(wide, deep, 0.03) * flare
    parts = []
    for outline, z in ((low, wire), (0.5 * (low + high), height / 2), (high, height)):
        path = np.column_stack([outline, np.full(len(outline), z)])
        parts.append(raw_sweep(path, 1.6 * wire, 8, closed=True))
    for index in range(len(low)):
        parts.append(rod((*low[index], wire), (*high[index], height), wire, 5))
    for x in np.linspace(-wide / 2, wide / 2, bench.n(5, 12) + 2)[1:-1]:
        bent = [
            (x * flare, -flare * deep / 2, height),
            (x, -deep / 2, wire),
            (x, deep / 2, wire),
            (x * flare, flare * deep / 2, height),
        ]
        parts.append(raw_sweep(np.array(bent), wire, 6))
    bench.put_all(parts, look)
    return bench.thing(
        "wire basket", inside(2 * wire, rectangle(0.75 * wide, 0.75 * deep), height - 2 * wire)
    )


def make_tripod(shop: Workshop, name: str) -> Thing:
    """A tripod with a camera, a globe or a plate on top."""
    bench = Bench(shop, name)
    high, spread, radius, look = bench.u(0.12, 0.28), bench.u(0.05, 0.12), bench.u(0.003, 0.007), bench.look()
    turned = bench.u(0, 120)
    feet = ring(spread, 3) @ turn(z=turned)[:2, :2]
    bench.put_all([grounded(rod((*f, 0), (*(0.08 * f), high), radius, 8), 0.015) for f in feet], look)
    bench.put(rod((0, 0, 0.75 * high), (0, 0, high + 0.022), 1.2 * radius, 10), look)
    bench.put(rod((0, 0, 0.95 * high), (0, 0, high + 0.004), 0.08 * spread + radius, 16), look)
    kind, z = bench.n(0, 2), high + 0.02
    if kind == 0:
        size = bench.rng.uniform((0.06, 0.03, 0.04), (0.11, 0.06, 0.08))
        bench.put(raw_superquadric(size / 2, 0.25, 0.25, 14, 24), bench.look(), (0, 0, z + size[2] / 2))
        lens = rod((0, 0, 0), (0, -size[1] / 2 - bench.u(0.02, 0.06), 0), 0.4 * size[2], 20)
        bench.put(lens, bench.look("dark"), (0, 0, z + size[2] / 2))
    elif kind == 1:
        ball = bench.u(0.03, 0.07)
        bench.put(raw_ellipsoid((ball, ball, ball), 3), bench.look(), (0, 0, z + 0.9 * ball))
    else:
        bench.put(raw_extrude(ring(bench.u(0.03, 0.12), 32), bench.u(0.004, 0.012)), bench.look(), (0, 0, z))
    return bench.thing("tripod")


def make_fan(shop: Workshop, name: str) -> Thing:
    """A table fan: foot, pole, blades in a cage of rings."""
    bench = Bench(shop, name)
    pole, radius, look = bench.u(0.1, 0.2), bench.u(0.06, 0.11), bench.look()
    foot = bench.u(0.05, 0.08)
    bench.put(raw_lathe(np.array([[0, 0], [foot, 0], [0.8 * foot, 0.02], [0, 0.03]]), 32), look)
    z, tilt = pole + 0.8 * radius, turn(x=bench.u(-20, 20))
    bench.put(rod((0, 0.01, 0.01), (0, 0.03, z), 0.008, 10), look)
    bench.put(rod((0, -0.02, 0), (0, 0.05, 0), 0.024, 20, 0.8), look, (0, 0, z), tilt)
    blades, count, wide = [], bench.n(3, 6), bench.u(0.5, 1.0)
    for index in range(count):
        blade = raw_leaf(0.85 * radius, wide * radius, 0.0, 0.3, 0.002)
        about = turn(y=360 * index / count)
        blades.append(
            (posed(posed(blade, (0, 0, 0), turn(x=90 + 25)), (0, -0.012, 0), None)[0] @ about.T, blade[1])
        )
    bench.put_all([posed(b, (0, 0, z), tilt) for b in blades], bench.look())
    cage = []
    for share, y in ((1.0, 0.0), (0.85, -0.022), (0.85, 0.025), (0.5, -0.034), (0.2, -0.036)):
        flat = radius * share * ring(1.0, 32)
        cage.append(
            raw_sweep(np.column_stack([flat[:, 0], np.full(32, y), flat[:, 1]]), 0.0016, 5, closed=True)
        )
    spokes = bench.n(8, 20)
    for c, s in ring(radius, spokes):
        bent = np.array(
            [
                (0.15 * c, -0.036, 0.15 * s),
                (0.5 * c, -0.034, 0.5 * s),
                (0.85 * c, -0.022, 0.85 * s),
                (c, 0, s),
                (0.85 * c, 0.025, 0.85 * s),
                (0.2 * c, 0.03, 0.2 * s),
            ]
        )
        cage.append(raw_sweep(bent, 0.0011, 5))
    bench.put_all([posed(part, (0, 0, z), tilt) for part in cage], bench.look())
    return bench.thing("fan", vary=(0.8, 1.2))


def _sheet(bench: Bench, wide: float, deep: float, curl: float, thickness: float) -> Raw:
    """Make a sheet that lies, with one bent corner or edge."""
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 12), np.linspace(-0.5, 0.5, 14), indexing="ij")
    angle = bench.u(0, 2 * np.pi)
    ahead = np.maximum(np.cos(angle) * u + np.sin(angle) * v - bench.u(0.0, 0.3), 0)
    z = curl * ahead**1.6 + thickness / 2
    return raw_slab(np.stack([wide * u, deep * v, z], -1), thickness)


def make_papers(shop: Workshop, name: str) -> Thing:
    """Sheets of paper or cards on each other, turned a little, the upper ones curled."""
    bench = Bench(shop, name)
    wide, deep, z = bench.u(0.08, 0.22), bench.u(0.1, 0.3), 0.0
    looks = [bench.look("print", 0.3), bench.look("white"), bench.look()]
    for number in range(bench.n(1, 5)):
        thick = bench.u(0.001, 0.004)
        curl = bench.u(0.0, 0.12) if number > 0 or bench.chance(0.7) else 0.0
        raw = _sheet(bench, wide, deep, curl, thick)
        at = (*bench.rng.uniform(-0.02, 0.02, 2), z)
        bench.put(raw, bench.pick(looks), at, turn(z=bench.u(-20, 20)))
        z += 0.9 * thick
        if curl > 0:
            break
    return bench.thing("papers", vary=(0.7, 1.2))


def make_salver(shop: Workshop, name: str) -> Thing:
    """A shallow tray or platter, round, oval or square, with two grips."""
    bench = Bench(shop, name)
    wide, deep, height, power = (
        bench.u(0.1, 0.2),
        bench.u(0.08, 0.16),
        bench.u(0.01, 0.035),
        bench.u(0.3, 1.0),
    )
    profile = np.array([[0, 0], [0.8, 0], [1.0, height], [0.96, height], [0.78, 0.004], [0, 0.004]])
    vertices, faces = raw_lathe(profile, 40)
    radius = np.maximum(np.linalg.norm(vertices[:, :2], axis=1, keepdims=True), 1e-9)
    flat = vertices[:, :2] / radius
    flat = radius * np.sign(flat) * np.abs(flat) ** power * (wide, deep)
    bench.put((np.column_stack([flat, vertices[:, 2]]), faces), bench.look(size_m=0.3))
    if bench.chance(0.5):
        look = bench.look()
        for sign in (-1, 1):
            x = sign * 0.97 * wide
            bench.put(
                raw_sweep(
                    bow((x, -0.04, height - 0.003), (x, 0.04, height - 0.003), (sign * 0.03, 0, 0.012)), 0.004
                ),
                look,
            )
    return bench.thing("salver", inside(0.004, rectangle(wide, deep), height - 0.004))


def _cutlery(bench: Bench, kind: int) -> list[Raw]:
    """Make a knife, fork or spoon that lies along +x."""
    long, thick = bench.u(0.15, 0.21), bench.u(0.0018, 0.003)
    x = np.linspace(0, 1, 22)
    half = np.interp(x, [0, 0.05, 0.35, 0.62, 0.7], [0.005, 0.009, 0.006, 0.0035, 0.004])
    if kind == 0:
        half = np.where(x > 0.6, np.interp(x, [0.6, 0.68, 0.93, 1], [0.004, 0.010, 0.009, 0.003]), half)
        z = np.zeros_like(x)
    else:
        head = np.interp(x, [0.66, 0.74, 0.86, 0.96, 1], [0.004, 0.013, 0.019, 0.013, 0.004])
        half = np.where(x > 0.66, head if kind == 2 else np.minimum(head, 0.012), half)
        z = 0.012 * np.sin(np.pi * np.clip(x - 0.1, 0, 1) * 1.05) * (x < 0.99)
    side = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    end = 22 if kind != 1 else 18
    bowl = 0.008 * (x > 0.72) * np.sin(np.pi * np.clip((x - 0.7) / 0.3, 0, 1)) if kind == 2 else 0 * x
    grid = np.empty((22, 5, 3))
    grid[..., 0], grid[..., 1] = long * x[:, None], half[:, None] * side
    grid[..., 2] = z[:, None] - bowl[:, None] * (1 - side**2)
    raws = [raw_slab(grid[:end], thick)]
    if kind == 1:
        start = grid[end - 1, 2]
        for y in (-0.0085, -0.003, 0.003, 0.0085):
            path = np.array(
                [start + (-0.002, y, 0), start + (0.02, y, -0.006), start + (0.045, 0.9 * y, 0.0)]
            )
            raws.append(raw_sweep(path, np.array([0.0019, 0.0017, 0.001]), 6))
    return raws


def make_cutlery(shop: Workshop, name: str) -> Thing:
    """Knives, forks and spoons side by side on a napkin or a board."""
    bench = Bench(shop, name)
    wide = bench.u(0.1, 0.18)
    bench.put(raw_extrude(rounded(0.25, wide, bench.u(0.001, 0.03)), 0.004), bench.look(size_m=0.25))
    look, count = bench.look("metal" if bench.chance(0.6) else ""), bench.n(1, 4)
    for y in (np.arange(count) - (count - 1) / 2) * 0.037:
        at = (-0.09, y * wide / 0.17, 0.0035)
        spin = turn(z=bench.u(-6, 6))
        bench.put_all([posed(raw, at, spin) for raw in _merged_low(_cutlery(bench, bench.n(0, 2)))], look)
    return bench.thing("cutlery", vary=(0.8, 1.2))


def _merged_low(raws: list[Raw]) -> list[Raw]:
    """Move raw meshes together so that their lowest point lies at z = 0."""
    low = min(float(raw[0][:, 2].min()) for raw in raws)
    return [posed(raw, (0, 0, -low)) for raw in raws]


def make_pens(shop: Workshop, name: str) -> Thing:
    """Pens, pencils and a ruler or set square side by side; some with one more pen across them."""
    bench = Bench(shop, name)
    radius, count, sides = bench.u(0.0035, 0.006), bench.n(1, 4), bench.pick((6, 8, 12))
    if bench.chance(0.7):
        shape = rounded(bench.u(0.12, 0.32), bench.u(0.025, 0.05), 0.002)
        if bench.chance(0.3):
            shape = np.array([(-0.1, 0), (bench.u(0.0, 0.1), 0), (-0.1, bench.u(0.08, 0.16))])
        bench.put(
            raw_extrude(shape, bench.u(0.0015, 0.005)), bench.look(), (0, 0.05, 0), turn(z=bench.u(-6, 6))
        )
    low = radius * np.cos(np.pi / sides)
    spots = [(bench.u(-0.02, 0.02), -0.021 * index, low, bench.u(-4, 4)) for index in range(count)]
    if count > 1 and bench.chance(0.6):
        spots.append((0.0, -0.01 * count, 3.0 * low, bench.u(60, 120)))
    for x, y, z, yaw in spots:
        long = bench.u(0.11, 0.18)
        path = np.array([(-0.5, 0, 0), (0.38, 0, 0), (0.5, 0, 0)]) * long
        pen = raw_sweep(path, radius * np.array([1, 1, 0.15]), sides)
        bench.put(pen, bench.look(), (x, y, z), turn(z=yaw))
        if bench.chance(0.5):
            cap = raw_sweep(np.array([(-0.52, 0, 0), (-0.25, 0, 0)]) * long, 1.12 * radius, sides)
            bench.put(cap, bench.look(), (x, y, z + 0.12 * low), turn(z=yaw))
    return bench.thing("pens", vary=(0.9, 1.4))


def make_hanger(shop: Workshop, name: str) -> Thing:
    """A coat hanger that lies, of wire or of wood."""
    bench = Bench(shop, name)
    half, rise, thick = bench.u(0.13, 0.19), bench.u(0.06, 0.11), bench.u(0.002, 0.008)
    look = bench.look()
    shoulders = smooth(
        [
            (-half, 0, 0),
            (-0.5 * half, 0.55 * rise, 0),
            (0, rise, 0),
            (0.5 * half, 0.55 * rise, 0),
            (half, 0, 0),
        ],
        24,
    )
    bench.put(raw_sweep(shoulders, thick, 8, bench.u(1.0, 1.6)), look)
    bench.put(rod((-0.99 * half, 0.004, 0), (0.99 * half, 0.004, 0), 0.7 * thick, 8), look)
    t = np.linspace(-np.pi / 2, bench.u(2.2, 3.4), 16)
    hook = np.column_stack([0.022 * np.cos(t), rise + 0.055 + 0.022 * np.sin(t), 0 * t])
    hook = np.concatenate([[(0, rise - 0.002, 0)], hook])
    bench.put(raw_sweep(hook, 0.0022, 8), bench.look("metal"))
    return bench.thing("coat hanger", vary=(0.7, 1.15))


def make_step_ladder(shop: Workshop, name: str) -> Thing:
    """A small folding ladder or a plant stand of rungs."""
    bench = Bench(shop, name)
    high, wide, lean, radius = (
        bench.u(0.18, 0.4),
        bench.u(0.08, 0.16),
        bench.u(0.2, 0.4),
        bench.u(0.004, 0.008),
    )
    look, rungs, rung_look = bench.look(), bench.n(2, 6), bench.look()
    sides = []
    for sign in (-1, 1):
        x, narrow = sign * wide / 2, sign * 0.4 * wide
        sides.append(grounded(rod((x, -lean * high, 0), (narrow, 0, high), radius, 8), 0.01))
        sides.append(grounded(rod((x, 0.8 * lean * high, 0), (narrow, 0.01, high), 0.8 * radius, 8), 0.01))
    bench.put_all(sides, look)
    steps, flat = [], bench.chance(0.5)
    for share in (np.arange(rungs) + 0.7) / (rungs + 0.3):
        half, y, z = wide / 2 * (1 - 0.2 * share), -lean * high * (1 - share), share * high
        if flat:
            steps.append(posed(raw_box(2 * half, 0.04, 0.006), (0, y, z - 0.003)))
        else:
            steps.append(rod((-half, y, z), (half, y, z), 0.8 * radius, 8))
    bench.put_all(steps, rung_look)
    bench.put(raw_box(0.95 * wide, 0.05, 0.01), rung_look, (0, 0, high - 0.006))
    return bench.thing("ladder")


# Plants


def _planter(bench: Bench, radius: float, height: float) -> None:
    """Add a pot with soil in it; its rim is at `height`."""
    foot, rim = bench.u(0.55, 1.0), bench.u(1.0, 1.12)
    outline = np.array([(foot, 0), (bench.u(0.8, 1.1), 0.6), (1, 0.9), (rim, 0.9), (rim, 1)]) * (
        radius,
        height,
    )
    if bench.chance(0.5):
        outline = gentle(outline[[0, 1, 2]], 14) * (1, 1 / 0.9)
    profile = np.concatenate(
        [[[0, 0]], outline, [[0.88 * radius, height], [0.85 * radius, 0.86 * height], [0, 0.88 * height]]]
    )
    bench.put(raw_lathe(profile, bench.pick((4, 6, 32, 32, 32))), bench.look())
    soil = np.array([[0, 0], [0.84, 0], [0.86, 0.5], [0.5, 1.0], [0, 1.1]]) * (0.88 * radius, 0.03)
    bench.put(raw_lathe(soil, 20), bench.look("noise"), (0, 0, 0.86 * height - 0.012))


def _placed_leaf(leaf: Raw, at: np.ndarray, lift_deg: float, yaw_deg: float, roll_deg: float = 0.0) -> Raw:
    return posed(leaf, at, turn(z=yaw_deg) @ turn(y=-lift_deg) @ turn(x=roll_deg))


def make_leafy_plant(shop: Workshop, name: str) -> Thing:
    """A potted plant: stems with leaves all along them."""
    bench = Bench(shop, name)
    radius, height = bench.u(0.04, 0.08), bench.u(0.05, 0.11)
    _planter(bench, radius, height)
    stems, leaves = [], []
    tall, long, slim = bench.u(0.08, 0.24), bench.u(0.04, 0.11), bench.u(0.25, 0.8)
    droop, fold = bench.u(0.1, 1.4), bench.u(-0.1, 0.5)
    for _ in range(bench.n(2, 5)):
        yaw, lean = bench.u(0, 2 * np.pi), bench.u(0.05, 0.5) * tall
        base = np.array([0.3 * radius * np.cos(yaw), 0.3 * radius * np.sin(yaw), 0.85 * height])
        out = np.array([np.cos(yaw), np.sin(yaw), 0])
        path = smooth(
            [
                base,
                base + 0.3 * lean * out + (0, 0, 0.5 * tall),
                base + lean * out + (0, 0, tall * bench.u(0.8, 1.1)),
            ],
            10,
        )
        stems.append(raw_sweep(path, np.linspace(0.0032, 0.0016, 10), 6))
        for share in np.linspace(0.3, 1.0, bench.n(4, 9)):
            at = path[round(share * 9)]
            size = long * bench.u(0.6, 1.1)
            leaf = raw_leaf(size, slim * size, droop * bench.u(0.6, 1.3), fold)
            leaves.append(_placed_leaf(leaf, at, bench.u(10, 65), bench.u(0, 360), bench.u(-20, 20)))
    bench.put_all(stems, bench.look("green"))
    bench.put_all(leaves, bench.look("green"), 80.0)
    return bench.thing("plant")


def make_rosette(shop: Workshop, name: str) -> Thing:
    """A succulent, a fern or a sword plant: leaves from one middle."""
    bench = Bench(shop, name)
    radius, height = bench.u(0.035, 0.08), bench.u(0.04, 0.1)
    _planter(bench, radius, height)
    kind, leaves = bench.n(0, 2), []
    if kind == 0:  # thick short leaves in circles
        for level in range(bench.n(3, 5)):
            for index in range(7):
                size = radius * (1.5 - 0.22 * level)
                leaf = raw_leaf(size, 0.45 * size, -0.5, 0.3, 0.005)
                leaves.append(
                    _placed_leaf(
                        leaf,
                        np.array([0, 0, 0.9 * height + 0.004 * level]),
                        12 + 17 * level,
                        51.4 * index + 25 * level,
                    )
                )
    elif kind == 1:  # upright swords
        long, wide = bench.u(0.12, 0.3), bench.u(0.02, 0.04)
        for _ in range(bench.n(5, 12)):
            yaw = bench.u(0, 360)
            out = (
                0.5
                * radius
                * bench.u(0.1, 1)
                * np.array([np.cos(np.radians(yaw)), np.sin(np.radians(yaw)), 0])
            )
            leaf = raw_leaf(long * bench.u(0.5, 1.1), wide, bench.u(-0.1, 0.3), 0.5, 0.002)
            leaves.append(_placed_leaf(leaf, out + (0, 0, 0.85 * height), bench.u(65, 88), yaw))
    else:  # long arching grass or fern
        long, wide = bench.u(0.12, 0.26), bench.u(0.006, 0.03)
        for _ in range(bench.n(18, 40)):
            leaf = raw_leaf(long * bench.u(0.5, 1.1), wide, bench.u(0.5, 2.0), 0.3)
            leaves.append(
                _placed_leaf(
                    leaf,
                    np.array([*bench.rng.uniform(-0.3, 0.3, 2) * radius, 0.85 * height]),
                    bench.u(35, 85),
                    bench.u(0, 360),
                )
            )
    bench.put_all(leaves, bench.look("green"), 80.0)
    return bench.thing("plant")


def make_cactus(shop: Workshop, name: str) -> Thing:
    """A cactus: ribbed columns or balls, with arms, spines and a flower."""
    bench = Bench(shop, name)
    radius, height = bench.u(0.035, 0.07), bench.u(0.04, 0.09)
    _planter(bench, radius, height)
    wide, tall, ribs, deep = (
        bench.u(0.4, 0.75) * radius,
        bench.u(0.04, 0.2),
        bench.n(5, 11),
        bench.u(0.05, 0.25),
    )
    look = bench.look("green")

    def column(wide: float, tall: float) -> Raw:
        vertices, faces = raw_superquadric((wide, wide, tall / 2), bench.u(0.5, 0.9), 1.0, 16, 4 * ribs)
        angle = np.arctan2(vertices[:, 1], vertices[:, 0])
        vertices[:, :2] *= 1 + deep * np.cos(ribs * angle)[:, None]
        return vertices + (0, 0, tall / 2), faces

    bench.put(column(wide, tall), look, (0, 0, 0.85 * height))
    for _ in range(bench.n(0, 3)):
        yaw, z, out = (
            bench.u(0, 2 * np.pi),
            0.85 * height + bench.u(0.3, 0.6) * tall,
            bench.u(1.4, 2.1) * wide,
        )
        way = np.array([np.cos(yaw), np.sin(yaw), 0])
        path = smooth(
            [
                0.5 * wide * way,
                0.9 * out * way,
                out * way + (0, 0, 0.02),
                out * way + (0, 0, bench.u(0.03, 0.09)),
            ],
            12,
        )
        thick = 0.4 * wide * np.sqrt(np.clip(1.05 - np.linspace(0, 1, 12) ** 6, 0.05, 1))
        bench.put(raw_sweep(path + (0, 0, z), thick, 12), look)
    if bench.chance(0.5):
        flower = [
            _placed_leaf(
                raw_leaf(0.025, 0.014, -0.4, 0.2), np.array([0, 0, 0.85 * height + tall - 0.003]), 40, 60 * k
            )
            for k in range(6)
        ]
        bench.put_all(flower, bench.look(), 80.0)
    return bench.thing("cactus")


def make_bouquet(shop: Workshop, name: str) -> Thing:
    """Flowers in a vase: thin stems, leaves, blossoms of petals or balls."""
    bench = Bench(shop, name)
    radius, height, neck = bench.u(0.03, 0.06), bench.u(0.08, 0.18), bench.u(0.4, 0.9)
    outline = gentle([(bench.u(0.5, 0.9), 0), (1, bench.u(0.3, 0.6)), (neck, 0.85), (neck * 1.2, 1)], 22) * (
        radius,
        height,
    )
    mouth = 1.2 * neck * radius - 0.004
    profile = np.concatenate(
        [[[0, 0]], outline, [[mouth, height], [0.8 * mouth, 0.7 * height], [0, 0.7 * height]]]
    )
    bench.put(raw_lathe(profile, bench.pick((6, 32, 32))), bench.look())
    stems, leaves, petals, hearts = [], [], [], []
    kind, size = bench.n(0, 2), bench.u(0.014, 0.03)
    for _ in range(bench.n(3, 8)):
        yaw, out, tall = bench.u(0, 2 * np.pi), bench.u(0.0, 0.09), bench.u(0.06, 0.16)
        way = np.array([np.cos(yaw), np.sin(yaw), 0])
        base, rim = np.array([0, 0, 0.68 * height]), 0.5 * mouth * way + (0, 0, height)
        head = out * way + (0, 0, height + tall)
        path = smooth([base + 0.2 * mouth * way, rim, head], 10)
        stems.append(raw_sweep(path, 0.0018, 6))
        leaves.append(_placed_leaf(raw_leaf(0.05, 0.02, 0.6, 0.3), path[6], bench.u(20, 60), bench.u(0, 360)))
        if kind == 0:
            petals.append(posed(raw_superquadric((size, size, size), bench.u(0.6, 1.2), 1, 10, 14), head))
        else:
            count = bench.n(5, 9)
            for k in range(count):
                petal = raw_leaf(1.4 * size, size * (0.9 if kind == 1 else 0.45), bench.u(-0.8, 0.3), 0.2)
                petals.append(_placed_leaf(petal, head, bench.u(5, 45), 360 * k / count))
            hearts.append(posed(raw_ellipsoid((0.4 * size, 0.4 * size, 0.3 * size), 1), head))
    bench.put_all(stems, bench.look("green"))
    bench.put_all(leaves, bench.look("green"), 80.0)
    bench.put_all(petals, bench.look("plain"), 80.0)
    bench.put_all(hearts, bench.look("plain"), 80.0)
    return bench.thing("bouquet", vary=(0.85, 1.3))


def make_small_tree(shop: Workshop, name: str) -> Thing:
    """A small tree: crooked trunk, branches, crowns of leaves or of lumps."""
    bench = Bench(shop, name)
    radius, height = bench.u(0.045, 0.08), bench.u(0.04, 0.1)
    _planter(bench, radius, height)
    tall, lumps = bench.u(0.12, 0.24), bench.chance(0.5)
    bends = np.column_stack(
        [np.cumsum(bench.rng.uniform(-0.025, 0.025, (4, 2)), 0), 0.8 * height + np.linspace(0, tall, 4)]
    )
    trunk = smooth(bends, 14)
    wood, crowns, leaves = [raw_sweep(trunk, np.linspace(bench.u(0.006, 0.012), 0.004, 14), 8)], [], []
    for _ in range(bench.n(3, 6)):
        start, yaw, long = trunk[bench.n(6, 13)], bench.u(0, 2 * np.pi), bench.u(0.03, 0.1)
        end = start + long * np.array([np.cos(yaw), np.sin(yaw), bench.u(0.1, 0.9)])
        wood.append(rod(start, end, 0.004, 6, 0.5))
        if lumps:
            size = bench.rng.uniform((0.025, 0.025, 0.018), (0.06, 0.06, 0.045))
            crowns.append(posed(wobbled(raw_ellipsoid(size, 2), bench.rng, 0.006, 0.03), end))
        else:
            for _ in range(8):
                leaf = raw_leaf(bench.u(0.02, 0.045), 0.018, bench.u(0, 0.8), 0.2)
                at = start + bench.u(0.4, 1.0) * (end - start)
                leaves.append(_placed_leaf(leaf, at, bench.u(-20, 70), bench.u(0, 360)))
    bench.put_all(wood, bench.look("wood"))
    look = bench.look("green")
    bench.put_all(crowns, look, 20.0)
    bench.put_all(leaves, look, 80.0)
    return bench.thing("tree")


def make_grass_box(shop: Workshop, name: str) -> Thing:
    """A box of grass or sprouts: many thin blades."""
    bench = Bench(shop, name)
    wide, deep, height, tall = (
        bench.u(0.08, 0.26),
        bench.u(0.05, 0.12),
        bench.u(0.03, 0.07),
        bench.u(0.03, 0.12),
    )
    wall = 0.004
    bench.put(
        raw_extrude(rounded(wide, deep, 0.004), height, [rounded(wide - 2 * wall, deep - 2 * wall, 0.003)]),
        bench.look(),
    )
    bench.put(raw_box(wide - wall, deep - wall, 0.85 * height), bench.look("noise"))
    spots = bench.rng.uniform(-0.45, 0.45, (bench.n(40, 70), 2)) * (wide - 2 * wall, deep - 2 * wall)
    blades = []
    for x, y in spots:
        t = np.linspace(0, 1, 4)[:, None]
        lean = bench.rng.uniform(-0.5, 0.5, 2) * tall
        rib = np.concatenate([(x, y) + t**2 * lean, 0.84 * height + t * tall * bench.u(0.5, 1.1)], axis=1)
        blades.append(raw_sweep(rib, np.array([0.0022, 0.002, 0.0016, 0.0006]), 4, 0.35))
    bench.put_all(blades, bench.look("green"), 80.0)
    return bench.thing("grass")


# Cables, ropes, chains


def _laid(flat: np.ndarray, radius: float) -> np.ndarray:
    """Lay a curve (k, 2) on the support; where it crosses itself, it runs over what lies there."""
    z = np.full(len(flat), radius)
    gap = np.linalg.norm(flat[:, None] - flat[None], axis=-1)
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(flat, axis=0), axis=1))])
    for index in range(len(flat)):
        below = (gap[index, :index] < 2.4 * radius) & (arc[index] - arc[:index] > 6 * radius)
        if below.any():
            z[index] = z[:index][below].max() + 2.1 * radius
    # Rise and fall over about four radii to either side.
    lifted = z.copy()
    for index in np.flatnonzero(z > radius):
        lifted = np.maximum(lifted, z[index] - 0.35 * np.maximum(np.abs(arc - arc[index]) - radius, 0))
    return np.column_stack([flat, np.maximum(lifted, radius)])


def _cable(
    bench: Bench, start: np.ndarray, heading: float, length: float, radius: float, wild: float
) -> np.ndarray:
    """Draw a wandering path (k, 3) on the support from a point (2,) with a first heading (radians)."""
    count = int(np.clip(length / (3.0 * radius), 24, 110))
    steps = np.full(count, length / count)
    bends = smooth(bench.rng.normal(bench.u(-0.8, 0.8) * wild, wild, (7, 1)), count)[:, 0]
    bends[:3] = 0.0
    angle = heading + np.cumsum(bends * length / count * 10)
    flat = start + np.cumsum(np.column_stack([np.cos(angle), np.sin(angle)]) * steps[:, None], axis=0)
    return _laid(np.concatenate([[start], flat]), radius * np.cos(np.pi / 8))


def _plug(bench: Bench, path: np.ndarray, look: str) -> None:
    """Put a plug on the end of a cable that lies."""
    way = path[-1] - path[-3]
    yaw = float(np.degrees(np.arctan2(way[1], way[0])))
    long, wide, tall = bench.u(0.02, 0.05), bench.u(0.01, 0.03), bench.u(0.008, 0.022)
    at = (*path[-1, :2], 0.0)
    bench.put(
        posed(raw_extrude(rounded(long, wide, 0.3 * wide), tall), (0.45 * long, 0, 0)), look, at, turn(z=yaw)
    )
    pins = [posed(raw_box(0.016, 0.003, 0.003), (long, sign * 0.25 * wide, 0.45 * tall)) for sign in (-1, 1)]
    bench.put_all([posed(pin, at, turn(z=yaw)) for pin in pins], bench.look("metal"))


def _wire_look(bench: Bench) -> str:
    return bench.look(bench.pick(("dark", "white", "dark", "plain")))


def make_loose_cable(shop: Workshop, name: str) -> Thing:
    """A cable that lies in loops on its support, with plugs."""
    bench = Bench(shop, name)
    radius, look = bench.u(0.0025, 0.005), _wire_look(bench)
    path = _cable(bench, np.zeros(2), bench.u(0, 6), bench.u(0.3, 0.9), radius, bench.u(0.8, 2.0))
    bench.put(raw_sweep(path, radius, 8), look, crease_deg=60)
    _plug(bench, path, look)
    if bench.chance(0.5):
        _plug(bench, path[::-1], bench.look())
    return bench.thing("cable", vary=(0.9, 1.1))


def make_power_strip(shop: Workshop, name: str) -> Thing:
    """A power strip with its cable and some plugs in it."""
    bench = Bench(shop, name)
    sockets, wide, tall = bench.n(3, 6), bench.u(0.04, 0.055), bench.u(0.025, 0.04)
    long = 0.045 * sockets + 0.04
    look, dark = bench.look("white" if bench.chance(0.5) else "dark"), bench.look("dark")
    bench.put(raw_extrude(rounded(long, wide, bench.u(0.003, 0.02)), tall), look)
    for index in range(sockets):
        x = (index - (sockets - 1) / 2) * 0.045
        bench.put(
            raw_lathe(
                np.array([[0, 0], [0.018, 0], [0.018, 0.002], [0.015, 0.002], [0.014, 0.001], [0, 0.001]]), 20
            ),
            dark,
            (x, 0, tall - 0.0005),
        )
        if bench.chance(0.35):
            bench.put(raw_box(0.034, bench.u(0.03, 0.05), bench.u(0.02, 0.05)), bench.look(), (x, 0, tall))
    radius = bench.u(0.003, 0.0045)
    path = _cable(bench, np.array([long / 2 - 0.004, 0]), 0.0, bench.u(0.25, 0.6), radius, bench.u(0.8, 1.8))
    bench.put(raw_sweep(path, radius, 8), look, crease_deg=60)
    return bench.thing("power strip", vary=(0.9, 1.1))


def make_lying_headphones(shop: Workshop, name: str) -> Thing:
    """Headphones that lie flat, with their cable."""
    bench = Bench(shop, name)
    wide, cup, thick, look = (
        bench.u(0.07, 0.085),
        bench.u(0.03, 0.04),
        bench.u(0.025, 0.04),
        _wire_look(bench),
    )
    band = bow((-wide, 0, 0.5 * cup), (wide, 0, 0.5 * cup), (0, bench.u(0.12, 0.16), 0), 24)
    bench.put(raw_sweep(band, 0.006, 8, bench.u(1.2, 2.2)), look)
    pad = bench.look()
    for sign in (-1, 1):
        shell = grounded(raw_superquadric((thick / 2, cup, cup * 0.9), 0.7, 0.6, 16, 24), 0.12)
        bench.put(shell, pad, (sign * wide, 0, 0))
    radius = bench.u(0.0025, 0.0035)
    path = _cable(
        bench, np.array([-wide, -0.3 * cup]), -np.pi / 2, bench.u(0.2, 0.5), radius, bench.u(1.0, 2.2)
    )
    bench.put(raw_sweep(path, radius, 8), look, crease_deg=60)
    _plug(bench, path, look)
    return bench.thing("headphones", vary=(0.9, 1.2))


def make_rope_coil(shop: Workshop, name: str) -> Thing:
    """A coil of rope or hose: a flat spiral, a stack of turns, or a loose bundle with a free end."""
    bench = Bench(shop, name)
    radius, turns, kind = bench.u(0.003, 0.009), bench.n(3, 6), bench.n(0, 2)
    count = 22 * turns
    angle, share = np.linspace(0, 2 * np.pi * turns, count), np.linspace(0, 1, count)
    inner = bench.u(0.025, 0.07)
    low = radius * np.cos(np.pi / 8)
    if kind == 0:
        wide, z = inner + 2.05 * radius * angle / (2 * np.pi), np.full(count, low)
    else:
        wide = inner * 1.3 + (0.0 if kind == 1 else 1.0) * 0.9 * radius * np.sin(
            angle / turns * bench.n(2, 4)
        )
        z = low + 2.05 * radius * angle / (2 * np.pi)
        flat_turn = angle < 2 * np.pi * 0.6
        z = np.where(flat_turn, low, low + 2.05 * radius * (angle - 1.2 * np.pi) / (2 * np.pi) * 1.0)
        wide = np.broadcast_to(wide, count) + 1.9 * radius * np.clip((angle - 1.2 * np.pi) / np.pi, 0, 1) * (
            kind == 2
        )
    path = np.column_stack([wide * np.cos(angle), wide * np.sin(angle) * bench.u(0.75, 1.0), z + 0 * share])
    if kind == 0:
        out = path[-1] + np.linspace(0.02, bench.u(0.05, 0.2), 8)[:, None] * (
            path[-1] - path[-2]
        ) / np.linalg.norm(path[-1] - path[-2])
        path = np.concatenate([path, out])
    bench.put(raw_sweep(path, radius, 8), bench.look(), crease_deg=60)
    return bench.thing("rope", vary=(0.9, 1.3))


def make_chain(shop: Workshop, name: str) -> Thing:
    """A chain that lies in a curve: links in turn flat and upright."""
    bench = Bench(shop, name)
    wire, half, wide = bench.u(0.002, 0.004), bench.u(0.012, 0.022), bench.u(0.007, 0.012)
    t = np.linspace(0, 2 * np.pi, 18, endpoint=False)
    link = np.column_stack([half * np.sign(np.cos(t)) * np.abs(np.cos(t)) ** 0.8, wide * np.sin(t), 0 * t])
    raw = raw_sweep(link, wire, 7, closed=True)
    pitch, count = 2 * half - 2.6 * wire, bench.n(8, 18)
    angle = bench.u(0, 6) + np.cumsum(smooth(bench.rng.normal(0, 0.35, (6, 1)), count)[:, 0])
    spots = np.cumsum(np.column_stack([np.cos(angle), np.sin(angle)]), axis=0) * pitch
    middle = spots - 0.5 * pitch * np.column_stack([np.cos(angle), np.sin(angle)])
    links = []
    for index in range(count):
        spin = turn(z=float(np.degrees(angle[index]))) @ turn(x=90.0 * (index % 2))
        links.append(posed(raw, (*middle[index], wide + wire if index % 2 else wire * 1.4), spin))
    # Flat links lie on the support, upright ones stand on it: each is pressed in by a hair.
    links = [grounded(link, 0.04) for link in links]
    bench.put_all(links, bench.look("metal" if bench.chance(0.6) else ""), 80.0)
    return bench.thing("chain")


def make_charger(shop: Workshop, name: str) -> Thing:
    """A power brick with a thick and a thin cable."""
    bench = Bench(shop, name)
    wide, deep, tall = bench.u(0.06, 0.13), bench.u(0.04, 0.07), bench.u(0.022, 0.04)
    look = _wire_look(bench)
    bench.put(
        raw_extrude(rounded(wide, deep, bench.u(0.004, 0.018)), tall, layers=2, taper=bench.u(0.88, 1.0)),
        look,
    )
    bench.put(raw_box(0.5 * wide, 0.5 * deep, 0.001), bench.look("print", 0.08), (0, 0, tall - 0.0006))
    for sign, radius in ((1, bench.u(0.003, 0.005)), (-1, bench.u(0.0025, 0.003))):
        heading = 0.0 if sign > 0 else np.pi
        path = _cable(
            bench,
            np.array([sign * (wide / 2 - 0.006), 0]),
            heading,
            bench.u(0.15, 0.4),
            radius,
            bench.u(0.8, 2.0),
        )
        bench.put(raw_sweep(path, radius, 8), look, crease_deg=60)
        _plug(bench, path, bench.pick((look, bench.look())))
    return bench.thing("charger", vary=(0.9, 1.1))


def make_beads(shop: Workshop, name: str) -> Thing:
    """A string of beads or lights that lies in a curve."""
    bench = Bench(shop, name)
    size, press = bench.u(0.006, 0.016), bench.u(0.7, 1.4)
    length, wire = bench.u(0.3, 0.7), 0.0025
    path = _cable(bench, np.zeros(2), bench.u(0, 6), length, wire, bench.u(0.6, 1.2))
    bench.put(raw_sweep(path, wire, 8), bench.look(), crease_deg=60)
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    pitch = size * bench.u(2.1, 5.0)
    looks = [bench.look("plain") for _ in range(bench.n(1, 3))]
    groups: list[list[Raw]] = [[] for _ in looks]
    bead = grounded(raw_ellipsoid((size, size, size * press), 2), 0.08)
    for index, at in enumerate(np.arange(size, arc[-1], pitch)):
        x, y = (float(np.interp(at, arc, path[:, k])) for k in (0, 1))
        groups[index % len(looks)].append(posed(bead, (x, y, 0)))
    for look, raws in zip(looks, groups):
        bench.put_all(raws, look)
    return bench.thing("beads")


THIN_KINDS: dict[str, Kind] = {
    "plate_rack": Kind("plate rack", make_plate_rack),
    "leaning_frame": Kind("frame", make_leaning_frame),
    "easel": Kind("easel", make_easel),
    "desk_lamp": Kind("desk lamp", make_desk_lamp),
    "wire_rack": Kind("wire basket", make_wire_rack),
    "tripod": Kind("tripod", make_tripod),
    "fan": Kind("fan", make_fan),
    "papers": Kind("papers", make_papers),
    "salver": Kind("salver", make_salver),
    "cutlery": Kind("cutlery", make_cutlery),
    "pens": Kind("pens", make_pens),
    "hanger": Kind("coat hanger", make_hanger),
    "step_ladder": Kind("ladder", make_step_ladder),
}
FOLIAGE_KINDS: dict[str, Kind] = {
    "leafy_plant": Kind("plant", make_leafy_plant),
    "rosette": Kind("plant", make_rosette),
    "cactus": Kind("cactus", make_cactus),
    "bouquet": Kind("bouquet", make_bouquet),
    "small_tree": Kind("tree", make_small_tree),
    "grass_box": Kind("grass", make_grass_box),
}
CABLE_KINDS: dict[str, Kind] = {
    "loose_cable": Kind("cable", make_loose_cable),
    "power_strip": Kind("power strip", make_power_strip),
    "lying_headphones": Kind("headphones", make_lying_headphones),
    "rope_coil": Kind("rope", make_rope_coil),
    "chain": Kind("chain", make_chain),
    "charger": Kind("charger", make_charger),
    "beads": Kind("beads", make_beads),
}
