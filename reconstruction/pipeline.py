"""From a video to a registered scene: the stages in order, wired, cached and measured. The first file to read.

    frames -> poses -> depth -> world -> gaussians -> surface
    -> instances (-> views) -> assets -> scene_graph -> assembly -> publish

Each stage is a function from artifacts to an artifact (`reconstruction.types`) with its own config. Depth comes before
the world frame because the depth maps' normals are what tells gravity. Gaussians are fitted in the space of the
poses, so that another scale does not ask for another fit, and correct the depth maps; from `surface` on everything is
in metres, +z up, floor at z = 0. `views` is done only where something asks for it: a generator, a vision-language
model, `simrecon show --views`. `Run` remembers each stage's result under the fingerprint of what went into it.
"""

import importlib
import logging
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from reconstruction.avo import SceneViews
from reconstruction.cache import KEPT_PER_STAGE, StageStore, digest_input, fingerprint
from reconstruction.compiling import compilation_shown
from reconstruction.config import PipelineConfig
from reconstruction.editing.anchors import Footage, Pointer
from reconstruction.editing.overrides import Overrides
from reconstruction.gaussians import GaussianScene
from reconstruction.poses.lens import Lens
from reconstruction.profiling import Usage, UsageMeter
from reconstruction.progress import NO_PROGRESS, Progress, StageListener
from reconstruction.scene_graph import MergedGraph
from reconstruction.types import (
    AssembledScene,
    AssetSet,
    DepthMaps,
    FrameSet,
    InstanceSet,
    ObjectAsset,
    PosedFrames,
    Surface,
    WorldFrame,
)
from registry import SceneRecord, SceneRegistry
from registry.errors import InputError, UsageError

if TYPE_CHECKING:
    from reconstruction.avo import ViewScene
    from reconstruction.oracle import Oracle

logger = logging.getLogger(__name__)

_OBJECT_SCALE_PASSES = 3
_OBJECT_SCALE_TOLERANCE = 0.015  # half of what the scale is said to be sure to


@dataclass(frozen=True)
class Stage:
    """One stage: where its code is, what it makes, and which stages it reads."""

    name: str
    module: str
    produces: type
    needs: tuple[str, ...]
    options: str = ""  # name of its config, where it is not that of the stage
    on_demand: bool = False  # done only where a stage's `wants_views` or a command asks for it


STAGES: tuple[Stage, ...] = (
    Stage("frames", "reconstruction.frames", FrameSet, ()),
    Stage("poses", "reconstruction.poses", PosedFrames, ("frames",)),
    Stage("depth", "reconstruction.depth", DepthMaps, ("poses",)),
    Stage("world", "reconstruction.world", WorldFrame, ("poses", "depth")),
    Stage("gaussians", "reconstruction.gaussians", GaussianScene, ("poses", "depth")),
    Stage("surface", "reconstruction.surface", Surface, ("poses", "gaussians", "world")),
    Stage("instances", "reconstruction.instances", InstanceSet, ("poses", "gaussians", "world", "surface")),
    Stage(
        "views", "reconstruction.avo", SceneViews, ("poses", "gaussians", "world", "surface", "instances"),
        options="avo", on_demand=True,
    ),
    Stage(
        "assets", "reconstruction.assets", AssetSet, ("poses", "gaussians", "world", "surface", "instances")
    ),
    Stage("scene_graph", "reconstruction.scene_graph", MergedGraph, ("assets",)),
    Stage("assembly", "reconstruction.assembly", AssembledScene, ("assets", "scene_graph")),
)  # fmt: skip
STAGE_NAMES = tuple(stage.name for stage in STAGES)
DEFAULT_STAGE_NAMES = tuple(stage.name for stage in STAGES if not stage.on_demand)


@dataclass
class Run:
    """One reconstruction in progress: results by stage name, with their fingerprints and costs."""

    video: Path
    config: PipelineConfig
    store: StageStore
    overrides: Overrides = field(default_factory=Overrides)
    oracle: "Oracle | None" = None  # stages whose output the truth replaces, for measuring
    listener: StageListener = NO_PROGRESS
    results: dict[str, Any] = field(default_factory=dict)
    keys: dict[str, str] = field(default_factory=dict)
    usage: dict[str, Usage] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    input_digest: str = ""  # of the video; computed where it is not given
    computed: set[str] = field(default_factory=set)  # stages that this run did itself; the others were kept
    started: float = field(default_factory=time.perf_counter)

    def __post_init__(self) -> None:
        """Digest the input once."""
        self.input_digest = self.input_digest or digest_input(self.video)

    def execute(self, until: str = STAGE_NAMES[-1]) -> None:
        """Run or load every stage up to and including `until`, and of those on demand what is asked for."""
        wanted = self.wanted_stages()
        if until not in wanted:
            wanted = tuple(name for name in STAGE_NAMES if name in (*wanted, until))
        for stage in STAGES:
            if stage.name in wanted:
                self._execute_stage(stage, wanted)
            if stage.name == until:
                return

    def complete(self, name: str) -> None:
        """Run or load one stage whose inputs are among the results already."""
        self._execute_stage(next(stage for stage in STAGES if stage.name == name), (name,))

    def wanted_stages(self) -> tuple[str, ...]:
        """Return the stages that make this scene, in order."""
        asked = {name for stage in STAGES for name in self.needs_of(stage)}
        return tuple(stage.name for stage in STAGES if not stage.on_demand or stage.name in asked)

    def needs_of(self, stage: Stage) -> tuple[str, ...]:
        """Return which stages a stage reads under this config."""
        wants_views = getattr(importlib.import_module(stage.module), "wants_views", None)
        wanted = wants_views is not None and wants_views(self.options_of(stage))
        return (*stage.needs, "views") if wanted else stage.needs

    def options_of(self, stage: Stage) -> Any:
        """Return a stage's config."""
        return getattr(self.config, stage.options or stage.name)

    def view_scene(self) -> "ViewScene":
        """Return what `reconstruction.avo.find_views` looks at, for views of any things or regions of them."""
        from reconstruction.avo import prepare_scene

        done = self.results
        gaussians = done["gaussians"].in_world(done["world"])
        return prepare_scene(gaussians, done["surface"], done["instances"], done["poses"].camera)

    def _execute_stage(self, stage: Stage, wanted: tuple[str, ...]) -> None:
        number = (
            STAGE_NAMES.index(stage.name) + 1
        )  # of its folder; people are told its place among those wanted
        config = self.options_of(stage)
        upstream = tuple(self.keys[name] for name in self.needs_of(stage)) or (self.input_digest,)
        options = ()
        if stage.name == "poses" and config.import_path and Path(config.import_path).exists():
            options += (digest_input(Path(config.import_path)),)
        outside = getattr(importlib.import_module(stage.module), "outside_inputs", None)
        if outside is not None:
            options += outside(config)
        if self.oracle is not None and self.oracle.of_stage(stage.name):
            options += (self.oracle.of_stage(stage.name),)

        def key_with(corrections: list) -> str:
            return fingerprint(stage.name, stage.module, (config, corrections, *options), upstream)

        corrections = self.overrides.fingerprint_of_stage(stage.name)
        key = self.keys[stage.name] = key_with(corrections)
        cached = self.store.has(number, stage.name, key)
        self.listener.begin_stage(stage.name, wanted.index(stage.name) + 1, len(wanted), cached)
        if not cached:
            with compilation_shown(self.listener) as shown:
                if corrections:
                    self._keep_corrected(number, stage, key_with([]), key, shown)
                else:
                    self._keep(number, stage, key, lambda noted: self._compute(stage, config, noted), shown)
            self.computed.add(stage.name)
        manifest = self.store.manifest(number, stage.name, key)
        # Always continue from what is on disk: a resumed run then computes with the very same values.
        self.results[stage.name] = self.store.load(stage.produces, number, stage.name, key)
        self.usage[stage.name] = Usage(**manifest["usage"])
        self.notes.extend(
            note if note.startswith(f"{stage.name}:") else f"{stage.name}: {note}"
            for note in manifest["notes"]
        )
        self.listener.end_stage(stage.name, None if cached else self.usage[stage.name])

    def _keep(
        self,
        number: int,
        stage: Stage,
        key: str,
        make: Callable[[Progress], Any],
        shown: Progress,
        before: dict | None = None,
    ) -> None:
        """Make a stage's result and keep it; `before` is the manifest of the result that it was made from."""
        notes = list(before["notes"]) if before else []
        with UsageMeter() as meter:
            result = make(_NoteTaker(shown, notes))
        usage = meter.usage if before is None else Usage(**before["usage"]).followed_by(meter.usage)
        config = self.options_of(stage)
        record = {"stage": stage.name, "key": key, "usage": asdict(usage), "notes": notes, "config": config}
        self.store.save(result, number, stage.name, key, record)

    def _keep_corrected(self, number: int, stage: Stage, plain_key: str, key: str, shown: Progress) -> None:
        """Correct a stage's result as the user says; the result before that is kept too, for the next correction."""
        config = self.options_of(stage)
        if not self.store.has(number, stage.name, plain_key):
            self._keep(number, stage, plain_key, lambda noted: self._compute(stage, config, noted), shown)
        plain = self.store.load(stage.produces, number, stage.name, plain_key)
        before = self.store.manifest(number, stage.name, plain_key)
        self._keep(number, stage, key, lambda _: self._corrected(stage, plain), shown, before)

    def _corrected(self, stage: Stage, plain: Any) -> Any:
        done = self.results
        if stage.name == "instances":
            return self.overrides.apply_to_instances(self._pointer(plain))
        pointer = self._pointer(done["instances"])
        if stage.name == "assets":
            return self.overrides.apply_to_assets(plain, pointer)
        if stage.name == "assembly":
            assets, graph = done["assets"], done["scene_graph"].plain()
            movable = self.overrides.movable(assets, graph, pointer)
            return importlib.import_module(stage.module).assemble(
                assets, graph, self.config.assembly, movable=movable
            )
        return self.overrides.apply_to_graph(plain, done["assets"], pointer)

    def _pointer(self, found: InstanceSet) -> Pointer:
        """Return what addresses of the overrides are looked up in."""
        posed, depth = self.in_world()
        surface = self.results["surface"]
        return Pointer(found, surface, Footage(posed, depth, surface, self.lens()))

    def lens(self) -> Lens:
        """Return the map from the film's pixels to those of its straightened frames."""
        return Lens.measure(self.results["frames"], self.results["poses"])

    def _compute(self, stage: Stage, config: Any, progress: Progress) -> Any:
        module = importlib.import_module(stage.module)
        done = self.results
        if self.oracle is not None and stage.name in self.oracle.stages:
            return self._ask_oracle(stage, config, progress)
        if stage.name == "frames":
            return module.load_frames(self.video, config, progress=progress)
        if stage.name == "poses":
            scratch = self.store.scratch(stage.name)
            try:
                return module.estimate_poses(done["frames"], config, work_dir=scratch, progress=progress)
            finally:
                self.store.discard(scratch)
        if stage.name == "depth":
            return module.estimate_depth(done["poses"], config, progress=progress)
        if stage.name == "world":
            return module.find_world(done["poses"], done["depth"], config, progress=progress)
        if stage.name == "gaussians":
            if self.oracle is not None and "depth" in self.oracle.stages:
                config = replace(config, refine_depth=False)  # the truth has nothing to gain
            return module.make_gaussians(done["poses"], done["depth"], config, progress=progress)
        if stage.name == "scene_graph":
            return module.infer_scene_graph(
                done["assets"],
                config,
                make_scene=self.view_scene,
                records=self.store.work_dir / module.RECORDS,
                progress=progress,
            )
        if stage.name == "assembly":
            return module.assemble(done["assets"], done["scene_graph"].plain(), config, progress=progress)
        if stage.name == "views":
            return module.make_views(self.view_scene(), done["instances"], config, progress=progress)
        posed, depth = self.in_world()
        if stage.name == "surface":
            return module.fuse_surface(posed, depth, config, progress=progress)
        if stage.name == "instances":
            return module.make_instances(posed, depth, done["surface"], config, progress=progress)
        views = done["views"] if "views" in self.needs_of(stage) else None
        return module.build_assets(
            posed,
            depth,
            done["surface"],
            done["instances"],
            config,
            views=views,
            keep=self.store.work_dir / "collision",
            progress=progress,
        )

    def _ask_oracle(self, stage: Stage, config: Any, progress: Progress) -> Any:
        progress.note(f"{stage.name}: taken from the ground truth")
        done = self.results
        if stage.name == "poses":
            scratch = self.store.scratch(stage.name)
            try:
                return self.oracle.poses(done["frames"], config, work_dir=scratch, progress=progress)
            finally:
                self.store.discard(scratch)
        if stage.name == "depth":
            from reconstruction.depth.estimate import sized_camera

            return self.oracle.depth(done["poses"], sized_camera(done["poses"].camera, config.depth_side_px))
        if stage.name == "world":
            return self.oracle.world(done["poses"])
        return self.oracle.instances(*self.in_world(), done["surface"])

    def in_world(self) -> tuple[PosedFrames, DepthMaps]:
        """Return the posed frames and the depth maps that the Gaussians corrected, in world space, in metres."""
        world: WorldFrame = self.results["world"]
        scene: GaussianScene = self.results["gaussians"]
        return world.apply_to(scene.posed(self.results["poses"])), world.scale_depth(scene.depth)


class _NoteTaker:
    """Passes progress on and keeps the notes for the stage's manifest."""

    def __init__(self, listener: Progress, notes: list[str]) -> None:
        self._listener, self._notes = listener, notes
        self.start, self.advance = listener.start, listener.advance

    def note(self, message: str) -> None:
        self._notes.append(message)
        logger.info(message)
        self._listener.note(message)


@dataclass(frozen=True)
class Reconstruction:
    """What `reconstruct` returns."""

    record: SceneRecord
    run: Run

    @property
    def env_id(self) -> str:
        """The id to give to `gym.make`."""
        return f"SimRecon/{self.record.scene_id}"


def reconstruct(
    video: Path,
    *,
    scene_id: str | None = None,
    registry_root: Path | None = None,
    work_dir: Path | None = None,
    config: PipelineConfig | None = None,
    overrides: Overrides | None = None,
    oracle: "Oracle | None" = None,
    require_stable: bool = False,
    keep_results: int = KEPT_PER_STAGE,
    listener: StageListener = NO_PROGRESS,
) -> Reconstruction:
    """Turn a video (or a folder of images) into a registered scene.

    Args:
        video: any file that ffmpeg decodes, or a folder of images in name order.
        scene_id: id in the registry, `[a-z0-9_]+`; None takes the next free `sceneNNNN`.
        registry_root: where scenes live; None is `$SIMRECON_HOME/registry` or `~/.simrecon/registry`.
        work_dir: where finished stages are kept for resuming; None is a folder beside the registry, named by the
            input's digest.
        config: options of every stage.
        overrides: the user's corrections.
        oracle: stages that the ground truth replaces, to measure what they cost.
        require_stable: refuse to publish a scene in which an object does not stay put.
        keep_results: how many results of each stage stay in the work folder; more of them make going back and forth
            between several configs cheap.
        listener: told of stages, progress and notes.

    Raises:
        UsageError: the video does not exist, or the id is malformed.
        InputError: the video cannot be reconstructed.
        SceneBusy: another process is reconstructing the same scene into the same registry.
        EnvironmentMissing: no space, no permission, something not installed.
    """
    from reconstruction.publish import publish_scene

    started = time.perf_counter()
    video = Path(video)
    if not video.exists():
        raise UsageError(f"{video}: no such file or folder")
    config = config or PipelineConfig()
    _refuse_missing(config)
    registry = SceneRegistry(registry_root, create=True)
    holder = registry.hold(scene_id) if scene_id is not None else registry.reserve_next_id()
    with holder as held_id:
        scene_id = scene_id or held_id
        digest = digest_input(video)
        folder = Path(work_dir) if work_dir else registry.root.parent / "work" / digest[:16]
        run = Run(
            video,
            config,
            StageStore(folder, keep_results),
            overrides or Overrides(),
            oracle,
            listener,
            input_digest=digest,
            started=started,
        )
        run.execute()
        run = _with_object_scale(run)
        record = publish_scene(run, registry, scene_id, require_stable=require_stable)
        run.store.note_published(scene_id, record.revision, run.keys)
    return Reconstruction(record, run)


def _refuse_missing(config: PipelineConfig) -> None:
    """Raise what a backend lacks now, not minutes later: a folder, an endpoint, a key."""
    if config.instances.masks == "folder":
        from reconstruction.instances.masks import load_mask_backend

        load_mask_backend(config.instances)
    if config.instances.labels == "vlm":
        from reconstruction.instances import load_namer

        load_namer(config.instances)
    if config.assets.physics != "table":
        from reconstruction.assets.physics.load import load_physicist

        load_physicist(config.assets)
    if config.scene_graph.backend != "geometry":
        from reconstruction.scene_graph.load import check_backend

        check_backend(config.scene_graph)
    if config.assets.generator != "none":
        from reconstruction.assets.generation import check_generator

        check_generator(config.assets)


def _with_object_scale(run: Run) -> Run:
    """Apply `--scale object:ID.height=H`: run again at the scale that its height asks for, until it is that high."""
    from reconstruction.world import parse_scale, settle_object_height

    request = parse_scale(run.config.world.scale) if run.config.world.scale else None
    if request is None or request.kind != "object" or run.results["world"].scale.method == "marker":
        return run
    found = [item for item in run.results["assets"].objects if item.id == request.object_id]
    if not found:
        ids = ", ".join(f"{item.id} ({item.label})" for item in run.results["assets"].objects)
        raise UsageError(
            f"--scale {run.config.world.scale}: no object {request.object_id}; there are {ids or 'none'}"
        )
    place = _place_in_sfm(run, found[0])
    passes: dict[float, Run] = {}

    def height_at(measured_m: float) -> float:
        world = replace(run.config.world, object_measured_height_m=measured_m)
        again = replace(run, config=replace(run.config, world=world), results={}, keys={}, usage={}, notes=[])
        again.execute()
        passes[measured_m] = again
        objects = again.results["assets"].objects
        if not objects:
            raise InputError(
                f"--scale {run.config.world.scale}: at that scale nothing is found any more. Is it in metres?"
            )
        # Ids are given by size and may change with the scale; the place stays.
        return _height(min(objects, key=lambda item: np.linalg.norm(_place_in_sfm(again, item) - place)))

    best, error = settle_object_height(
        _height(found[0]),
        request.value_m,
        height_at,
        tolerance=_OBJECT_SCALE_TOLERANCE,
        passes=_OBJECT_SCALE_PASSES,
    )
    again = passes[best]
    if best != list(passes)[-1]:
        again.results, again.keys, again.usage, again.notes = {}, {}, {}, []
        again.execute()
    again.notes.append(
        f"world: object {request.object_id} ends {error:.1%} off the {request.value_m:g} m asked for"
    )
    return again


def _height(item: ObjectAsset) -> float:
    return float(np.ptp(item.visual.vertices[:, 2]))


def _place_in_sfm(run: Run, item: ObjectAsset) -> np.ndarray:
    """Return where an object is in sfm space, which the scale does not change."""
    return np.linalg.solve(run.results["world"].world_from_sfm, item.world_from_object[:, 3])[:3]
