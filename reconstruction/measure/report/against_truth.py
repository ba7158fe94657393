"""Build the report's section on the evaluation against ground truth."""

from typing import Any

from reconstruction.measure.report.blocks import (
    Block,
    Cell,
    Details,
    Section,
    Table,
    Text,
    Tile,
    Tiles,
    left_out,
)
from reconstruction.measure.report.collect import Gathered, by_reason

# (metric, name, unit, factor, digits) of the tiles.
_HEADLINE = (
    ("ate_cm", "camera error", " cm", 1, 1),
    ("scale_error", "scale error", "%", 100, 1),
    ("cd_cm", "Chamfer", " cm", 1, 1),
    ("f_5cm", "F-score, 5 cm", "%", 1, 0),
    ("object_recall_25", "objects found, IoU 0.25", "%", 100, 0),
    ("object_precision_25", "object precision", "%", 100, 0),
    ("object_cd_cm", "object Chamfer", " cm", 1, 1),
    ("object_f_1cm", "object F-score, 1 cm", "%", 1, 0),
    ("graph_f1", "graph F1", "", 1, 2),
    ("psnr_db", "PSNR", " dB", 1, 1),
)


def truth_section(g: Gathered) -> Section | None:
    """Return the metrics of CONTRACT section 4 for this scene; None without an evaluation."""
    if g.evaluation is None:
        return None
    metrics = g.evaluation["metrics"]
    tiles = [
        Tile(f"{factor * metrics[key]:.{digits}f}{unit}", name)
        for key, name, unit, factor, digits in _HEADLINE
        if metrics.get(key) is not None
    ]
    blocks: list[Block] = [Tiles(tiles, columns=5)]
    if g.evaluation["objects"]:
        blocks.append(_objects_table(g, g.evaluation["objects"]))
    extra = [f"{item['label']} {item['id']}" for item in g.evaluation["extra"]]
    if extra:
        blocks.append(Text(f"Found objects without a match: {', '.join(extra)}."))
    blocks.append(_stages_table(g.evaluation["stages"]))
    lines = [f"{key} = {value:.6g}" for key, value in metrics.items() if value is not None]
    blocks.append(Details("All metrics", "\n".join(lines)))
    for reason, names in by_reason(g.evaluation["left_out"]).items():
        blocks.append(left_out(", ".join(sorted(names)), reason))
    lead = "After aligning the cameras with the true ones."
    return Section("truth", "Against the truth", blocks, lead, "Truth")


def _objects_table(g: Gathered, objects: list[dict[str, Any]]) -> Table:
    rows = []
    for item in objects:
        match, right = item["match"], item.get("relation_right")
        relation = Cell("–")
        if right is not None:
            relation = Cell("right", "good") if right else Cell("wrong", "bad")
        rows.append(
            [
                Cell(item["name"].replace("_", " ")),
                Cell("missed", "bad") if match is None else Cell(g.names[match]),
                Cell(f"{item['box_iou']:.2f}", "" if item["box_iou"] >= 0.5 else "warn"),
                Cell(f"{item['cd_cm']:.1f} cm"),
                Cell(f"{item['f_1cm']:.0f}%"),
                relation,
            ]
        )
    columns = ["true object", "found as", "box IoU", "Chamfer", "F 1 cm", "relation"]
    return Table(columns, rows, numeric=[2, 3, 4])


def _stages_table(stages: dict[str, Any]) -> Table:
    """Return one row per stage, in the order of the pipeline."""
    from reconstruction.pipeline import STAGE_NAMES

    order = [name for name in STAGE_NAMES if name in stages] + sorted(set(stages) - set(STAGE_NAMES))
    rows = []
    for stage in order:
        figures = tuple(_with_unit(name, value) for name, value in _flat(stages[stage]))
        rows.append([Cell(stage), Cell("", figures=figures)])
    return Table(["stage", "figures"], rows)


def _flat(figures: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Flatten nested figures to (name, value) pairs; lists, which have tables of their own, are skipped."""
    out = []
    for name, value in figures.items():
        if isinstance(value, dict):
            out += _flat(value, f"{prefix}{name}: ")
        elif isinstance(value, bool | int | float | str):
            out.append((f"{prefix}{name}", value))
    return out


_UNITS = (("_cm", " cm"), ("_mm", " mm"), ("_deg", "°"), ("_db", " dB"), ("_s", " s"), ("_mb", " MB"))


def _with_unit(name: str, value: Any) -> tuple[str, str]:
    """Return a metric's name in words, and its value with the unit from the name's suffix."""
    if not isinstance(value, float):
        return name.replace("_", " "), str(value)
    if "share" in name or name.endswith("_rel") or "recall" in name or "precision" in name:
        return name.removesuffix("_rel").replace("_", " "), f"{100 * value:.3g}%"
    for suffix, unit in _UNITS:
        if name.endswith(suffix):
            return name.removesuffix(suffix).replace("_", " "), f"{value:.3g}{unit}"
    if name.endswith("_percent"):
        return name.removesuffix("_percent").replace("_", " "), f"{value:.3g}%"
    return name.replace("_", " "), f"{value:.3g}"
