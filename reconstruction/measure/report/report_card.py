"""Build the report's sections on physics, time and memory, notes and options."""

import json
from dataclasses import asdict
from typing import Any

from reconstruction.measure.report import drawing, plots
from reconstruction.measure.report.blocks import (
    Block,
    Cell,
    Details,
    Listing,
    Plots,
    Section,
    Table,
    Text,
    Tile,
    Tiles,
    facts,
    graded,
    left_out,
)
from reconstruction.measure.report.collect import Gathered

_THRESHOLDS = (
    ("stable", "< 2 cm, < 5°"),
    ("stable_10cm_0.1rad", "< 0.1 m, < 0.1 rad"),
    ("stable_5cm_drop_5deg", "< 5 cm drop, < 5°"),
)


def physics_section(g: Gathered) -> Section:
    """Return the physics report, overall and per object."""
    physics = g.scene["report"].get("physics", {})
    if "objects" not in physics:
        return Section("physics", "Physics", [left_out("The report card", "the bundle has none")])
    rates = {"stable": "stable_rate", **{key: f"stable_rate_{key[7:]}" for key, _ in _THRESHOLDS[1:]}}
    tiles = [
        Tile(f"{physics[rates[key]]:.0%}", text, graded(physics[rates[key]], 1.0, 0.8))
        for key, text in _THRESHOLDS
    ]
    floating, overlap = physics["floating_rate"], physics["spawn_penetration_mm"]
    between = " and ".join(x.replace("_", " ") for x in physics.get("spawn_penetration_between", []))
    tiles.append(Tile(f"{floating:.0%}", "floating", graded(-floating, 0.0, -0.2), "fall > 5 mm in 0.5 s"))
    tiles.append(Tile(f"{overlap:.2f} mm", "deepest contact at spawn", graded(-overlap, -1.0, -5.0), between))
    tiles += _rest_tiles(physics)
    rows = []
    ids = {o["id"] for o in g.objects}
    for item in physics["objects"]:
        swatch = drawing.css_color(g.colors[item["id"]]) if item["id"] in ids else ""
        rows.append(
            [
                Cell(item["name"].replace("_", " "), swatch=swatch),
                Cell(f"{1000 * item['moved_m']:.1f} mm"),
                Cell(f"{item['turned_deg']:.2f}°"),
                Cell(f"{1000 * item['drop_m'] + 0.0:.1f} mm".replace("-0.0", "0.0")),
                *(
                    Cell("yes" if item[key] else "no", "good" if item[key] else "bad")
                    for key, _ in _THRESHOLDS
                ),
                Cell("yes" if item["floating"] else "no", "bad" if item["floating"] else ""),
            ]
        )
    columns = ["object", "moved", "turned", "drop", *(text for _, text in _THRESHOLDS), "floats"]
    lead = (
        f"All {physics['dynamic_objects']} movable objects together, simulated for {physics['duration_s']:.0f} s at "
        f"1/{1 / physics['timestep_s']:.0f} s, undamped, never asleep; {physics['fixed_objects']} objects are fixed."
    )
    if without := physics.get("without_collision"):  # older bundles have no list
        lead += f" No collision shape: {', '.join(name.replace('_', ' ') for name in without)}."
    blocks: list[Block] = [Tiles(tiles, columns=-(-len(tiles) // 2) if len(tiles) > 5 else len(tiles))]
    if rows:
        blocks.append(Table(columns, rows, numeric=[1, 2, 3]))
    return Section("physics", "Physics", blocks, lead)


def _rest_tiles(physics: dict) -> list[Tile]:
    """Return the tiles on contacts and energy at rest; older bundles have none."""
    if "contacts" not in physics:
        return []
    contacts, energy = physics["contacts"], physics["energy_at_rest_j"]
    edges = contacts["support_edges"] + contacts["attached_edges"]
    real = contacts["support_edges_real"] + contacts["attached_edges_real"]
    other = len(contacts["supports_without_edge"])
    share = real / edges if edges else 1.0
    unknown = f"{other} more contacts carry objects" if other else "no other contact carries an object"
    return [
        Tile(f"{real} of {edges}", "relations are contacts at rest", graded(share, 1.0, 0.8), unknown),
        Tile(f"{energy:.0e} J", "kinetic energy at the end", graded(physics["at_rest_rate"], 1.0, 0.8)),
    ]


def cost_section(g: Gathered) -> Section:
    """Return wall time, CPU time and peak memory of each stage."""
    from reconstruction.pipeline import STAGE_NAMES

    report = g.scene["report"]
    wall, volatile = report.get("timings_s", {}), report.get("volatile", {})
    names = [name for name in STAGE_NAMES if name in wall] + sorted(set(wall) - set(STAGE_NAMES))
    svgs = [plots.bars(names, [wall[n] for n in names], "wall time", "s", "#4f86e3", "wall")]
    for key, title, unit, color in (
        ("cpu_s", "CPU time", "s", "#53a58b"),
        ("stage_peak_memory_mb", "peak memory", "MB", "#c78a3b"),
    ):
        if key in volatile:
            svgs.append(
                plots.bars(names, [volatile[key].get(n, 0.0) for n in names], title, unit, color, key[:3])
            )
    blocks: list[Block] = [Plots(svgs, columns=3)]
    if len(svgs) < 3:
        blocks.append(left_out("CPU time and memory by stage", "the bundle does not have them"))
    versions = ", ".join(
        f"{name} {version}" for name, version in sorted(volatile.get("versions", {}).items())
    )
    rows = [(name, volatile[name]) for name in ("machine", "commit") if volatile.get(name)]
    backends = ", ".join(f"{stage}: {name}" for stage, name in sorted(report.get("backends", {}).items()))
    rows += [("versions", versions)] if versions else []
    rows += [("backends", backends)] if backends else []
    if rows:
        blocks.append(facts(rows))
    return Section("cost", "Time and memory", blocks, short="Cost")


def notes_section(g: Gathered) -> Section:
    """Return the notes of the stages, changed options, overrides, and the whole configuration."""
    report = g.scene["report"]
    blocks: list[Block] = []
    if report.get("notes"):
        blocks.append(Listing(list(report["notes"])))
    changed = changed_options(report.get("config", {}))
    if changed:
        blocks.append(facts([(name, f"{value} (default {default})") for name, value, default in changed]))
    else:
        blocks.append(Text("All options have their default values."))
    if report.get("overrides"):
        blocks.append(Details("Overrides", json.dumps(report["overrides"], indent=1)))
    if report.get("config"):
        blocks.append(Details("All options", _config_lines(report["config"])))
    return Section("notes", "Notes and options", blocks, short="Notes")


def changed_options(config: dict[str, dict]) -> list[tuple[str, str, str]]:
    """Return the options that differ from the defaults: (stage.option, value, default)."""
    from reconstruction.config import PipelineConfig

    default = json.loads(json.dumps(asdict(PipelineConfig())))
    return [
        (f"{stage}.{name}", json.dumps(value), json.dumps(default[stage][name]))
        for stage, options in sorted(config.items())
        if isinstance(options, dict)
        for name, value in sorted(options.items())
        if name in default.get(stage, {}) and default[stage][name] != value
    ]


def _config_lines(config: dict[str, Any], prefix: str = "") -> str:
    lines = []
    for name, value in sorted(config.items()):
        if isinstance(value, dict):
            lines.append(_config_lines(value, f"{prefix}{name}."))
        else:
            lines.append(f"{prefix}{name} = {json.dumps(value)}")
    return "\n".join(lines)
