"""Light a generated room: lamps, windows and sun, baked into one color per vertex.

Many shadow maps (lamps spread over the ceiling) give soft shadows and darken corners.
"""

from dataclasses import dataclass, replace

import numpy as np
from numba import njit, prange

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera
from synthetic.camera_paths import look_at

_LAMP_HEIGHT_M = 2.45
_SHADOW_BIAS_M = 0.012


@dataclass(frozen=True)
class Lamp:
    """A small source of light; large ones are made of several."""

    position: tuple[float, float, float]  # metres; lights only what lies below it
    color: tuple[float, float, float]
    weight: float


@dataclass(frozen=True)
class Window:
    """A bright rectangle in a wall: glossy things mirror it, and the sun may shine in."""

    wall: str  # "wall_north", ...
    along: tuple[float, float]  # from, to, in x or y of the world
    up: tuple[float, float]
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    sun: tuple[float, float, float] | None = None  # unit vector to the sun
    sun_weight: float = 0.0


@dataclass(frozen=True)
class Light:
    """What lights a room; as it is by default, `prepare` lights every room as it always did."""

    lamps: tuple[Lamp, ...] | None = None
    """None: the soft lamp and the bright ceiling of before."""
    windows: tuple[Window, ...] = ()
    ambient: float = 0.16
    """Light from everywhere, which stands for all further bounces."""
    ambient_above: float = 0.06
    """How much more of it comes from above."""
    contrast: float = 1.0
    """Power of all light: below 1 flat, above 1 harsh."""


def usual_lamps(extent: tuple[float, float, float, float]) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Return (position, color, weight): a soft warm lamp, and cool light spread over the ceiling."""
    west, east, south, north = extent
    lamps = []
    for dx, dy in [(0, 0), (0.16, 0.05), (-0.12, 0.14), (-0.06, -0.17), (0.12, -0.13)]:
        position = np.array([-1.0 + dx, 0.3 + dy, _LAMP_HEIGHT_M - 0.2])
        lamps.append((position, np.array([1.06, 1.0, 0.90]), 0.60 / 5))
    across = np.linspace(west + 0.4, east - 0.4, 4)
    along = np.linspace(south + 0.4, north - 0.4, 4)
    for x in across:
        for y in along:
            lamps.append((np.array([x, y, _LAMP_HEIGHT_M + 0.02]), np.array([0.95, 1.0, 1.05]), 0.50 / 16))
    return lamps


@njit(cache=True, parallel=True)
def _add_light(points, normals, lamp, weight, focal, size, depth, bias, light):  # pragma: no cover - compiled
    """Add one lamp: Lambert times a 3x3 percentage-closer shadow, bright side only."""
    half = size / 2.0
    for i in prange(points.shape[0]):
        px = points[i, 0] + 0.012 * normals[i, 0]
        py = points[i, 1] + 0.012 * normals[i, 1]
        pz = points[i, 2] + 0.012 * normals[i, 2]
        dx, dy, dz = lamp[0] - px, lamp[1] - py, lamp[2] - pz
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        cosine = (dx * normals[i, 0] + dy * normals[i, 1] + dz * normals[i, 2]) / distance
        if cosine <= 0.0 or dz <= 0.05:
            continue
        # The lamp's camera looks straight down: +x right, +y of the image is -y of the world.
        u = half + focal * (px - lamp[0]) / dz
        v = half - focal * (py - lamp[1]) / dz
        lit, seen = 0.0, 0
        for row in range(-1, 2):
            for column in range(-1, 2):
                x, y = int(np.floor(u)) + column, int(np.floor(v)) + row
                if 0 <= x < size and 0 <= y < size:
                    seen += 1
                    if depth[y, x] == 0.0 or depth[y, x] > dz - bias:
                        lit += 1.0
        share = lit / seen if seen > 0 else 1.0
        # Softer than the inverse square: real rooms are filled by what walls send back.
        amount = share * cosine * 2.2 / (1.0 + 0.22 * distance * distance)
        for channel in range(3):
            light[i, channel] += weight[channel] * amount


def bake_light(
    vertices: np.ndarray,
    normals: np.ndarray,
    faces: np.ndarray,
    lamps: list,
    shadow_px: int,
    light_of_room: Light,
    things: np.ndarray,
) -> np.ndarray:
    """Return the light (n, 3) that falls on vertices (n, 3): ambient, and of lamps with shadow maps."""
    focal = shadow_px / 2 / np.tan(np.radians(62))
    camera = Camera(shadow_px, shadow_px, focal, focal, shadow_px / 2, shadow_px / 2)
    # A little light from everywhere, more from above, stands for all further bounces.
    ambient, above = light_of_room.ambient, light_of_room.ambient_above
    light = np.repeat((ambient + above * normals[:, 2:3]), 3, axis=1)
    for position, color, weight in lamps:
        world_from_camera = np.eye(4)
        world_from_camera[:3, :3] = np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1.0]])
        world_from_camera[:3, 3] = position
        depth = rasterize_mesh(vertices, faces, camera, world_from_camera).depth
        _add_light(
            vertices, normals, position, weight * color, focal, shadow_px, depth, _SHADOW_BIAS_M, light
        )
    for window in light_of_room.windows:
        if window.sun is not None and window.sun_weight > 0:
            light += _sunlight(window, vertices, normals, faces[things])
    if light_of_room.contrast != 1.0:
        middle = max(float(np.median(light)), 1e-3)
        light = middle * (np.maximum(light, 0.0) / middle) ** light_of_room.contrast
    return np.clip(light, 0.0, 2.0).astype(np.float32) ** np.float32(1 / 2.2)


def _sunlight(window: Window, vertices: np.ndarray, normals: np.ndarray, things: np.ndarray) -> np.ndarray:
    """Return light (v, 3) of the sun through a window; only `things` (faces) cast shadows."""
    to_sun = np.array(window.sun)
    axis = 0 if window.wall in ("wall_west", "wall_east") else 1
    lit = np.clip(normals @ to_sun, 0, 1)
    plane = _plane_of(window, vertices)
    way = (plane - vertices[:, axis]) / to_sun[axis]
    at = vertices + way[:, None] * to_sun
    for (low, high), value in ((window.along, at[:, 1 - axis]), (window.up, at[:, 2])):
        lit *= np.clip((value - low) / 0.06, 0, 1) * np.clip((high - value) / 0.06, 0, 1)
    lit[way < 0.02] = 0.0
    far, size = 30.0, 1024
    world_from_camera = look_at(to_sun * far, np.zeros(3))
    focal = size / 2 * far / 4.5
    camera = Camera(size, size, focal, focal, size / 2, size / 2)
    depth = rasterize_mesh(vertices, things, camera, world_from_camera).depth
    points = vertices + 0.012 * normals
    x, y, z = ((points - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]).T
    column, row = (np.clip((focal * v / z + size / 2).astype(int), 0, size - 1) for v in (x, y))
    depth = np.where(depth == 0, np.float32(1e6), depth)
    seen = np.mean(
        [
            depth[np.clip(row + j, 0, size - 1), np.clip(column + i, 0, size - 1)] > z - 0.03
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
        ],
        axis=0,
    )
    return (window.sun_weight * lit * seen)[:, None] * np.array(window.color)


def _plane_of(window: Window, vertices: np.ndarray) -> float:
    axis = 0 if window.wall in ("wall_west", "wall_east") else 1
    ends = vertices[:, axis].min() + 0.1, vertices[:, axis].max() - 0.1  # walls are 0.1 m thick
    return float(ends[window.wall in ("wall_east", "wall_north")])


def draw_light(rng: np.random.Generator, extent: tuple[float, float, float, float]) -> Light:
    """Draw lamps, windows and their balance for a room of this extent (west, east, south, north)."""
    west, east, south, north = extent
    lamps: list[Lamp] = []

    def spread(color, weight, low, high, count, z) -> None:
        for _ in range(count):
            x, y = rng.uniform(low, high)
            place = (float(x), float(y), float(z + rng.uniform(-0.03, 0.03)))
            lamps.append(Lamp(place, tuple(float(c) for c in color), weight / count))

    warmth = rng.uniform(-0.12, 0.22)
    warm = np.array([1 + warmth, 1.0, 1 - 1.2 * warmth])
    sky = np.array([1.0, 1.0, 1.0]) + rng.uniform(-0.08, 0.14) * np.array([-1.0, 0.0, 1.0])
    low, high = np.array([west + 0.4, south + 0.4]), np.array([east - 0.4, north - 0.4])
    ceiling = float(rng.choice([0.0, 0.15, 0.4, 0.7]) * rng.uniform(0.6, 1.2))
    if ceiling > 0:
        spread(warm, ceiling, low, high, 10, _LAMP_HEIGHT_M)
    for _ in range(int(rng.choice([0, 1, 1, 2]))):
        at = rng.uniform(low, high)
        size = rng.uniform(0.02, 0.25)
        spread(warm, rng.uniform(0.2, 0.7), at - size, at + size, 4, rng.uniform(2.0, 2.4))
    windows = []
    if not lamps or rng.random() < 0.65:
        wall = str(rng.choice(["wall_north", "wall_west", "wall_east", "wall_south"]))
        axis = 0 if wall in ("wall_west", "wall_east") else 1
        ends = (south, north) if axis == 0 else (west, east)
        width = rng.uniform(0.7, 1.8)
        start = rng.uniform(ends[0] + 0.1, max(ends[1] - 0.1 - width, ends[0] + 0.2))
        plane = {"wall_west": west, "wall_east": east, "wall_south": south, "wall_north": north}[wall]
        inwards = 1.0 if wall in ("wall_west", "wall_south") else -1.0
        near, along = plane + 0.12 * inwards, (start, start + width)
        corners = [(near, v) if axis == 0 else (v, near) for v in along]
        spread(sky, rng.uniform(0.5, 1.3), np.minimum(*corners), np.maximum(*corners), 8, 2.36)
        sun, weight = None, 0.0
        if rng.random() < 0.4:
            direction = np.zeros(3)
            direction[axis], direction[1 - axis] = -inwards, rng.uniform(-0.9, 0.9)
            direction[2] = rng.uniform(0.5, 1.3)
            sun, weight = (
                tuple((direction / np.linalg.norm(direction)).tolist()),
                float(rng.uniform(0.6, 2.0)),
            )
        up = (float(rng.uniform(0.4, 1.0)), float(rng.uniform(1.9, 2.3)))
        color = tuple((sky * rng.uniform(0.8, 1.4)).tolist())
        windows.append(Window(wall, (float(along[0]), float(along[1])), up, color, sun, weight))
    total = sum(lamp.weight for lamp in lamps)
    gain = rng.uniform(0.7, 1.35) / max(total, 1e-6)
    lamps = [replace(lamp, weight=lamp.weight * gain) for lamp in lamps]
    return Light(
        tuple(lamps), tuple(windows), float(rng.uniform(0.06, 0.34)), float(rng.uniform(0.0, 0.08)),
        float(np.exp(rng.uniform(-0.3, 0.25))),
    )  # fmt: skip


def mirrored_lamps(lamps: list) -> np.ndarray:
    """Return (k, 7) position, color times weight, size: at most 6 lamps that stand for all of them."""
    places = np.array([p for p, _, _ in lamps])
    amounts = np.array([w * np.asarray(c) for _, c, w in lamps])
    label = np.zeros(len(lamps), int)
    chosen = [int(amounts.sum(1).argmax())]
    for _ in range(5):
        away = np.min([np.linalg.norm(places - places[k], axis=1) for k in chosen], axis=0)
        if away.max() < 0.5:
            break
        chosen.append(int(away.argmax()))
    label = np.argmin([np.linalg.norm(places - places[k], axis=1) for k in chosen], axis=0)
    rows = []
    for k in range(len(chosen)):
        mine = label == k
        spread = np.linalg.norm(places[mine] - places[mine].mean(0), axis=1).mean()
        rows.append([*places[mine].mean(0), *amounts[mine].sum(0), max(float(spread), 0.05)])
    return np.array(rows)


def mirrored_windows(light: Light, vertices: np.ndarray) -> np.ndarray:
    """Return the windows as rows (n, 9) of orientation, plane, extents and color, as `paint` reads them."""
    rows = [
        [
            0.0 if w.wall in ("wall_west", "wall_east") else 1.0,
            _plane_of(w, vertices),
            *w.along,
            *w.up,
            *w.color,
        ]
        for w in light.windows
    ]
    return np.array(rows, np.float64).reshape(-1, 9)
