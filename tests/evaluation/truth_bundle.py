"""Write a generated room as a ground-truth folder, and as a scene bundle with known changes."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from reconstruction.assets.gltf import write_glb, write_obj
from reconstruction.core.types import Camera, ConvexPart, TexturedMesh
from reconstruction.publish.preview import render_textured
from registry import SceneBundle, seal_bundle
from registry.geometry import invert_rigid, rigid, split_similarity, transform_points
from synthetic.camera_paths import handheld_path, phone_camera
from synthetic.capture import write_ground_truth
from synthetic.film import prepare
from synthetic.room import Entity, Room, build_room

KINDS = ("table", "shelf", "box", "can", "carton", "book", "tin", "picture")
FIXED = ("table", "shelf", "picture")


@dataclass(frozen=True)
class Truth:
    """A room, its cameras and its ground-truth folder."""

    folder: Path  # ground truth; the frames are in `frames/` beside it
    room: Room
    camera: Camera
    poses: np.ndarray  # (n, 4, 4)

    @property
    def frames(self) -> Path:
        """Folder of the renderings of the true room, one per frame."""
        return self.folder.parent / "frames"

    def entity(self, name: str) -> Entity:
        """Return a true entity."""
        return self.room.entity(name)


@dataclass
class Change:
    """How a bundle differs from the truth. Ids are those of the room's entities."""

    estimated_from_true: np.ndarray = field(default_factory=lambda: np.eye(4))  # a similarity
    moved: dict[str, np.ndarray] = field(default_factory=dict)  # name -> transform in the true world
    reshaped: dict[str, Callable[[np.ndarray], np.ndarray]] = field(default_factory=dict)  # of world vertices
    missing: tuple[str, ...] = ()
    parent: dict[str, str] = field(default_factory=dict)
    brighter: int = 0
    camera_error: Callable[[int, np.ndarray], np.ndarray] = lambda _, pose: pose


def write_truth(folder: Path, frames: int = 21, width: int = 240, height: int = 180) -> Truth:
    """Build a room, write its ground truth and the renderings at its cameras."""
    room = build_room(3, KINDS, step_m=0.3, density=0.05)
    camera, poses = phone_camera(width, height), handheld_path(frames, seed=1)
    truth = Truth(folder / "ground_truth", room, camera, np.asarray(poses))
    write_ground_truth(truth.folder, room, prepare(room, shadow_px=64), camera, truth.poses, 12.0)
    truth.frames.mkdir()
    meshes = [(textured(e), np.eye(4)) for e in room.entities]
    for number, pose in enumerate(truth.poses):
        if number % 10 == 0:
            picture, depth = render_textured(meshes, camera, pose)
            picture[depth == 0] = (200, 30, 90)  # differs from the renderer's background
        cv2.imwrite(str(truth.frames / f"{number:05d}.png"), picture[..., ::-1])
    return truth


def textured(entity: Entity, brighter: int = 0) -> TexturedMesh:
    """Return the true mesh in world space with a smooth random texture."""
    mesh = entity.mesh()
    rng = np.random.default_rng(entity.id)
    texture = cv2.resize(
        rng.integers(40, 200, (4, 4, 3)).astype(np.uint8), (32, 32), interpolation=cv2.INTER_LINEAR
    )
    uvs = rng.random((len(mesh.vertices), 2)).astype(np.float32)
    return TexturedMesh(
        np.asarray(mesh.vertices, np.float32),
        np.asarray(mesh.faces, np.int32),
        uvs,
        texture + np.uint8(brighter),
    )


def write_bundle(truth: Truth, folder: Path, change: Change | None = None) -> SceneBundle:
    """Write the truth as a scene bundle, changed as asked."""
    change = change or Change()
    scale, rotation, _ = split_similarity(change.estimated_from_true)
    folder.mkdir(parents=True)
    ids = {e.name: e.id for e in truth.room.entities}
    base, objects, edges = [], [], []
    for entity in truth.room.entities:
        if entity.name in change.missing:
            continue
        mesh = textured(entity, change.brighter)
        home = folder / f"objects/{entity.id:03d}"
        home.mkdir(parents=True)
        visual, collision = f"objects/{entity.id:03d}/visual.glb", []
        pose = np.eye(4)
        if not entity.base:
            pose = change.moved.get(entity.name, np.eye(4)) @ entity.world_from_object
        reshape = change.reshaped.get(entity.name, lambda points: points)

        def to_object(points: np.ndarray, pose=pose, entity=entity, reshape=reshape) -> np.ndarray:
            """Transform true world points of the unmoved entity to the space of its mesh file."""
            points = reshape(np.asarray(points, np.float64))
            if entity.base:
                return transform_points(change.estimated_from_true, points)
            return scale * transform_points(invert_rigid(entity.world_from_object), points)

        placed = TexturedMesh(to_object(mesh.vertices).astype(np.float32), mesh.faces, mesh.uvs, mesh.texture)
        write_glb(placed, folder / visual)
        for number, solid in enumerate(entity.solids):
            points = to_object(np.concatenate([patch.vertices for patch in solid])).astype(np.float32)
            collision.append(f"objects/{entity.id:03d}/collision_{number:03d}.obj")
            write_obj(ConvexPart(points, np.array([[0, 1, 2]], np.int32)), folder / collision[-1])
        if entity.base:
            base.append(
                {"id": entity.id, "label": entity.label, "mesh": visual, "plane": [0, 0, 1, 0], "observed": True,
                 "collision": collision}
            )  # fmt: skip
            continue
        world_from_object = rigid(
            rotation @ pose[:3, :3], transform_points(change.estimated_from_true, pose[None, :3, 3])[0]
        )
        extents = np.ptp(placed.vertices, axis=0)
        objects.append(
            {
                "id": entity.id, "label": entity.label, "label_confidence": 1.0,
                "world_from_object": world_from_object.tolist(), "scale": extents.tolist(), "visual": visual,
                "collision": collision, "material": "wood", "density_kg_m3": 500.0, "mass_kg": 1.0,
                "center_of_mass": (0.5 * (placed.vertices.min(0) + placed.vertices.max(0))).tolist(),
                "friction": 0.6, "restitution": 0.0, "dynamic": entity.name not in FIXED,
                "relation_fixed": entity.relation == "attached_to",
                "provenance": {"geometry": "truth", "appearance": "truth", "physics": "truth",
                               "observed_fraction": 1.0},
                "views": [],
            }
        )  # fmt: skip
        parent = ids[change.parent[entity.name]] if entity.name in change.parent else entity.parent
        edges.append(
            {
                "child": entity.id,
                "relation": entity.relation,
                "parent": parent,
                "confidence": 1.0,
                "evidence": "",
            }
        )
    seal_bundle(folder, _scene(truth, change, base, objects, edges))
    return SceneBundle.open(folder)


def _scene(truth: Truth, change: Change, base: list, objects: list, edges: list) -> dict:
    _, rotation, _ = split_similarity(change.estimated_from_true)
    camera, frames = truth.camera, []
    for index, true_pose in enumerate(truth.poses):
        pose = change.camera_error(index, true_pose)
        center = transform_points(change.estimated_from_true, pose[None, :3, 3])[0]
        estimated = rigid(rotation @ pose[:3, :3], center)
        frames.append({"index": index, "time_s": index / 12, "world_from_camera": estimated.tolist()})
    return {
        "schema": "simrecon.scene/1",
        "id": "room",
        "source": {"file": "room.mp4", "sha256": "ab" * 32, "width": camera.width, "height": camera.height,
                   "fps": 12.0, "frame_count": len(frames), "duration_s": len(frames) / 12},
        "scale": {"method": "unknown", "uncertainty": None},
        "cameras": {"model": "PINHOLE", "width": camera.width, "height": camera.height,
                    "params": [camera.fx, camera.fy, camera.cx, camera.cy], "frames": frames},
        "base": base,
        "objects": objects,
        "graph": {"edges": edges},
        "report": {"physics": {}, "timings_s": {"frames": 1.0, "poses": 2.5}, "peak_memory_mb": 700.0,
                   "backends": {}, "config": {}},
    }  # fmt: skip
