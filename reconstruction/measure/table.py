"""Format an evaluation as a text table, with recall first, so that deleting hard objects does not look better."""

from reconstruction.measure.evaluate import Evaluation

# (metric, format, meaning)
_ROWS: tuple[tuple[str, str, str], ...] = (
    ("object_recall_25", "{:.2f}", "objects found, box IoU >= 0.25"),
    ("object_recall_50", "{:.2f}", "objects found, box IoU >= 0.5"),
    ("object_precision_25", "{:.2f}", "found objects that match a true one, IoU >= 0.25"),
    ("object_precision_50", "{:.2f}", "found objects that match a true one, IoU >= 0.5"),
    ("outline_recall_25", "{:.2f}", "outlined objects that were found, IoU >= 0.25"),
    ("outline_recall_50", "{:.2f}", "the same, IoU >= 0.5"),
    ("outline_precision_25", "{:.2f}", "objects in labelled frames that match an outline, IoU >= 0.25"),
    ("outline_precision_50", "{:.2f}", "the same, IoU >= 0.5"),
    ("outline_edges", "{:.2f}", "found outlined objects with the right parent"),
    ("ate_cm", "{:.2f} cm", "camera error after alignment"),
    ("rotation_median_deg", "{:.2f} deg", "camera rotation error, median"),
    ("scale_error", "{:.1%}", "error of the metric scale"),
    ("tilt_deg", "{:.2f} deg", "error of the up direction"),
    ("cd_cm", "{:.2f} cm", "Chamfer distance of the visible composition"),
    ("f_5cm", "{:.1f} %", "F-score at 5 cm"),
    ("nc", "{:.1f} %", "normal consistency"),
    ("object_cd_cm", "{:.2f} cm", "Chamfer distance of complete objects, with misses"),
    ("object_f_1cm", "{:.1f} %", "F-score at 1 cm of complete objects, with misses"),
    ("matched_object_cd_cm", "{:.2f} cm", "the same without the misses"),
    ("matched_object_f_1cm", "{:.1f} %", "the same without the misses"),
    ("graph_f1", "{:.2f}", "relations, all objects"),
    ("graph_f1_matched", "{:.2f}", "relations of the objects found"),
    ("psnr_db", "{:.2f} dB", "assembled scene on held-out frames"),
    ("ssim", "{:.3f}", "the same"),
    ("lpips", "{:.3f}", "the same, lower is better"),
    ("musiq", "{:.1f}", "image quality without reference"),
    ("coverage", "{:.1%}", "share of those frames that the scene covers"),
    ("psnr_whole_db", "{:.2f} dB", "over all pixels, with the backdrop"),
    ("holes", "{:.2%}", "share of pixels that show nothing, backdrop included"),
    ("stable_rate", "{:.0%}", "stable movable objects: < 2 cm and < 5 deg in 10 s"),
    ("stable_rate_10cm_0.1rad", "{:.0%}", "... < 0.1 m and < 0.1 rad"),
    ("stable_rate_5cm_drop_5deg", "{:.0%}", "... < 5 cm drop and < 5 deg"),
    ("spawn_penetration_mm", "{:.2f} mm", "deepest contact at spawn"),
    ("floating_rate", "{:.0%}", "movable objects that fall > 5 mm in the first 0.5 s"),
    ("time_s", "{:.0f} s", "reconstruction"),
    ("peak_memory_mb", "{:.0f} MB", "peak memory of the process tree"),
)

_STAGE_ROWS: tuple[tuple[str, str, str, str], ...] = (
    ("poses", "registered_share", "{:.0%}", "frames registered"),
    ("poses", "focal_error_percent", "{:.2f} %", "focal length error"),
    ("depth", "median_rel", "{:.2%}", "median relative error"),
    ("depth", "share_over_5_percent", "{:.1%}", "pixels with an error over 5 %"),
    ("depth", "known_share", "{:.0%}", "pixels with depth"),
    ("depth", "measured_share", "{:.0%}", "... measured, not completed"),
    ("gaussians", "psnr_db", "{:.2f} dB", "Gaussians rendered at held-out frames"),
    ("gaussians", "worst_psnr_db", "{:.2f} dB", "... the worst frame"),
    ("gaussians", "depth_median_rel", "{:.2%}", "median relative depth error on held-out frames"),
    ("gaussians", "depth_maps.median_rel", "{:.2%}", "... of the refined depth maps"),
    ("gaussians", "depth_maps.share_over_5_percent", "{:.1%}", "pixels of them with an error over 5 %"),
    ("surface", "cd_cm", "{:.2f} cm", "Chamfer distance of the fused surface"),
    ("surface", "f_5cm", "{:.1f} %", "F-score at 5 cm"),
    ("surface", "nc", "{:.1f} %", "normal consistency"),
    ("surface", "depth_median_rel", "{:.2%}", "median relative depth error on held-out frames"),
    ("surface", "depth_share_over_5_percent", "{:.1%}", "pixels with an error over 5 %"),
    ("surface", "planes.found_share", "{:.0%}", "true floor, walls and tops of supports found"),
    ("surface", "planes.angle_median_deg", "{:.2f} deg", "... their angle error, median"),
    ("surface", "planes.offset_median_mm", "{:.1f} mm", "... their offset error, median"),
    ("assembly", "median_moved_cm", "{:.2f} cm", "displacement of objects, median"),
    ("assembly", "max_moved_cm", "{:.2f} cm", "displacement of objects, maximum"),
)


def as_table(evaluation: Evaluation) -> str:
    """Format an evaluation as aligned text."""
    lines = [f"{evaluation.scene}, revision {evaluation.revision}"]
    for name, form, meaning in _ROWS:
        value = evaluation.metrics.get(name)
        if value is not None:
            lines.append(f"  {name:<26} {form.format(value):>10}   {meaning}")
        elif name in evaluation.left_out:
            lines.append(f"  {name:<26} {'left out':>10}   {evaluation.left_out[name]}")
    lines += _objects(evaluation) + _outlines(evaluation) + _stages(evaluation)
    known = {name for name, _, _ in _ROWS}
    reasons: dict[str, list[str]] = {}
    for name, why in evaluation.left_out.items():
        if name not in known:
            reasons.setdefault(why, []).append(name)
    lines += [f"left out: {', '.join(names)}: {why}" for why, names in reasons.items()]
    return "\n".join(lines)


def _objects(evaluation: Evaluation) -> list[str]:
    if not evaluation.objects:
        return []
    lines = ["objects"]
    for item in evaluation.objects:
        if item["match"] is None:
            verdict = f"missed (best box IoU {item['box_iou']:.2f})"
        else:
            relation = {True: "right", False: "wrong", None: "none"}[item.get("relation_right")]
            verdict = (
                f"is {item['match']} ({item['found_label']}), box IoU {item['box_iou']:.2f}, "
                f"cd {item['cd_cm']:.2f} cm, f {item['f_1cm']:.0f} %, relation {relation}"
            )
        lines.append(f"  {item['name']:<16} {verdict}")
    lines += [f"  {'(no match)':<16} {item['id']} ({item['label']})" for item in evaluation.extra]
    return lines


def _outlines(evaluation: Evaluation) -> list[str]:
    if not evaluation.outlines:
        return []
    frames = ", ".join(map(str, evaluation.outlines["frames"]))
    lines = [f"outlines of frame {frames}"]
    for item in evaluation.outlines["things"]:
        verdict = f"missed (best IoU {item['iou']:.2f})"
        if item["match"] is not None:
            parent = {True: "right", False: "wrong", None: "not evaluated"}[item["parent_right"]]
            verdict = f"is {item['match']} ({item['found_label']}), IoU {item['iou']:.2f}, parent {parent}"
        lines.append(f"  {item['name']:<16} {verdict}")
    lines += [f"  {'(no outline)':<16} {o['id']} ({o['label']})" for o in evaluation.outlines["extra"]]
    return lines


def _stages(evaluation: Evaluation) -> list[str]:
    lines = []
    for stage, name, form, meaning in _STAGE_ROWS:
        value = evaluation.stages.get(stage, {})
        for key in name.split("."):
            value = value.get(key) if isinstance(value, dict) else None
        if value is not None:
            lines.append(f"  {stage:<10} {name:<26} {form.format(value):>10}   {meaning}")
    instances = evaluation.stages.get("instances") or {}
    for part, figures in instances.items():
        if figures and "mean_iou" in figures:
            found = f"mean IoU; found at 0.5: {figures['recall_50']:.2f}"
            lines.append(f"  instances  {part:<26} {figures['mean_iou']:>10.2f}   {found}")
    if "boxes" in instances:
        boxes = instances["boxes"]
        found = (
            f"recall of the instances stage, box IoU >= 0.25; precision {boxes['object_precision_25']:.2f}"
        )
        lines.append(f"  instances  {'boxes':<26} {boxes['object_recall_25']:>10.2f}   {found}")
    return ["stages", *lines] if lines else []
