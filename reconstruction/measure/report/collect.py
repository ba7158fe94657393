"""Gather the inputs of the report: the bundle, the stage results that still exist, and the truth, if any."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

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
from reconstruction.measure.scene import PlacedMesh, bundle_poses, placed_meshes
from reconstruction.measure.stage_results import StageResults
from registry import SceneBundle

if TYPE_CHECKING:
    from reconstruction.measure.outline_scores import OutlineScores
    from reconstruction.measure.report.truth import Truth

T = TypeVar("T")


def present(value: T | None) -> T:
    """Return a value that the caller has checked not to be None."""
    assert value is not None
    return value


@dataclass(frozen=True)
class Gathered:
    """The inputs of the report's sections; stage results are None if missing, see `why_missing`."""

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
        """Return which of these stages' results are missing and why; "" if none is."""
        missing = {n: self.stages.missing.get(n, "not kept") for n in names if n not in self.stages.folders}
        return "; ".join(f"{', '.join(stages)}: {reason}" for reason, stages in by_reason(missing).items())

    @cached_property
    def _in_world(self) -> tuple[PosedFrames | None, DepthMaps | None]:
        return self.stages.in_world()

    @property
    def posed(self) -> PosedFrames | None:
        """Keyframes and held-out frames with cameras, in world space, in metres."""
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
        """Depth maps in metres: refined by the Gaussians, or those of the depth stage if that result is missing."""
        return self._refined[1] or self._in_world[1]

    @property
    def surface(self) -> Surface | None:
        """The fused surface, in world space."""
        return self.stages.get("surface")

    @property
    def instances(self) -> InstanceSet | None:
        """The instances of the surface."""
        return self.stages.get("instances")

    @property
    def assets(self) -> AssetSet | None:
        """Assets as reconstructed, before assembly."""
        return self.stages.get("assets")

    @property
    def assembled(self) -> AssembledScene | None:
        """The assembled scene."""
        return self.stages.get("assembly")

    @cached_property
    def camera(self) -> Camera:
        """The bundle's camera, at the resolution of the posed frames."""
        c = self.bundle.cameras
        return Camera(c.width, c.height, *(float(x) for x in c.params[:4]))

    @cached_property
    def poses(self) -> dict[int, np.ndarray]:
        """Poses world_from_camera (4, 4) by video frame."""
        return bundle_poses(self.bundle)

    @cached_property
    def keyframe_indices(self) -> list[int]:
        """Video frames that are keyframes, ascending."""
        frames = self.scene["cameras"]["frames"]
        return sorted(f["index"] for f in frames if not f.get("held_out", False))

    @cached_property
    def objects(self) -> list[dict]:
        """The objects of scene.json, sorted by id."""
        return sorted(self.scene["objects"], key=lambda o: o["id"])

    @cached_property
    def names(self) -> dict[int, str]:
        """`label id` by id, of objects and base surfaces."""
        entries = [*self.scene["base"], *self.scene["objects"]]
        return {e["id"]: f"{e['label']} {e['id']}" for e in entries}

    @cached_property
    def colors(self) -> dict[int, tuple[int, int, int]]:
        """One color per object id, the same in all images of the report."""
        return {item["id"]: object_color(rank) for rank, item in enumerate(self.objects)}

    @cached_property
    def meshes(self) -> list[PlacedMesh]:
        """All meshes of the bundle at their assembled poses; base surfaces first."""
        return placed_meshes(self.bundle)

    @cached_property
    def object_meshes(self) -> list[PlacedMesh]:
        """The object meshes, sorted by id."""
        return sorted((m for m in self.meshes if not m.base), key=lambda m: m.id)

    @cached_property
    def seen_poses(self) -> dict[int, np.ndarray] | None:
        """Object poses before assembly, by id; None if the assets are missing."""
        if self.assets is None:
            return None
        return {item.id: item.world_from_object for item in self.assets.objects}

    def keyframe_rows(self, count: int) -> list[int]:
        """Return up to `count` evenly spaced rows of the posed keyframes."""
        total = 0 if self.posed is None else len(self.posed.images)
        if total == 0:
            return []
        middle = (np.arange(min(count, total)) + 0.5) * total / min(count, total)
        return [int(x) for x in middle]


def by_reason(missing: dict[str, str]) -> dict[str, list[str]]:
    """Group missing stages by reason."""
    out: dict[str, list[str]] = {}
    for stage, reason in missing.items():
        out.setdefault(reason, []).append(stage)
    return out
