"""Which instance each pixel of each keyframe shows: the labeled surface drawn, its borders moved to image edges."""

import cv2
import numpy as np

from reconstruction.instances.config import InstancesConfig
from reconstruction.progress import Progress
from reconstruction.surface.mesh_graph import lab_from_rgb
from reconstruction.types import DepthMaps, PosedFrames, Surface


def render_id_maps(
    posed: PosedFrames,
    depth: DepthMaps,
    surface: Surface,
    vertex_instance: np.ndarray,
    config: InstancesConfig,
    *,
    progress: Progress,
) -> np.ndarray:
    """Return uint16 (n, h, w) ids per keyframe at depth resolution."""
    camera = depth.camera
    maps = np.zeros((len(posed.images), camera.height, camera.width), np.uint16)
    progress.start(len(maps), "instance maps")
    for i in range(len(maps)):
        image = cv2.resize(posed.images[i], (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        measured = np.where(depth.confidence[i] > 0, depth.depth[i], 0).astype(np.float32)
        maps[i] = render_id_map(
            surface, vertex_instance, depth, image, measured, np.asarray(posed.world_from_camera[i]), config
        )
        progress.advance()
    return maps


def render_id_map(
    surface: Surface,
    vertex_instance: np.ndarray,
    depth: DepthMaps,
    image: np.ndarray,
    measured: np.ndarray,
    world_from_camera: np.ndarray,
    config: InstancesConfig,
) -> np.ndarray:
    """Return uint16 (h, w) ids of one frame; `image` and `measured` depth are at depth resolution."""
    from reconstruction.rasterize import rasterize_mesh

    raster = rasterize_mesh(surface.vertices, surface.faces, depth.camera, world_from_camera)
    ids = np.zeros(raster.face.shape, np.uint16)
    hit = raster.face >= 0
    corner = np.argmax(raster.barycentric[hit], axis=1)
    ids[hit] = vertex_instance[np.asarray(surface.faces)[raster.face[hit], corner]]
    # Where the measured depth is far in front of the drawn surface, something unmodelled is seen: no id.
    contradicted = hit & (measured > 0) & (measured < 0.9 * raster.depth)
    ids[contradicted] = 0
    if config.snap_radius_px <= 0:
        return ids
    from reconstruction.instances._pixel_kernels import snap_borders

    radius = config.snap_radius_px
    kernel = np.ones((2 * radius + 1,) * 2, np.uint8)
    signed = ids.astype(np.float32)
    band = cv2.dilate(signed, kernel) != cv2.erode(signed, kernel)
    lab = lab_from_rgb(image)
    ids = snap_borders(ids, band, lab, measured, radius, 2 * radius + 2)
    return cv2.medianBlur(ids, 3)
