"""Id maps of keyframes: render the labeled surface, then move the borders to image edges."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from reconstruction.core.mesh_graph import lab_from_rgb
from reconstruction.core.progress import Progress
from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera, DepthMaps, InstanceSet, PosedFrames, Surface
from reconstruction.instances._pixel_kernels import snap_borders
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.mask_propagation import MaskPropagation
from reconstruction.instances.masks.base import FrameMasks
from reconstruction.poses.parallel import ordered_map


def render_id_maps(
    posed: PosedFrames, depth: DepthMaps, surface: Surface, vertex_instance: np.ndarray, config: InstancesConfig,
    labeled: FrameMasks | None = None, *, progress: Progress,
) -> np.ndarray:  # fmt: skip
    """Return the instance id of each pixel of each keyframe, uint16 (n, h, w) at depth resolution.

    Where masks with instance ids (`labeled`) are given, they take precedence over the rendered surface.
    """
    camera = depth.camera
    propagation = None if labeled is None else MaskPropagation(labeled, surface)
    maps = np.zeros((len(posed.images), camera.height, camera.width), np.uint16)
    progress.start(len(maps), "instance maps")
    # Frames are rendered ahead, one per core; the kernels after that are parallel themselves.
    rendered = ordered_map(partial(draw_ids, surface, vertex_instance, posed, depth), range(len(maps)))
    for row, ids in enumerate(rendered):
        ids = snapped_ids(ids, posed, depth, row, config)
        maps[row] = ids if propagation is None else cv2.medianBlur(propagation.ids(ids, posed, depth, row), 3)
        progress.advance()
    return maps


def seen_vertices(
    surface: Surface, camera: Camera, world_from_camera: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Render a surface; return the vertex at each pixel, int32 (h, w), -1 = none, and z-depth, float32 (h, w)."""
    raster = rasterize_mesh(surface.vertices, surface.faces, camera, world_from_camera)
    out = np.full(raster.face.shape, -1, np.int32)
    hit = raster.face >= 0
    corner = np.argmax(raster.barycentric[hit], axis=1)
    out[hit] = np.asarray(surface.faces)[raster.face[hit], corner]
    return out, raster.depth


def draw_ids(
    surface: Surface, vertex_instance: np.ndarray, posed: PosedFrames, depth: DepthMaps, row: int
) -> np.ndarray:
    """Return the ids uint16 (h, w) of the surface rendered into a keyframe."""
    seen, drawn = seen_vertices(surface, depth.camera, np.asarray(posed.world_from_camera[row]))
    measured = _measured(depth, row)
    # Measured depth far in front of the rendered surface: an occluder that is not modeled, which has no id.
    contradicted = (measured > 0) & (measured < 0.9 * drawn)
    shown = (seen >= 0) & ~contradicted
    ids = np.zeros(seen.shape, np.uint16)
    ids[shown] = np.asarray(vertex_instance)[seen[shown]]
    return ids


def snapped_ids(
    ids: np.ndarray, posed: PosedFrames, depth: DepthMaps, row: int, config: InstancesConfig
) -> np.ndarray:
    """Return the rendered ids (h, w) of a keyframe with their borders moved to edges of its image and depth map."""
    if config.snap_radius_px <= 0:
        return ids
    radius = config.snap_radius_px
    kernel = np.ones((2 * radius + 1,) * 2, np.uint8)
    signed = ids.astype(np.float32)
    band = cv2.dilate(signed, kernel) != cv2.erode(signed, kernel)
    size = (depth.camera.width, depth.camera.height)
    lab = lab_from_rgb(cv2.resize(posed.images[row], size, interpolation=cv2.INTER_AREA))
    return cv2.medianBlur(snap_borders(ids, band, lab, _measured(depth, row), radius, 2 * radius + 2), 3)


def _measured(depth: DepthMaps, row: int) -> np.ndarray:
    return np.where(depth.confidence[row] > 0, depth.depth[row], 0).astype(np.float32)


def without_unseen(found: InstanceSet, config: InstancesConfig, progress: Progress) -> InstanceSet:
    """Return the instances without objects that cover less than `min_object_image_share` of every id map.

    Objects on top of a removed one rest on what supported that.
    """
    count = max((o.id for o in found.objects), default=0) + 1
    best = np.zeros(count, np.int64)
    for id_map in found.id_maps:
        seen = np.bincount(id_map.ravel(), minlength=count)[:count]
        best = np.maximum(best, seen)
    fewest = config.min_object_image_share * found.id_maps[0].size
    gone = {o.id: o.support_hint for o in found.objects if best[o.id] < fewest}
    if not gone:
        return found
    progress.note(f"{len(gone)} objects are dropped: they cover too few pixels of every keyframe")

    def support(hint: int) -> int:
        while hint in gone:
            hint = gone[hint]
        return hint

    erased = np.array(sorted(gone))
    return InstanceSet(
        np.where(np.isin(found.vertex_instance, erased), 0, found.vertex_instance).astype(np.int32),
        found.base,
        tuple(replace(o, support_hint=support(o.support_hint)) for o in found.objects if o.id not in gone),
        np.where(np.isin(found.id_maps, erased), 0, found.id_maps).astype(np.uint16),
        found.structure,
    )
