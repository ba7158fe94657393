"""Film a generated room: baked light, textured frames with sensor noise, true depth and instance ids.

Light is computed once per vertex from many shadow maps (lamps spread over the ceiling give soft shadows and
darken corners), so a frame costs one pass of the rasterizer and one texture lookup per sample.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from numba import njit, prange

from reconstruction.rasterize import rasterize_mesh
from reconstruction.types import Camera
from registry.geometry import invert_rigid
from synthetic.materials import Finish
from synthetic.room import WALL_HEIGHT_M, Room
from synthetic.textures import Texture

_LAMP_HEIGHT_M = 2.45
_SHADOW_BIAS_M = 0.012
_BACKGROUND = (58, 56, 54)
_NEAR_M = 1e-3
_BANDS = 6  # of a rolling shutter


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


@dataclass(frozen=True)
class FilmSet:
    """A room made ready for drawing: one mesh, one texture atlas with mip levels, light per vertex."""

    vertices: np.ndarray  # float64 (v, 3)
    faces: np.ndarray  # int32 (f, 3)
    uvs_m: np.ndarray  # float32 (v, 2)
    light: np.ndarray  # float32 (v, 3) factor on sRGB values
    face_texture: np.ndarray  # int32 (f,)
    face_entity: np.ndarray  # uint16 (f,)
    face_normal: np.ndarray  # float32 (f, 3)
    atlas: np.ndarray  # uint8 (texels, 3) all mip levels of all textures
    levels: np.ndarray  # int64 (textures, levels, 3) first texel, height, width
    texture_size: np.ndarray  # float64 (textures, 3) width_m, height_m, texels_per_m
    normals: np.ndarray  # float32 (v, 3)
    face_patch: np.ndarray  # int32 (f,) of which smooth piece of surface
    finish: np.ndarray  # float64 (textures, 2) gloss, sharpness; see `materials.Finish`
    mirrored: np.ndarray  # float64 (k, 7) lamps that glossy things show: position, color, size
    windows: np.ndarray  # float64 (k, 9) axis, plane, low and high along, low and high up, color
    box: np.ndarray  # float64 (6,) west, east, south, north, floor, ceiling: what reflections hit


def _pack_textures(looks: list[Texture]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    count = 12
    chunks, levels, start = [], np.zeros((len(looks), count, 3), np.int64), 0
    for number, look in enumerate(looks):
        image = look.pixels
        for level in range(count):
            levels[number, level] = start, image.shape[0], image.shape[1]
            chunks.append(image.reshape(-1, 3))
            start += image.shape[0] * image.shape[1]
            size = (max(image.shape[1] // 2, 1), max(image.shape[0] // 2, 1))
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA).reshape(size[1], size[0], 3)
    sizes = np.array([(t.width_m, t.height_m, t.texels_per_m) for t in looks])
    return np.concatenate(chunks), levels, sizes


def _lamps(extent: tuple[float, float, float, float]) -> list[tuple[np.ndarray, np.ndarray, float]]:
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


def _bake_light(
    vertices: np.ndarray,
    normals: np.ndarray,
    faces: np.ndarray,
    lamps: list,
    shadow_px: int,
    light_of_room: Light,
    things: np.ndarray,
) -> np.ndarray:
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


def _mirrored_lamps(lamps: list) -> np.ndarray:
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


def _mirrored_windows(light: Light, vertices: np.ndarray) -> np.ndarray:
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


def prepare(
    room: Room,
    *,
    shadow_px: int = 768,
    light: Light | None = None,
    finishes: Mapping[str, Finish] | None = None,
) -> FilmSet:
    """Gather the room's surface, pack its textures, bake its light.

    Args:
        room: The room.
        shadow_px: Size of the shadow maps.
        light: What lights it; None: as every room.
        finishes: Of textures that shine, by name; see `materials.repaint`.
    """
    light, finishes = light or Light(), finishes or {}
    names = sorted(room.textures)
    number_of = {name: i for i, name in enumerate(names)}
    patches = [(entity.id, patch) for entity in room.entities for patch in entity.patches]
    offsets = np.cumsum([0] + [len(p.vertices) for _, p in patches[:-1]])
    counts = [len(p.faces) for _, p in patches]
    vertices = np.concatenate([p.vertices for _, p in patches])
    normals = np.concatenate([p.normals for _, p in patches])
    faces = np.concatenate([p.faces + o for (_, p), o in zip(patches, offsets)]).astype(np.int32)
    corner = vertices[faces]
    face_normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    face_normal /= np.maximum(np.linalg.norm(face_normal, axis=1, keepdims=True), 1e-30)
    atlas, levels, sizes = _pack_textures([room.textures[name] for name in names])
    lamps = _lamps(room.extent)
    if light.lamps is not None:
        lamps = [(np.array(lamp.position), np.array(lamp.color), lamp.weight) for lamp in light.lamps]
    base = {entity.id for entity in room.base}
    things = np.repeat(np.array([i not in base for i, _ in patches]), counts)
    return FilmSet(
        vertices=vertices,
        faces=faces,
        uvs_m=np.concatenate([p.uvs_m for _, p in patches]).astype(np.float32),
        light=_bake_light(vertices, normals, faces, lamps, shadow_px, light, things),
        face_texture=np.repeat(np.array([number_of[p.texture] for _, p in patches], np.int32), counts),
        face_entity=np.repeat(np.array([i for i, _ in patches], np.uint16), counts),
        face_normal=face_normal.astype(np.float32),
        atlas=atlas,
        levels=levels,
        texture_size=sizes,
        normals=normals.astype(np.float32),
        face_patch=np.repeat(np.arange(len(patches), dtype=np.int32), counts),
        finish=np.array([(f.gloss, f.sharpness) for f in (finishes.get(n, Finish()) for n in names)], float),
        mirrored=_mirrored_lamps(lamps),
        windows=_mirrored_windows(light, vertices),
        box=np.array([*room.extent, 0.0, WALL_HEIGHT_M]),
    )


@njit(cache=True, inline="always")
def _sample(atlas, levels, texture, level, s, t):  # pragma: no cover - compiled
    """Bilinear lookup at (s, t) in [0, 1) of one mip level; repeats at the border; three channels."""
    start, height, width = levels[texture, level, 0], levels[texture, level, 1], levels[texture, level, 2]
    x, y = s * width - 0.5, t * height - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    ax, ay = x - x0, y - y0
    xa = x0 + width if x0 < 0 else x0
    xb = x0 + 1 - width if x0 + 1 >= width else x0 + 1
    ya = y0 + height if y0 < 0 else y0
    yb = y0 + 1 - height if y0 + 1 >= height else y0 + 1
    aa, ab = start + ya * width + xa, start + ya * width + xb
    ba, bb = start + yb * width + xa, start + yb * width + xb
    red = (1 - ay) * ((1 - ax) * atlas[aa, 0] + ax * atlas[ab, 0])
    red += ay * ((1 - ax) * atlas[ba, 0] + ax * atlas[bb, 0])
    green = (1 - ay) * ((1 - ax) * atlas[aa, 1] + ax * atlas[ab, 1])
    green += ay * ((1 - ax) * atlas[ba, 1] + ax * atlas[bb, 1])
    blue = (1 - ay) * ((1 - ax) * atlas[aa, 2] + ax * atlas[ab, 2])
    blue += ay * ((1 - ax) * atlas[ba, 2] + ax * atlas[bb, 2])
    return red, green, blue


@njit(cache=True, inline="always")
def _edge(value, low, high, soft):  # pragma: no cover - compiled
    """Return 1 between low and high, 0 outside, with borders as wide as `soft`."""
    a = min(max((value - low) / soft + 0.5, 0.0), 1.0)
    b = min(max((high - value) / soft + 0.5, 0.0), 1.0)
    return a * b


@njit(cache=True)
def _shine(at, normal, ray, gloss, sharpness, mirrored, windows, box, out):  # pragma: no cover - compiled
    """Write the light (3,) that a glossy surface sends to the camera: lamps, windows, ceiling, walls."""
    facing = -(ray[0] * normal[0] + ray[1] * normal[1] + ray[2] * normal[2])
    if facing < 0.0:  # interpolated normals may turn away at outlines
        facing = 0.0
    rx = ray[0] + 2 * facing * normal[0]
    ry = ray[1] + 2 * facing * normal[1]
    rz = ray[2] + 2 * facing * normal[2]
    bright = 0.04 + 0.10 * gloss * gloss
    fresnel = bright + (1 - bright) * (1 - facing) ** 5 * min(1.0, 0.2 + sharpness / 200.0)
    out[0] = out[1] = out[2] = 0.0
    # Where the mirrored ray leaves the room.
    way, side = 1e9, 4
    for axis in range(3):
        r = rx if axis == 0 else (ry if axis == 1 else rz)
        if abs(r) < 1e-9:
            continue
        t = (box[2 * axis + (1 if r > 0 else 0)] - at[axis]) / r
        if 0.0 < t < way:
            way, side = t, 2 * axis + (1 if r > 0 else 0)
    hz = at[2] + way * rz
    blur = 0.03 + way * 1.6 / np.sqrt(sharpness + 1.0)
    if side == 5:
        around = 0.85
    elif side == 4:
        around = 0.22
    else:
        around = 0.30 + 0.20 * hz
    for channel in range(3):
        out[channel] = fresnel * gloss * around
    for k in range(windows.shape[0]):
        axis = int(windows[k, 0])
        r = rx if axis == 0 else ry
        if abs(r) < 1e-9:
            continue
        t = (windows[k, 1] - at[axis]) / r
        if t <= 0.0 or t > way + 0.3:
            continue
        along = at[1] + t * ry if axis == 0 else at[0] + t * rx
        up = at[2] + t * rz
        share = _edge(along, windows[k, 2], windows[k, 3], blur) * _edge(
            up, windows[k, 4], windows[k, 5], blur
        )
        middle = 0.5 * (windows[k, 2] + windows[k, 3])  # the post between two panes
        share *= 1.0 - 0.6 * _edge(along, middle - 0.03, middle + 0.03, blur)
        for channel in range(3):
            out[channel] += fresnel * gloss * 4.0 * share * windows[k, 6 + channel]
    for k in range(mirrored.shape[0]):
        dx, dy, dz = mirrored[k, 0] - at[0], mirrored[k, 1] - at[1], mirrored[k, 2] - at[2]
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        cosine = (dx * rx + dy * ry + dz * rz) / distance
        if cosine <= 0.0:
            continue
        # A large or near lamp gives a large, a weak one a faint highlight.
        size = mirrored[k, 6] / distance
        power = 1.0 / (1.0 / sharpness + 0.5 * size * size)
        lobe = np.exp(-power * (1.0 - cosine)) * (power + 2.0) / 8.0 * 0.12
        for channel in range(3):
            out[channel] += fresnel * gloss * min(lobe, 60.0) * mirrored[k, 3 + channel] * 4.0


@njit(cache=True, inline="always")
def _add_shine(value, light):  # pragma: no cover - compiled
    """Add light to a value of 0..255 as the eye's scale wants it."""
    linear = (max(value, 0.0) / 255.0) ** 2.2 + light
    return 255.0 * linear ** (1 / 2.2)


@njit(cache=True, parallel=True)
def _shade(
    depth, face, bary, faces, uvs, light, face_texture, face_normal, atlas, levels, sizes,
    world_from_camera, fx, fy, cx, cy, background, normals, finish, mirrored, windows, box, out,
):  # fmt: skip  # pragma: no cover - compiled
    height, width = depth.shape
    for y in prange(height):
        extra, at = np.empty(3), np.empty(3)
        ray, normal = np.empty(3), np.empty(3)
        for x in range(width):
            f = face[y, x]
            if f < 0:
                for channel in range(3):
                    out[y, x, channel] = background[channel]
                continue
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            wa, wb, wc = bary[y, x, 0], bary[y, x, 1], bary[y, x, 2]
            texture = face_texture[f]
            s = (wa * uvs[a, 0] + wb * uvs[b, 0] + wc * uvs[c, 0]) / sizes[texture, 0]
            t = 1.0 - (wa * uvs[a, 1] + wb * uvs[b, 1] + wc * uvs[c, 1]) / sizes[texture, 1]
            s, t = s - np.floor(s), t - np.floor(t)
            # The footprint of a sample on a tilted surface decides the mip level.
            rx, ry = (x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy
            norm = np.sqrt(rx * rx + ry * ry + 1.0)
            cosine = 0.0
            for k in range(3):
                ray[k] = world_from_camera[k, 0] * rx + world_from_camera[k, 1] * ry + world_from_camera[k, 2]
                cosine -= ray[k] * face_normal[f, k] / norm
            footprint = depth[y, x] / fx / np.sqrt(max(abs(cosine), 0.08))
            wanted = min(max(np.log2(footprint * sizes[texture, 2]), 0.0), levels.shape[1] - 2.0)
            level = int(wanted)
            blend = wanted - level
            near = _sample(atlas, levels, texture, level, s, t)
            far = _sample(atlas, levels, texture, level + 1, s, t)
            for channel in range(3):
                value = (1 - blend) * near[channel]
                value += blend * far[channel]
                value *= wa * light[a, channel] + wb * light[b, channel] + wc * light[c, channel]
                out[y, x, channel] = value
            if finish[texture, 0] <= 0.0:
                continue
            length = 0.0
            for k in range(3):
                at[k] = world_from_camera[k, 3] + depth[y, x] * ray[k]
                ray[k] /= norm
                normal[k] = wa * normals[a, k] + wb * normals[b, k] + wc * normals[c, k]
                length += normal[k] * normal[k]
            normal /= np.sqrt(max(length, 1e-12))
            _shine(at, normal, ray, finish[texture, 0], finish[texture, 1], mirrored, windows, box, extra)
            for channel in range(3):
                out[y, x, channel] = _add_shine(out[y, x, channel], extra[channel])


@njit(cache=True, nogil=True)
def _fill(f, ax, ay, ai, bx, by, bi, cx, cy, ci, near, face):  # pragma: no cover - compiled
    """Draw a triangle given by its corners on the image and their 1 / z; the back side is left out."""
    height, width = face.shape
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    if area > -1e-12:
        return
    x0 = max(0, int(np.ceil(min(ax, bx, cx) - 0.5)))
    x1 = min(width - 1, int(np.floor(max(ax, bx, cx) - 0.5)))
    y0 = max(0, int(np.ceil(min(ay, by, cy) - 0.5)))
    y1 = min(height - 1, int(np.floor(max(ay, by, cy) - 0.5)))
    if x0 > x1 or y0 > y1:
        return
    inv = 1.0 / area
    for y in range(y0, y1 + 1):
        py, px = y + 0.5, x0 + 0.5
        wa = ((bx - px) * (cy - py) - (cx - px) * (by - py)) * inv
        wb = ((cx - px) * (ay - py) - (ax - px) * (cy - py)) * inv
        da, db = (by - cy) * inv, (cy - ay) * inv
        entered = False
        for x in range(x0, x1 + 1):
            wc = 1.0 - wa - wb
            if wa >= -1e-9 and wb >= -1e-9 and wc >= -1e-9:
                entered = True
                i = wa * ai + wb * bi + wc * ci
                if i > near[y, x]:
                    near[y, x] = i
                    face[y, x] = f
            elif entered:
                break
            wa += da
            wb += db


@njit(cache=True, nogil=True)
def _see(points, faces, fx, fy, cx, cy, limit, near, face):  # pragma: no cover - compiled
    """Write which face is seen where; `points` are in the camera's space."""
    count = points.shape[0]
    sx, sy, iz = np.empty(count), np.empty(count), np.empty(count)
    for k in range(count):
        z = points[k, 2]
        if z < limit:
            iz[k] = 0.0
            continue
        iz[k] = 1.0 / z
        sx[k] = fx * points[k, 0] * iz[k] + cx
        sy[k] = fy * points[k, 1] * iz[k] + cy
    px, py, pi = np.empty(4), np.empty(4), np.empty(4)
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if iz[a] > 0.0 and iz[b] > 0.0 and iz[c] > 0.0:
            _fill(f, sx[a], sy[a], iz[a], sx[b], sy[b], iz[b], sx[c], sy[c], iz[c], near, face)
            continue
        if iz[a] == 0.0 and iz[b] == 0.0 and iz[c] == 0.0:
            continue
        corners = 0
        for k in range(3):
            p, q = points[faces[f, k]], points[faces[f, (k + 1) % 3]]
            if p[2] >= limit:
                pi[corners] = 1.0 / p[2]
                px[corners], py[corners] = fx * p[0] * pi[corners] + cx, fy * p[1] * pi[corners] + cy
                corners += 1
            if (p[2] >= limit) != (q[2] >= limit):
                t = (limit - p[2]) / (q[2] - p[2])
                pi[corners] = 1.0 / limit
                px[corners] = fx * (p[0] + t * (q[0] - p[0])) / limit + cx
                py[corners] = fy * (p[1] + t * (q[1] - p[1])) / limit + cy
                corners += 1
        for k in range(1, corners - 1):
            _fill(
                f, px[0], py[0], pi[0], px[k], py[k], pi[k], px[k + 1], py[k + 1], pi[k + 1], near, face
            )  # fmt: skip


@njit(cache=True, parallel=True, fastmath=True)
def _paint(
    face, times, points, faces, uvs, light, face_texture, face_patch, atlas, levels, sizes,
    world_from_camera, fx, fy, cx, cy, background, normals, finish, mirrored, windows, box, out,
):  # fmt: skip  # pragma: no cover - compiled
    """Color every pixel from `times` x `times` samples of `face`, once per patch that they see."""
    height, width = out.shape[:2]
    samples = times * times
    for y in prange(height):
        extra, at = np.empty(3), np.empty(3)
        ray, normal = np.empty(3), np.empty(3)
        known, level, texture, a, b, c = -1, 0, 0, 0, 0, 0
        pax = pay = paz = pbx = pby = pbz = pcx = pcy = pcz = 0.0
        mx = my = mz = steep = volume = wide = high = az = bz = dz = 0.0
        for x in range(width):
            red_sum = green_sum = blue_sum = 0.0
            for sample in range(samples):
                row, column = sample // times, sample % times
                f = face[y * times + row, x * times + column]
                if f < 0:
                    red_sum += background[0]
                    green_sum += background[1]
                    blue_sum += background[2]
                    continue
                first, same = True, 1
                if samples > 1:
                    same = 0
                    for other in range(samples):
                        g = face[y * times + other // times, x * times + other % times]
                        if g == f or (g >= 0 and face_patch[g] == face_patch[f]):
                            if other < sample:
                                first = False
                                break
                            same += 1
                if not first:
                    continue
                middle = same == samples
                px = x + (0.5 if middle else (column + 0.5) / times)
                py = y + (0.5 if middle else (row + 0.5) / times)
                rx, ry = (px - cx) / fx, (py - cy) / fy
                fresh = f != known
                if fresh:
                    known = f
                    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
                    ax, ay, az = points[a, 0], points[a, 1], points[a, 2]
                    bx, by, bz = points[b, 0], points[b, 1], points[b, 2]
                    dx, dy, dz = points[c, 0], points[c, 1], points[c, 2]
                    # A corner's weight is the volume that the ray spans with the other two corners.
                    pax, pay, paz = by * dz - bz * dy, bz * dx - bx * dz, bx * dy - by * dx
                    pbx, pby, pbz = dy * az - dz * ay, dz * ax - dx * az, dx * ay - dy * ax
                    pcx, pcy, pcz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
                    volume = ax * pax + ay * pay + az * paz
                    mx, my, mz = pax + pbx + pcx, pay + pby + pcy, paz + pbz + pcz
                    steep = 1.0 / np.sqrt(max(mx * mx + my * my + mz * mz, 1e-30))
                    texture = face_texture[f]
                    wide, high = 1.0 / sizes[texture, 0], 1.0 / sizes[texture, 1]
                whole = mx * rx + my * ry + mz
                if abs(whole) < 1e-30:
                    whole = 1e-30
                inverse = 1.0 / whole
                wa = (rx * pax + ry * pay + paz) * inverse
                wb = (rx * pbx + ry * pby + pbz) * inverse
                wc = 1.0 - wa - wb
                z = volume * inverse
                if middle and (min(wa, wb, wc) < -1.0 or z <= 0.0):
                    wa = min(max(wa, 0.0), 1.0)
                    wb = min(max(wb, 0.0), 1.0 - wa)
                    wc = 1.0 - wa - wb
                    z = wa * az + wb * bz + wc * dz
                s = (wa * uvs[a, 0] + wb * uvs[b, 0] + wc * uvs[c, 0]) * wide
                t = 1.0 - (wa * uvs[a, 1] + wb * uvs[b, 1] + wc * uvs[c, 1]) * high
                s, t = s - np.floor(s), t - np.floor(t)
                if fresh or x % 4 == 0:
                    # A sample's footprint on a tilted surface decides the mip level; rows and columns take turns
                    # at rounding it up, which looks as if levels were mixed.
                    cosine = abs(whole) * steep / np.sqrt(rx * rx + ry * ry + 1.0)
                    footprint = z / fx / np.sqrt(max(cosine, 0.08)) * sizes[texture, 2]
                    wanted = np.log2(max(footprint, 1e-6)) - 0.2
                    wanted += 0.25 + 0.5 * ((x // 4 + y) % 2)
                    level = int(min(max(wanted, 0.0), levels.shape[1] - 1.0))
                red, green, blue = _sample(atlas, levels, texture, level, s, t)
                red *= wa * light[a, 0] + wb * light[b, 0] + wc * light[c, 0]
                green *= wa * light[a, 1] + wb * light[b, 1] + wc * light[c, 1]
                blue *= wa * light[a, 2] + wb * light[b, 2] + wc * light[c, 2]
                if finish[texture, 0] > 0.0:
                    norm = np.sqrt(rx * rx + ry * ry + 1.0)
                    length = 0.0
                    for k in range(3):
                        ray[k] = (
                            world_from_camera[k, 0] * rx
                            + world_from_camera[k, 1] * ry
                            + world_from_camera[k, 2]
                        )
                        at[k] = world_from_camera[k, 3] + z * ray[k]
                        ray[k] /= norm
                        normal[k] = wa * normals[a, k] + wb * normals[b, k] + wc * normals[c, k]
                        length += normal[k] * normal[k]
                    for k in range(3):
                        normal[k] /= np.sqrt(max(length, 1e-12))
                    _shine(
                        at, normal, ray, finish[texture, 0], finish[texture, 1], mirrored, windows, box, extra
                    )
                    red = _add_shine(red, extra[0])
                    green = _add_shine(green, extra[1])
                    blue = _add_shine(blue, extra[2])
                red_sum += same * red
                green_sum += same * green
                blue_sum += same * blue
                if middle:
                    break
            out[y, x, 0] = red_sum / samples
            out[y, x, 1] = green_sum / samples
            out[y, x, 2] = blue_sum / samples


def render_color(
    film_set: FilmSet,
    camera: Camera,
    world_from_camera: np.ndarray,
    supersample: int = 2,
    quick: bool = False,
) -> np.ndarray:
    """Draw one frame without noise: float32 (h, w, 3), 0..255 and beyond where overexposed.

    Args:
        film_set: The room.
        camera: The camera.
        world_from_camera: Its pose.
        supersample: Samples per pixel along each side.
        quick: Several times as fast and nearly the same picture: `supersample` smooths outlines only (textures
            are smooth by their mip levels), and back sides are left out.
    """
    pose = np.ascontiguousarray(world_from_camera, np.float64)
    shining = film_set.normals, film_set.finish, film_set.mirrored, film_set.windows, film_set.box
    background = np.array(_BACKGROUND, np.float32)
    if quick:
        points = _into_camera(film_set.vertices, invert_rigid(pose))
        large = camera.resized(camera.width * supersample, camera.height * supersample)
        face = np.full((large.height, large.width), -1, np.int32)
        near = np.zeros(face.shape, np.float32)
        _see(points, film_set.faces, large.fx, large.fy, large.cx, large.cy, _NEAR_M, near, face)
        out = np.empty((camera.height, camera.width, 3), np.float32)
        _paint(
            face, supersample, points, film_set.faces, film_set.uvs_m, film_set.light, film_set.face_texture,
            film_set.face_patch, film_set.atlas, film_set.levels, film_set.texture_size, pose,
            camera.fx, camera.fy, camera.cx, camera.cy, background, *shining, out,
        )  # fmt: skip
        return out
    large = camera.resized(camera.width * supersample, camera.height * supersample)
    raster = rasterize_mesh(film_set.vertices, film_set.faces, large, world_from_camera)
    out = np.empty((large.height, large.width, 3), np.float32)
    _shade(
        raster.depth, raster.face, raster.barycentric, film_set.faces, film_set.uvs_m, film_set.light,
        film_set.face_texture, film_set.face_normal, film_set.atlas, film_set.levels, film_set.texture_size,
        pose, large.fx, large.fy, large.cx, large.cy, background, *shining, out,
    )  # fmt: skip
    return (
        cv2.resize(out, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        if supersample > 1
        else out
    )


@njit(cache=True, nogil=True)
def _into_camera(vertices, camera_from_world):  # pragma: no cover - compiled
    out = np.empty_like(vertices)
    m = camera_from_world
    for i in range(len(vertices)):
        x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        for k in range(3):
            out[i, k] = m[k, 0] * x + m[k, 1] * y + m[k, 2] * z + m[k, 3]
    return out


def render_truth(
    film_set: FilmSet, camera: Camera, world_from_camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return true z-depth float32 (h, w) in metres (0 = nothing) and true entity ids uint16 (h, w)."""
    raster = rasterize_mesh(film_set.vertices, film_set.faces, camera, world_from_camera)
    ids = np.where(raster.face >= 0, film_set.face_entity[np.maximum(raster.face, 0)], 0).astype(np.uint16)
    return raster.depth, ids


@dataclass(frozen=True)
class Sensor:
    """What a phone does to light.

    The truth of a frame (`render_truth`) is that of its pose: the first moment of a blurred exposure, the middle
    row of a rolling shutter. Other moments and rows differ by the little that the camera moves meanwhile.
    """

    noise: float = 1.6
    """Standard deviation of the noise, in 8-bit steps."""
    exposure_drift: float = 0.06
    """Amplitude of the slow change of exposure, relative."""
    blur_shutter: float = 0.0
    """Share of the time between two frames that the shutter is open; 0 draws sharp frames."""
    blur_samples: int = 3
    """Positions along the motion that a blurred frame averages."""
    blur_jitter: bool = False
    """Draw each of those positions unsupersampled, shifted by its share of a pixel: as smooth, and much faster."""
    rolling_shutter: float = 0.0
    """Share of the time between two frames that passes from the first to the last row."""
    exposure: float = 1.0
    """Factor on all light."""
    exposure_mean: float = 0.0
    """Level (0..255) that the camera turns the mean of its frames to, with some delay; 0: it does not."""
    exposure_steps: float = 0.0
    """Size of sudden changes of exposure, a few in a film, relative."""
    clip_level: float = 255.0
    """What is brighter than this becomes white; below 255: overexposed."""
    vignetting: float = 0.0
    """Share of the light that is lost in the corners."""
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors on red, green and blue."""
    white_drift: float = 0.0
    """Amplitude of the slow change between warm and cool, relative."""
    gamma: float = 1.0
    """Power of the values; below 1 lifts shadows."""
    contrast: float = 0.0
    """Share of an S-shaped curve; below 0 flattens."""
    saturation: float = 1.0
    """Factor on colorfulness."""
    defocus_px: float = 0.0
    """Standard deviation of the blur of the lens."""
    sharpening: float = 0.0
    """Strength of the edges' exaggeration by the camera's software."""
    shot_noise: float = 0.0
    """Noise at full brightness that grows with the square root of the signal, in 8-bit steps."""
    chroma_noise: float = 0.0
    """Blotchy noise of color, in 8-bit steps."""
    noise_grain_px: float = 0.0
    """How far all noise is smeared; its strength stays."""
    jpeg_quality: int | None = None
    """Pack every frame at this quality (1..100); None: not at all."""


def draw_sensor(rng: np.random.Generator) -> Sensor:
    """Draw a phone and how well it is used: from nearly perfect to dim, noisy and badly packed."""

    def sometimes(share: float, low: float, high: float) -> float:
        return float(rng.uniform(low, high)) if rng.random() < share else 0.0

    bad = float(rng.uniform(0, 1)) ** 2
    warm = float(rng.normal(0, 0.05))
    blurred = sometimes(0.4, 0.1, 0.6)
    return Sensor(
        noise=float(rng.uniform(0.3, 1.5 + 4 * bad)),
        exposure_drift=float(rng.uniform(0, 0.08)),
        blur_shutter=blurred,
        blur_samples=3,
        blur_jitter=True,
        rolling_shutter=sometimes(0.25, 0.1, 0.5),
        exposure_mean=float(rng.uniform(75, 150)),
        exposure_steps=sometimes(0.2, 0.03, 0.15),
        clip_level=float(rng.uniform(190, 255)) if rng.random() < 0.3 else 255.0,
        vignetting=sometimes(0.6, 0.02, 0.35),
        white_balance=(1 + warm, 1 + float(rng.normal(0, 0.02)), 1 - warm),
        white_drift=sometimes(0.4, 0.01, 0.05),
        gamma=float(np.exp(rng.normal(0, 0.16))),
        contrast=float(rng.uniform(-0.25, 0.6)),
        saturation=float(rng.uniform(0.6, 1.35)),
        defocus_px=sometimes(0.6, 0.3, 0.8 + 0.8 * bad),
        sharpening=sometimes(0.4, 0.1, 0.9),
        shot_noise=float(rng.uniform(0, 2 + 6 * bad)),
        chroma_noise=sometimes(0.5, 0.3, 1 + 3 * bad),
        noise_grain_px=sometimes(0.6, 0.4, 1.0),
        jpeg_quality=int(rng.integers(35, 96)) if rng.random() < 0.8 else None,
    )


def film_room(
    film_set: FilmSet,
    camera: Camera,
    world_from_camera: np.ndarray,
    sensor: Sensor | None = None,
    *,
    seed: int = 0,
    supersample: int = 2,
    quick: bool = False,
) -> np.ndarray:
    """Film along a path (n, 4, 4); uint8 (n, h, w, 3)."""
    frames = iterate_film(
        film_set, camera, world_from_camera, sensor, seed=seed, supersample=supersample, quick=quick
    )
    return np.stack(list(frames))


def iterate_film(
    film_set: FilmSet,
    camera: Camera,
    world_from_camera: np.ndarray,
    sensor: Sensor | None = None,
    *,
    seed: int = 0,
    supersample: int = 2,
    quick: bool = False,
):
    """Yield one frame after the other, so that long films need little memory; `quick` as in `render_color`."""
    sensor = sensor or Sensor()
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * np.pi)
    count = len(world_from_camera)
    electronics = _Electronics(sensor, count, seed)
    for number in range(count):
        image = _expose(film_set, camera, world_from_camera, number, sensor, supersample, quick)
        gain = 1 + sensor.exposure_drift * np.sin(phase + 2 * np.pi * 1.3 * number / max(count, 1))
        image = electronics.develop(image * (np.float32(gain) if quick else gain), number)
        if quick:
            image = electronics.noisy(image, sensor.noise)
        else:
            image = electronics.noisy(image, 0.0)
            image = image + sensor.noise * rng.standard_normal(image.shape, np.float32)
        yield electronics.packed(np.clip(image + 0.5, 0, 255).astype(np.uint8))


def _expose(
    film_set: FilmSet,
    camera: Camera,
    world_from_camera: np.ndarray,
    number: int,
    sensor: Sensor,
    supersample: int,
    quick: bool,
) -> np.ndarray:
    """Draw a frame as the shutter sees it, moving and row by row, without noise."""
    last = len(world_from_camera) - 1
    pose, following = world_from_camera[number], world_from_camera[min(number + 1, last)]
    if sensor.rolling_shutter <= 0:
        return _open_shutter(film_set, camera, pose, following, 0.0, sensor, supersample, quick)
    edges = np.linspace(0, camera.height, _BANDS + 1).astype(int)
    bands = []
    for top, bottom in pairwise(edges):
        lens = replace(camera, height=int(bottom - top), cy=camera.cy - int(top))
        late = sensor.rolling_shutter * ((top + bottom) / 2 / camera.height - 0.5)
        start, end, share = pose, following, late
        if late < 0 < number:  # before the first and after the last frame the motion goes on
            start, end, share = world_from_camera[number - 1], pose, 1 + late
        elif number == last and last > 0:
            start, end, share = world_from_camera[last - 1], pose, 1 + late
        bands.append(_open_shutter(film_set, lens, start, end, share, sensor, supersample, quick))
    return np.concatenate(bands)


def _open_shutter(
    film_set: FilmSet,
    camera: Camera,
    start: np.ndarray,
    end: np.ndarray,
    share: float,
    sensor: Sensor,
    supersample: int,
    quick: bool,
) -> np.ndarray:
    if sensor.blur_shutter <= 0:
        pose = start if share == 0.0 else _between(start, end, share)
        return render_color(film_set, camera, pose, supersample, quick)
    shares = share + np.linspace(0, sensor.blur_shutter, sensor.blur_samples)
    shots = [(_between(start, end, s), *_shot(camera, k, sensor, supersample)) for k, s in enumerate(shares)]
    pictures = [render_color(film_set, lens, at, times, quick) for at, lens, times in shots]
    return np.mean(pictures, axis=0)


@njit(cache=True, parallel=True)
def _toned(image, factor, shading, table, saturation, out):  # pragma: no cover - compiled
    """Shade, weight the colors, look the curve up (with more steps than are seen) and saturate."""
    steps = (len(table) - 1) / 255.0
    for y in prange(image.shape[0]):
        for x in range(image.shape[1]):
            mean = 0.0
            for k in range(3):
                value = image[y, x, k] * factor[k] * shading[y, x]
                value = table[int(min(max(value, 0.0), 255.0) * steps + 0.5)]
                out[y, x, k] = value
                mean += value / 3
            for k in range(3):
                out[y, x, k] = mean + saturation * (out[y, x, k] - mean)


@njit(cache=True, parallel=True)
def _add_noise(image, field, row, sign, noise, shot, out):  # pragma: no cover - compiled
    """Add noise whose variance grows with the signal."""
    for y in prange(image.shape[0]):
        for x in range(image.shape[1]):
            for k in range(3):
                signal = min(max(image[y, x, k], 0.0), 255.0) / 255.0
                strength = sign * np.sqrt(noise * noise + shot * shot * signal)
                out[y, x, k] = image[y, x, k] + strength * field[y + row, x, k]


class _Electronics:
    """What happens to a frame after the lens; a neutral `Sensor` changes nothing."""

    def __init__(self, sensor: Sensor, count: int, seed: int) -> None:
        self.sensor = sensor
        self.rng = np.random.default_rng([seed, 79])  # its own stream: the old noise stays as it is
        self.count = max(count, 1)
        self.phase = float(self.rng.uniform(0, 2 * np.pi))
        jumps = self.rng.uniform(0, 1, 3)
        steps = self.rng.choice([-1.0, 1.0], 3) * sensor.exposure_steps
        self.jumps = [(float(at), float(step)) for at, step in zip(jumps, steps)]
        self.gain = 0.0
        self.shading: np.ndarray | None = None
        self.field: np.ndarray | None = None
        level = np.linspace(0, 1, 4096)
        curve = level**sensor.gamma
        curve = curve + sensor.contrast * (curve * curve * (3 - 2 * curve) - curve)
        self.table = (255 * curve).astype(np.float32)

    def develop(self, image: np.ndarray, number: int) -> np.ndarray:
        """Apply lens shading, exposure, colors, curves, blur and sharpening to values of 0..255."""
        s = self.sensor
        t = number / self.count
        gain = s.exposure
        if s.exposure_mean > 0:
            wanted = s.exposure_mean / max(float(np.minimum(image[::4, ::4], 255).mean()), 1.0)
            wanted = float(np.clip(wanted, 0.4, 3.0))
            self.gain = wanted if self.gain == 0.0 else self.gain + 0.15 * (wanted - self.gain)
            gain *= self.gain
        for at, step in self.jumps:
            gain *= 1 + step if t > at else 1.0
        factor = np.array(s.white_balance, np.float32) * np.float32(gain * 255.0 / s.clip_level)
        if s.white_drift > 0:
            swing = s.white_drift * np.sin(self.phase + 2 * np.pi * 0.8 * t)
            factor = factor * np.array([1 + swing, 1.0, 1 - swing], np.float32)
        if s.defocus_px > 0:
            image = cv2.GaussianBlur(np.minimum(image, 400.0).astype(np.float32), (0, 0), s.defocus_px)
        curved = s.gamma != 1.0 or s.contrast != 0.0 or s.saturation != 1.0
        if curved or s.vignetting > 0:
            out = np.empty(image.shape, np.float32)
            _toned(
                image,
                factor.astype(np.float32),
                self._vignette(image.shape[:2]),
                self.table,
                s.saturation,
                out,
            )
            image = out
        elif np.any(factor != 1.0):
            image = image * factor
        if s.sharpening > 0:
            image = np.clip(image, 0, 255)
            image = cv2.addWeighted(
                image, 1 + s.sharpening, cv2.GaussianBlur(image, (0, 0), 1.2), -s.sharpening, 0
            )
        return image

    def _vignette(self, shape: tuple[int, int]) -> np.ndarray:
        if self.shading is None or self.shading.shape[:2] != shape:
            y, x = np.mgrid[-1 : 1 : shape[0] * 1j, -1 : 1 : shape[1] * 1j]
            self.shading = (1 - self.sensor.vignetting * ((x * x + y * y) / 2) ** 1.5).astype(np.float32)
        return self.shading

    def noisy(self, image: np.ndarray, noise: float) -> np.ndarray:
        """Add noise of even strength, that of the light and that of color; one field is used again and again."""
        s = self.sensor
        if noise <= 0 and s.shot_noise <= 0 and s.chroma_noise <= 0:
            return image
        height, width = image.shape[:2]
        if self.field is None or self.field.shape[1] != width:
            self.field = self._noise_field((height + 128, width, 3))
        row = int(self.rng.integers(129))
        sign = float(self.rng.choice([-1.0, 1.0]))
        out = np.empty(image.shape, np.float32)
        _add_noise(image, self.field, row, sign, noise, s.shot_noise, out)
        if s.chroma_noise > 0:
            small = self.rng.standard_normal((height // 3 + 1, width // 3 + 1, 3), np.float32)
            small -= small.mean(2, keepdims=True)
            small *= np.float32(1.6 * s.chroma_noise)
            out += cv2.resize(small, (width, height))
        return out

    def _noise_field(self, shape: tuple[int, int, int]) -> np.ndarray:
        """Return noise of variance 1, smeared over its neighbors where the sensor says so."""
        noise = self.rng.standard_normal(shape, np.float32)
        if self.sensor.noise_grain_px > 0:
            noise = cv2.GaussianBlur(noise, (0, 0), self.sensor.noise_grain_px)
            noise /= noise.std()
        return noise

    def packed(self, frame: np.ndarray) -> np.ndarray:
        """Pack and unpack a frame."""
        if self.sensor.jpeg_quality is None:
            return frame
        options = [cv2.IMWRITE_JPEG_QUALITY, int(self.sensor.jpeg_quality)]
        ok, data = cv2.imencode(".jpg", frame[..., ::-1], options)
        assert ok, "OpenCV packs every frame"
        return np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])


def _shot(camera: Camera, number: int, sensor: Sensor, supersample: int) -> tuple[Camera, int]:
    """Return camera and supersampling of one of the pictures that make a blurred frame."""
    if not sensor.blur_jitter:
        return camera, supersample
    # A lattice of rank 1 spreads any number of samples over the pixel; together they must not shift the frame.
    order = np.arange(sensor.blur_samples)
    x, y = (order + 0.5) / len(order) - 0.5, order * 0.618034 % 1.0
    y = y - y.mean()
    return replace(camera, cx=camera.cx + float(x[number]), cy=camera.cy + float(y[number])), 1


def _between(a: np.ndarray, b: np.ndarray, share: float) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    step = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).as_rotvec()
    out = np.eye(4)
    out[:3, :3] = a[:3, :3] @ Rotation.from_rotvec(share * step).as_matrix()
    out[:3, 3] = (1 - share) * a[:3, 3] + share * b[:3, 3]
    return out


def look_at(position: np.ndarray, target: np.ndarray, roll_rad: float = 0.0) -> np.ndarray:
    """Return world_from_camera (OpenCV axes) of an upright camera at `position` that looks at `target`."""
    forward = np.asarray(target, float) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    out = np.eye(4)
    out[:3, :3] = np.stack([right, down, forward], axis=1)
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    out[:3, :3] = out[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    out[:3, 3] = position
    return out


def handheld_path(
    n_frames: int, *, seed: int = 0, arc_deg: float = 136.0, middle_deg: float = -88.0,
    radius_m: float = 1.42, height_m: float = 1.38,
    target: tuple[float, float, float] = (0.02, 0.08, 0.56), shake: float = 1.0,
) -> np.ndarray:  # fmt: skip
    """Walk an arc around the table as a person does: (n, 4, 4) world_from_camera.

    Slow sways of radius, height and aim, steps at walking pace and a small tremor, all scaled by `shake`.
    """
    rng = np.random.default_rng([seed, 77])
    t = np.linspace(0, 1, n_frames)

    def sway(amplitude: float, cycles: tuple[float, ...]) -> np.ndarray:
        waves = [
            rng.uniform(0.5, 1.0) / (k + 1) * np.sin(2 * np.pi * (c * t + rng.uniform()))
            for k, c in enumerate(cycles)
        ]
        return shake * amplitude * np.sum(waves, axis=0)

    def tremor(amplitude: float) -> np.ndarray:
        noise = rng.standard_normal(n_frames + 4)
        return shake * amplitude * np.convolve(noise, np.ones(5) / 5, "valid")

    ease = t + 0.018 * np.sin(2 * np.pi * 2 * t)
    angle = np.radians(middle_deg + arc_deg * (ease - 0.5))
    radius = radius_m + sway(0.10, (0.9, 2.1))
    x = target[0] + radius * np.cos(angle) + tremor(0.003)
    y = target[1] + radius * np.sin(angle) + tremor(0.003)
    z = height_m + sway(0.08, (0.8, 1.7)) + sway(0.008, (9.0,)) + tremor(0.003)
    aim = np.array(target) + np.stack(
        [sway(0.09, (1.1, 2.3)), sway(0.06, (1.4, 2.9)), sway(0.09, (1.0, 1.9))], -1
    )
    aim += np.stack([tremor(0.006) for _ in range(3)], -1)
    roll = np.radians(sway(1.5, (1.2, 3.1)) + tremor(0.2))
    return np.stack([look_at(np.array(p), a, r) for p, a, r in zip(np.stack([x, y, z], -1), aim, roll)])


def pan_path(
    n_frames: int, *, arc_deg: float = 90.0, position: tuple[float, float, float] = (0.0, -1.6, 1.4)
) -> np.ndarray:
    """Turn on the spot, without any parallax: (n, 4, 4)."""
    angles = np.radians(90 + arc_deg * np.linspace(-0.5, 0.5, n_frames))
    at = np.array(position)
    return np.stack([look_at(at, at + np.array([np.cos(a), np.sin(a), -0.4])) for a in angles])


def phone_camera(width: int, height: int, fov_deg: float = 62.0) -> Camera:
    """Return a camera whose longer side spans `fov_deg`."""
    focal = max(width, height) / 2 / np.tan(np.radians(fov_deg) / 2)
    return Camera(width, height, focal, focal, width / 2, height / 2)
