"""Replace the output of a stage by ground truth, to measure how much the stage's error costs the end result.

`simrecon reconstruct VIDEO --oracle depth --ground-truth DIR` runs all stages but takes the depth maps from the true
meshes. The output is expressed in the space of the preceding stages, so that only the error of one stage is removed.
The bundle of such a run names the replaced stages.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from reconstruction.code_digest import code_digest
from reconstruction.core.progress import Progress
from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import (
    BaseEntity,
    Camera,
    DepthMaps,
    FrameSet,
    InstanceSet,
    Plane,
    PosedFrames,
    ScaleEstimate,
    Surface,
    WorldFrame,
)
from reconstruction.depth.images import sized_camera
from reconstruction.measure.alignment import Alignment, align
from reconstruction.measure.ground_truth import GroundTruth, TrueEntity
from reconstruction.measure.surfaces import nearest_entities
from reconstruction.poses import PosesConfig, estimate_poses
from registry.errors import UsageError

if TYPE_CHECKING:
    from reconstruction.core.mesh_graph import MeshGraph
    from reconstruction.instances.cut import Thing
    from reconstruction.pipeline import Call

ORACLE_STAGES = ("poses", "depth", "world", "instances")
_NEAR_TRUTH_M = 0.05  # farther vertices belong to no entity
_MIN_VERTICES = 30  # entities with fewer are no instances
_SAMPLES = 40_000  # per object, to find nearest surfaces
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Oracle:
    """The stages that ground truth replaces."""

    stages: tuple[str, ...]
    truth: GroundTruth
    digest: str  # SHA-256 of the truth's files, part of the fingerprints of the replaced stages

    @classmethod
    def load(cls, stages: Sequence[str], ground_truth: Path | None) -> "Oracle":
        """Read the ground truth for some stages.

        Raises:
            UsageError: a stage cannot be replaced, or the truth lacks what it needs.
        """
        unknown = sorted(set(stages) - set(ORACLE_STAGES))
        if unknown:
            raise UsageError(
                f"--oracle {','.join(unknown)}: there are oracles for {', '.join(ORACLE_STAGES)} only"
            )
        if ground_truth is None:
            raise UsageError("--oracle needs --ground-truth DIR, the folder with the truth")
        truth = GroundTruth.load(ground_truth)
        if not truth.entities and set(stages) - {"poses"}:
            raise UsageError(
                f"--oracle {','.join(stages)}: {ground_truth} has cameras only; only --oracle poses works with it"
            )
        digest = hashlib.sha256()
        names = [path for path in sorted(truth.folder.glob("*.json")) if path.is_file()]
        for path in [*names, *(e.mesh_path for e in truth.entities)]:
            digest.update(path.name.encode() + b"\0" + path.read_bytes())
        return cls(tuple(s for s in ORACLE_STAGES if s in stages), truth, digest.hexdigest())

    def of_stage(self, stage: str) -> list[str]:
        """Return additional parts of a stage's fingerprint; none if the stage is not replaced."""
        return [self.digest, code_digest(__name__)] if stage in self.stages else []

    def make(self, stage: str, call: "Call") -> Any:
        """Compute the artifact of a stage from the ground truth."""
        call.progress.note(f"{stage}: taken from the ground truth")
        if stage == "poses":
            return self.poses(call["frames"], call.options, work_dir=call.scratch, progress=call.progress)
        if stage == "depth":
            return self.depth(call["poses"], sized_camera(call["poses"].camera, call.options.depth_side_px))
        if stage == "world":
            return self.world(call["poses"])
        return self.instances(*call.in_world(), call["surface"])

    def poses(
        self, frames: FrameSet, config: PosesConfig, *, work_dir: Path, progress: Progress
    ) -> PosedFrames:
        """Return the frames with the true cameras, and points triangulated from our own matches with them."""
        camera, truth = self.truth.camera, self.truth.world_from_camera
        work_dir.mkdir(parents=True, exist_ok=True)
        path = work_dir / "transforms.json"
        wanted = sorted({int(i) for i in (*frames.indices, *frames.held_out_indices)} & set(truth))
        names = _image_names(frames)
        data = {
            **{"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy},
            **{"cx": camera.cx, "cy": camera.cy},
            "frames": [
                {
                    "file_path": names[i] if names else f"frame_{i:06d}.png",
                    "transform_matrix": (truth[i] @ _OPENCV_FROM_OPENGL).tolist(),
                }
                for i in wanted
            ],
        }
        path.write_text(json.dumps(data))
        config = replace(config, import_path=str(path), refine_imported="never")
        return estimate_poses(frames, config, work_dir=work_dir, progress=progress)

    def depth(self, posed: PosedFrames, camera: Camera) -> DepthMaps:
        """Render depth maps of the true meshes at the aligned cameras, in the units of the poses."""
        alignment = self._align(posed)
        vertices, faces = self.truth.mesh
        depth = np.stack(
            [
                rasterize_mesh(vertices, faces, camera, alignment.pose_to_true(pose)).depth
                for pose in posed.world_from_camera
            ]
        )
        depth /= np.float32(alignment.scale)
        return DepthMaps(camera, depth, np.where(depth > 0, 2, 0).astype(np.uint8))

    def world(self, posed: PosedFrames) -> WorldFrame:
        """Return the similarity from sfm to the true world."""
        alignment = self._align(posed)
        return WorldFrame(
            world_from_sfm=alignment.true_from_estimated,
            scale=ScaleEstimate("ground-truth", 0.0, "an oracle run: the scale is that of the ground truth"),
            gravity_method="ground-truth",
            gravity_sigma_deg=0.0,
            floor_observed=True,
            yaw_snapped=False,
        )

    def instances(self, posed: PosedFrames, depth: DepthMaps, surface: Surface) -> InstanceSet:
        """Return the true instances: each surface vertex gets the nearest true entity within 5 cm."""
        from reconstruction.core.mesh_graph import MeshGraph
        from reconstruction.instances.describe import describe

        alignment = self._align(posed)
        entities = [e for e in self.truth.entities if e.visible_pixels > 0]
        points = alignment.to_true(surface.vertices)
        owner = nearest_entities(points, entities, _SAMPLES, _NEAR_TRUTH_M)
        entities = [e for e in entities if (owner == e.id).sum() >= _MIN_VERTICES]
        graph = MeshGraph.from_surface(surface)
        base = _base(entities, owner, graph, posed)
        planes = [e for e in entities if e.base]
        # If no true floor is visible, `base` begins with an assumed one.
        numbers = {e.id: b.id for e, b in zip(planes, base[len(base) - len(planes) :])}
        things = _things(entities, owner)
        vertex_instance = np.zeros(len(owner), np.int32)
        for true_id, number in numbers.items():
            vertex_instance[owner == true_id] = number
        objects = describe(graph, list(things.values()), base, vertex_instance)
        for true_id, thing in things.items():
            numbers[true_id] = int(vertex_instance[thing.vertices[0]])
        label_of = {numbers[e.id]: e.label for e in entities}
        objects = tuple(replace(o, label=label_of[o.id], label_confidence=1.0) for o in objects)
        return InstanceSet(vertex_instance, base, objects, self._id_maps(posed, depth, alignment, numbers))

    def _id_maps(
        self, posed: PosedFrames, depth: DepthMaps, alignment: Alignment, numbers: dict[int, int]
    ) -> np.ndarray:
        vertices, faces = self.truth.mesh
        entities = self.truth.entities
        face_number = np.repeat(
            [numbers.get(e.id, 0) for e in entities], [len(e.mesh.faces) for e in entities]
        )
        maps = np.zeros(np.shape(depth.depth), np.uint16)
        for row, pose in enumerate(posed.world_from_camera):
            face = rasterize_mesh(vertices, faces, depth.camera, alignment.pose_to_true(pose)).face
            maps[row] = np.where(face >= 0, face_number[np.maximum(face, 0)], 0)
        return maps

    def _align(self, posed: PosedFrames) -> Alignment:
        pairs = zip(
            [*posed.indices, *posed.held_out_indices],
            [*posed.world_from_camera, *posed.held_out_world_from_camera],
        )
        return align({int(i): pose for i, pose in pairs}, self.truth.world_from_camera, self.truth.up)


def _image_names(frames: FrameSet) -> list[str]:
    """Return the file names of a folder of images; [] for a video."""
    from reconstruction.frames.decoding import ImageFolder

    source = Path(frames.source.file)
    return [path.name for path in ImageFolder(source).files] if source.is_dir() else []


def _base(
    entities: list[TrueEntity], owner: np.ndarray, graph: "MeshGraph", posed: PosedFrames
) -> tuple[BaseEntity, ...]:
    """Fit a plane to the visible vertices of each true base surface; floors come first, as later stages expect."""
    from reconstruction.instances.base import assumed_floor
    from reconstruction.surface.base_planes import base_outline

    entities.sort(key=lambda e: (not e.base, e.label != "floor", e.id))
    eye = posed.world_from_camera[:, :3, 3].mean(axis=0)
    floor_seen = bool(entities) and entities[0].base and entities[0].label == "floor"
    out = [] if floor_seen else [assumed_floor(1, graph.points)]
    for entity in entities:
        if not entity.base:
            continue
        members = owner == entity.id
        points = graph.points[members]
        center = np.median(points, axis=0)
        normal = np.linalg.svd(points - center, full_matrices=False)[2][2]
        normal *= np.sign((eye - center) @ normal) or 1.0
        plane = np.array([*normal, -normal @ center])
        outline = base_outline(points, plane)
        out.append(BaseEntity(len(out) + 1, entity.label, Plane(plane, outline), True))
    return tuple(out)


def _things(entities: list[TrueEntity], owner: np.ndarray) -> dict[int, "Thing"]:
    """Convert each true object to the segment type of the instances stage: vertices, support, attachment."""
    from reconstruction.instances.cut import Thing

    things = {
        e.id: Thing(np.flatnonzero(owner == e.id), attached=e.relation == "attached_to")
        for e in entities
        if not e.base
    }
    for entity in entities:
        if not entity.base and entity.parent in things and entity.relation == "supported_by":
            things[entity.id].rests_on = things[entity.parent]
    return things
