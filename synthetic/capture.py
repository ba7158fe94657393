"""A filmed generated room as pipeline artefacts with the whole truth: what tests measure against.

Everything is in world space, in metres, as after the world-frame stage; `SyntheticCapture.in_sfm_space`
gives what the poses and depth stages would hand over before it.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from reconstruction.core.types import Camera, DepthMaps, FrameSet, PosedFrames, VideoSource
from registry.geometry import split_similarity, transform_points
from synthetic.camera_paths import handheld_path, phone_camera
from synthetic.film import FilmSet, film_room, prepare, render_truth
from synthetic.room import Entity, Room, build_room
from synthetic.sensor import Sensor


@dataclass(frozen=True)
class SyntheticCapture:
    """Frames of a generated room with true cameras, depth, instance ids and entities."""

    posed: PosedFrames  # world space; `indices` skip every tenth frame, which is held out
    depth: DepthMaps  # true depth at the frames' own resolution
    id_maps: np.ndarray  # uint16 (n, h, w) true entity ids of the keyframes, 0 = nothing
    held_out_depth: np.ndarray  # float32 (m, h, w)
    room: Room

    @property
    def entities(self) -> tuple[Entity, ...]:
        """Return floor, walls and things."""
        return self.room.entities

    def frame_set(self) -> FrameSet:
        """Return what stage 1 would have handed over."""
        p = self.posed
        return FrameSet(
            p.source, p.images, p.indices, p.times_s, p.sharpness, p.held_out_images, p.held_out_indices,
            p.held_out_times_s, 0.0, p.ordered,
        )  # fmt: skip

    def in_sfm_space(self, sfm_from_world: np.ndarray) -> tuple[PosedFrames, DepthMaps]:
        """Return frames and depth moved by a similarity 4x4, as before the world frame is known."""
        scale, rotation, _ = split_similarity(sfm_from_world)

        def move(poses: np.ndarray) -> np.ndarray:
            out = poses.copy()
            out[:, :3, :3] = rotation @ poses[:, :3, :3]
            out[:, :3, 3] = transform_points(sfm_from_world, poses[:, :3, 3])
            return out

        posed = replace(
            self.posed,
            world_from_camera=move(self.posed.world_from_camera),
            held_out_world_from_camera=move(self.posed.held_out_world_from_camera),
            points=transform_points(sfm_from_world, self.posed.points),
        )
        return posed, replace(self.depth, depth=self.depth.depth * np.float32(scale))


def make_test_capture(
    n_frames: int = 12,
    width: int = 320,
    height: int = 240,
    seed: int = 0,
    objects: Sequence[str] | None = None,
    *,
    sensor: Sensor | None = None,
    path: np.ndarray | None = None,
    step_m: float = 0.05,
    density: float = 0.5,
) -> SyntheticCapture:
    """Film a generated room and return frames with the truth.

    Args:
        n_frames: Number of keyframes; held-out frames (every tenth of the film) come on top.
        width: Of the frames, in pixels; depth and ids have the same resolution.
        height: Of the frames, in pixels.
        seed: Of room, path and noise.
        objects: Kinds of things to furnish with (`room.OBJECT_KINDS`); None: all eleven.
        sensor: Noise, exposure and blur.
        path: world_from_camera (k, 4, 4) of the whole film, instead of a hand-held arc around the table.
        step_m: Fineness of baked light.
        density: Factor on texture resolution; 1 suits 640x480.

    Returns:
        The capture; film frame i is held out where i % 10 == 0, as in a real video.
    """
    room = build_room(seed, objects, step_m=step_m, density=density)
    film_set = prepare(room, shadow_px=384)
    if path is None:
        total = n_frames + 1
        while total - len(range(0, total, 10)) < n_frames:
            total += 1
        path = handheld_path(total, seed=seed)
    camera = phone_camera(width, height)
    images = film_room(film_set, camera, path, sensor, seed=seed)
    truth = [render_truth(film_set, camera, pose) for pose in path]
    depth, ids = np.stack([d for d, _ in truth]), np.stack([i for _, i in truth])
    numbers = np.arange(len(path), dtype=np.int32)
    keep, held = numbers[numbers % 10 != 0], numbers[numbers % 10 == 0]
    posed = posed_capture(camera, path, images, depth, f"synthetic-room-{seed}.mp4", held)
    confidence = np.where(depth[keep] > 0, 2, 0).astype(np.uint8)
    return SyntheticCapture(posed, DepthMaps(camera, depth[keep], confidence), ids[keep], depth[held], room)


def posed_capture(
    camera: Camera,
    path: np.ndarray,
    images: np.ndarray,
    depth: np.ndarray,
    name: str,
    held_out: Sequence[int] = (),
    fps: float = 12.0,
) -> PosedFrames:
    """Return a film (n frames, true cameras and depth) as the poses stage would, with corners as sparse points."""
    held = np.asarray(held_out, np.int32)
    keep = np.setdiff1d(np.arange(len(path), dtype=np.int32), held)
    points, colors, observations = _sparse_points(camera, path[keep], images[keep], depth[keep])
    digest = hashlib.sha256(images.tobytes()).hexdigest()
    source = VideoSource(name, digest, camera.width, camera.height, fps, len(path), len(path) / fps)
    return PosedFrames(
        source=source,
        camera=camera,
        images=images[keep],
        indices=keep,
        times_s=keep / fps,
        world_from_camera=path[keep],
        sharpness=np.ones(len(keep), np.float32),
        held_out_images=images[held],
        held_out_indices=held,
        held_out_times_s=held / fps,
        held_out_world_from_camera=path[held],
        points=points,
        point_colors=colors,
        point_errors_px=np.full(len(points), 0.3, np.float32),
        observations=observations,
        chosen_frames=len(keep),
        ordered=True,
        reprojection_error_px=0.3,
    )


def _sparse_points(
    camera: Camera, poses: np.ndarray, images: np.ndarray, depth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lift corners of every third frame with true depth; a frame observes a point that it sees unoccluded."""
    import cv2

    points, colors = [], []
    for row in range(0, len(images), 3):
        gray = cv2.cvtColor(images[row], cv2.COLOR_RGB2GRAY)
        corners = cv2.goodFeaturesToTrack(gray, 300, 0.01, 4)
        if corners is None:
            continue
        u, v = corners[:, 0].astype(int).T
        z = depth[row][v, u].astype(np.float64)
        local = np.stack(
            [(u + 0.5 - camera.cx) / camera.fx * z, (v + 0.5 - camera.cy) / camera.fy * z, z], -1
        )
        points.append(transform_points(poses[row], local[z > 0]))
        colors.append(images[row][v, u][z > 0])
    if not points:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros((0, 2), np.int32)
    points_all = np.concatenate(points)
    pairs = []
    for row, pose in enumerate(poses):
        local = transform_points(np.linalg.inv(pose), points_all)
        z = np.maximum(local[:, 2], 1e-9)
        u = np.floor(camera.fx * local[:, 0] / z + camera.cx).astype(int)
        v = np.floor(camera.fy * local[:, 1] / z + camera.cy).astype(int)
        inside = (local[:, 2] > 0.1) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        number = np.flatnonzero(inside)
        number = number[np.abs(depth[row][v[number], u[number]] - z[number]) < 0.01 * z[number]]
        pairs.append(np.stack([np.full(len(number), row), number], -1))
    return points_all, np.concatenate(colors), np.concatenate(pairs).astype(np.int32)


def truth_as_json(room: Room, camera: Camera, world_from_camera: np.ndarray, fps: float) -> dict:
    """Describe the truth as `ground_truth/scene.json` does, with sizes and poses, without visible pixels."""
    names = {e.id: e.name for e in room.entities}
    return {
        "units": "metres",
        "up": "+Z",
        "camera_convention": "OpenCV",
        "fps": fps,
        "width": camera.width,
        "height": camera.height,
        "intrinsics": {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy},
        "frames": [
            {"index": i, "world_from_camera": np.round(pose, 6).tolist()}
            for i, pose in enumerate(world_from_camera)
        ],
        "entities": [
            {
                "id": e.id,
                "name": e.name,
                "label": e.label,
                "mesh": f"meshes/{e.name}.ply",
                "base": e.base,
                "relation": e.relation,
                "parent": names.get(e.parent),
                "fixed": e.fixed,
                "size": np.round(e.size, 4).tolist(),
                "world_from_object": np.round(e.world_from_object, 6).tolist(),
            }
            for e in room.entities
        ],
    }


def write_ground_truth(
    folder: Path, room: Room, film_set: FilmSet, camera: Camera, world_from_camera: np.ndarray, fps: float
) -> None:
    """Write a folder that `simrecon evaluate --ground-truth` reads (contract, section 3)."""
    import cv2

    for name in ("meshes", "depth", "instances"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    visible = np.zeros(max(e.id for e in room.entities) + 1, np.int64)
    for number, pose in enumerate(world_from_camera):
        depth, ids = render_truth(film_set, camera, pose)
        visible += np.bincount(ids.ravel(), minlength=len(visible))
        if number % 10 == 0:
            millimetres = np.clip(np.round(depth * 1000), 0, 65535).astype(np.uint16)
            cv2.imwrite(str(folder / "depth" / f"{number:05d}.png"), millimetres)
            cv2.imwrite(str(folder / "instances" / f"{number:05d}.png"), ids)
    truth = truth_as_json(room, camera, world_from_camera, fps)
    for entry, entity in zip(truth["entities"], room.entities):
        entry["visible_pixels"] = int(visible[entity.id])
        entity.mesh().export(folder / entry["mesh"])
    (folder / "scene.json").write_text(json.dumps(truth, indent=1))
