"""Texture coordinates, and colours baked from the frames that see each texel best.

Every texel is looked up in the chosen frames where the object's own mesh does not hide it and the instance map says
that the pixel is the object's. Frames are brought to one exposure, the best few colours are blended, unseen texels
take colours from the nearest seen surface.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.views import ScenePixels
from reconstruction.rasterize import rasterize_mesh
from reconstruction.types import Camera, PosedFrames, TexturedMesh
from registry.geometry import invert_rigid, transform_points

_BEST = 3  # colours blended per texel


@dataclass(frozen=True)
class Texels:
    """The texels that a mesh uses, with their places on it."""

    rows: np.ndarray  # int32 (t,)
    columns: np.ndarray  # int32 (t,)
    points: np.ndarray  # float64 (t, 3)
    normals: np.ndarray  # float64 (t, 3)


@dataclass(frozen=True)
class Baked:
    """A texture and where it came from."""

    texture: np.ndarray  # uint8 (s, s, 3), row 0 at v = 1
    seen_share: float  # of the mesh's area
    frames: np.ndarray  # int32 (k,) frame rows, best first
    mean_rgb: np.ndarray  # float64 (3,) of what was seen


def unwrap(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut a mesh into charts: indices of the original vertices (v,), faces (f, 3), uvs (v, 2) with padding."""
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_mesh(np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.uint32))
    charts = xatlas.ChartOptions()
    charts.max_iterations = 1
    charts.max_cost = 4.0
    charts.normal_deviation_weight = 1.0
    pack = xatlas.PackOptions()
    pack.resolution = 512
    pack.padding = 3
    pack.bilinear = True
    pack.bruteForce = False
    atlas.generate(charts, pack)
    mapping, new_faces, uvs = atlas[0]
    return mapping.astype(np.int64), new_faces.astype(np.int32), uvs.astype(np.float64)


def texels_of(vertices: np.ndarray, faces: np.ndarray, uvs: np.ndarray, size: int) -> Texels:
    """Find the texel centres that lie in triangles, with their points and face normals."""
    flat = np.column_stack([uvs[:, 0] * size, (1 - uvs[:, 1]) * size, np.ones(len(uvs))])
    camera = Camera(size, size, 1.0, 1.0, 0.0, 0.0)
    raster = rasterize_mesh(flat, faces, camera, np.eye(4))
    rows, columns = np.nonzero(raster.face >= 0)
    face = raster.face[rows, columns]
    corner = vertices[faces[face]]
    points = np.einsum("tk,tkc->tc", raster.barycentric[rows, columns].astype(np.float64), corner)
    normals = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return Texels(rows.astype(np.int32), columns.astype(np.int32), points, normals)


def choose_frames(posed: PosedFrames, pixels: ScenePixels, target: int, limit: int) -> np.ndarray:
    """Choose frames that see the object large, sharp and from different sides; best first: int32 (k,)."""
    count = (pixels.ids == target).reshape(len(pixels.ids), -1).sum(axis=1).astype(np.float64)
    sharp = np.asarray(posed.sharpness, np.float64)
    sharp = sharp / max(float(np.median(sharp)), 1e-12)
    score = count * np.clip(sharp, 0.3, 1.5)
    candidates = np.flatnonzero(score > 0.02 * score.max()) if score.max() > 0 else np.zeros(0, int)
    positions = posed.world_from_camera[:, :3, 3]
    chosen: list[int] = []
    while len(chosen) < min(limit, len(candidates)):
        rest = [c for c in candidates if c not in chosen]
        if chosen:
            apart = np.min(np.linalg.norm(positions[rest][:, None] - positions[chosen][None], axis=2), axis=1)
            value = score[rest] * (0.15 + apart / max(float(np.ptp(positions, axis=0).max()), 1e-6))
        else:
            value = score[rest]
        chosen.append(int(rest[int(np.argmax(value))]))
    return np.array(chosen, np.int32)


def bake_object(
    vertices_world: np.ndarray, faces: np.ndarray, uvs: np.ndarray, target: int, posed: PosedFrames,
    depth_camera: Camera, pixels: ScenePixels, config: AssetsConfig, tolerance_m: float,
) -> Baked:  # fmt: skip
    """Bake the texture of one object from the frames that see it."""
    frames = choose_frames(posed, pixels, target, config.texture_frames)
    size = _texture_size(vertices_world, faces, uvs, frames, posed, config)
    texels = texels_of(vertices_world, faces, uvs, size)
    colors = np.zeros((len(frames), len(texels.points), 3), np.float32)
    weights = np.zeros((len(frames), len(texels.points)), np.float32)
    for row, frame in enumerate(frames):
        raster = rasterize_mesh(vertices_world, faces, depth_camera, posed.world_from_camera[frame])
        mask = cv2.erode((pixels.ids[frame] == target).astype(np.uint8), np.ones((3, 3), np.uint8))
        border = cv2.distanceTransform(mask, cv2.DIST_L2, 3)
        colors[row], weights[row] = look_up(
            texels, posed, int(frame), depth_camera, raster.depth, np.minimum(border, 6.0) / 6.0, tolerance_m
        )
    color, seen = blend(colors, weights)
    return _finish(texels, color, seen, size, frames, weights)


def _texture_size(
    vertices: np.ndarray,
    faces: np.ndarray,
    uvs: np.ndarray,
    frames: np.ndarray,
    posed: PosedFrames,
    config: AssetsConfig,
) -> int:
    """Side of the texture at which a texel is about a pixel of the nearest frame."""
    corner, flat = vertices[faces], uvs[faces]
    area = (
        np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum() / 2
    )
    e1, e2 = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    used = np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]).sum() / 2
    if len(frames) == 0 or used <= 0:
        return config.texture_min_px
    center = vertices.mean(axis=0)
    distance = np.linalg.norm(posed.world_from_camera[frames][:, :3, 3] - center, axis=1).min()
    pixel = max(distance, 0.1) / posed.camera.fx
    wanted = np.sqrt(area / used) / pixel
    size = config.texture_min_px
    while size < min(wanted, config.texture_max_px):
        size *= 2
    return min(size, config.texture_max_px)


def look_up(
    texels: Texels, posed: PosedFrames, frame: int, depth_camera: Camera, depth: np.ndarray, border: np.ndarray,
    tolerance_m: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Colours (t, 3) and weights (t,) of all texels in one frame; weight 0 where it is not seen."""
    camera = posed.camera
    local = transform_points(invert_rigid(posed.world_from_camera[frame]), texels.points)
    z = np.maximum(local[:, 2], 1e-6)
    xn, yn = local[:, 0] / z, local[:, 1] / z
    u, v = camera.fx * xn + camera.cx, camera.fy * yn + camera.cy
    du, dv = depth_camera.fx * xn + depth_camera.cx, depth_camera.fy * yn + depth_camera.cy
    inside = (
        (local[:, 2] > 0.05) & (u > 0.5) & (v > 0.5) & (u < camera.width - 0.5) & (v < camera.height - 0.5)
    )
    iu = np.clip(du.astype(np.int32), 0, depth_camera.width - 1)
    iv = np.clip(dv.astype(np.int32), 0, depth_camera.height - 1)
    here = depth[iv, iu]
    view = posed.world_from_camera[frame][:3, 3] - texels.points
    range_m = np.linalg.norm(view, axis=1)
    cos = np.einsum("tk,tk->t", view, texels.normals) / np.maximum(range_m, 1e-9)
    slope = 1.5 * z / depth_camera.fx / np.maximum(cos, 0.1)  # depth changes this much over a pixel
    seen = inside & (cos > 0.08) & (here > 0) & (np.abs(here - local[:, 2]) < tolerance_m + slope)
    weight = np.where(seen, cos**2 / np.maximum(range_m, 0.1) ** 2 * border[iv, iu], 0).astype(np.float32)
    image = np.asarray(posed.images[frame])
    color = cv2.remap(
        image, (u - 0.5).astype(np.float32)[None], (v - 0.5).astype(np.float32)[None], cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )[0] if len(u) < 32000 else _remap_long(image, u, v)  # fmt: skip
    return color.astype(np.float32), weight * float(posed.sharpness[frame] > 0)


def _remap_long(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Bilinear look-up of any number of places (OpenCV's remap takes rows below 2^15)."""
    width = 16384
    pad = (-len(u)) % width
    mu = np.pad((u - 0.5).astype(np.float32), (0, pad)).reshape(-1, width)
    mv = np.pad((v - 0.5).astype(np.float32), (0, pad)).reshape(-1, width)
    out = cv2.remap(image, mu, mv, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return out.reshape(-1, 3)[: len(u)]


def blend(colors: np.ndarray, weights: np.ndarray, *, equalize: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Bring frames (k, t, 3) to one exposure and blend each texel's best few; returns (t, 3) and seen (t,)."""
    if len(colors) == 0:
        return np.zeros((colors.shape[1], 3), np.float32), np.zeros(colors.shape[1], bool)
    if equalize:
        colors = colors * exposure_gains(colors, weights)[:, None]
    best = np.argsort(-weights, axis=0, kind="stable")[:_BEST]
    w = np.take_along_axis(weights, best, axis=0)
    c = np.take_along_axis(colors, best[..., None], axis=0)
    middle = np.median(np.where(w[..., None] > 0, c, np.nan), axis=0) if len(w) >= 3 else c[0]
    middle = np.where(np.isfinite(middle), middle, c[0])
    # Highlights and stray labels differ from the rest.
    off = np.abs(c - middle).max(axis=2) / 40.0
    w = w**2 / (1 + off**2)
    total = w.sum(axis=0)
    color = (c * w[..., None]).sum(axis=0) / np.maximum(total, 1e-20)[:, None]
    return color, weights.max(axis=0) > 0


def exposure_gains(colors: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """One gain per frame (k, 1) that makes frames agree where they see the same texels; mean gain 1."""
    gains = np.ones(len(colors))
    luminance = colors.mean(axis=2)
    seen = weights > 0
    for _ in range(3):
        adjusted = luminance * gains[:, None]
        total = (weights * seen).sum(axis=0)
        mean = (adjusted * weights).sum(axis=0) / np.maximum(total, 1e-20)
        for k in range(len(colors)):
            use = seen[k] & (seen.sum(axis=0) > 1) & (luminance[k] > 10) & (luminance[k] < 245)
            if use.sum() > 50:
                gains[k] = np.clip(np.median(mean[use] / luminance[k][use]), 0.75, 1.33)
    return (gains / np.exp(np.log(gains).mean()))[:, None]


def _finish(
    texels: Texels, color: np.ndarray, seen: np.ndarray, size: int, frames: np.ndarray, weights: np.ndarray
) -> Baked:
    """Fill unseen texels from the nearest seen surface, write the picture and grow charts over their borders."""
    if seen.any() and not seen.all():
        color[~seen] = _from_neighbours(texels, color, seen)
    elif not seen.any():
        color[:] = 150.0
    mean = color[seen].mean(axis=0) if seen.any() else np.full(3, 150.0)
    picture = np.zeros((size, size, 3), np.float32)
    filled = np.zeros((size, size), bool)
    picture[texels.rows, texels.columns] = color
    filled[texels.rows, texels.columns] = True
    picture = push_pull(picture, filled)
    order = np.argsort(-weights.sum(axis=1), kind="stable") if len(frames) else np.zeros(0, int)
    used = [int(k) for k in order if weights[k].any()]
    return Baked(
        np.clip(np.round(picture), 0, 255).astype(np.uint8),
        float(seen.mean()) if len(seen) else 0.0,
        frames[used],
        mean,
    )


def _from_neighbours(texels: Texels, color: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Mean colour of the nearest seen texels, near in place and facing alike."""
    from scipy.spatial import cKDTree

    size = max(float(np.ptp(texels.points, axis=0).max()), 1e-6)
    feature = np.concatenate([texels.points, 0.12 * size * texels.normals], axis=1)
    source = np.flatnonzero(seen)
    source = source[:: max(1, len(source) // 20000)]
    k = min(12, len(source))
    distance, index = cKDTree(feature[source]).query(feature[~seen], k=k)
    distance, index = distance.reshape(-1, k), index.reshape(-1, k)
    weight = 1.0 / (distance + 0.01 * size)
    return (color[source][index] * weight[..., None]).sum(axis=1) / weight.sum(axis=1, keepdims=True)


def push_pull(picture: np.ndarray, filled: np.ndarray) -> np.ndarray:
    """Fill the pixels that are not `filled` smoothly from those that are, over a pyramid."""
    weight = filled.astype(np.float32)
    if filled.all() or not filled.any():
        return picture
    levels = [(picture * weight[..., None], weight)]
    while min(levels[-1][1].shape) > 1 and (levels[-1][1] == 0).any():
        c, w = levels[-1]
        shape = (max(1, (c.shape[1] + 1) // 2), max(1, (c.shape[0] + 1) // 2))
        c2, w2 = (
            cv2.resize(c, shape, interpolation=cv2.INTER_AREA),
            cv2.resize(w, shape, interpolation=cv2.INTER_AREA),
        )
        full = np.minimum(w2 * 4, 1.0) / np.maximum(w2, 1e-12)
        levels.append((c2 * full[..., None], w2 * full))
    c, w = levels[-1]
    current = c / np.maximum(w, 1e-12)[..., None]
    for c, w in reversed(levels[:-1]):
        up = cv2.resize(current, (c.shape[1], c.shape[0]), interpolation=cv2.INTER_LINEAR)
        current = c + up.reshape(c.shape) * (1 - w)[..., None]
    return current


def textured(vertices: np.ndarray, faces: np.ndarray, uvs: np.ndarray, texture: np.ndarray) -> TexturedMesh:
    """Assemble the mesh type of `reconstruction.types`."""
    return TexturedMesh(
        np.ascontiguousarray(vertices, np.float32),
        np.ascontiguousarray(faces, np.int32),
        np.ascontiguousarray(uvs, np.float32),
        texture,
    )
