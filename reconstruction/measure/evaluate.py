"""Measure a scene: every metric of CONTRACT sections 4 and 5, and every stage whose result is still at hand."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.frames import HELD_OUT_EVERY
from reconstruction.measure.alignment import Alignment, align
from reconstruction.measure.ground_truth import GroundTruth
from reconstruction.measure.object_boxes import instance_box_figures
from reconstruction.measure.object_scores import score_graph, score_objects
from reconstruction.measure.outlines import measure_outlines
from reconstruction.measure.perceptual import perceptual_scores
from reconstruction.measure.rendering import render_views, score_pictures, video_frames
from reconstruction.measure.scene import (
    PlacedMesh,
    bundle_camera,
    bundle_poses,
    joined,
    placed_meshes,
)
from reconstruction.measure.stage_results import StageResults
from reconstruction.measure.surfaces import (
    COMPOSITION_POINTS,
    compare,
    sample_seen,
)
from reconstruction.measure.visibility import spread_poses
from registry import SceneBundle
from registry.errors import UsageError

SCHEMA = "simrecon.evaluation/1"
COMPOSITION_BOUND_M = 0.05
_PHYSICS_KEYS = (
    "stable_rate",
    "stable_rate_10cm_0.1rad",
    "stable_rate_5cm_drop_5deg",
    "spawn_penetration_mm",
    "floating_rate",
)


@dataclass
class Evaluation:
    """What was measured of one scene. `metrics` has the names of CONTRACT 4 and 5; None is in `left_out`."""

    scene: str
    revision: str
    ground_truth: str | None
    metrics: dict[str, float | None] = field(default_factory=dict)
    objects: list[dict[str, Any]] = field(default_factory=list)  # one per evaluated true object
    extra: list[dict[str, Any]] = field(default_factory=list)  # found objects that match none of them
    stages: dict[str, dict[str, Any]] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)  # metric or stage -> why
    labels: str | None = None  # the file of outlines
    outlines: dict[str, Any] = field(default_factory=dict)  # `OutlineScores.to_json()`

    def to_json(self) -> dict[str, Any]:
        """Return strict JSON values: what is not finite becomes null."""
        return json.loads(json.dumps({"schema": SCHEMA, **asdict(self)}, default=float), parse_constant=_null)


def _null(_: str) -> None:
    return None


def evaluate_scene(
    bundle: SceneBundle,
    ground_truth: Path | None,
    *,
    labels: Path | None = None,
    stages: StageResults | None = None,
    video: Path | None = None,
    composition_points: int = COMPOSITION_POINTS,
    progress: Progress = NO_PROGRESS,
) -> Evaluation:
    """Evaluate a scene against the truth, or without it only what needs none (physics, rendering, registration).

    Args:
        bundle: the scene.
        ground_truth: folder of CONTRACT section 3, or of cameras and depth only; None where there is no truth.
        labels: outlines drawn by hand (CONTRACT section 5, COCO or labelme); None where there are none.
        stages: the results of the scene's stages, for the figures per stage; None leaves them out.
        video: the video, for kept-out frames, where the stages' results are gone; None: the one beside the truth.
        composition_points: drawn on each side's whole surface; the contract's figures need the default.
        progress: told of each part.

    Raises:
        UsageError: the truth or the labels are malformed, or not of this video.
    """
    truth = None if ground_truth is None else GroundTruth.load(ground_truth)
    out = Evaluation(bundle.scene["id"], bundle.revision, None if ground_truth is None else str(ground_truth))
    stages = stages or StageResults({}, {})
    scene = placed_meshes(bundle)
    parts: list[Callable[[], None]] = [
        lambda: _outlines(bundle, scene, labels, stages, video, out),
        lambda: _cost(bundle, out),
        lambda: _physics(bundle, out),
        lambda: _rendering(bundle, scene, stages, _video_of(video, ground_truth), out),
    ]
    alignment = None
    if truth is not None:
        alignment = align(bundle_poses(bundle), truth.world_from_camera, truth.up)
        moved = [mesh.moved(alignment.true_from_estimated) for mesh in scene]
        _cameras(alignment, truth, out)
        parts += [
            lambda: _composition(moved, truth, stages, alignment, composition_points, out),
            lambda: _objects(bundle, moved, truth, out),
            lambda: _stage_figures(truth, stages, alignment, out),
        ]
    else:
        reason = "no ground truth was given" if labels is None else "labels have outlines only"
        out.left_out["cameras, geometry, objects, graph"] = reason
    parts.append(lambda: _gaussians(truth, alignment, stages, out))
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


def _cost(bundle: SceneBundle, out: Evaluation) -> None:
    report = bundle.scene["report"]
    out.metrics["time_s"] = float(sum(report["timings_s"].values()))
    out.metrics["peak_memory_mb"] = float(report["peak_memory_mb"])
    out.metrics["objects"] = len(bundle.scene["objects"])
    registration = report.get("registration")
    if registration:
        out.metrics["frames_chosen"] = registration["keyframes"]
        out.metrics["frames_registered"] = registration["registered"]


def _outlines(
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
        out.left_out["outline_edges"] = (
            "no thing and its parent are both found, or the labels have no parents"
        )
    if scores.without_camera:
        numbers = ", ".join(map(str, scores.without_camera))
        out.left_out[f"outlines of frame {numbers}"] = "the scene has no camera of it"


def _physics(bundle: SceneBundle, out: Evaluation) -> None:
    from registry.report_card import physics_report
    from registry.simulation import specs_from_bundle

    report = physics_report(specs_from_bundle(bundle), bundle.edges)
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


def _rendering(
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
        reason = "the kept-out frames are gone; give --video, or reconstruct again"
        out.left_out.update({"psnr_db": reason, "ssim": reason, "coverage": reason})
        return
    indices = sorted(set(poses) & set(frames))
    if not indices:
        reason = "no kept-out frame could be registered (a small folder of images has none)"
        out.left_out.update({"psnr_db": reason, "ssim": reason, "coverage": reason})
        return
    pictures, covered = render_views(
        [(m.visual, m.world_from_mesh) for m in scene], camera, [poses[i] for i in indices]
    )
    true = [frames[i] for i in indices]
    score = score_pictures(pictures, covered, true)
    if score is None:
        out.left_out["psnr_db"] = out.left_out["ssim"] = "the scene covers no pixel of the kept-out frames"
        out.metrics["coverage"] = 0.0
        return
    out.metrics.update(psnr_db=score.psnr_db, ssim=score.ssim, coverage=score.coverage)
    out.stages["rendering"] = {"frames": score.frames, "frames_from": source}
    perceptual, missing = perceptual_scores(pictures, true)
    out.metrics.update(perceptual)
    out.left_out.update(missing)


def _cameras(alignment: Alignment, truth: GroundTruth, out: Evaluation) -> None:
    out.metrics.update(
        ate_cm=alignment.ate_cm,
        scale_error=abs(alignment.scale - 1),
        tilt_deg=alignment.tilt_deg,
        rotation_median_deg=float(np.median(alignment.rotation_errors_deg)),
        cameras_compared=len(alignment.indices),
    )


def _composition(
    scene: list[PlacedMesh],
    truth: GroundTruth,
    stages: StageResults,
    alignment: Alignment,
    count: int,
    out: Evaluation,
) -> None:
    from reconstruction.measure.stages import sensor_surface, surface_figures

    poses = spread_poses(list(truth.world_from_camera.values()))
    if truth.entities:
        true_seen = sample_seen(*joined([e.mesh for e in truth.entities]), truth.camera, poses, count)
    else:
        # What a depth sensor measured stands for the surface; it tells of no normals worth comparing.
        true_seen = sensor_surface(truth)
        out.left_out["nc"] = "the truth is a depth sensor's points, without normals"
    if not len(true_seen.points):
        reason = "the truth has neither meshes nor depth"
        out.left_out.update({"cd_cm": reason, "f_5cm": reason, "nc": reason})
        return
    estimated = sample_seen(*joined(scene), truth.camera, poses, count)
    score = compare(estimated, true_seen, COMPOSITION_BOUND_M)
    if score is None:
        reason = "no part of the scene is where the true cameras look"
        out.left_out.update({"cd_cm": reason, "f_5cm": reason, "nc": reason})
    else:
        out.metrics.update(cd_cm=score.cd_cm, f_5cm=score.f)
        out.metrics.update(accuracy_cm=score.accuracy_cm, completeness_cm=score.completeness_cm)
        if truth.entities:
            out.metrics["nc"] = score.nc
    surface = stages.get("surface")
    if surface is not None:
        figures = surface_figures(surface, alignment, truth, true_seen, COMPOSITION_BOUND_M, count)
        if not truth.entities:
            figures.pop("nc", None)
        out.stages["surface"] = figures


def _objects(bundle: SceneBundle, scene: list[PlacedMesh], truth: GroundTruth, out: Evaluation) -> None:
    if not truth.entities:
        for name in ("object_recall_25", "object_precision_25", "object_cd_cm", "object_f_1cm", "graph_f1"):
            out.left_out[name] = "the truth has no entities"
        return
    scores = score_objects([m for m in scene if not m.base], truth)
    edges, base = bundle.scene["graph"]["edges"], [m for m in scene if m.base]
    out.metrics.update(scores.metrics)
    out.metrics.update(score_graph(edges, base, truth, scores.true_of, scores.records))
    out.objects, out.extra = scores.records, scores.extra


def _stage_figures(truth: GroundTruth, stages: StageResults, alignment: Alignment, out: Evaluation) -> None:
    from reconstruction.measure import stages as figures
    from reconstruction.measure.planes import planes_figures

    posed, depth = stages.in_world()
    surface, instances = stages.get("surface"), stages.get("instances")
    if posed is None:
        return
    out.stages["poses"] = figures.poses_figures(posed, alignment, truth)
    if depth is not None:
        _keep(out, "depth", figures.depth_figures(posed, depth, alignment, truth), "the truth has no meshes")
    if surface is not None:
        shown = figures.surface_depth_figures(posed, surface, alignment, truth)
        out.stages.setdefault("surface", {}).update(
            {f"depth_{key}": value for key, value in (shown or {}).items()}
        )
        found = planes_figures(surface, alignment, truth)
        if found is not None:
            out.stages["surface"]["planes"] = found
    if surface is not None and instances is not None:
        if truth.entities:
            on_surface = figures.instance_figures_3d(surface, instances, alignment, truth)
            per_view = figures.instance_figures_2d(posed, surface, instances, truth)
            boxes = instance_box_figures(surface, instances, alignment, truth)
            out.stages["instances"] = {"surface": on_surface, "per_view": per_view, "boxes": boxes}
        else:
            out.left_out["stage instances"] = "the truth has no entities"


def _gaussians(
    truth: GroundTruth | None, alignment: Alignment | None, stages: StageResults, out: Evaluation
) -> None:
    """Kept-out frames as the Gaussians show them, which needs no truth; their depth against it where there is one."""
    from reconstruction.measure import stages as figures

    posed, _ = stages.in_world()
    gaussians, depth = stages.refined_in_world()
    if posed is None or gaussians is None:
        return
    out.stages["gaussians"] = figures.gaussians_figures(posed, gaussians, depth, alignment, truth)


def _keep(out: Evaluation, stage: str, figures: dict | None, reason: str) -> None:
    if figures is None:
        out.left_out[f"stage {stage}"] = reason
    else:
        out.stages[stage] = figures
