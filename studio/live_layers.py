"""Scene nodes that each stage of a reconstruction adds to the live page: cameras, points, depth, surface, things.

Before the world frame is known, a similarity from the cameras alone puts the scene upright and near the origin; the
stage `world` replaces it. Nodes are `/live/<layer>/...`.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from reconstruction.core.types import (
    AssembledScene,
    AssetSet,
    DepthMaps,
    FrameSet,
    InstanceSet,
    PosedFrames,
    Surface,
    TexturedMesh,
    WorldFrame,
)
from registry.geometry import quat_from_matrix, split_similarity
from studio.text import bare

_THUMBNAIL_PX = 96  # longer side of photographs in camera frustums
_FRUSTUM_M = 0.12
_SHEET_FRAMES, _SHEET_PX = 12, 160  # of the sheet of keyframes
_POINTS = 60_000  # depth pixels that are shown
_ASSUMED_M = 1.5  # median distance from camera to points before the scale is known
_INSTANCE_COLORS = np.array(
    [
        [228, 26, 28],
        [55, 126, 184],
        [77, 175, 74],
        [152, 78, 163],
        [255, 127, 0],
        [166, 86, 40],
        [247, 129, 191],
    ]
)  # ColorBrewer's Set1


class LiveLayers:
    """Draws results of stages into a viser server."""

    def __init__(self, server: viser.ViserServer) -> None:
        """Start with an empty scene."""
        self._server = server
        self._posed: PosedFrames | None = None
        self._depth: DepthMaps | None = None
        self._surface: Surface | None = None
        self._world_from_sfm = np.eye(4)
        self._framed = False
        self._draw: dict[str, Callable[[Any], str]] = {
            "frames": self._frames,
            "poses": self._poses,
            "depth": self._depths,
            "world": self._world,
            "surface": self._surfaces,
            "instances": self._instances,
            "assets": self._assets,
            "assembly": self._assembly,
        }

    def draw(self, stage: str, result: Any) -> str:
        """Draw the result of a stage; return a line about it, or "" where the page shows nothing of it."""
        draw = self._draw.get(stage)
        return "" if draw is None else draw(result)

    def _frames(self, frames: FrameSet) -> str:
        rows = np.linspace(0, len(frames.images) - 1, min(_SHEET_FRAMES, len(frames.images))).astype(int)
        pictures = [_smaller(frames.images[row], _SHEET_PX) for row in rows]
        height, width = pictures[0].shape[:2]
        sheet = np.zeros((-(-len(pictures) // 3) * height, 3 * width, 3), np.uint8)
        for number, picture in enumerate(pictures):
            y, x = number // 3 * height, number % 3 * width
            sheet[y : y + height, x : x + width] = picture
        self._server.gui.add_image(sheet, label="Keyframes", format="jpeg", jpeg_quality=80)
        return f"{len(frames.images)} keyframes of {frames.source.frame_count} frames"

    def _poses(self, posed: PosedFrames) -> str:
        self._posed, self._world_from_sfm = posed, upright_from_cameras(posed)
        self._draw_posed()
        return f"{len(posed.images)} cameras, {len(posed.points)} points"

    def _depths(self, depth: DepthMaps) -> str:
        self._depth = depth
        self._draw_depth()
        return f"{(depth.depth > 0).mean():.0%} of the pixels have depth"

    def _world(self, world: WorldFrame) -> str:
        self._world_from_sfm = world.world_from_sfm
        self._framed = False
        self._draw_posed()
        self._draw_depth()
        self._server.scene.add_grid("/live/floor", width=10, height=10, cell_size=0.5, position=(0, 0, 0))
        return f"scale by {world.scale.method}, 1 sigma {world.scale.uncertainty:.0%}"

    def _surfaces(self, surface: Surface) -> str:
        self._surface = surface
        self._draw_surface(surface.colors)
        for name in ("/live/depth", "/live/points", "/live/floor"):
            self._server.scene.remove_by_name(name)
        return f"{len(surface.faces)} triangles"

    def _instances(self, found: InstanceSet) -> str:
        if self._surface is not None:
            ids = np.array([thing.id for thing in found.objects], np.int64)
            colors = self._surface.colors.astype(np.float64)
            mine = np.isin(found.vertex_instance, ids)
            shown = _INSTANCE_COLORS[found.vertex_instance[mine] % len(_INSTANCE_COLORS)]
            colors[mine] = 0.5 * colors[mine] + 0.5 * shown
            self._draw_surface(colors.astype(np.uint8))
        for thing in found.objects:
            top = thing.center + np.array([0, 0, 0.5 * thing.extents_m[2] + 0.03])
            self._server.scene.add_label(
                f"/live/labels/{thing.id}", bare(f"{thing.label} {thing.id}"), position=top
            )
        return f"{len(found.objects)} things"

    def _assets(self, assets: AssetSet) -> str:
        for name in ("/live/surface", "/live/labels", "/live/cameras"):
            self._server.scene.remove_by_name(name)
        for base in assets.base:
            self._add_textured(f"/live/things/{base.id}", base.visual, np.eye(4))
        if assets.structure is not None:
            self._add_textured(f"/live/things/{assets.structure.id}", assets.structure.visual, np.eye(4))
        for item in assets.objects:
            self._add_textured(f"/live/things/{item.id}", item.visual, item.world_from_object)
        return f"{len(assets.objects)} meshes"

    def _assembly(self, scene: AssembledScene) -> str:
        for placed in scene.placed:
            node = self._server.scene.get_handle_by_name(f"/live/things/{placed.id}")
            if node is not None:
                _put(node, placed.world_from_object)
        moving = sum(not placed.stable for placed in scene.placed)
        return "everything rests" if not moving else f"{moving} things do not rest"

    # ---- Inside.

    def _draw_posed(self) -> None:
        posed = self._posed
        if posed is None:
            return
        poses, points = moved_by(self._world_from_sfm, posed)
        scene = self._server.scene
        scene.add_point_cloud(
            "/live/points",
            points.astype(np.float32),
            posed.point_colors,
            point_size=0.012,
            precision="float32",
        )
        fov = 2 * np.arctan2(0.5 * posed.camera.height, posed.camera.fy)
        for row, pose in enumerate(poses):
            scene.add_camera_frustum(
                f"/live/cameras/{int(posed.indices[row])}", fov, posed.camera.width / posed.camera.height,
                scale=_FRUSTUM_M, thickness=0.003, image=_smaller(posed.images[row], _THUMBNAIL_PX), format="jpeg",
                wxyz=quat_from_matrix(pose[:3, :3]), position=pose[:3, 3], cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
        self._frame_view(poses, points)

    def _draw_depth(self) -> None:
        if self._posed is None or self._depth is None:
            return
        points, colors = depth_points(self._posed, self._depth, _POINTS)
        world = points @ self._world_from_sfm[:3, :3].T + self._world_from_sfm[:3, 3]
        self._server.scene.add_point_cloud(
            "/live/depth", world.astype(np.float32), colors, point_size=0.01, precision="float32"
        )

    def _draw_surface(self, colors: np.ndarray) -> None:
        import trimesh

        surface = self._surface
        assert surface is not None
        mesh = trimesh.Trimesh(surface.vertices, surface.faces, vertex_colors=colors, process=False)
        self._server.scene.add_mesh_trimesh("/live/surface", mesh, cast_shadow=False, receive_shadow=False)

    def _add_textured(self, name: str, visual: TexturedMesh, world_from_mesh: np.ndarray) -> None:
        import trimesh
        from PIL import Image
        from trimesh.visual import TextureVisuals
        from trimesh.visual.material import PBRMaterial

        material = PBRMaterial(
            baseColorTexture=Image.fromarray(visual.texture), metallicFactor=0.0, roughnessFactor=1.0
        )
        mesh = trimesh.Trimesh(visual.vertices, visual.faces, process=False)
        mesh.visual = TextureVisuals(uv=visual.uvs, material=material)
        node = self._server.scene.add_mesh_trimesh(name, mesh, cast_shadow=False, receive_shadow=False)
        _put(node, world_from_mesh)

    def _frame_view(self, poses: np.ndarray, points: np.ndarray) -> None:
        """Set where new viewers start, and move those that are there: above and behind the cameras."""
        if self._framed:
            return
        self._framed = True
        middle = np.median(points, axis=0)
        away = poses[:, :3, 3].mean(axis=0) - middle
        eye = middle + 1.8 * away + [0, 0, 0.9 * float(np.linalg.norm(away))]
        cameras = [self._server.initial_camera, *(c.camera for c in self._server.get_clients().values())]
        for camera in cameras:
            camera.position, camera.look_at = tuple(eye), tuple(middle)


def upright_from_cameras(posed: PosedFrames) -> np.ndarray:
    """Return a similarity (4, 4) that makes the cameras' mean up +z and their median distance to the points 1.5 m."""
    up = -posed.world_from_camera[:, :3, 1].mean(axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-9)
    forward = posed.world_from_camera[0, :3, 2]
    right = np.cross(forward, up)
    right /= max(float(np.linalg.norm(right)), 1e-9)
    rotation = np.stack([right, np.cross(up, right), up])
    middle = np.median(posed.points, axis=0)
    distance = float(np.median(np.linalg.norm(posed.world_from_camera[:, :3, 3] - middle, axis=1)))
    out = np.eye(4)
    out[:3, :3] = rotation * (_ASSUMED_M / max(distance, 1e-9))
    out[:3, 3] = -out[:3, :3] @ middle
    return out


def depth_points(posed: PosedFrames, depth: DepthMaps, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a regular subset of the depth maps' pixels as points, in the space of the poses.

    Returns:
        Points float64 (n, 3), n at most about `most`, and colors uint8 (n, 3).
    """
    count, height, width = depth.depth.shape
    step = max(1, int(np.ceil(np.sqrt(count * height * width / max(most, 1)))))
    points, colors = [], []
    for row, pose in enumerate(posed.world_from_camera):
        z = depth.depth[row, ::step, ::step]
        rows, columns = np.nonzero(z > 0)
        found = depth.camera.unproject(columns * step + 0.5, rows * step + 0.5, z[rows, columns])
        points.append(found @ pose[:3, :3].T + pose[:3, 3])
        picture = posed.images[row]
        y = (rows * step + 0.5) * picture.shape[0] / height
        x = (columns * step + 0.5) * picture.shape[1] / width
        colors.append(picture[y.astype(int), x.astype(int)])
    return np.concatenate(points), np.concatenate(colors)


def moved_by(similarity: np.ndarray, posed: PosedFrames) -> tuple[np.ndarray, np.ndarray]:
    """Return poses (n, 4, 4), rigid, and points (p, 3) of frames after a similarity transform (4, 4)."""
    _, rotation, _ = split_similarity(similarity)
    poses = posed.world_from_camera.copy()
    poses[:, :3, :3] = rotation @ poses[:, :3, :3]
    poses[:, :3, 3] = poses[:, :3, 3] @ similarity[:3, :3].T + similarity[:3, 3]
    return poses, posed.points @ similarity[:3, :3].T + similarity[:3, 3]


def _smaller(picture: np.ndarray, side_px: int) -> np.ndarray:
    import cv2

    scale = side_px / max(picture.shape[:2])
    size = max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def _put(node: Any, world_from_node: np.ndarray) -> None:
    node.wxyz, node.position = quat_from_matrix(world_from_node[:3, :3]), world_from_node[:3, 3]
