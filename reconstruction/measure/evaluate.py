"""Evaluate a scene: the metrics of CONTRACT sections 4 and 5, and figures of each stage with a kept result."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.frames import HELD_OUT_EVERY
from reconstruction.measure import stages as stage_figures
from reconstruction.measure.alignment import Alignment, align
from reconstruction.measure.ground_truth import GroundTruth
from reconstruction.measure.object_boxes import instance_box_figures
from reconstruction.measure.object_scores import score_graph, score_objects
from reconstruction.measure.outlines import measure_outlines
from reconstruction.measure.perceptual import perceptual_scores
from reconstruction.measure.planes import planes_figures
from reconstruction.measure.rendering import before_backdrop, render_views, score_pictures, video_frames
from reconstruction.measure.scene import (
    PlacedMesh,
    backdrop_mesh,
    bundle_camera,
    bundle_poses,
    joined,
    placed_meshes,
)
from reconstruction.measure.stage_results import StageResults
from reconstruction.measure.surfaces import COMPOSITION_POINTS, OBJECT_POINTS, compare, sample_seen
from reconstruction.measure.visibility import spread_poses
from registry import SceneBundle
from registry.errors import UsageError
from registry.report_card import physics_report
from registry.simulation import specs_from_bundle

SCHEMA = "simrecon.evaluation/1"
COMPOSITION_BOUND_M = 0.05  # of the F-score, CONTRACT section 4
_PHYSICS_KEYS = (
    "stable_rate",
    "stable_rate_10cm_0.1rad",
    "stable_rate_5cm_drop_5deg",
    "spawn_penetration_mm",
    "floating_rate",
)


@dataclass
class Evaluation:
    """The evaluation of one scene; `metrics` has the names of CONTRACT sections 4 and 5."""

    scene: str
    revision: str
    ground_truth: str | None
    metrics: dict[str, float | None] = field(default_factory=dict)
    objects: list[dict[str, Any]] = field(default_factory=list)  # one per evaluated true object
    extra: list[dict[str, Any]] = field(default_factory=list)  # found objects without a match
    stages: dict[str, dict[str, Any]] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)  # metric or stage -> why it is missing
    labels: str | None = None  # path of the outlines
    outlines: dict[str, Any] = field(default_factory=dict)  # `OutlineScores.to_json()`

    def leave_out(self, reason: str, *names: str) -> None:
        """Record why metrics or stages are missing."""
        self.left_out.update(dict.fromkeys(names, reason))

    def to_json(self) -> dict[str, Any]:
        """Return strict JSON values; numbers that are not finite become null."""
        return json.loads(
            json.dumps({"schema": SCHEMA, **asdict(self)}, default=float), parse_constant=lambda _: None
        )


def evaluate_scene(
    bundle: SceneBundle,
    ground_truth: Path | None,
    *,
    labels: Path | None = None,
    stages: StageResults | None = None,
    video: Path | None = None,
    composition_points: int = COMPOSITION_POINTS,
    object_points: int = OBJECT_POINTS,
    progress: Progress = NO_PROGRESS,
) -> Evaluation:
    """Evaluate a scene against ground truth, or without it what needs none (physics, rendering, registration).

    Args:
        bundle: the scene.
        ground_truth: folder of CONTRACT section 3, or of cameras and depth only; may be None.
        labels: outlines drawn by hand (CONTRACT section 5, COCO or labelme); may be None.
        stages: results of the scene's stages, for figures per stage; None: no such figures.
        video: gives held-out frames if the stage results are missing; None: the video beside the ground truth.
        composition_points: samples per composition; the contract's figures need the default.
        object_points: samples per object; the contract's figures need the default.
        progress: advanced after each part.

    Raises:
        UsageError: the truth or the labels are malformed, or not of this video.
    """
    truth = None if ground_truth is None else GroundTruth.load(ground_truth)
    out = Evaluation(bundle.scene["id"], bundle.revision, None if ground_truth is None else str(ground_truth))
    stages = stages or StageResults({}, {})
    scene = placed_meshes(bundle)
    parts: list[Callable[[], None]] = [
        lambda: _add_outlines(bundle, scene, labels, stages, video, out),
        lambda: _add_cost(bundle, out),
        lambda: _add_physics(bundle, out),
        lambda: _add_rendering(bundle, scene, stages, _video_of(video, ground_truth), out),
        lambda: _add_holes(bundle, scene, out),
    ]
    alignment = None
    if truth is not None:
        alignment = align(bundle_poses(bundle), truth.world_from_camera, truth.up)
        moved = [mesh.moved(alignment.true_from_estimated) for mesh in scene]
        _add_cameras(alignment, out)
        parts += [
            lambda: _add_composition(moved, truth, stages, alignment, composition_points, out),
            lambda: _add_objects(bundle, moved, truth, object_points, out),
            lambda: _add_stages(truth, stages, alignment, out),
        ]
    else:
        reason = "no ground truth was given" if labels is None else "labels have outlines only"
        out.left_out["cameras, geometry, objects, graph"] = reason
    parts.append(lambda: _add_gaussians(truth, alignment, stages, out))
    progress.start(len(parts), "measuring")
    for part in parts:
        part()
        progress.advance()
    out.left_out.update({f"stage {name}": reason for name, reason in stages.missing.items()})
    return out


def _video_of(video: Path | None, ground_truth: Path | None) -> Path | None:
    if video is not None:
        if not video.exists():
            raise UsageError(f"{video}: no such video or folder")
        return video
    if ground_truth is None:
        return None
    beside = [folder / "video.mp4" for folder in (Path(ground_truth).parent, Path(ground_truth))]
    return next((path for path in beside if path.is_file()), None)


def _add_cost(bundle: SceneBundle, out: Evaluation) -> None:
    report = bundle.scene["report"]
    out.metrics["time_s"] = float(sum(report["timings_s"].values()))
    out.metrics["peak_memory_mb"] = float(report["peak_memory_mb"])
    out.metrics["objects"] = len(bundle.scene["objects"])
    registration = report.get("registration")
    if registration:
        out.metrics.update(
            frames_chosen=registration["keyframes"], frames_registered=registration["registered"]
        )


def _add_outlines(
    bundle: SceneBundle,
    scene: list[PlacedMesh],
    labels: Path | None,
    stages: StageResults,
    video: Path | None,
    out: Evaluation,
) -> None:
    if labels is None:
        out.left_out["outlines"] = "no labels were given"
        return
    scores = measure_outlines(bundle, scene, labels, stages, video)
    out.labels, out.outlines = str(labels), scores.to_json()
    out.metrics.update(scores.metrics)
    if scores.metrics["outline_edges"] is None:
        out.leave_out(
            "no object is found together with its parent, or the labels have no parents", "outline_edges"
        )
    if scores.without_camera:
        numbers = ", ".join(map(str, scores.without_camera))
        out.leave_out("the scene has no camera for it", f"outlines of frame {numbers}")


def _add_physics(bundle: SceneBundle, out: Evaluation) -> None:
    report = physics_report(specs_from_bundle(bundle), bundle.edges)  # pyright: ignore[reportArgumentType] - frozen
    out.metrics.update({key: report[key] for key in _PHYSICS_KEYS})
    out.metrics["dynamic_objects"] = report["dynamic_objects"]
    assembled = [o["assembly"] for o in bundle.scene["objects"] if "assembly" in o]
    moved_cm = [100 * item["moved_m"] for item in assembled]
    out.stages["assembly"] = {
        "median_moved_cm": float(np.median(moved_cm)) if moved_cm else 0.0,
        "max_moved_cm": max(moved_cm, default=0.0),
        "repaired": sum(bool(item["repair"]) for item in assembled),
        "fixed_objects": report["fixed_objects"],
        "without_collision": report["without_collision"],
        "physics": report["objects"],
    }


def _add_rendering(
    bundle: SceneBundle, scene: list[PlacedMesh], stages: StageResults, video: Path | None, out: Evaluation
) -> None:
    camera = bundle_camera(bundle)
    poses = {i: pose for i, pose in bundle_poses(bundle).items() if i % HELD_OUT_EVERY == 0}
    posed = stages.get("poses")
    if posed is not None:
        frames = {int(i): np.asarray(x) for i, x in zip(posed.held_out_indices, posed.held_out_images)}
        source = "undistorted by the poses stage"
    elif video is not None:
        frames, source = video_frames(video, sorted(poses), camera), "as decoded from the video"
    else:
        reason = "the held-out frames are not stored; give --video, or reconstruct the scene again"
        out.leave_out(reason, "psnr_db", "ssim", "coverage")
        return
    indices = sorted(set(poses) & set(frames))
    if not indices:
        reason = "no held-out frame could be registered (a small folder of images has none)"
        out.leave_out(reason, "psnr_db", "ssim", "coverage")
        return
    pictures, covered = render_views(
        [(m.visual, m.world_from_mesh) for m in scene], camera, [poses[i] for i in indices]
    )
    true = [frames[i] for i in indices]
    shown, _ = before_backdrop(pictures, covered, backdrop_mesh(bundle), camera, [poses[i] for i in indices])
    whole = score_pictures(shown, [np.ones_like(mask) for mask in covered], true)
    if whole is not None:
        out.metrics["psnr_whole_db"] = whole.psnr_db
    score = score_pictures(pictures, covered, true)
    if score is None:
        out.leave_out("the scene covers no pixel of the held-out frames", "psnr_db", "ssim")
        out.metrics["coverage"] = 0.0
        return
    out.metrics.update(psnr_db=score.psnr_db, ssim=score.ssim, coverage=score.coverage)
    out.stages.setdefault("rendering", {}).update(frames=score.frames, frames_from=source)
    perceptual, missing = perceptual_scores(pictures, true)
    out.metrics.update(perceptual)
    out.left_out.update(missing)


def _add_holes(bundle: SceneBundle, scene: list[PlacedMesh], out: Evaluation) -> None:
    """Measure the share of pixels that show neither a mesh nor the backdrop; of keyframes if no frame was kept out."""
    poses = bundle_poses(bundle)
    kept_out = sorted(_held_out(bundle) & set(poses))
    frames = [poses[i] for i in kept_out or sorted(poses)]
    if not frames:
        out.leave_out("the scene has no cameras", "holes")
        return
    camera = bundle_camera(bundle)
    camera = camera.resized(camera.width // 2, camera.height // 2)
    meshes = [(m.visual, m.world_from_mesh) for m in scene]
    pictures, covered = render_views(meshes, camera, frames)
    _, covered = before_backdrop(pictures, covered, backdrop_mesh(bundle), camera, frames)
    out.metrics["holes"] = 1 - float(np.mean(covered))
    out.stages.setdefault("rendering", {})["holes_of"] = "held-out frames" if kept_out else "keyframes"


def _held_out(bundle: SceneBundle) -> set[int]:
    """Return the numbers of the frames that were kept out of fitting."""
    return {int(f["index"]) for f in bundle.scene["cameras"]["frames"] if f.get("held_out", False)}


def _add_cameras(alignment: Alignment, out: Evaluation) -> None:
    out.metrics.update(
        ate_cm=alignment.ate_cm,
        scale_error=abs(alignment.scale - 1),
        tilt_deg=alignment.tilt_deg,
        rotation_median_deg=float(np.median(alignment.rotation_errors_deg)),
        cameras_compared=len(alignment.indices),
    )


def _add_composition(
    scene: list[PlacedMesh],
    truth: GroundTruth,
    stages: StageResults,
    alignment: Alignment,
    count: int,
    out: Evaluation,
) -> None:
    poses = spread_poses(truth.poses)
    if truth.entities:
        true_seen = sample_seen(*truth.mesh, truth.camera, poses, count)
    else:
        true_seen = stage_figures.sensor_surface(truth)
        out.leave_out("the truth is a depth sensor's points, without normals", "nc")
    if not len(true_seen.points):
        out.leave_out("the truth has neither meshes nor depth", "cd_cm", "f_5cm", "nc")
        return
    estimated = sample_seen(*joined(scene), truth.camera, poses, count)
    score = compare(estimated, true_seen, COMPOSITION_BOUND_M)
    if score is None:
        out.leave_out("no part of the scene is visible to the true cameras", "cd_cm", "f_5cm", "nc")
    else:
        out.metrics.update(cd_cm=score.cd_cm, f_5cm=score.f)
        out.metrics.update(accuracy_cm=score.accuracy_cm, completeness_cm=score.completeness_cm)
        if truth.entities:
            out.metrics["nc"] = score.nc
    surface = stages.get("surface")
    if surface is not None:
        figures = stage_figures.surface_figures(
            surface, alignment, truth, true_seen, COMPOSITION_BOUND_M, count
        )
        if not truth.entities:
            figures.pop("nc", None)
        out.stages["surface"] = figures


def _add_objects(
    bundle: SceneBundle, scene: list[PlacedMesh], truth: GroundTruth, count: int, out: Evaluation
) -> None:
    if not truth.entities:
        names = ("object_recall_25", "object_precision_25", "object_cd_cm", "object_f_1cm", "graph_f1")
        out.leave_out("the truth has no entities", *names)
        return
    scores = score_objects([m for m in scene if not m.base], truth, count)
    edges, base = bundle.scene["graph"]["edges"], [m for m in scene if m.base]
    out.metrics.update(scores.metrics)
    out.metrics.update(score_graph(edges, base, truth, scores.true_of, scores.records))
    out.objects, out.extra = scores.records, scores.extra


def _add_stages(truth: GroundTruth, stages: StageResults, alignment: Alignment, out: Evaluation) -> None:
    posed, depth = stages.in_world()
    surface, instances = stages.get("surface"), stages.get("instances")
    if posed is None:
        return
    out.stages["poses"] = stage_figures.poses_figures(posed, alignment, truth)
    if depth is not None:
        figures = stage_figures.depth_figures(posed, depth, alignment, truth)
        if figures is None:
            out.leave_out("the truth has no meshes", "stage depth")
        else:
            out.stages["depth"] = figures
    if surface is not None:
        figures = stage_figures.surface_depth_figures(posed, surface, alignment, truth) or {}
        out.stages.setdefault("surface", {}).update({f"depth_{key}": value for key, value in figures.items()})
        found = planes_figures(surface, alignment, truth)
        if found is not None:
            out.stages["surface"]["planes"] = found
    if surface is not None and instances is not None:
        if truth.entities:
            on_surface = stage_figures.instance_figures_3d(surface, instances, alignment, truth)
            per_view = stage_figures.instance_figures_2d(posed, surface, instances, truth)
            boxes = instance_box_figures(surface, instances, alignment, truth)
            out.stages["instances"] = {"surface": on_surface, "per_view": per_view, "boxes": boxes}
        else:
            out.left_out["stage instances"] = "the truth has no entities"


def _add_gaussians(
    truth: GroundTruth | None, alignment: Alignment | None, stages: StageResults, out: Evaluation
) -> None:
    posed, _ = stages.in_world()
    gaussians, depth = stages.refined_in_world()
    if posed is None or gaussians is None or depth is None:
        return
    out.stages["gaussians"] = stage_figures.gaussians_figures(posed, gaussians, depth, alignment, truth)
