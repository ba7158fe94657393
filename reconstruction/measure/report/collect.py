"""Gather what the report shows: the bundle, what its stages made as far as it is kept, and the truth, if any."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from reconstruction.core.types import (
    AssembledScene,
    AssetSet,
    Camera,
    DepthMaps,
    InstanceSet,
    PosedFrames,
    Surface,
)
from reconstruction.gaussians import Gaussians
from reconstruction.measure.report.drawing import object_color
from reconstruction.measure.scene import PlacedMesh, placed_meshes
from reconstruction.measure.stage_results import StageResults
from registry import SceneBundle

if TYPE_CHECKING:
    from reconstruction.measure.outline_scores import OutlineScores
    from reconstruction.measure.report.truth import Truth


@dataclass(frozen=True)
class Gathered:
    """Everything that the sections of the report read. What is None has a reason in `why_missing`."""

    bundle: SceneBundle
    stages: StageResults
    truth: "Truth | None" = None
    evaluation: dict[str, Any] | None = None  # `Evaluation.to_json()`
    outlines: "OutlineScores | None" = None

    @property
    def scene(self) -> dict:
        """The bundle's scene.json."""
        return self.bundle.scene

    def why_missing(self, *names: str) -> str:
        """Say which of these stages' results are missing and why; an empty string if none is."""
        gone = {
            name: self.stages.missing.get(name, "not kept")
            for name in names
            if name not in self.stages.folders
        }
        return "; ".join(f"{', '.join(stages)}: {reason}" for reason, stages in by_reason(gone).items())

    @cached_property
    def _in_world(self) -> tuple[PosedFrames | None, DepthMaps | None]:
        return self.stages.in_world()

    @property
    def posed(self) -> PosedFrames | None:
        """Keyframes and kept-out frames with cameras, in world space."""
        return self._in_world[0]

    @cached_property
    def _refined(self) -> tuple[Gaussians | None, DepthMaps | None]:
        return self.stages.refined_in_world()

    @property
    def gaussians(self) -> Gaussians | None:
        """The Gaussians in world space, in metres."""
        return self._refined[0]

    @property
    def depth(self) -> DepthMaps | None:
        """Depth maps in metres: those that the Gaussians corrected, or, where they are gone, as measured."""
        return self._refined[1] or self._in_world[1]

    @property
    def surface(self) -> Surface | None:
        """The fused surface."""
        return self.stages.get("surface")

    @property
    def instances(self) -> InstanceSet | None:
        """The surface cut into things."""
        return self.stages.get("instances")

    @property
    def assets(self) -> AssetSet | None:
        """Assets as reconstructed, before assembly."""
        return self.stages.get("assets")

    @property
    def assembled(self) -> AssembledScene | None:
        """The scene at rest."""
        return self.stages.get("assembly")

    @cached_property
    def camera(self) -> Camera:
        """The frames' camera, at the resolution that the cameras were estimated at."""
        c = self.bundle.cameras
        return Camera(c.width, c.height, *(float(x) for x in c.params[:4]))

    @cached_property
    def poses(self) -> dict[int, np.ndarray]:
        """Camera poses (world_from_camera) by video frame number."""
        c = self.bundle.cameras
        return {int(i): pose for i, pose in zip(c.indices, c.world_from_camera)}

    @cached_property
    def keyframe_indices(self) -> list[int]:
        """Video frame numbers of the keyframes, in order."""
        frames = self.scene["cameras"]["frames"]
        return sorted(f["index"] for f in frames if not f.get("held_out", False))

    @cached_property
    def objects(self) -> list[dict]:
        """The objects of scene.json by id."""
        return sorted(self.scene["objects"], key=lambda o: o["id"])

    @cached_property
    def names(self) -> dict[int, str]:
        """`label id` of everything in the scene."""
        entries = [*self.scene["base"], *self.scene["objects"]]
        return {e["id"]: f"{e['label']} {e['id']}" for e in entries}

    @cached_property
    def colors(self) -> dict[int, tuple[int, int, int]]:
        """One color for each object, the same all over the report."""
        return {item["id"]: object_color(rank) for rank, item in enumerate(self.objects)}

    @cached_property
    def meshes(self) -> list[PlacedMesh]:
        """Every mesh of the bundle, at rest in the assembled scene; base surfaces first."""
        return placed_meshes(self.bundle)

    @cached_property
    def object_meshes(self) -> list[PlacedMesh]:
        """The objects among them, by id."""
        return sorted((m for m in self.meshes if not m.base), key=lambda m: m.id)

    @cached_property
    def seen_poses(self) -> dict[int, np.ndarray] | None:
        """Object poses as reconstructed, before assembly; None where the assets are gone."""
        if self.assets is None:
            return None
        return {item.id: item.world_from_object for item in self.assets.objects}

    def keyframe_rows(self, count: int) -> list[int]:
        """Return up to `count` rows of the posed keyframes, evenly spread in time."""
        total = 0 if self.posed is None else len(self.posed.images)
        if total == 0:
            return []
        middle = (np.arange(min(count, total)) + 0.5) * total / min(count, total)
        return [int(x) for x in middle]


def gather(
    bundle: SceneBundle,
    stages: StageResults,
    truth: "Truth | None" = None,
    evaluation: dict[str, Any] | None = None,
    outlines: "OutlineScores | None" = None,
) -> Gathered:
    """Put together what a report is made from."""
    return Gathered(bundle, stages, truth, evaluation, outlines)


def by_reason(missing: dict[str, str]) -> dict[str, list[str]]:
    """Group missing stages by the reason that they share."""
    out: dict[str, list[str]] = {}
    for stage, reason in missing.items():
        out.setdefault(reason, []).append(stage)
    return out
