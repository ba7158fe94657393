"""Films of generated rooms, drawn from families of shapes, furniture and materials; some families are held out.

`draw_film(split, number)` returns the same film for the same arguments. What a held-out split is named after never
occurs in "train": figures of those splits say what is to be expected of rooms that nobody generated.
"""

import argparse
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np

from priors.partition_ruler import LEAST_SHARE
from reconstruction.core.types import Camera
from registry.errors import InputError
from synthetic.camera_paths import phone_camera
from synthetic.film import FilmSet, prepare, render_truth
from synthetic.furniture_families import FURNITURE_FAMILIES
from synthetic.layout import RoomShape
from synthetic.lighting import draw_light
from synthetic.materials import MaterialMix, repaint
from synthetic.model_library import PREFIX as MODELS
from synthetic.model_library import use_models
from synthetic.photographs import load_photographs
from synthetic.procedural import RoomSpec, furnish, plan_room
from synthetic.random_rooms import draw_room
from synthetic.room import Room
from synthetic.sensor import Sensor, draw_sensor
from synthetic.shape_families import SHAPE_FAMILIES
from synthetic.walks import draw_walk

HELD_OUT: dict[str, dict[str, tuple[str, ...]]] = {
    "shapes": {"shapes": ("union", "manypart")},
    "rooms": {"furniture": ("seating", "beds"), "materials": ("photograph",)},
}
"""Families by held-out split: of small things; of furniture and materials."""
MODELS_SPLIT = "models"
"""Rooms to train on, furnished with the shapes and furniture of "train" and with models of others, see
`synthetic.model_library`; materials are photographs, too, where there are any."""
SPLITS = ("train", MODELS_SPLIT, *HELD_OUT)
MODELS_TABLE = Path(__file__).with_name("models.yaml")
_WALK_FRAMES = 300  # of a whole film
_SKETCH = (80, 60)  # pixels at which keyframes are chosen
_STEPS = (0.035, 0.07)  # between keyframes, as a share of the longer side; the frames stage asks for .045
_WALKS_DRAWN = 4  # the one that shows the most things is taken
_STARTS, _FEWEST_KEYFRAMES, _FEWEST_THINGS = 6, 8, 2.0  # things in view, mean over the keyframes
_LOOKS = 16  # poses of a walk at which things in view are counted
_OBJECTS = (8, 26)  # things in a room
_FRAMES_A_STEP = (
    8.0  # frames of a phone's film from keyframe to keyframe: the shutter is open for a share of one
)
_ROUGH = 1 / 3  # share of films with less exact cameras
_OPEN = 0.4  # share of rooms without one or two of their walls: nothing stands there
_AS_FURNISHED = (
    0.4  # share of rooms with the generator's own materials, which windows measure nearly everywhere
)
_PHOTOGRAPHS = 2.5  # weight of photographs among the materials of "models"
_WITH_MODELS = 0.85  # share of the rooms of "models" that hold small ones
_USUAL = MaterialMix(
    print=2.0, text=0.7, noise=1.6, blank=1.0, dark=0.25, gloss=0.5, gradient=0.3, wood=1.0, tiles=0.6
)


@dataclass(frozen=True)
class Sources:
    """Folders of what others made, on this machine and no part of the repository; None: rooms do without."""

    photographs: Path | None = None
    models: Path | None = None

    @staticmethod
    def add_options(parser: argparse.ArgumentParser) -> None:
        """Add `--photographs` and `--models`."""
        add = parser.add_argument
        add("--photographs", type=Path, help="folder of pictures that materials may show")
        add(
            "--models", type=Path,
            help='folder of the files in priors/models.yaml; rooms of the split "models" need it',
        )  # fmt: skip

    @classmethod
    def of(cls, options: argparse.Namespace) -> "Sources":
        """Read the options."""
        return cls(options.photographs, options.models)

    @classmethod
    def check_options(
        cls, parser: argparse.ArgumentParser, options: argparse.Namespace, splits: Sequence[str]
    ) -> None:
        """End the command with one line if the models of a split are not there."""
        try:
            for split in splits:
                cls.of(options).use(split)
        except InputError as error:
            parser.error(str(error))

    def use(self, split: str) -> None:
        """Let rooms be furnished with the models of a split, or with none.

        Raises:
            InputError: The split is "models", and `models` holds no file of `priors/models.yaml`.
        """
        if split == MODELS_SPLIT and self.models is None:
            raise InputError(
                'rooms of the split "models" need --models: a folder of models, see docs/priors.md'
            )
        use_models(MODELS_TABLE, self.models if split == MODELS_SPLIT else None)


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

    usual = asdict(_USUAL)
    own = HELD_OUT.get(split, {}).get("materials")
    kept = chosen("materials", usual)
    mix = {name: weight * (name in kept) for name, weight in usual.items()}
    if own:  # beside blank walls, which every room may have
        mix = usual | dict.fromkeys(own, 6.0)
    shapes, furniture = chosen("shapes", SHAPE_FAMILIES), chosen("furniture", FURNITURE_FAMILIES)
    if split == MODELS_SPLIT:
        mix["photograph"] = _PHOTOGRAPHS
        furniture = (*furniture, MODELS, MODELS)  # each family of a room is drawn; twice: nearly always
    return Families(shapes, furniture, MaterialMix(**mix))


def _flow_px(depth: np.ndarray, camera: Camera, walk: np.ndarray, row: int) -> np.ndarray:
    """Return how far a grid of pixels moves on average from pose `row` to every later pose of a walk, pixels."""
    v, u = np.mgrid[2 : depth.shape[0] : 8, 2 : depth.shape[1] : 8]
    u, v, z = u.ravel(), v.ravel(), depth[2::8, 2::8].ravel()
    u, v, z = u[z > 0], v[z > 0], z[z > 0].astype(np.float64)
    local = np.stack([(u + 0.5 - camera.cx) / camera.fx * z, (v + 0.5 - camera.cy) / camera.fy * z, z], -1)
    other_from_row = np.linalg.inv(walk[row + 1 :]) @ walk[row]
    there = np.einsum("nij,pj->npi", other_from_row[:, :3, :3], local) + other_from_row[:, None, :3, 3]
    ahead = np.maximum(there[..., 2], 1e-3)
    du = camera.fx * there[..., 0] / ahead + camera.cx - u - 0.5
    dv = camera.fy * there[..., 1] / ahead + camera.cy - v - 0.5
    return np.minimum(np.hypot(du, dv), max(_SKETCH)).mean(1) if len(z) else np.zeros(len(walk) - row - 1)


@dataclass(frozen=True)
class Film:
    """A furnished, painted and lit room, and how it is filmed."""

    split: str
    number: int
    spec: RoomSpec
    room: Room
    film_set: FilmSet
    walk: np.ndarray  # float64 (k, 4, 4) world_from_camera, of the whole film
    sensor: Sensor  # at the walk's frame rate
    fov_deg: float
    portrait: bool
    materials: MaterialMix
    base_entities: int  # ids 1 to this are floor and walls

    def camera(self, width: int, height: int) -> Camera:
        """Return the camera, upright where the film is."""
        size = (height, width) if self.portrait else (width, height)
        return phone_camera(*size, self.fov_deg)

    def keyframes(self, count: int) -> np.ndarray:
        """Return poses (n, 4, 4) of keyframes in a row, as far apart as the frames stage chooses them, n <= count.

        A few starts are drawn; of the stretches that lead far enough, the one with the most things in view is taken.
        """
        rng = np.random.default_rng((self.number, 7))
        camera, step = self.camera(*_SKETCH), float(rng.uniform(*_STEPS)) * max(_SKETCH)
        best, most = self.walk[:0], 0.0
        for start in rng.integers(0, len(self.walk) - count, _STARTS):
            chosen, shown = [], []
            row = int(start)
            while True:
                depth, ids = render_truth(self.film_set, camera, self.walk[row])
                chosen.append(row)
                shown.append(_things_in_view(ids, self.base_entities))
                ahead = np.flatnonzero(_flow_px(depth, camera, self.walk, row) >= step)
                if len(chosen) == count or not len(ahead):
                    break
                row += 1 + int(ahead[0])
            if len(chosen) >= min(count, _FEWEST_KEYFRAMES) and np.mean(shown) > most:
                best, most = self.walk[chosen], float(np.mean(shown))
        if most < _FEWEST_THINGS:
            raise InputError(f"{self.split}/{self.number}: no stretch of this walk sees enough")
        return best

    def keyframe_sensor(self) -> Sensor:
        """Return the sensor of a film of keyframes alone: the shutter is open for a smaller share of its steps."""
        return replace(
            self.sensor,
            blur_shutter=self.sensor.blur_shutter / _FRAMES_A_STEP,
            rolling_shutter=self.sensor.rolling_shutter / _FRAMES_A_STEP,
        )

    def shaken(self, path: np.ndarray) -> np.ndarray:
        """Return poses off by what bundle adjustment leaves, as much as this film drew.

        Up to .15 mrad and .5 mm; four times that in one film of three, as in films of real rooms.
        """
        from scipy.spatial.transform import Rotation

        rng = np.random.default_rng((self.number, 8))
        size = rng.uniform(0, 1) * (4 if rng.random() < _ROUGH else 1)
        out = path.copy()
        turn = Rotation.from_rotvec(1.5e-4 * size * rng.standard_normal((len(path), 3))).as_matrix()
        out[:, :3, :3] = path[:, :3, :3] @ turn
        out[:, :3, 3] += 5e-4 * size * rng.standard_normal((len(path), 3))
        return out

    def describe(self) -> dict:
        """Return what the manifest says of it."""
        return {
            "room": asdict(self.spec), "fov_deg": self.fov_deg, "portrait": self.portrait,
            "materials": asdict(self.materials), "sensor": asdict(self.sensor),
        }  # fmt: skip


def _things_in_view(ids: np.ndarray, base_entities: int) -> int:
    """Return how many things cover a little of a frame of ids (h, w)."""
    pixels = np.bincount(ids[ids > base_entities].astype(np.int64))
    return int((pixels >= max(LEAST_SHARE * ids.size, 2)).sum())


def _walk_past_things(
    rng: np.random.Generator, shape: RoomShape, film_set: FilmSet, camera: Camera, base_entities: int
) -> np.ndarray:
    """Draw a few walks (k, 4, 4); return the one that has the most things in view, as people film."""

    def seen(walk: np.ndarray) -> float:
        rows = np.linspace(0, len(walk) - 1, _LOOKS).astype(int)
        return float(
            np.mean(
                [_things_in_view(render_truth(film_set, camera, walk[k])[1], base_entities) for k in rows]
            )
        )

    return max((draw_walk(rng, shape, _WALK_FRAMES) for _ in range(_WALKS_DRAWN)), key=seen)


def _without_walls(room: Room, rng: np.random.Generator) -> Room:
    """Return the room without one or two of its walls, and without all that hangs there."""
    walls = [e.id for e in room.base if e.label == "wall"]
    gone = {int(k) for k in rng.choice(walls, int(rng.integers(1, 3)), replace=False)}
    for entity in room.entities:  # parents come first
        if entity.parent in gone:
            gone.add(entity.id)
    return replace(room, entities=tuple(e for e in room.entities if e.id not in gone))


def draw_film(split: str, number: int, sources: Sources | None = None) -> Film:
    """Draw, furnish, paint and light the room of this number in a split, and a walk through it.

    Raises:
        InputError: The split is "models", and `sources.models` holds no file of `priors/models.yaml`.
    """
    sources = sources or Sources()
    sources.use(split)
    rng = np.random.default_rng((zlib.crc32(split.encode()), number))
    families = families_of(split)
    spec = draw_room(
        int(rng.integers(1 << 30)), shapes=families.shapes, furniture=families.furniture, objects=_OBJECTS
    )
    if split == MODELS_SPLIT and rng.random() < _WITH_MODELS:
        spec = replace(spec, families=(*spec.families[:2], MODELS))
    plan = plan_room(spec)
    usual = asdict(families.materials)
    mix = MaterialMix(
        **{f.name: usual[f.name] * float(np.exp(rng.normal(0, 0.6))) for f in fields(MaterialMix)}
    )
    pictures = None
    if sources.photographs and mix.photograph > 0:
        pictures = load_photographs(sources.photographs, 40, rng)
    room, finishes = furnish(plan), {}
    drawn = np.random.default_rng((number, 9))
    if drawn.random() >= _AS_FURNISHED or mix.photograph > 0:
        room, finishes = repaint(room, rng, mix, pictures)
    base = len(room.base)
    if drawn.random() < _OPEN:
        room = _without_walls(room, drawn)
    background = tuple(float(c) for c in drawn.uniform(20, 235) + drawn.uniform(-20, 20, 3))
    light, sensor = draw_light(rng, room.extent), draw_sensor(rng)
    film_set = prepare(room, shadow_px=512, light=light, finishes=finishes, background=background)
    fov_deg, portrait = float(rng.uniform(50, 76)), bool(rng.random() < 0.12)
    sketch = phone_camera(*(_SKETCH[::-1] if portrait else _SKETCH), fov_deg)
    walk = _walk_past_things(rng, plan.shape, film_set, sketch, base)
    return Film(split, number, spec, room, film_set, walk, sensor, fov_deg, portrait, mix, base)
