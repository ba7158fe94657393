"""Reconstruction of a video as a registered scene: all stages, passes at other scales if needed, publication."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from reconstruction.cache import KEPT_PER_STAGE, digest_input
from reconstruction.config import PipelineConfig
from reconstruction.core.progress import NO_PROGRESS, StageListener
from reconstruction.core.types import ObjectAsset
from reconstruction.downloads import as_local
from reconstruction.editing.overrides import Overrides
from reconstruction.frames.load import check_input
from reconstruction.made_by import note_made_by
from reconstruction.publish import publish_scene
from reconstruction.remote_cache import open_store
from reconstruction.runner import Run
from registry import SceneRecord, open_registry
from registry.errors import InputError, UsageError

if TYPE_CHECKING:
    from reconstruction.measure.oracle import Oracle

_FEW_REGISTERED = 0.9  # of the keyframes; as a good film has in benchmarks/check_films.py
_OBJECT_SCALE_PASSES = 3
_OBJECT_SCALE_TOLERANCE = 0.015  # relative; half of the 1-sigma that is reported for such a scale


@dataclass(frozen=True)
class Reconstruction:
    """Result of `reconstruct`."""

    record: SceneRecord
    run: Run

    @property
    def env_id(self) -> str:
        """Id for `gym.make`."""
        return f"SimRecon/{self.record.scene_id}"


def reconstruct(
    video: Path | str,
    *,
    scene_id: str | None = None,
    registry_root: Path | None = None,
    work_dir: Path | str | None = None,
    config: PipelineConfig | None = None,
    overrides: Overrides | None = None,
    oracle: "Oracle | None" = None,
    require_stable: bool = False,
    keep_results: int = KEPT_PER_STAGE,
    listener: StageListener = NO_PROGRESS,
    after_stage: Callable[[Run, str], None] | None = None,
) -> Reconstruction:
    """Reconstruct a video, or a folder of images, as a scene of the registry.

    Args:
        video: any file that ffmpeg decodes, or a folder of images in name order; also at an address of fsspec, from
            which it is downloaded once.
        scene_id: id in the registry, `[a-z0-9_]+`; None: the next free `sceneNNNN`.
        registry_root: folder of the registry; None: `$SIMRECON_HOME/registry` or `~/.simrecon/registry`.
        work_dir: folder of the stage cache; None: a folder beside the registry, named by the digest of the input. An
            address of fsspec (`s3://lab/work`): that folder, with a copy at the address.
        config: options of all stages.
        overrides: the user's corrections.
        oracle: stages that the ground truth replaces, to measure their share of the errors.
        require_stable: do not publish a scene in which an object moves in the final simulation.
        keep_results: number of results of each stage that stay in the stage cache.
        listener: receives stages, progress and notes.
        after_stage: called with the run and the name of each stage that is computed or loaded; it must return at once.

    Raises:
        UsageError: the video does not exist, the id is malformed, or an option names an unknown backend.
        InputError: the video cannot be reconstructed.
        SceneBusy: another process is reconstructing the same scene into the same registry.
        EnvironmentMissing: no disk space, no permission, or a missing package, key or endpoint.
    """
    started = time.perf_counter()
    video = as_local(video)
    check_input(video)
    _check_names(video, registry_root, work_dir)
    config = config or PipelineConfig()
    _check_backends(config)
    registry = open_registry(registry_root, create=True)
    holder = registry.hold(scene_id) if scene_id is not None else registry.reserve_next_id()
    with holder as held_id:
        scene_id = scene_id or held_id
        assert scene_id is not None
        digest = digest_input(video)
        with open_store(work_dir, registry.root, digest, keep_results, listener.note) as store:
            run = Run(
                video,
                config,
                store,
                overrides or Overrides(),
                oracle,
                listener,
                input_digest=digest,
                started=started,
                after_stage=_after(after_stage),
            )
            try:
                run.execute()
            except InputError as error:
                if run.results.keys() & {"poses"}:
                    raise
                raise InputError("\n".join([str(error), *_check_summary(video)])) from error
            run = _with_object_scale(run)
            record = publish_scene(run, registry, scene_id, require_stable=require_stable)
            store.note_published(scene_id, record.revision, run.keys)
            note_made_by(store.work_dir, scene_id, video, run.overrides.file)
    return Reconstruction(record, run)


def _check_names(*paths: Path | str | None) -> None:
    """Raise now, not when the scene is published, if a path cannot be written into a bundle."""
    for path in paths:
        try:
            str(path or "").encode()
        except UnicodeEncodeError:
            shown = str(path).encode("utf-8", "backslashreplace").decode()
            raise UsageError(
                f"{shown}: this name is not UTF-8. Rename the file or folder, and run again"
            ) from None


def _after(also: Callable[[Run, str], None] | None) -> Callable[[Run, str], None]:
    """Return the callback after each stage: the check of the poses, then `also`."""

    def after(run: Run, stage: str) -> None:
        _check_registered(run, stage)
        if also is not None:
            also(run, stage)

    return after


def _check_registered(run: Run, stage: str) -> None:
    """Note what `simrecon check` finds if the poses stage, just computed, left many keyframes without a pose."""
    if stage != "poses" or stage not in run.computed:
        return
    posed = run.results["poses"]
    if len(posed.images) < _FEW_REGISTERED * posed.chosen_frames:
        for line in _check_summary(run.video):
            run.listener.note(line)


def _check_summary(video: Path) -> list[str]:
    """Return one line with the properties that fail in `simrecon check`, and advice on the first of them.

    The list is empty if none fails, or if the film cannot be read.
    """
    from reconstruction.precheck import judge_film

    try:
        report = judge_film(video)
    except InputError:
        return []
    failed = [line for line in report.lines if line.status == "fail"]
    if not failed:
        return []
    names = ", ".join(line.name for line in failed)
    return [f"`simrecon check {video.name}` fails it for: {names}. {failed[0].advice}"]


def _check_backends(config: PipelineConfig) -> None:
    """Raise now, not minutes later, if a backend lacks its package, folder, endpoint or key."""
    for plugin in config.plugins():
        plugin.load()
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
    """Apply `--scale object:ID.height=H`: run again at other scales until the object has height H."""
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
                f"--scale {run.config.world.scale}: no object is found at that scale. Is the height in metres?"
            )
        # Ids are ordered by size and may change with the scale; the place does not.
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
    """Return the position of an object in `sfm` space, (3,), which does not depend on the scale."""
    return np.linalg.solve(run.results["world"].world_from_sfm, item.world_from_object[:, 3])[:3]
