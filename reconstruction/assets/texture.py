"""Texture atlases, and colors baked into them from keyframes.

A texel takes the blend of the best few frames that show it: where the object's own mesh does not occlude it and the
instance map has the object's id. Exposures are equalized first. Unseen texels take colors of the nearest seen surface.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.views import ScenePixels
from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera, PosedFrames, TexturedMesh
from registry.geometry import invert_rigid

if TYPE_CHECKING:
    from reconstruction.assets.generation.complete import SurfaceColors

_UNASSIGNED_WEIGHT = 0.1  # of pixels without an id: a hundredth of the others' say in a blend
_GAIN = (0.6, 1.6)  # range of the gains that match a generator's colors to the frames


@dataclass(frozen=True)
class Texels:
    """The texels of a mesh's atlas that lie in triangles, with their surface points."""

    rows: np.ndarray  # int32 (t,)
    columns: np.ndarray  # int32 (t,)
    points: np.ndarray  # float64 (t, 3)
    normals: np.ndarray  # float64 (t, 3) of the faces


@dataclass(frozen=True)
class Baked:
    """A baked texture and its source frames."""

    texture: np.ndarray  # uint8 (s, s, 3), row 0 at v = 1
    seen_share: float  # of the texels
    frames: np.ndarray  # int32 (k,) rows of the keyframes, best first
    mean_rgb: np.ndarray  # float (3,) of the seen texels


def unwrap(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut a mesh into padded charts: indices of the original vertices (v,), faces (f, 3), uvs (v, 2)."""
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
    """Return the texels whose centers lie in triangles, with their points and face normals."""
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
    """Choose frames that see the object large, sharp and from apart: int32 (k,), best first."""
    count = pixels.counts(target).astype(np.float64)
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


@dataclass(frozen=True)
class TextureViews:
    """Keyframes that surface points take their colors from."""

    frames: np.ndarray  # int32 (k,) rows of the keyframes
    camera_from_world: np.ndarray  # float64 (k, 4, 4)
    centers: np.ndarray  # float64 (k, 3) of the cameras
    images: np.ndarray  # uint8 (k, h, w, 3)
    depths: np.ndarray  # float32 (k, hd, wd) of the surface itself, 0 where another instance is seen
    borders: np.ndarray  # float32 (k, hd, wd) weight, falling towards the outline
    intrinsics: tuple[float, ...]  # fx, fy, cx, cy of the images
    depth_intrinsics: tuple[float, ...]

    def arguments(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return what the kernels take, in their order."""
        return self.camera_from_world, self.centers, self.images, self.depths, self.borders


def texture_views(
    posed: PosedFrames, depth_camera: Camera, frames: np.ndarray, depths: Sequence[np.ndarray] | np.ndarray,
    borders: Sequence[np.ndarray] | np.ndarray,
) -> TextureViews:  # fmt: skip
    """Gather the views of the keyframes at rows `frames`; `depths` and `borders` are theirs."""
    shape = (len(frames), depth_camera.height, depth_camera.width)
    poses = posed.world_from_camera[frames].reshape(-1, 4, 4)
    return TextureViews(
        np.asarray(frames, np.int32),
        np.ascontiguousarray(invert_rigid(poses)),
        np.ascontiguousarray(poses[:, :3, 3]),
        np.ascontiguousarray(posed.images[frames]),
        np.asarray(depths, np.float32).reshape(shape),
        np.asarray(borders, np.float32).reshape(shape),
        tuple(posed.camera.intrinsics.tolist()),
        tuple(depth_camera.intrinsics.tolist()),
    )


def collect_colors(
    texels: Texels, views: TextureViews, tolerance_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Blend all texels from the views.

    Returns:
        Colors float32 (t, 3), whether any view shows them (t,), and each view's total weight (k,).
    """
    from reconstruction.assets.kernels import blend_frames, sample_frames

    count = len(texels.points)
    if len(views.frames) == 0 or count == 0:
        return np.zeros((count, 3), np.float32), np.zeros(count, bool), np.zeros(len(views.frames))
    some = np.arange(0, count, max(1, count // 12000))
    colors, weights = sample_frames(
        texels.points[some], texels.normals[some], *views.arguments(), views.intrinsics, views.depth_intrinsics,
        tolerance_m,
    )  # fmt: skip
    gains = exposure_gains(colors, weights)[:, 0].astype(np.float32)
    color, seen = blend_frames(
        np.ascontiguousarray(texels.points), np.ascontiguousarray(texels.normals), *views.arguments(), gains,
        views.intrinsics, views.depth_intrinsics, tolerance_m,
    )  # fmt: skip
    return color, seen, weights.sum(axis=1, dtype=np.float64)


def bake_object(
    vertices_world: np.ndarray, faces: np.ndarray, uvs: np.ndarray, target: int, posed: PosedFrames,
    depth_camera: Camera, pixels: ScenePixels, config: AssetsConfig, tolerance_m: float,
    beneath: "SurfaceColors | None" = None,
) -> Baked:  # fmt: skip
    """Bake the texture of object `target` from the frames that see it; unseen texels take the colors `beneath`, if any.

    A frame sees a texel where its depth differs from the mesh's by `tolerance_m` at most.
    """
    frames = choose_frames(posed, pixels, target, config.texture_frames)
    size = _texture_size(vertices_world, faces, uvs, frames, posed, config)
    texels = texels_of(vertices_world, faces, uvs, size)
    depths, borders = [], []
    for frame in frames:
        depths.append(
            rasterize_mesh(vertices_world, faces, depth_camera, posed.world_from_camera[frame]).depth
        )
        unassigned = (pixels.ids[frame] == 0) & (pixels.depth[frame] > 0) & (depths[-1] > 0)
        unassigned &= np.abs(pixels.depth[frame] - depths[-1]) < tolerance_m
        borders.append(_view_weights(pixels.ids[frame] == target, unassigned))
    views = texture_views(posed, depth_camera, frames, depths, borders)
    color, seen, share = collect_colors(texels, views, tolerance_m)
    filled = None if beneath is None else _transferred(texels, color, seen, beneath)
    return _painted(texels, color, seen, size, frames, share, filled)


def _view_weights(own: np.ndarray, unassigned: np.ndarray) -> np.ndarray:
    """Return the weights float32 (h, w) of a frame's pixels, falling towards the object's outline.

    Args:
        own: bool (h, w), pixels that have the object's id.
        unassigned: bool (h, w), pixels without an id whose depth is the object's. They count little, so that they
            color only what no frame shows otherwise.
    """
    weights = np.zeros(own.shape, np.float32)
    for mask, most in ((own | unassigned, _UNASSIGNED_WEIGHT), (own, 1.0)):
        inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8))
        inside = np.minimum(cv2.distanceTransform(inner, cv2.DIST_L2, 3), 6.0) / 6.0
        weights = np.maximum(weights, most * inside)
    return weights


def _texture_size(
    vertices: np.ndarray, faces: np.ndarray, uvs: np.ndarray, frames: np.ndarray, posed: PosedFrames,
    config: AssetsConfig,
) -> int:  # fmt: skip
    """Return the texture's side at which a texel is about as large as a pixel of the nearest frame."""
    corner, flat = vertices[faces], uvs[faces]
    normals = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(normals, axis=1).sum() / 2
    e1, e2 = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    used = np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]).sum() / 2
    if len(frames) == 0 or used <= 0:
        return config.texture_min_px
    center = vertices.mean(axis=0)
    distance = np.linalg.norm(posed.world_from_camera[frames][:, :3, 3] - center, axis=1).min()
    pixel = max(distance, 0.1) / posed.camera.fx
    return texture_side(np.sqrt(area / used) / pixel, config.texture_min_px, config.texture_max_px)


def texture_side(wanted_px: float, least_px: int, most_px: int) -> int:
    """Double `least_px` until it reaches `wanted_px`, but not beyond `most_px`."""
    side = least_px
    while side < min(wanted_px, most_px):
        side *= 2
    return min(side, most_px)


def exposure_gains(colors: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return gains (k, 1), geometric mean 1, that equalize colors (k, t, 3) of the texels that frames see alike.

    `weights` (k, t) are 0 where a frame does not see a texel.
    """
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


def _painted(
    texels: Texels, color: np.ndarray, seen: np.ndarray, size: int, frames: np.ndarray, share: np.ndarray,
    filled: np.ndarray | None,
) -> Baked:  # fmt: skip
    """Draw the texels, unseen ones from `filled` or else the nearest seen surface; extend charts past their borders."""
    known = seen.copy()
    if filled is not None:
        color[~seen] = filled[~seen]
        known[:] = True
    elif seen.any() and not seen.all():
        # A coarse subset suffices: the texels between are interpolated.
        step = 1
        while (~seen).sum() / step**2 > 6000:
            step += 1
        coarse = ~seen & (texels.rows % step == 0) & (texels.columns % step == 0)
        color[coarse] = _from_neighbours(texels, color, seen, coarse)
        known |= coarse
    elif not seen.any():
        color[:] = 150.0
        known[:] = True
    if seen.any():
        mean = color[seen].mean(axis=0)
    else:
        mean = np.full(3, 150.0) if filled is None else color.mean(0)
    picture = np.zeros((size, size, 3), np.float32)
    drawn = np.zeros((size, size), bool)
    picture[texels.rows[known], texels.columns[known]] = color[known]
    drawn[texels.rows[known], texels.columns[known]] = True
    picture = push_pull(picture, drawn)
    order = np.argsort(-share, kind="stable")
    used = [int(k) for k in order if share[k] > 0]
    return Baked(
        np.clip(np.round(picture), 0, 255).astype(np.uint8),
        float(seen.mean()) if len(seen) else 0.0,
        frames[used],
        mean,
    )


def _transferred(texels: Texels, color: np.ndarray, seen: np.ndarray, beneath: "SurfaceColors") -> np.ndarray:
    """Return colors float32 (t, 3) of the nearest surface of like normal, with gains that match the seen texels."""
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

    size = max(float(np.ptp(texels.points, axis=0).max()), 1e-6)
    own = np.concatenate([beneath.points, 0.05 * size * beneath.normals], axis=1)
    nearest = cKDTree(own).query(np.concatenate([texels.points, 0.05 * size * texels.normals], axis=1))[1]
    out = beneath.colors[nearest].astype(np.float32)
    if seen.sum() > 50:
        gain = np.median(color[seen], axis=0) / np.maximum(np.median(out[seen], axis=0), 1.0)
        out = np.clip(out * np.clip(gain, *_GAIN), 0, 255).astype(np.float32)
    return out


def _from_neighbours(texels: Texels, color: np.ndarray, seen: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the mean color of the nearest seen texels, by position and normal."""
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

    size = max(float(np.ptp(texels.points, axis=0).max()), 1e-6)
    feature = np.concatenate([texels.points, 0.12 * size * texels.normals], axis=1)
    source = np.flatnonzero(seen)
    source = source[:: max(1, len(source) // 10000)]
    k = min(8, len(source))
    distance, index = cKDTree(feature[source]).query(feature[wanted], k=k)
    distance, index = distance.reshape(-1, k), index.reshape(-1, k)
    weight = 1.0 / (distance + 0.01 * size)
    return (color[source][index] * weight[..., None]).sum(axis=1) / weight.sum(axis=1, keepdims=True)


def push_pull(picture: np.ndarray, filled: np.ndarray) -> np.ndarray:
    """Fill the pixels that are not `filled` smoothly from those that are (pull-push, Gortler et al. 1996)."""
    weight = filled.astype(np.float32)
    if filled.all() or not filled.any():
        return picture
    levels: list[tuple[np.ndarray, np.ndarray]] = [(picture * weight[..., None], weight)]
    while min(levels[-1][1].shape) > 1 and (levels[-1][1] == 0).any():
        c, w = levels[-1]
        shape = (max(1, (c.shape[1] + 1) // 2), max(1, (c.shape[0] + 1) // 2))
        c2, w2 = (np.asarray(cv2.resize(image, shape, interpolation=cv2.INTER_AREA)) for image in (c, w))
        full = np.minimum(w2 * 4, 1.0) / np.maximum(w2, 1e-12)
        levels.append((c2 * full[..., None], w2 * full))
    c, w = levels[-1]
    current = c / np.maximum(w, 1e-12)[..., None]
    for c, w in reversed(levels[:-1]):
        up = cv2.resize(current, (c.shape[1], c.shape[0]), interpolation=cv2.INTER_LINEAR)
        current = np.asarray(up).reshape(c.shape)
        current *= (1 - w)[..., None]
        current += c
    return current


def textured(vertices: np.ndarray, faces: np.ndarray, uvs: np.ndarray, texture: np.ndarray) -> TexturedMesh:
    """Convert to the array types of `TexturedMesh`."""
    return TexturedMesh(
        np.ascontiguousarray(vertices, np.float32),
        np.ascontiguousarray(faces, np.int32),
        np.ascontiguousarray(uvs, np.float32),
        texture,
    )
