"""Render single objects on a turntable and crop them from the frames that textured them."""

import cv2
import numpy as np

from reconstruction.core.types import Camera
from reconstruction.measure.report import drawing
from reconstruction.measure.report.blocks import Picture
from reconstruction.measure.report.collect import Gathered
from reconstruction.measure.report.pictures import picture, project
from reconstruction.measure.scene import PlacedMesh
from registry.geometry import invert_rigid, transform_points

ANGLES = 12
_TURNTABLE_PX, _VIEW_PX = 190, 150
# Corners of a square of half-width 1 in the image plane, which the turntable frames.
_CROSS = np.array([[-1.0, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0]])


def turntable(g: Gathered, mesh: PlacedMesh, first_view: int | None) -> Picture:
    """Render an object from twelve azimuths side by side, starting at that of its best view."""
    vertices = np.asarray(mesh.visual.vertices, np.float64)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    center = (low + high) / 2
    reach = max(float(np.hypot(*(vertices - center)[:, :2].T).max()), 1e-3)
    tall = max(float(high[2] - low[2]), 1e-3)
    elevation, start = 20.0, 0.0
    if first_view in g.poses:
        local = invert_rigid(mesh.world_from_mesh) @ g.poses[first_view][:, 3]
        start = float(np.degrees(np.arctan2(local[1] - center[1], local[0] - center[0])))
    up = tall * np.cos(np.radians(elevation)) + 2 * reach * np.sin(np.radians(elevation))
    box = max(2 * reach, up) * 1.08
    strip = []
    for k in range(ANGLES):
        azimuth = start + 360 * k / ANGLES
        camera, pose = drawing.framing_camera(
            center + 0.5 * box * _CROSS @ drawing.looking(azimuth, elevation).T, azimuth, elevation,
            _TURNTABLE_PX, _TURNTABLE_PX, margin=0.0,
        )  # fmt: skip
        strip.append(drawing.render_lit([(mesh.visual, np.eye(4))], camera, pose))
    image = np.hstack(strip)
    return picture(image, f"{mesh.label} {mesh.id} from twelve angles", quality=76)


def object_views(g: Gathered, mesh: PlacedMesh, views: list[int], count: int = 4) -> list[Picture]:
    """Crop an object from up to `count` of the frames `views`, with the outline of its instance mask."""
    if g.posed is None or g.seen_poses is None or mesh.id not in g.seen_poses:
        return []
    rows = {int(i): row for row, i in enumerate(g.posed.indices)}
    vertices = transform_points(g.seen_poses[mesh.id], mesh.visual.vertices)
    out = []
    for index in [v for v in views if v in rows][:count]:
        row = rows[index]
        box = _crop_box(project(vertices, g.posed.camera, g.posed.world_from_camera[row]), g.posed.camera)
        if box is None:
            continue
        x0, y0, x1, y1 = box
        image = np.asarray(g.posed.images[row])[y0:y1, x0:x1].copy()
        if g.instances is not None:
            size = (g.posed.camera.width, g.posed.camera.height)
            mask = (np.asarray(g.instances.id_maps[row]) == mesh.id).astype(np.uint8)
            mask = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)[y0:y1, x0:x1]
            contours, _ = cv2.findContours(np.ascontiguousarray(mask), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
            thick = max(1, round((x1 - x0) / 110))
            cv2.drawContours(image, contours, -1, g.colors[mesh.id], thick, cv2.LINE_AA)
        out.append(
            picture(_resized_to(image, _VIEW_PX), f"{mesh.label} {mesh.id} in frame {index}", str(index))
        )
    return out


def _crop_box(pixels: np.ndarray, camera: Camera) -> tuple[int, int, int, int] | None:
    inside = np.isfinite(pixels).all(axis=1)
    if not inside.any():
        return None
    low, high = pixels[inside].min(axis=0), pixels[inside].max(axis=0)
    half = max(0.62 * float((high - low).max()), 24.0)
    center = (low + high) / 2
    x0, y0 = np.floor(np.maximum(center - half, 0)).astype(int)
    x1, y1 = np.ceil(np.minimum(center + half, [camera.width, camera.height])).astype(int)
    return None if x1 - x0 < 8 or y1 - y0 < 8 else (x0, y0, x1, y1)


def _resized_to(image: np.ndarray, side: int) -> np.ndarray:
    """Scale a crop to fit a square and center it there."""
    scale = side / max(image.shape[:2])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    out = np.broadcast_to(drawing.BACKGROUND, (side, side, 3)).copy()
    y, x = (side - size[1]) // 2, (side - size[0]) // 2
    out[y : y + size[1], x : x + size[0]] = cv2.resize(image, size, interpolation=method)
    return out
