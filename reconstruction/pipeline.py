"""From a video to a scene: the stages in order, what each reads and what it makes. The first file to read.

    frames -> poses -> depth -> world -> gaussians -> surface
    -> instances (-> views) -> assets -> scene_graph -> assembly -> publish

Each stage is a function from artifacts (`reconstruction.core.types`) to an artifact, with options of its own. Depth
comes before the world frame, because the normals of depth maps tell gravity. Gaussians are fitted in the space of the
poses, so that another scale needs no other fit; they correct the depth maps. From `surface` on everything is in
metres, +z up, floor at z = 0. `views` is done only where a stage or a command asks for it.

`runner.Run` runs the stages: it keeps results, measures, corrects. `video_to_scene.reconstruct` is the whole way, from
the video to the registry.
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
    """Inputs of a stage: its options, the results that it declares, folders."""

    video: Path
    options: Any
    results: Mapping[str, Any]  # of the stages that it needs, by name
    scratch: Path  # empty, removed afterwards
    kept: Path  # the run's own folder, for what is worth keeping between runs
    progress: Progress

    def __getitem__(self, stage: str) -> Any:
        """Return the result of a stage before."""
        return self.results[stage]

    def in_world(self) -> tuple[PosedFrames, DepthMaps]:
        """Return frames and corrected depth maps in world space, metres."""
        return in_world(self.results)

    def view_scene(self) -> ViewScene:
        """Return the Gaussians, surface and things that views are chosen of."""
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
    return make_instances(*call.in_world(), call["surface"], call.options, progress=call.progress)


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
    """One stage."""

    name: str
    make: Callable[[Call], Any]
    package: str  # its code; a change there, or in what it imports, makes the stage anew
    produces: type
    needs: tuple[str, ...]
    needs_also: Callable[[Any], tuple[str, ...]] = _nothing  # by its options
    outside: Callable[[Any], tuple[str, ...]] = _nothing  # what its options name, for the fingerprint
    options: str = ""  # name of its options, where it is not that of the stage
    on_demand: bool = False  # done only where another stage or a command needs it


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
    """Return the posed frames and the depth maps that the Gaussians corrected, in world space, metres."""
    world, scene = results["world"], results["gaussians"]
    return world.apply_to(scene.posed(results["poses"])), world.scale_depth(scene.depth)


def view_scene(results: Mapping[str, Any]) -> ViewScene:
    """Return Gaussians, surface and things in world space, the input of `reconstruction.views.find_views`."""
    gaussians = results["gaussians"].in_world(results["world"])
    return prepare_scene(gaussians, results["surface"], results["instances"], results["poses"].camera)
