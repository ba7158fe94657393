"""An evaluation as text for people: recall stands first, because leaving out what is hard must not pay."""

from reconstruction.measure.evaluate import Evaluation

# (metric, how it is shown, what it means); `better` is said in words where it is not plain.
_ROWS: tuple[tuple[str, str, str], ...] = (
    ("object_recall_25", "{:.2f}", "objects found, box IoU >= 0.25"),
    ("object_recall_50", "{:.2f}", "objects found, box IoU >= 0.5"),
    ("object_precision_25", "{:.2f}", "found objects that are real, IoU >= 0.25"),
    ("object_precision_50", "{:.2f}", "found objects that are real, IoU >= 0.5"),
    ("outline_recall_25", "{:.2f}", "things outlined by hand that were found, IoU >= 0.25"),
    ("outline_recall_50", "{:.2f}", "the same, IoU >= 0.5"),
    ("outline_precision_25", "{:.2f}", "objects in the labelled frames that are such things, IoU >= 0.25"),
    ("outline_precision_50", "{:.2f}", "the same, IoU >= 0.5"),
    ("outline_edges", "{:.2f}", "things found that have the right parent"),
    ("ate_cm", "{:.2f} cm", "camera error after alignment"),
    ("rotation_median_deg", "{:.2f} deg", "camera rotation error, median"),
    ("scale_error", "{:.1%}", "error of the metric scale"),
    ("tilt_deg", "{:.2f} deg", "error of up"),
    ("cd_cm", "{:.2f} cm", "Chamfer distance of the whole, visible part"),
    ("f_5cm", "{:.1f} %", "F-score at 5 cm"),
    ("nc", "{:.1f} %", "normal consistency"),
    ("object_cd_cm", "{:.2f} cm", "Chamfer distance of complete objects, misses included"),
    ("object_f_1cm", "{:.1f} %", "F-score at 1 cm of complete objects, misses included"),
    ("matched_object_cd_cm", "{:.2f} cm", "the same without the misses"),
    ("matched_object_f_1cm", "{:.1f} %", "the same without the misses"),
    ("graph_f1", "{:.2f}", "relations, all objects"),
    ("graph_f1_matched", "{:.2f}", "relations of the objects found"),
    ("psnr_db", "{:.2f} dB", "assembled scene on kept-out frames"),
    ("ssim", "{:.3f}", "the same"),
    ("lpips", "{:.3f}", "the same, lower is better"),
    ("musiq", "{:.1f}", "quality of its pictures without reference"),
    ("coverage", "{:.1%}", "share of those frames that the scene covers"),
    ("stable_rate", "{:.0%}", "movable objects that stay: < 2 cm and < 5 deg in 10 s"),
    ("stable_rate_10cm_0.1rad", "{:.0%}", "... < 0.1 m and < 0.1 rad"),
    ("stable_rate_5cm_drop_5deg", "{:.0%}", "... < 5 cm drop and < 5 deg"),
    ("spawn_penetration_mm", "{:.2f} mm", "deepest overlap at the start"),
    ("floating_rate", "{:.0%}", "movable objects that fall > 5 mm in the first 0.5 s"),
    ("time_s", "{:.0f} s", "reconstruction"),
    ("peak_memory_mb", "{:.0f} MB", "peak memory of its process tree"),
)

_STAGE_ROWS: tuple[tuple[str, str, str, str], ...] = (
    ("poses", "registered_share", "{:.0%}", "frames registered"),
    ("poses", "focal_error_percent", "{:.2f} %", "focal length error"),
    ("depth", "median_rel", "{:.2%}", "median relative error"),
    ("depth", "share_over_5_percent", "{:.1%}", "pixels off by more than 5 %"),
    ("depth", "known_share", "{:.0%}", "pixels that have depth"),
    ("depth", "measured_share", "{:.0%}", "... that is measured rather than completed"),
    ("gaussians", "psnr_db", "{:.2f} dB", "kept-out frames drawn from the Gaussians"),
    ("gaussians", "worst_psnr_db", "{:.2f} dB", "... the worst of them"),
    ("gaussians", "depth_median_rel", "{:.2%}", "median relative depth error on kept-out frames"),
    ("gaussians", "depth_maps.median_rel", "{:.2%}", "... of the corrected depth maps"),
    ("gaussians", "depth_maps.share_over_5_percent", "{:.1%}", "pixels of them off by more than 5 %"),
    ("surface", "cd_cm", "{:.2f} cm", "Chamfer distance before objects are cut out"),
    ("surface", "f_5cm", "{:.1f} %", "F-score at 5 cm"),
    ("surface", "nc", "{:.1f} %", "normal consistency"),
    ("surface", "depth_median_rel", "{:.2%}", "median relative depth error on kept-out frames"),
    ("surface", "depth_share_over_5_percent", "{:.1%}", "pixels off by more than 5 %"),
    ("surface", "planes.found_share", "{:.0%}", "true floor, walls and support tops found"),
    ("surface", "planes.angle_median_deg", "{:.2f} deg", "... their angle error, median"),
    ("surface", "planes.offset_median_mm", "{:.1f} mm", "... their offset error, median"),
    ("assembly", "median_moved_cm", "{:.2f} cm", "objects moved by, median"),
    ("assembly", "max_moved_cm", "{:.2f} cm", "objects moved by, at most"),
)


def as_table(evaluation: Evaluation) -> str:
    """Lay an evaluation out as aligned text."""
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
    lines += [f"  {'(not real)':<16} {item['id']} ({item['label']})" for item in evaluation.extra]
    return lines


def _outlines(evaluation: Evaluation) -> list[str]:
    if not evaluation.outlines:
        return []
    frames = ", ".join(map(str, evaluation.outlines["frames"]))
    lines = [f"outlines of frame {frames}"]
    for item in evaluation.outlines["things"]:
        verdict = f"missed (best IoU {item['iou']:.2f})"
        if item["match"] is not None:
            parent = {True: "right", False: "wrong", None: "not asked"}[item["parent_right"]]
            verdict = f"is {item['match']} ({item['found_label']}), IoU {item['iou']:.2f}, parent {parent}"
        lines.append(f"  {item['name']:<16} {verdict}")
    lines += [f"  {'(not outlined)':<16} {o['id']} ({o['label']})" for o in evaluation.outlines["extra"]]
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
            f"recall before assets are made, box IoU >= 0.25; precision {boxes['object_precision_25']:.2f}"
        )
        lines.append(f"  instances  {'boxes':<26} {boxes['object_recall_25']:>10.2f}   {found}")
    return ["stages", *lines] if lines else []
