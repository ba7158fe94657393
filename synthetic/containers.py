"""Hollow things of procedural rooms: mugs, bowls, plates, trays, open boxes, baskets; things can lie inside.

Turned vessels are cut into convex pieces sector by sector, so that physics sees their hollow as it is.
"""

from itertools import pairwise

import numpy as np

from synthetic import textures
from synthetic.footprints import disc, rectangle
from synthetic.furniture import Workshop
from synthetic.shapes import Solid, box, lathe, shifted, tube
from synthetic.things import Kind, Place, Thing, pick_color, prefixed

_SEGMENTS = 48  # of the turned mesh
_SECTORS = 24  # of its convex pieces; each spans two segments


def vessel(outer: np.ndarray, inner: np.ndarray, looks: tuple[str, str], step_m: float) -> Solid:
    """Turn a vessel: `outer` (k, 2) of (radius, height) from the table up, `inner` (m, 2) from its floor up."""
    outside, inside = looks
    return lathe(
        [
            (np.array([[0, outer[0, 1]], outer[0]]), inside),
            (outer, outside),
            (np.array([outer[-1], inner[-1]]), inside),
            (inner[::-1], inside),
            (np.array([inner[0], [0, inner[0, 1]]]), inside),
        ],
        step_m,
        _SEGMENTS,
    )


def vessel_pieces(outer: np.ndarray, inner: np.ndarray, levels: int) -> tuple[np.ndarray, ...]:
    """Cut a vessel into its floor and rings of wall sectors; heights must not fall along the outlines."""
    floor, rim = inner[0, 1], inner[-1, 1]
    below = outer[outer[:, 1] < floor - 1e-6]
    rings = np.concatenate([below, [[np.interp(floor, outer[:, 1], outer[:, 0]), floor]]])
    turn = disc(1.0, _SEGMENTS // 2)
    pieces = [np.concatenate([np.column_stack([r * turn, np.full(len(turn), z)]) for r, z in rings])]
    angles = np.linspace(0, 2 * np.pi, _SEGMENTS + 1)
    steps = np.linspace(floor, rim, levels + 1)
    for low, high in pairwise(steps):
        wall = []
        for outline in (outer, inner):
            between = outline[(outline[:, 1] > low + 1e-6) & (outline[:, 1] < high - 1e-6)]
            ends = [[np.interp(z, outline[:, 1], outline[:, 0]), z] for z in (low, high)]
            wall.append(np.concatenate([ends, between]))
        section = np.concatenate(wall)
        per = _SEGMENTS // _SECTORS
        for sector in range(_SECTORS):
            a = angles[sector * per : (sector + 1) * per + 1]
            radius, z = section[:, :1], section[:, 1:]
            ring = np.stack(np.broadcast_arrays(radius * np.cos(a), radius * np.sin(a), z), -1)
            pieces.append(ring.reshape(-1, 3))
    return tuple(pieces)


def _cup(
    shop: Workshop, name: str, label: str, radius: float, height: float, flare: float, ear: bool
) -> Thing:
    """A drinking vessel: straight or flared, with or without a handle."""
    wall, base, foot = 0.004, 0.006, radius * (1 - flare)
    outer = np.array([[foot, 0], [radius, height]])
    inner = np.array([[np.interp(base, [0, height], [foot, radius]) - wall, base], [radius - wall, height]])
    around = 2 * np.pi * radius
    look = {
        "out": textures.label(
            shop.rng, around, height, 2000 * shop.density, pick_color(shop), ("GOOD", "MORNING"), 2
        ),
        "in": textures.glaze(shop.rng, 0.3, 0.15, 1800 * shop.density, shop.color((226, 222, 210))),
    }
    parts = [vessel(outer, inner, (f"{name}out", f"{name}in"), shop.step_m)]
    pieces = list(vessel_pieces(outer, inner, 1))
    if ear:
        handle, hull = _ear(radius, height, f"{name}in")
        parts.append(handle)
        pieces += hull
    size = (2 * radius, 2 * radius, height)
    return Thing(label, parts, prefixed(name, look), size, pieces=tuple(pieces))


def _ear(radius: float, height: float, texture: str) -> tuple[Solid, list[np.ndarray]]:
    """A handle towards +x; its ends sink into the wall but not through it."""
    angles = np.radians(np.linspace(108, -108, 19))
    x = radius + 0.006 + 0.026 * np.cos(angles)
    path = np.stack(
        [np.maximum(x, radius - 0.001), np.zeros(19), height / 2 + 0.33 * height * np.sin(angles)], -1
    )
    solid = tube(path, (0.006, 0.0035), texture)
    rings = solid[0].vertices.reshape(19, -1, 3)
    return solid, [rings[i : i + 4].reshape(-1, 3) for i in range(0, 18, 3)]


def make_mug(shop: Workshop, name: str) -> Thing:
    """A straight mug with a handle."""
    radius, height = shop.rng.uniform((0.037, 0.085), (0.045, 0.105)).tolist()
    return _cup(shop, name, "mug", radius, height, 0.0, True)


def make_cup(shop: Workshop, name: str) -> Thing:
    """A beaker that widens upwards, without a handle."""
    radius, height = shop.rng.uniform((0.036, 0.08), (0.045, 0.12)).tolist()
    return _cup(shop, name, "cup", radius, height, 0.28, False)


def make_plate(shop: Workshop, name: str) -> Thing:
    """A flat plate with a raised rim; a bowl or a cup may stand on it."""
    radius = float(shop.rng.uniform(0.1, 0.125))
    well, foot = 0.62 * radius, 0.6 * radius
    outer = np.array([[foot, 0], [radius, 0.02]])
    inner = np.array([[well, 0.007], [radius - 0.006, 0.02]])
    look = {
        "out": textures.glaze(shop.rng, 0.8, 0.1, 1500 * shop.density, pick_color(shop)),
        "in": textures.label(
            shop.rng, 2 * radius, 2 * radius, 1300 * shop.density, pick_color(shop), ("BON", "APPETIT")
        ),
    }
    solid = vessel(outer, inner, (f"{name}out", f"{name}in"), shop.step_m)
    size = (2 * radius, 2 * radius, 0.02)
    pieces = vessel_pieces(outer, inner, 1)
    place = Place(0.007, disc(well), rim_m=0.013, stack=True, name="well")
    return Thing("plate", [solid], prefixed(name, look), size, places=(place,), pieces=pieces)


def make_bowl(shop: Workshop, name: str) -> Thing:
    """A wide bowl with a level floor, for fruit and small things."""
    radius = float(shop.rng.uniform(0.12, 0.15))
    height, floor = 0.46 * radius, 0.64 * radius
    bend = np.linspace(0, np.pi / 2, 10)
    base, wall = 0.008, 0.006
    outer = np.stack([floor + (radius - floor) * np.sin(bend), height * (1 - np.cos(bend))], -1)
    rise = height - base
    inner = np.stack([floor + (radius - wall - floor) * np.sin(bend), base + rise * (1 - np.cos(bend))], -1)
    look = {
        "out": textures.glaze(shop.rng, 0.8, 0.15, 1600 * shop.density, pick_color(shop)),
        "in": textures.label(
            shop.rng, 2 * np.pi * radius, 0.16, 1300 * shop.density, pick_color(shop), ("FRUIT",), 4
        ),
    }
    solid = vessel(outer, inner, (f"{name}out", f"{name}in"), shop.step_m)
    place = Place(base, disc(floor), inside=True, rim_m=rise, name="inside")
    size = (2 * radius, 2 * radius, height)
    pieces = vessel_pieces(outer, inner, 5)
    return Thing("bowl", [solid], prefixed(name, look), size, places=(place,), pieces=pieces)


def make_vase(shop: Workshop, name: str) -> Thing:
    """A tall vase that narrows towards its mouth."""
    radius, height = shop.rng.uniform((0.05, 0.18), (0.065, 0.26)).tolist()
    z = np.linspace(0, 1, 9)
    swell = 0.72 + 0.28 * np.sin(np.pi * np.minimum(z / 0.75, 1.0) ** 0.8) - 0.22 * np.maximum(z - 0.6, 0)
    outer = np.stack([radius * swell, height * z], -1)
    base = 0.1 * height
    heights = np.linspace(base, height, 8)
    inner = np.stack([np.interp(heights, outer[:, 1], outer[:, 0]) - 0.006, heights], -1)
    look = {
        "out": textures.glaze(shop.rng, 0.5, 0.4, 1500 * shop.density, pick_color(shop)),
        "in": textures.plaster(shop.rng, 0.4, 0.3, 1000 * shop.density, pick_color(shop), 8),
    }
    solid = vessel(outer, inner, (f"{name}out", f"{name}in"), shop.step_m)
    size = (2 * float(outer[:, 0].max()), 2 * float(outer[:, 0].max()), height)
    return Thing("vase", [solid], prefixed(name, look), size, pieces=vessel_pieces(outer, inner, 5))


def _open_box(
    shop: Workshop, name: str, label: str, size: tuple[float, float, float], wall: float, look: dict
) -> Thing:
    """A box without a lid; sides show "front", floor and ends "*"."""
    width, depth, height = size
    overlap = min(0.002, wall / 3)
    parts = [box((width, depth, wall), f"{name}*", shop.step_m)]
    for sign in (-1, 1):
        faces = {"*": f"{name}*", "-y" if sign < 0 else "+y": f"{name}front"}
        parts.append(shifted(box((width, wall, height), faces, shop.step_m), y=sign * (depth - wall) / 2))
        end = box((wall, depth - 2 * wall + 2 * overlap, height), f"{name}*", shop.step_m, (0.2, 0.1 * sign))
        parts.append(shifted(end, x=sign * (width - wall) / 2))
    area = rectangle(width - 2 * wall, depth - 2 * wall)
    place = Place(wall, area, inside=True, rim_m=height - wall, name="inside")
    return Thing(label, parts, prefixed(name, look), size, places=(place,))


def make_tray(shop: Workshop, name: str) -> Thing:
    """A low wooden tray."""
    size = (*shop.rng.uniform((0.3, 0.21), (0.38, 0.26)).tolist(), 0.035)
    look = {
        "*": textures.wood(shop.rng, 0.6, 0.4, 1300 * shop.density, shop.color((176, 128, 80)), boards=0.06),
        "front": textures.wood(shop.rng, 0.5, 0.1, 1300 * shop.density, pick_color(shop)),
    }
    return _open_box(shop, name, "tray", size, 0.01, look)


def make_open_box(shop: Workshop, name: str) -> Thing:
    """An open cardboard box of 6 to 9 cm height."""
    size = tuple(shop.rng.uniform((0.24, 0.17, 0.06), (0.3, 0.22, 0.09)).tolist())
    look = {
        "*": textures.cardboard(shop.rng, 0.4, 0.3, 1400 * shop.density),
        "front": textures.cardboard(shop.rng, size[0], size[2], 1500 * shop.density, "SPARE PARTS"),
    }
    return _open_box(shop, name, "open box", size, 0.006, look)


def make_crate(shop: Workshop, name: str) -> Thing:
    """A wooden crate for the floor, low enough that a standing person sees what lies in it."""
    size = tuple(shop.rng.uniform((0.38, 0.28, 0.09), (0.48, 0.34, 0.13)).tolist())
    look = {
        "*": textures.wood(shop.rng, 0.7, 0.5, 1000 * shop.density, shop.color((190, 150, 96)), boards=0.08),
        "front": textures.cardboard(shop.rng, size[0], size[2], 1200 * shop.density, "ORANGES"),
    }
    return _open_box(shop, name, "crate", size, 0.012, look)


def make_basket(shop: Workshop, name: str) -> Thing:
    """A basket of horizontal slats between corner posts."""
    width, depth, height = shop.rng.uniform((0.26, 0.19, 0.085), (0.34, 0.24, 0.11)).tolist()
    wall, post, slats, overlap = 0.008, 0.014, 3, 0.002
    look = {
        "*": textures.wood(shop.rng, 0.6, 0.3, 1300 * shop.density, shop.color((198, 160, 104))),
        "slat": textures.wood(shop.rng, 0.5, 0.1, 1300 * shop.density, pick_color(shop)),
    }
    parts = [box((width, depth, wall), f"{name}*", shop.step_m)]
    for sx in (-1, 1):
        for sy in (-1, 1):
            corner = box((post, post, height), f"{name}*", shop.step_m, (0.1 * sx, 0.1 * sy), upright=False)
            parts.append(shifted(corner, sx * (width - post) / 2, sy * (depth - post) / 2))
    pitch = (height - wall) / slats
    for number in range(slats):
        z, tall = wall + (number + 0.35) * pitch, 0.62 * pitch
        for sign in (-1, 1):
            long = box(
                (width - 2 * post + 2 * overlap, wall, tall), f"{name}slat", shop.step_m, (0.1, 0.2 * number)
            )
            parts.append(shifted(long, 0, sign * (depth - wall) / 2, z))
            short = box(
                (wall, depth - 2 * post + 2 * overlap, tall), f"{name}slat", shop.step_m, (0.2, 0.1 * number)
            )
            parts.append(shifted(short, sign * (width - wall) / 2, 0, z))
    place = Place(
        wall, rectangle(width - 2 * post, depth - 2 * post), inside=True, rim_m=height - wall, name="inside"
    )
    size = (width, depth, height)
    return Thing("basket", parts, prefixed(name, look), size, places=(place,))


VESSEL_KINDS: dict[str, Kind] = {
    "mug": Kind("mug", make_mug, weight=1.2),
    "cup": Kind("cup", make_cup),
    "plate": Kind("plate", make_plate, weight=0.8),
    "vase": Kind("vase", make_vase, weight=0.6),
}
"""Hollow things that stay empty (a plate carries what stands on it)."""

CONTAINER_KINDS: dict[str, Kind] = {
    "bowl": Kind("bowl", make_bowl),
    "tray": Kind("tray", make_tray),
    "open_box": Kind("open box", make_open_box),
    "basket": Kind("basket", make_basket),
}
"""Open containers that things are put into."""
