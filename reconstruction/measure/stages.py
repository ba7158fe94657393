"""Compare the artifacts of single stages with ground truth, to locate the stage that causes an error.

Artifacts are in the estimated world, in metres; `alignment` maps it to the true one.
"""

import numpy as np

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import DepthMaps, InstanceSet, PosedFrames, Surface
from reconstruction.gaussians import Gaussians, evaluate_gaussians
from reconstruction.measure.alignment import Alignment
from reconstruction.measure.ground_truth import GroundTruth
from reconstruction.measure.matching import match
from reconstruction.measure.surfaces import Samples, compare, nearest_entities, sample_seen
from reconstruction.measure.visibility import spread_poses
from registry.geometry import transform_points

_MAX_DEPTH_FRAMES = 24
_FAR_M = 5.0  # farther pixels are not compared
_LARGE_ERROR = 0.05  # relative
_NEAR_TRUTH_M, _ENTITY_SAMPLES = 0.03, 30_000  # assignment of surface vertices to true entities
_MIN_ENTITY_PX = 50  # smaller entities in a view are not evaluated


def poses_figures(posed: PosedFrames, alignment: Alignment, truth: GroundTruth) -> dict[str, float]:
    """Return camera errors after alignment, the share of registered frames and the focal length error."""
    true_fx = truth.camera.fx * posed.camera.width / truth.camera.width
    return {
        "ate_cm": alignment.ate_cm,
        "max_center_error_cm": float(alignment.center_errors_m.max() * 100),
        "rotation_median_deg": float(np.median(alignment.rotation_errors_deg)),
        "registered_share": len(posed.images) / max(posed.chosen_frames, 1),
        "focal_error_percent": float(abs(posed.camera.fx / true_fx - 1) * 100),
        "tilt_deg": alignment.tilt_deg,
    }


def depth_figures(
    posed: PosedFrames, depth: DepthMaps, alignment: Alignment, truth: GroundTruth
) -> dict[str, float] | None:
    """Return relative depth errors of up to 24 keyframes against the true meshes rendered at the aligned cameras.

    None without true meshes, or if no pixel can be compared.
    """
    if not truth.entities:
        return None
    rows = np.unique(np.linspace(0, len(posed.images) - 1, _MAX_DEPTH_FRAMES).round().astype(int))
    errors, measured, asked = [], [], 0
    for row in rows:
        pose = alignment.pose_to_true(posed.world_from_camera[row])
        true = rasterize_mesh(*truth.mesh, depth.camera, pose).depth
        relative, both, count = _relative_errors(np.asarray(depth.depth[row]) * alignment.scale, true)
        asked += count
        errors.append(relative)
        measured.append(np.asarray(depth.confidence[row])[both] >= 2)
    error, sure = np.concatenate(errors), np.concatenate(measured)
    if not len(error):
        return None
    return {
        **_depth_error(error),
        "known_share": len(error) / max(asked, 1),
        "measured_share": float(sure.sum() / max(asked, 1)),
        "measured_median_rel": float(np.median(error[sure])) if sure.any() else float("nan"),
        "completed_median_rel": float(np.median(error[~sure])) if (~sure).any() else float("nan"),
        "frames": len(rows),
    }


def gaussians_figures(
    posed: PosedFrames,
    gaussians: Gaussians,
    depth: DepthMaps,
    alignment: Alignment | None,
    truth: GroundTruth | None,
) -> dict[str, float | int | dict]:
    """Return the image quality of the Gaussians on held-out frames, over all pixels, at working resolution.

    Adds the median relative error of their expected depth if the truth has depth images, and under `depth_maps` the
    figures of the refined depth maps of the keyframes if it has meshes.
    """
    true_depth = None
    if truth is not None and alignment is not None:
        maps = [truth.depth(int(index)) for index in posed.held_out_indices]
        blank = next((np.zeros_like(d) for d in maps if d is not None), None)
        if blank is not None:
            true_depth = np.stack([blank if d is None else d / alignment.scale for d in maps])
    out: dict[str, float | int | dict] = {"count": len(gaussians), "frames": len(posed.held_out_images)}
    if len(posed.held_out_images):
        shown = evaluate_gaussians(gaussians, posed, true_depth)
        out |= {
            "psnr_db": shown.mean_psnr_db,
            "worst_psnr_db": float(shown.psnr_db.min()),
            "ssim": shown.mean_ssim,
            "coverage": float(shown.coverage.mean()),
        }
        if true_depth is not None:
            out["depth_median_rel"] = shown.median_depth_error
    if truth is not None and alignment is not None:
        corrected = depth_figures(posed, depth, alignment, truth)
        if corrected is not None:
            out["depth_maps"] = corrected
    return out


def surface_depth_figures(
    posed: PosedFrames, surface: Surface, alignment: Alignment, truth: GroundTruth
) -> dict[str, float] | None:
    """Return relative depth errors of the fused surface rendered at held-out cameras against true depth images."""
    errors, asked = [], 0
    for index, pose in zip(posed.held_out_indices, posed.held_out_world_from_camera):
        true = truth.depth(int(index))
        if true is None:
            continue
        camera = posed.camera.resized(true.shape[1], true.shape[0])
        estimated = rasterize_mesh(surface.vertices, surface.faces, camera, pose).depth * alignment.scale
        relative, _, count = _relative_errors(estimated, true)
        asked += count
        errors.append(relative)
    known = sum(len(relative) for relative in errors)
    if not known:
        return None
    return {**_depth_error(np.concatenate(errors)), "known_share": known / asked, "frames": len(errors)}


def _relative_errors(estimated: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Compare depth maps (h, w): relative errors (k,), mask of the k compared pixels, number with true depth."""
    inside = (true > 0) & (true < _FAR_M)
    both = inside & (estimated > 0)
    return np.abs(estimated[both] / true[both] - 1), both, int(inside.sum())


def _depth_error(error: np.ndarray) -> dict[str, float]:
    return {
        "median_rel": float(np.median(error)),
        "share_over_5_percent": float((error > _LARGE_ERROR).mean()),
    }


def surface_figures(
    surface: Surface, alignment: Alignment, truth: GroundTruth, true_seen: Samples, bound_m: float, count: int
) -> dict[str, float]:
    """Return Chamfer distance, F-score and normal consistency of the visible part of the fused surface.

    Args:
        surface: before segmentation.
        alignment: to the true world.
        truth: for its cameras.
        true_seen: samples of the visible true surface.
        bound_m: of the F-score.
        count: samples drawn on the whole surface.
    """
    vertices = alignment.to_true(surface.vertices)
    seen = sample_seen(vertices, surface.faces, truth.camera, spread_poses(truth.poses), count)
    score = compare(seen, true_seen, bound_m)
    if score is None:
        return {}
    return {
        "cd_cm": score.cd_cm,
        "f_5cm": score.f,
        "nc": score.nc,
        "accuracy_cm": score.accuracy_cm,
        "completeness_cm": score.completeness_cm,
    }


def instance_figures_3d(
    surface: Surface, instances: InstanceSet, alignment: Alignment, truth: GroundTruth
) -> dict[str, float]:
    """Score instances by IoU over surface vertices, which get the id of the nearest true entity within 3 cm."""
    points = alignment.to_true(surface.vertices)
    true = nearest_entities(points, truth.entities, _ENTITY_SAMPLES, _NEAR_TRUTH_M)
    found = np.asarray(instances.vertex_instance)
    counted = true > 0
    return _overlap_figures(true[counted], found[counted], truth, [o.id for o in instances.objects])


def instance_figures_2d(
    posed: PosedFrames, surface: Surface, instances: InstanceSet, truth: GroundTruth
) -> dict[str, float] | None:
    """Score instances by IoU over pixels of held-out frames with a true id image; means over frames, None without."""
    views = []
    for index, pose in zip(posed.held_out_indices, posed.held_out_world_from_camera):
        true = truth.instances(int(index))
        if true is None:
            continue
        camera = posed.camera.resized(true.shape[1] // 2, true.shape[0] // 2)
        true = true[::2, ::2][: camera.height, : camera.width]
        raster = rasterize_mesh(surface.vertices, surface.faces, camera, pose)
        found = np.zeros(raster.face.shape, np.int64)
        hit = raster.face >= 0
        corner = np.argmax(raster.barycentric[hit], axis=1)
        vertex = np.asarray(surface.faces)[raster.face[hit], corner]
        found[hit] = np.asarray(instances.vertex_instance)[vertex]
        present = set(np.unique(true).tolist())
        figures = _overlap_figures(
            true.ravel(), found.ravel(), truth, [o.id for o in instances.objects], only=present
        )
        if figures["entities"]:
            views.append(figures)
    if not views:
        return None
    keys = ("mean_iou", "recall_25", "recall_50")
    return {**{k: float(np.mean([v[k] for v in views])) for k in keys}, "views": len(views)}


def _overlap_figures(
    true: np.ndarray,
    found: np.ndarray,
    truth: GroundTruth,
    object_ids: list[int],
    only: set[int] | None = None,
) -> dict[str, float]:
    """Match evaluated true entities with found objects by IoU; `true` and `found` are ids (n,) per vertex or pixel."""
    wanted = [e.id for e in truth.evaluated if only is None or e.id in only]
    sizes_true = np.bincount(true, minlength=max([*wanted, 0]) + 1)
    if only is not None:
        wanted = [i for i in wanted if sizes_true[i] >= _MIN_ENTITY_PX]
    ids = sorted(set(object_ids))
    iou = np.zeros((len(wanted), len(ids)))
    sizes_found = np.bincount(found, minlength=max([*ids, 0]) + 1)
    for r, entity in enumerate(wanted):
        inside = np.bincount(found[true == entity], minlength=len(sizes_found))
        for c, instance in enumerate(ids):
            union = sizes_true[entity] + sizes_found[instance] - inside[instance]
            iou[r, c] = inside[instance] / union if union else 0.0
    best = {r: iou[r, c] for r, c in match(iou, 1e-9)}
    values = np.array([best.get(r, 0.0) for r in range(len(wanted))])
    return {
        "mean_iou": float(values.mean()) if len(values) else 1.0,
        "recall_25": float((values >= 0.25).mean()) if len(values) else 1.0,
        "recall_50": float((values >= 0.5).mean()) if len(values) else 1.0,
        "precision_50": float((values >= 0.5).sum() / max(len(ids), 1)),
        "entities": len(wanted),
        "found": len(ids),
    }


def sensor_surface(truth: GroundTruth, voxel_m: float = 0.01) -> Samples:
    """Back-project the true depth images within 5 m; return one point per voxel, with zero normals."""
    camera = truth.camera
    clouds = []
    for index in truth.indices("depth"):
        if index not in truth.world_from_camera:
            continue
        depth = truth.depth(index)
        assert depth is not None  # `indices` lists existing files
        rows, columns = np.nonzero((depth > 0) & (depth < _FAR_M))
        z = depth[rows, columns].astype(np.float64)
        small = camera.resized(depth.shape[1], depth.shape[0])
        local = small.unproject(columns + 0.5, rows + 0.5, z)
        clouds.append(transform_points(truth.world_from_camera[index], local))
    points = np.concatenate(clouds) if clouds else np.zeros((0, 3))
    _, first = np.unique(np.floor(points / voxel_m).astype(np.int64), axis=0, return_index=True)
    return Samples(points[first], np.zeros((len(first), 3)))
