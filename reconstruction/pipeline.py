"""The stages in order, with the inputs and the result of each. Read this file first.

    frames -> poses -> depth -> world -> gaussians -> surface
    -> instances (-> views) -> assets -> scene_graph -> assembly -> publish

A stage is a function from artifacts (`reconstruction.core.types`) and its options to an artifact. `depth` precedes
`world`, as gravity is estimated from the normals of the depth maps. `gaussians` are fitted in the space of the poses
(`sfm`), so that another scale needs no other fit; they correct the depth maps. From `surface` on all is in world space:
metres, +z up, floor at z = 0. `views` runs only if a stage or a command needs it.

`runner.Run` runs the stages and caches their results. `video_to_scene.reconstruct` runs everything, from the video to
the registry.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reconstruction.assembly import assemble
from reconstruction.assets import build_assets
from reconstruction.assets import outside_inputs as outside_assets
from reconstruction.assets import wants_views as assets_want_views
from reconstruction.core.progress import Progress
from reconstruction.core.types import (
    AssembledScene,
    AssetSet,
    DepthMaps,
    FrameSet,
    InstanceSet,
    PosedFrames,
    Surface,
    WorldFrame,
)
from reconstruction.depth import estimate_depth
from reconstruction.frames import load_frames
from reconstruction.gaussians import GaussianScene, make_gaussians
from reconstruction.instances import make_instances
from reconstruction.instances import outside_inputs as outside_instances
from reconstruction.poses import estimate_poses
from reconstruction.poses import outside_inputs as outside_poses
from reconstruction.scene_graph import RECORDS, MergedGraph, infer_scene_graph
from reconstruction.scene_graph import outside_inputs as outside_scene_graph
from reconstruction.scene_graph import wants_views as graph_wants_views
from reconstruction.surface import fuse_surface
from reconstruction.views import SceneViews, ViewScene, make_views, prepare_scene
from reconstruction.world import find_world


@dataclass(frozen=True)
class Call:
    """Inputs of a stage: the video, its options, results of other stages, folders."""

    video: Path
    options: Any
    results: Mapping[str, Any]  # of the stages that it reads, by name
    scratch: Path  # empty folder, removed when the stage ends
    kept: Path  # the run's work folder, for data that later runs reuse
    progress: Progress

    def __getitem__(self, stage: str) -> Any:
        """Return the result of another stage."""
        return self.results[stage]

    def in_world(self) -> tuple[PosedFrames, DepthMaps]:
        """See `in_world`."""
        return in_world(self.results)

    def view_scene(self) -> ViewScene:
        """See `view_scene`."""
        return view_scene(self.results)


def _frames(call: Call) -> FrameSet:
    return load_frames(call.video, call.options, progress=call.progress)


def _poses(call: Call) -> PosedFrames:
    return estimate_poses(call["frames"], call.options, work_dir=call.scratch, progress=call.progress)


def _depth(call: Call) -> DepthMaps:
    return estimate_depth(call["poses"], call.options, progress=call.progress)


def _world(call: Call) -> WorldFrame:
    return find_world(call["poses"], call["depth"], call.options, progress=call.progress)


def _gaussians(call: Call) -> GaussianScene:
    return make_gaussians(call["poses"], call["depth"], call.options, progress=call.progress)


def _surface(call: Call) -> Surface:
    return fuse_surface(*call.in_world(), call.options, progress=call.progress)


def _instances(call: Call) -> InstanceSet:
    mirrors = call["world"].mirrors_in_world()
    return make_instances(
        *call.in_world(), call["surface"], call.options, mirrors=mirrors, progress=call.progress
    )


def _views(call: Call) -> SceneViews:
    return make_views(call.view_scene(), call["instances"], call.options, progress=call.progress)


def _assets(call: Call) -> AssetSet:
    return build_assets(
        *call.in_world(), call["surface"], call["instances"], call.options, views=call.results.get("views"),
        keep=call.kept / "collision", progress=call.progress,
    )  # fmt: skip


def _scene_graph(call: Call) -> MergedGraph:
    return infer_scene_graph(
        call["assets"], call.options, make_scene=call.view_scene, records=call.kept / RECORDS, progress=call.progress
    )  # fmt: skip


def _assembly(call: Call) -> AssembledScene:
    return assemble(call["assets"], call["scene_graph"].plain(), call.options, progress=call.progress)


def _nothing(options: Any) -> tuple[str, ...]:
    return ()


@dataclass(frozen=True)
class Stage:
    """A stage: its function, its inputs, and what its fingerprint covers."""

    name: str
    make: Callable[[Call], Any]
    package: str  # its code; the stage runs again if this, or a module that it imports, changes
    produces: type
    needs: tuple[str, ...]  # stages that it reads
    needs_also: Callable[[Any], tuple[str, ...]] = _nothing  # further ones, by its options
    outside: Callable[[Any], tuple[str, ...]] = _nothing  # digests of files and models that its options name
    options: str = ""  # its field in `PipelineConfig`; empty: the stage's name
    on_demand: bool = False  # runs only if another stage or a command needs it

    @property
    def option_group(self) -> str:
        """Its field in `PipelineConfig`."""
        return self.options or self.name


_METRIC = ("poses", "gaussians", "world")
_SEEN = (*_METRIC, "surface", "instances")


def _views_of_assets(options: Any) -> tuple[str, ...]:
    return ("views",) if assets_want_views(options) else ()


def _views_of_graph(options: Any) -> tuple[str, ...]:
    return _SEEN if graph_wants_views(options) else ()


STAGES: tuple[Stage, ...] = (
    Stage("frames", _frames, "reconstruction.frames", FrameSet, ()),
    Stage("poses", _poses, "reconstruction.poses", PosedFrames, ("frames",), outside=outside_poses),
    Stage("depth", _depth, "reconstruction.depth", DepthMaps, ("poses",)),
    Stage("world", _world, "reconstruction.world", WorldFrame, ("poses", "depth")),
    Stage("gaussians", _gaussians, "reconstruction.gaussians", GaussianScene, ("poses", "depth")),
    Stage("surface", _surface, "reconstruction.surface", Surface, _METRIC),
    Stage(
        "instances", _instances, "reconstruction.instances", InstanceSet, (*_METRIC, "surface"),
        outside=outside_instances,
    ),
    Stage("views", _views, "reconstruction.views", SceneViews, _SEEN, options="avo", on_demand=True),
    Stage(
        "assets", _assets, "reconstruction.assets", AssetSet, _SEEN, needs_also=_views_of_assets,
        outside=outside_assets,
    ),
    Stage(
        "scene_graph", _scene_graph, "reconstruction.scene_graph", MergedGraph, ("assets",),
        needs_also=_views_of_graph, outside=outside_scene_graph,
    ),
    Stage("assembly", _assembly, "reconstruction.assembly", AssembledScene, ("assets", "scene_graph")),
)  # fmt: skip
STAGE_NAMES = tuple(stage.name for stage in STAGES)
DEFAULT_STAGE_NAMES = tuple(stage.name for stage in STAGES if not stage.on_demand)


def in_world(results: Mapping[str, Any]) -> tuple[PosedFrames, DepthMaps]:
    """Return the posed frames and the corrected depth maps, in world space, metres."""
    world, scene = results["world"], results["gaussians"]
    posed = world.apply_to(scene.posed(results["poses"]))
    return posed, world.depth_in_world(scene.depth, posed)


def view_scene(results: Mapping[str, Any]) -> ViewScene:
    """Return Gaussians, surface and things in world space: the input of `reconstruction.views.find_views`."""
    gaussians = results["gaussians"].in_world(results["world"])
    return prepare_scene(gaussians, results["surface"], results["instances"], results["poses"].camera)
