"""Families of furniture that rooms may be furnished from or that may be held out, and cloths to lie on supports.

Kinds are named "family_kind" in a room; `kind_named` finds them, and those of `shape_families`, by that name.
"""

import importlib
from collections.abc import Iterable
from functools import cache

import numpy as np

from registry.errors import UsageError
from synthetic.footprints import disc, rectangle
from synthetic.furniture import Workshop
from synthetic.furniture_kit import Carpenter, slab, waves
from synthetic.furniture_seating import BEDS, SEATING
from synthetic.furniture_storage import STORAGE
from synthetic.furniture_tables import TABLES
from synthetic.furniture_wall import HANG_M, WALL
from synthetic.model_library import PREFIX as MODELS
from synthetic.model_library import library
from synthetic.shapes import COARSE, Solid, flipped, grid_patch, signed_volume
from synthetic.things import Kind, Place, Thing

FURNITURE_FAMILIES: dict[str, dict[str, Kind]] = {
    "tables": TABLES,
    "seating": SEATING,
    "beds": BEDS,
    "storage": STORAGE,
    "wall": WALL,
}
"""Furniture by family; every kind stands at z = 0, or hangs with its back at y = 0."""


def _cloth(shop: Workshop, name: str, long: float, wide: float) -> Thing:
    """A cloth that lies in shallow folds; its lower side is flat."""
    c = Carpenter(shop, name)
    width, depth = c.between(0.75, 1.0) * long, c.between(0.75, 1.0) * wide
    amplitude, thick = c.between(0.005, 0.03), c.between(0.003, 0.008)
    bumps = waves(c.dims, amplitude, c.between(0.09, 0.3))
    round_one = c.chance(0.25)
    c.look["*"] = c.cloth(1.0, 1.0)

    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        x, y = np.asarray(x, float), np.asarray(y, float)
        if round_one:
            rim = np.clip(1 - ((2 * x / width) ** 2 + (2 * y / depth) ** 2) ** 2, 0, 1)
        else:
            rim = np.clip((1 - (2 * x / width) ** 8) * (1 - (2 * y / depth) ** 8), 0, 1)
        return bumps(x, y) * rim

    if round_one:
        c.add(_round_cloth(width, depth, thick, height, c.tex("*")))
        area = disc(0.47, 24) * (width, depth)
    else:
        x = np.linspace(-0.5, 0.5, 29) * width
        y = np.linspace(-0.5, 0.5, 23) * depth
        # Its outline is a little uneven, as cut and laid by hand.
        wavy = np.stack(np.broadcast_arrays(x[:, None], y[None], np.zeros((29, 23))), -1).copy()
        top = wavy.copy()
        top[..., 2] = thick + height(wavy[..., 0], wavy[..., 1])
        c.add(slab(top, wavy, c.tex("*"), wavy[..., :2] + 1.0))
        area = rectangle(0.95 * width, 0.95 * depth)
    return c.finish("cloth", (Place(thick, area, name="cloth", sag=height),))


def _round_cloth(width: float, depth: float, thick: float, height, texture: str) -> Solid:
    """An oval cloth: rings from the middle outwards."""
    turn = np.linspace(0, 2 * np.pi, 49)
    turn[-1] = 0.0
    share = np.linspace(0, 1, 15)[:, None]
    flat = np.stack([0.5 * width * share * np.cos(turn), 0.5 * depth * share * np.sin(turn)], -1)
    top = np.concatenate([flat, (thick + height(flat[..., 0], flat[..., 1]))[..., None]], -1)
    low = np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], -1)
    uvs = flat + 1.0
    solid = (
        grid_patch(top, uvs, texture),
        grid_patch(low[:, ::-1], uvs[:, ::-1], texture),
        grid_patch(np.stack([top[-1], low[-1]]), np.stack([uvs[-1], uvs[-1] + 0.004]), texture),
    )
    return solid if signed_volume(solid) > 0 else tuple(flipped(p) for p in solid)


def make_napkin(shop: Workshop, name: str) -> Thing:
    """A small cloth."""
    return _cloth(shop, name, 0.46, 0.34)


def make_throw(shop: Workshop, name: str) -> Thing:
    """A cloth as large as half a table."""
    return _cloth(shop, name, 0.72, 0.52)


def make_blanket(shop: Workshop, name: str) -> Thing:
    """A cloth that covers a table."""
    return _cloth(shop, name, 1.15, 0.68)


CLOTH_KINDS: dict[str, Kind] = {
    "blanket": Kind("cloth", make_blanket),
    "throw": Kind("cloth", make_throw),
    "napkin": Kind("cloth", make_napkin),
}
"""Cloths on supports, the large one first."""


def shape_families() -> dict[str, dict[str, Kind]]:
    """Return the families of small things; none where that module is missing."""
    try:
        return importlib.import_module("synthetic.shape_families").SHAPE_FAMILIES
    except ModuleNotFoundError as missing:
        if missing.name != "synthetic.shape_families":
            raise
        return {}


def furniture_keys(families: Iterable[str]) -> list[str]:
    """Return the room names of all kinds of some furniture families."""
    return [f"{family}_{kind}" for family in families for kind in FURNITURE_FAMILIES[family]]


def shape_keys(families: Iterable[str]) -> list[str]:
    """Return the room names of all kinds of some families of small things."""
    known = shape_families()
    out = [f"{family}_{kind}" for family in families if family != MODELS for kind in known[family]]
    return [*out, *(library().keys("thing") if MODELS in families else ())]


def kind_named(key: str) -> Kind:
    """Return the kind of this room name."""
    if key in CLOTH_KINDS:
        return CLOTH_KINDS[key]
    model = library().kind(key)
    if model is not None:
        return model
    for families in (FURNITURE_FAMILIES, shape_families()):
        for family, kinds in families.items():
            kind = kinds.get(key.removeprefix(f"{family}_")) if key.startswith(f"{family}_") else None
            if kind is not None:
                return kind
    raise UsageError(f"no kind of thing is called {key!r}")


def hang_range_m(key: str) -> tuple[float, float] | None:
    """Return between which heights a kind of a family hangs, None for others."""
    model = library().record(key)
    if model is not None:
        return model.hangs_m
    return HANG_M.get(key.split("_", 1)[-1]) if key.startswith(("wall_", "storage_")) else None


@cache
def role_of(key: str) -> str:
    """Return what a small thing may be used as: "container", "support", "content", "rolls" or "free"."""
    kind = kind_named(key)
    if kind.rolls:
        return "rolls"
    thing = kind.make(Workshop(np.random.default_rng(0), COARSE, 0.01), "")
    if any(p.inside for p in thing.places):
        return "container"
    if any(p.stack for p in thing.places):
        return "support"
    return "content" if max(thing.size) < 0.13 else "free"
