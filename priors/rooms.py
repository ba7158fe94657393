"""Films of generated rooms, drawn from families of shapes, furniture and materials; some families are held out.

`draw_film(split, number)` returns the same film for the same arguments. What a held-out split is named after never
occurs in "train": figures of those splits say what is to be expected of rooms that nobody generated.
"""

import zlib
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from reconstruction.types import Camera
from synthetic.arrangements import draw_room
from synthetic.camera_paths import phone_camera
from synthetic.film import FilmSet, prepare
from synthetic.furniture_families import FURNITURE_FAMILIES
from synthetic.lighting import draw_light
from synthetic.materials import MaterialMix, repaint
from synthetic.photographs import load_photographs
from synthetic.procedural import RoomSpec, furnish, plan_room
from synthetic.sensor import Sensor, draw_sensor
from synthetic.shape_families import SHAPE_FAMILIES
from synthetic.walks import draw_walk

HELD_OUT: dict[str, dict[str, tuple[str, ...]]] = {
    "shapes": {"shapes": ("union", "manypart")},
    "rooms": {"furniture": ("seating", "beds"), "materials": ("photograph",)},
}
"""Families by held-out split: of small things; of furniture and materials."""
SPLITS = ("train", *HELD_OUT)


@dataclass(frozen=True)
class Families:
    """What a split draws from."""

    shapes: tuple[str, ...]
    furniture: tuple[str, ...]
    materials: MaterialMix


def families_of(split: str) -> Families:
    """Return a split's families: a held-out one has only its own of one sort, and the trained ones of the others."""

    def chosen(sort: str, names) -> tuple[str, ...]:
        held = {name for sorts in HELD_OUT.values() for name in sorts.get(sort, ())}
        return HELD_OUT.get(split, {}).get(sort) or tuple(name for name in names if name not in held)

    usual = asdict(MaterialMix())
    own = HELD_OUT.get(split, {}).get("materials")
    kept = chosen("materials", usual)
    mix = {name: weight * (name in kept) for name, weight in usual.items()}
    if own:  # beside blank walls, which every room may have
        mix = usual | dict.fromkeys(own, 6.0)
    return Families(
        chosen("shapes", SHAPE_FAMILIES), chosen("furniture", FURNITURE_FAMILIES), MaterialMix(**mix)
    )


@dataclass(frozen=True)
class Film:
    """A furnished, painted and lit room, and how it is filmed."""

    split: str
    number: int
    spec: RoomSpec
    film_set: FilmSet
    walk: np.ndarray  # float64 (k, 4, 4) world_from_camera, of the whole film
    sensor: Sensor
    fov_deg: float
    portrait: bool
    materials: MaterialMix
    base_entities: int  # ids 1 to this are floor and walls

    def camera(self, width: int, height: int) -> Camera:
        """Return the camera, upright where the film is."""
        size = (height, width) if self.portrait else (width, height)
        return phone_camera(*size, self.fov_deg)

    def stretch(self, frames: int) -> np.ndarray:
        """Return `frames` poses (n, 4, 4) in a row, from anywhere in the walk."""
        start = int(np.random.default_rng((self.number, 7)).integers(0, len(self.walk) - frames + 1))
        return self.walk[start : start + frames]

    def shaken(self, path: np.ndarray) -> np.ndarray:
        """Return poses off by what bundle adjustment leaves: up to .4 mrad and 2 mm, as much as this film drew."""
        from scipy.spatial.transform import Rotation

        rng = np.random.default_rng((self.number, 8))
        size = rng.uniform(0, 1)
        out = path.copy()
        turn = Rotation.from_rotvec(4e-4 * size * rng.standard_normal((len(path), 3))).as_matrix()
        out[:, :3, :3] = path[:, :3, :3] @ turn
        out[:, :3, 3] += 2e-3 * size * rng.standard_normal((len(path), 3))
        return out

    def describe(self) -> dict:
        """Return what the manifest says of it."""
        return {
            "room": asdict(self.spec), "fov_deg": self.fov_deg, "portrait": self.portrait,
            "materials": asdict(self.materials), "sensor": asdict(self.sensor),
        }  # fmt: skip


def draw_film(split: str, number: int, keyframes: int, *, photographs: Path | None = None) -> Film:
    """Draw, furnish, paint and light the room of this number in a split; its walk has that many keyframes."""
    rng = np.random.default_rng((zlib.crc32(split.encode()), number))
    families = families_of(split)
    spec = draw_room(int(rng.integers(1 << 30)), shapes=families.shapes, furniture=families.furniture)
    plan = plan_room(spec)
    usual = asdict(families.materials)
    mix = MaterialMix(
        **{f.name: usual[f.name] * float(np.exp(rng.normal(0, 0.8))) for f in fields(MaterialMix)}
    )
    pictures = load_photographs(photographs, 40, rng) if photographs else None
    room, finishes = repaint(furnish(plan), rng, mix, pictures)
    light = draw_light(rng, room.extent)
    return Film(
        split, number, spec, prepare(room, shadow_px=512, light=light, finishes=finishes),
        draw_walk(rng, plan.shape, keyframes), draw_sensor(rng), fov_deg=float(rng.uniform(50, 76)),
        portrait=bool(rng.random() < 0.12), materials=mix, base_entities=len(room.base),
    )  # fmt: skip
