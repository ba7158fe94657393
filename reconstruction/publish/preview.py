"""Render the assembled scene on the CPU, without a graphics driver."""

import cv2
import numpy as np

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import AssembledScene, AssetSet, Camera, PosedFrames, TexturedMesh
from registry.geometry import transform_points

_BACKGROUND = np.array([236, 238, 241], np.float32)


def render_textured(
    meshes: list[tuple[TexturedMesh, np.ndarray]],
    camera: Camera,
    world_from_camera: np.ndarray,
    supersample: int = 2,
) -> tuple[np.ndarray, np.ndarray]:
    """Rasterize textured meshes, each with its `world_from_mesh`, without shading.

    Returns:
        The image uint8 (h, w, 3), and the z-depth float32 (h, w), 0 = background.
    """
    big = camera.resized(camera.width * supersample, camera.height * supersample)
    color = np.broadcast_to(_BACKGROUND, (big.height, big.width, 3)).copy()
    depth = np.zeros((big.height, big.width), np.float32)
    for mesh, world_from_mesh in meshes:
        vertices = transform_points(world_from_mesh, mesh.vertices)
        raster = rasterize_mesh(vertices, mesh.faces, big, world_from_camera)
        nearer = (raster.face >= 0) & ((depth == 0) | (raster.depth < depth))
        if not nearer.any():
            continue
        corners = mesh.faces[raster.face[nearer]]
        uv = np.einsum("nk,nkc->nc", raster.barycentric[nearer], mesh.uvs[corners])
        rows, columns = mesh.texture.shape[:2]
        x = np.clip((uv[:, 0] * columns).astype(int), 0, columns - 1)
        y = np.clip(((1.0 - uv[:, 1]) * rows).astype(int), 0, rows - 1)
        color[nearer] = mesh.texture[y, x]
        depth[nearer] = raster.depth[nearer]
    # Sums of whole numbers: no order of summing changes a bit, and slices are several times faster than `mean`.
    each = (color[i::supersample, j::supersample] for i, j in np.ndindex(supersample, supersample))
    picture = sum(each, np.zeros((camera.height, camera.width, 3), np.float32)) / np.float32(supersample**2)
    return picture.round().astype(np.uint8), depth[::supersample, ::supersample]


def scene_meshes(assets: AssetSet, assembled: AssembledScene) -> list[tuple[TexturedMesh, np.ndarray]]:
    """Return all visual meshes of the scene with their `world_from_mesh`: backdrop, base, structure, objects."""
    pose = {item.id: item.world_from_object for item in assembled.placed}
    behind = [] if assets.backdrop is None else [assets.backdrop.visual]
    still = [*behind, *(item.visual for item in assets.base)]
    still += [] if assets.structure is None else [assets.structure.visual]
    return [(visual, np.eye(4)) for visual in still] + [(o.visual, pose[o.id]) for o in assets.objects]


def render_preview(assets: AssetSet, assembled: AssembledScene, posed: PosedFrames) -> np.ndarray:
    """Render the scene at the keyframe that shows most objects, to the right of that frame: uint8 (h, 2w, 3)."""
    camera = posed.camera.resized(640, round(640 * posed.camera.height / posed.camera.width))
    best = best_view(assembled, posed, camera)
    picture, _ = render_textured(scene_meshes(assets, assembled), camera, posed.world_from_camera[best])
    frame = cv2.resize(
        np.asarray(posed.images[best]), (camera.width, camera.height), interpolation=cv2.INTER_AREA
    )
    return np.hstack([frame, picture])


def best_view(assembled: AssembledScene, posed: PosedFrames, camera: Camera) -> int:
    """Return the row of the frame with the most object centers in view; ties go to the nearest."""
    centers = np.array([item.world_from_object[:3, 3] for item in assembled.placed]).reshape(-1, 3)
    scores = []
    for pose in posed.world_from_camera:
        local = (centers - pose[:3, 3]) @ pose[:3, :3]
        u, v = camera.project(np.column_stack([local[:, :2], np.maximum(local[:, 2], 1e-6)]))
        margin = 0.05 * camera.width
        inside = (local[:, 2] > 0.1) & (u > margin) & (u < camera.width - margin)
        inside &= (v > margin) & (v < camera.height - margin)
        distance = float(np.linalg.norm(local, axis=1).mean()) if len(local) else 0.0
        scores.append(inside.sum() - 0.1 * distance)
    return int(np.argmax(scores)) if scores else 0
