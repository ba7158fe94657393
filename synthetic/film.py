"""Film a generated room: baked light, textured frames with sensor noise, true depth and instance ids.

Light is computed once per vertex from many shadow maps (lamps spread over the ceiling give soft shadows and
darken corners), so a frame costs one pass of the rasterizer and one texture lookup per sample.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import njit, prange

from reconstruction.rasterize import rasterize_mesh
from reconstruction.types import Camera
from synthetic.room import Room
from synthetic.textures import Texture

_LAMP_HEIGHT_M = 2.45
_SHADOW_BIAS_M = 0.012
_BACKGROUND = (58, 56, 54)


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
    vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, lamps: list, shadow_px: int
) -> np.ndarray:
    focal = shadow_px / 2 / np.tan(np.radians(62))
    camera = Camera(shadow_px, shadow_px, focal, focal, shadow_px / 2, shadow_px / 2)
    # A little light from everywhere, more from above, stands for all further bounces.
    light = np.repeat((0.16 + 0.06 * normals[:, 2:3]), 3, axis=1)
    for position, color, weight in lamps:
        world_from_camera = np.eye(4)
        world_from_camera[:3, :3] = np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1.0]])
        world_from_camera[:3, 3] = position
        depth = rasterize_mesh(vertices, faces, camera, world_from_camera).depth
        _add_light(
            vertices, normals, position, weight * color, focal, shadow_px, depth, _SHADOW_BIAS_M, light
        )
    return np.clip(light, 0.0, 2.0).astype(np.float32) ** np.float32(1 / 2.2)


def prepare(room: Room, *, shadow_px: int = 768) -> FilmSet:
    """Gather the room's surface, pack its textures, bake its light."""
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
    return FilmSet(
        vertices=vertices,
        faces=faces,
        uvs_m=np.concatenate([p.uvs_m for _, p in patches]).astype(np.float32),
        light=_bake_light(vertices, normals, faces, _lamps(room.extent), shadow_px),
        face_texture=np.repeat(np.array([number_of[p.texture] for _, p in patches], np.int32), counts),
        face_entity=np.repeat(np.array([i for i, _ in patches], np.uint16), counts),
        face_normal=face_normal.astype(np.float32),
        atlas=atlas,
        levels=levels,
        texture_size=sizes,
    )


@njit(cache=True, inline="always")
def _sample(atlas, levels, texture, level, s, t, channel):  # pragma: no cover - compiled
    """Bilinear lookup at (s, t) in [0, 1) of one mip level; repeats at the border."""
    start, height, width = levels[texture, level, 0], levels[texture, level, 1], levels[texture, level, 2]
    x, y = s * width - 0.5, t * height - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    ax, ay = x - x0, y - y0
    xa, xb = x0 % width, (x0 + 1) % width
    ya, yb = y0 % height, (y0 + 1) % height
    top = (1 - ax) * atlas[start + ya * width + xa, channel] + ax * atlas[start + ya * width + xb, channel]
    low = (1 - ax) * atlas[start + yb * width + xa, channel] + ax * atlas[start + yb * width + xb, channel]
    return (1 - ay) * top + ay * low


@njit(cache=True, parallel=True)
def _shade(
    depth, face, bary, faces, uvs, light, face_texture, face_normal, atlas, levels, sizes,
    world_from_camera, fx, fy, cx, cy, background, out,
):  # fmt: skip  # pragma: no cover - compiled
    height, width = depth.shape
    for y in prange(height):
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
                ray = world_from_camera[k, 0] * rx + world_from_camera[k, 1] * ry + world_from_camera[k, 2]
                cosine -= ray * face_normal[f, k] / norm
            footprint = depth[y, x] / fx / np.sqrt(max(abs(cosine), 0.08))
            wanted = min(max(np.log2(footprint * sizes[texture, 2]), 0.0), levels.shape[1] - 2.0)
            level = int(wanted)
            blend = wanted - level
            for channel in range(3):
                value = (1 - blend) * _sample(atlas, levels, texture, level, s, t, channel)
                value += blend * _sample(atlas, levels, texture, level + 1, s, t, channel)
                value *= wa * light[a, channel] + wb * light[b, channel] + wc * light[c, channel]
                out[y, x, channel] = value


def render_color(
    film_set: FilmSet, camera: Camera, world_from_camera: np.ndarray, supersample: int = 2
) -> np.ndarray:
    """Draw one frame without noise: float32 (h, w, 3), 0..255 and beyond where overexposed."""
    large = camera.resized(camera.width * supersample, camera.height * supersample)
    raster = rasterize_mesh(film_set.vertices, film_set.faces, large, world_from_camera)
    out = np.empty((large.height, large.width, 3), np.float32)
    _shade(
        raster.depth, raster.face, raster.barycentric, film_set.faces, film_set.uvs_m, film_set.light,
        film_set.face_texture, film_set.face_normal, film_set.atlas, film_set.levels, film_set.texture_size,
        np.ascontiguousarray(world_from_camera), large.fx, large.fy, large.cx, large.cy,
        np.array(_BACKGROUND, np.float32), out,
    )  # fmt: skip
    return (
        cv2.resize(out, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        if supersample > 1
        else out
    )


def render_truth(
    film_set: FilmSet, camera: Camera, world_from_camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return true z-depth float32 (h, w) in metres (0 = nothing) and true entity ids uint16 (h, w)."""
    raster = rasterize_mesh(film_set.vertices, film_set.faces, camera, world_from_camera)
    ids = np.where(raster.face >= 0, film_set.face_entity[np.maximum(raster.face, 0)], 0).astype(np.uint16)
    return raster.depth, ids


@dataclass(frozen=True)
class Sensor:
    """What a phone does to light."""

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


def film_room(
    film_set: FilmSet,
    camera: Camera,
    world_from_camera: np.ndarray,
    sensor: Sensor | None = None,
    *,
    seed: int = 0,
    supersample: int = 2,
) -> np.ndarray:
    """Film along a path (n, 4, 4); uint8 (n, h, w, 3)."""
    return np.stack(
        list(iterate_film(film_set, camera, world_from_camera, sensor, seed=seed, supersample=supersample))
    )


def iterate_film(
    film_set: FilmSet,
    camera: Camera,
    world_from_camera: np.ndarray,
    sensor: Sensor | None = None,
    *,
    seed: int = 0,
    supersample: int = 2,
):
    """Yield one frame after the other, so that long films need little memory."""
    sensor = sensor or Sensor()
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 2 * np.pi)
    count = len(world_from_camera)
    for number, pose in enumerate(world_from_camera):
        if sensor.blur_shutter > 0:
            other = world_from_camera[min(number + 1, count - 1)]
            shares = np.linspace(0, sensor.blur_shutter, sensor.blur_samples)
            shots = [
                (_between(pose, other, s), *_shot(camera, k, sensor, supersample))
                for k, s in enumerate(shares)
            ]
            image = np.mean([render_color(film_set, lens, at, times) for at, lens, times in shots], axis=0)
        else:
            image = render_color(film_set, camera, pose, supersample)
        gain = 1 + sensor.exposure_drift * np.sin(phase + 2 * np.pi * 1.3 * number / max(count, 1))
        image = image * gain + sensor.noise * rng.standard_normal(image.shape, np.float32)
        yield np.clip(image + 0.5, 0, 255).astype(np.uint8)


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
