"""Film a generated room: baked light, textured frames with sensor noise, true depth and instance ids.

Light is computed once per vertex (`lighting`), so a frame costs one pass of the rasterizer and one texture lookup
per sample (`shading`); what the phone makes of it is in `sensor`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera
from registry.geometry import invert_rigid
from synthetic.lighting import Light, bake_light, mirrored_lamps, mirrored_windows, usual_lamps
from synthetic.materials import Finish
from synthetic.mirrors import GLASS, Mirror, reflected_points
from synthetic.room import WALL_HEIGHT_M, Room
from synthetic.sensor import Electronics, Sensor, expose
from synthetic.shading import into_camera, paint, see, shade
from synthetic.textures import Texture

_BACKGROUND = (58, 56, 54)
_NEAR_M = 1e-3


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
    background: tuple[float, float, float] = _BACKGROUND  # color where nothing stands, 0 to 255
    mirror: Mirror | None = None


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


def prepare(
    room: Room,
    *,
    shadow_px: int = 768,
    light: Light | None = None,
    finishes: Mapping[str, Finish] | None = None,
    background: tuple[float, float, float] = _BACKGROUND,
    mirror: np.ndarray | None = None,
) -> FilmSet:
    """Gather the room's surface, pack its textures, bake its light.

    Args:
        room: The room.
        shadow_px: Size of the shadow maps.
        light: What lights it; None: as every room.
        finishes: Of textures that shine, by name; see `materials.repaint`.
        background: Color where nothing stands, 0 to 255.
        mirror: Plane (4,) of `mirrors.GLASS`, which reflects the room; None: no mirror.
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
    lamps = usual_lamps(room.extent)
    if light.lamps is not None:
        lamps = [(np.array(lamp.position), np.array(lamp.color), lamp.weight) for lamp in light.lamps]
    base = {entity.id for entity in room.base}
    things = np.repeat(np.array([i not in base for i, _ in patches]), counts)
    return FilmSet(
        vertices=vertices,
        faces=faces,
        uvs_m=np.concatenate([p.uvs_m for _, p in patches]).astype(np.float32),
        light=bake_light(vertices, normals, faces, lamps, shadow_px, light, things),
        face_texture=np.repeat(np.array([number_of[p.texture] for _, p in patches], np.int32), counts),
        face_entity=np.repeat(np.array([i for i, _ in patches], np.uint16), counts),
        face_normal=face_normal.astype(np.float32),
        atlas=atlas,
        levels=levels,
        texture_size=sizes,
        normals=normals.astype(np.float32),
        face_patch=np.repeat(np.arange(len(patches), dtype=np.int32), counts),
        finish=np.array([(f.gloss, f.sharpness) for f in (finishes.get(n, Finish()) for n in names)], float),
        mirrored=mirrored_lamps(lamps),
        windows=mirrored_windows(light, vertices),
        box=np.array([*room.extent, 0.0, WALL_HEIGHT_M]),
        background=background,
        mirror=None if mirror is None else Mirror(number_of[GLASS], mirror),
    )


def reflected(film_set: FilmSet) -> FilmSet:
    """Return the image of a film set in its mirror: what stands before the mirror, behind it."""
    mirror = film_set.mirror
    assert mirror is not None
    before = film_set.vertices @ mirror.plane[:3] + mirror.plane[3] > 1e-3
    kept = before[film_set.faces].all(axis=1)
    flip = (np.eye(3) - 2 * np.outer(mirror.plane[:3], mirror.plane[:3])).astype(np.float32)
    return replace(
        film_set,
        vertices=reflected_points(mirror.plane, film_set.vertices),
        normals=film_set.normals @ flip,
        faces=np.ascontiguousarray(film_set.faces[kept][:, ::-1]),
        face_texture=film_set.face_texture[kept],
        face_entity=film_set.face_entity[kept],
        face_normal=film_set.face_normal[kept] @ flip,
        face_patch=film_set.face_patch[kept],
        mirror=None,
    )


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
    if film_set.mirror is not None:
        return _with_reflection(film_set, camera, world_from_camera, supersample, quick)
    pose = np.ascontiguousarray(world_from_camera, np.float64)
    shining = film_set.normals, film_set.finish, film_set.mirrored, film_set.windows, film_set.box
    background = np.array(film_set.background, np.float32)
    if quick:
        points = into_camera(film_set.vertices, invert_rigid(pose))
        large = camera.resized(camera.width * supersample, camera.height * supersample)
        face = np.full((large.height, large.width), -1, np.int32)
        near = np.zeros(face.shape, np.float32)
        see(points, film_set.faces, large.fx, large.fy, large.cx, large.cy, _NEAR_M, near, face)
        out = np.empty((camera.height, camera.width, 3), np.float32)
        paint(
            face, supersample, points, film_set.faces, film_set.uvs_m, film_set.light, film_set.face_texture,
            film_set.face_patch, film_set.atlas, film_set.levels, film_set.texture_size, pose,
            camera.fx, camera.fy, camera.cx, camera.cy, background, *shining, out,
        )  # fmt: skip
        return out
    large = camera.resized(camera.width * supersample, camera.height * supersample)
    raster = rasterize_mesh(film_set.vertices, film_set.faces, large, world_from_camera)
    out = np.empty((large.height, large.width, 3), np.float32)
    shade(
        raster.depth, raster.face, raster.barycentric, film_set.faces, film_set.uvs_m, film_set.light,
        film_set.face_texture, film_set.face_normal, film_set.atlas, film_set.levels, film_set.texture_size,
        pose, large.fx, large.fy, large.cx, large.cy, background, *shining, out,
    )  # fmt: skip
    return (
        cv2.resize(out, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        if supersample > 1
        else out
    )


def _with_reflection(
    film_set: FilmSet, camera: Camera, world_from_camera: np.ndarray, supersample: int, quick: bool
) -> np.ndarray:
    """Draw a frame, and the reflected room over the pixels of the mirror."""
    mirror = film_set.mirror
    assert mirror is not None
    color = render_color(replace(film_set, mirror=None), camera, world_from_camera, supersample, quick)
    large = camera.resized(camera.width * supersample, camera.height * supersample)
    face = rasterize_mesh(film_set.vertices, film_set.faces, large, world_from_camera).face
    glass = (face >= 0) & (film_set.face_texture[np.maximum(face, 0)] == mirror.texture)
    if not glass.any():
        return color
    share = cv2.resize(glass.astype(np.float32), (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    image = render_color(reflected(film_set), camera, world_from_camera, supersample, quick)
    return color + share[..., None] * (image - color)


def render_truth(
    film_set: FilmSet, camera: Camera, world_from_camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return true z-depth float32 (h, w) in metres (0 = nothing) and true entity ids uint16 (h, w)."""
    raster = rasterize_mesh(film_set.vertices, film_set.faces, camera, world_from_camera)
    ids = np.where(raster.face >= 0, film_set.face_entity[np.maximum(raster.face, 0)], 0).astype(np.uint16)
    return raster.depth, ids


def render_stereo_depth(film_set: FilmSet, camera: Camera, world_from_camera: np.ndarray) -> np.ndarray:
    """Return the z-depth float32 (h, w) that stereo sees: the true one, and behind a mirror that of its image."""
    depth, _ = render_truth(film_set, camera, world_from_camera)
    if film_set.mirror is None:
        return depth
    face = rasterize_mesh(film_set.vertices, film_set.faces, camera, world_from_camera).face
    glass = (face >= 0) & (film_set.face_texture[np.maximum(face, 0)] == film_set.mirror.texture)
    image, _ = render_truth(reflected(film_set), camera, world_from_camera)
    return np.where(glass, image, depth)


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
    electronics = Electronics(sensor, count, seed)

    def draw(lens: Camera, pose: np.ndarray, times: int) -> np.ndarray:
        return render_color(film_set, lens, pose, times, quick)

    for number in range(count):
        image = expose(draw, camera, world_from_camera, number, sensor, supersample)
        gain = 1 + sensor.exposure_drift * np.sin(phase + 2 * np.pi * 1.3 * number / max(count, 1))
        image = electronics.develop(image * (np.float32(gain) if quick else gain), number)
        if quick:
            image = electronics.noisy(image, sensor.noise)
        else:
            image = electronics.noisy(image, 0.0)
            image = image + sensor.noise * rng.standard_normal(image.shape, np.float32)
        yield electronics.packed(np.clip(image + 0.5, 0, 255).astype(np.uint8))
