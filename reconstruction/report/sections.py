"""What the report says, section by section: each function turns what was gathered into blocks of the page."""

import json
from dataclasses import asdict
from typing import Any

import numpy as np

from reconstruction.report import drawing, pictures, plots
from reconstruction.report.blocks import (
    Block,
    Card,
    Cards,
    Cell,
    Details,
    Legend,
    Listing,
    Pictures,
    Plots,
    Section,
    Split,
    Table,
    Text,
    Tile,
    Tiles,
)
from reconstruction.report.collect import Gathered


def all_sections(g: Gathered) -> list[Section]:
    """Return the page's sections in order."""
    from reconstruction.report.against_truth import truth_section

    makers = (
        truth_section, cameras_section, depth_section, gaussians_section, surface_section, instances_section,
        objects_section, graph_section, assembly_section, kept_out_section, physics_section, cost_section,
        notes_section,
    )  # fmt: skip
    made = [maker(g) for maker in makers]
    return [section for section in made if section is not None]


def left_out(what: str, why: str) -> Text:
    """One line for what cannot be shown."""
    return Text(f"{what} left out: {why}.", left_out=True)


def summary_tiles(g: Gathered) -> Tiles:
    """The figures to see at a glance."""
    scene, report = g.scene, g.scene["report"]
    physics, scale = report["physics"], scene["scale"]
    tiles = [Tile(str(len(scene["objects"])), "objects", detail=f"{len(scene['base'])} base surfaces")]
    if "stable_rate" in physics:
        rate = physics["stable_rate"]
        detail = f"of {physics.get('dynamic_objects', '?')} movable objects, 10 s"
        tiles.append(Tile(f"{rate:.0%}", "stable", _graded(rate, 1.0, 0.8), detail))
    if "spawn_penetration_mm" in physics:
        depth = physics["spawn_penetration_mm"]
        tiles.append(Tile(f"{depth:.1f} mm", "deepest overlap", _graded(-depth, -1.0, -5.0)))
    sigma = scale["uncertainty"]
    tiles.append(
        Tile(f"± {sigma:.0%}", "scale", _graded(-sigma, -0.05, -0.2), scale["method"].replace("-", " "))
    )
    if "registration" in report:
        found = report["registration"]
        share = found["registered"] / max(found["keyframes"], 1)
        text = f"{found['registered']} of {found['keyframes']}"
        tiles.append(Tile(text, "keyframes registered", _graded(share, 0.95, 0.7)))
    total = sum(report["timings_s"].values())
    memory = f"peak {report['peak_memory_mb'] / 1024:.1f} GB"
    tiles.append(Tile(f"{total / 60:.1f} min" if total >= 90 else f"{total:.0f} s", "time", detail=memory))
    return Tiles(tiles)


def _graded(value: float, good: float, fair: float) -> str:
    return "good" if value >= good else "warn" if value >= fair else "bad"


def cameras_section(g: Gathered) -> Section:
    """Keyframes, camera path, registration and scale."""
    blocks: list[Block] = []
    if g.posed is None:
        blocks.append(left_out("Keyframes", g.why_missing("poses", "world")))
    else:
        blocks.append(Pictures(pictures.keyframes(g), 6, phone_columns=3))
    centers = g.bundle.cameras.world_from_camera[:, :3, 3]
    length = float(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum())
    scene, source = g.scene, g.scene["source"]
    rows = [
        ("video", f"{source['file']}, {source['width']}×{source['height']}, {source['frame_count']} frames"),
        ("camera path", f"{length:.1f} m long, {np.median(centers[:, 2]):.2f} m above the floor (median)"),
    ]
    found = scene["report"].get("registration")
    if found:
        rows.append(
            (
                "registration",
                f"{found['registered']} of {found['keyframes']} keyframes, "
                f"reprojection error {found['reprojection_error_px']:.2f} px",
            )
        )
    c = g.camera
    rows.append(("camera", f"{c.width}×{c.height}, focal length {c.fx:.0f} px, field of view {_fov(c):.0f}°"))
    scale = scene["scale"]
    detail = f"; {scale['detail']}" if scale.get("detail") else ""
    rows.append(("scale", f"{scale['method']}, ± {scale['uncertainty']:.0%} (1 σ){detail}"))
    world = scene.get("world")
    if world:
        floor = "seen" if world["floor_observed"] else "assumed below everything seen"
        rows.append(
            ("gravity", f"{world['gravity_method']}, ± {world['gravity_sigma_deg']:.1f}°; floor {floor}")
        )
    path = Pictures(
        [pictures.camera_path(g)],
        1,
        phone_columns=1,
        caption="The assembled scene from above. Full dots are keyframes, empty dots kept-out frames; lines show where "
        "the camera looks.",
    )
    blocks.append(Split(path, facts(rows)))
    return Section("cameras", "Video and cameras", blocks, short="Cameras")


def _fov(camera: Any) -> float:
    return float(np.degrees(2 * np.arctan(camera.width / 2 / camera.fx)))


def facts(rows: list[tuple[str, str]]) -> Table:
    """A table of names and values."""
    return Table([], [[Cell(name), Cell(value)] for name, value in rows])


def depth_section(g: Gathered) -> Section:
    """Depth and normals beside color, and the error."""
    section = Section("depth", "Depth", [])
    if g.posed is None or g.depth is None:
        section.blocks.append(left_out("Depth and normals", g.why_missing("poses", "depth", "world")))
        return section
    items, errors = pictures.depth_rows(g)
    heads = ["color", "depth", "normals"] + (["error"] if g.truth is not None else [])
    section.blocks.append(
        Pictures(items, len(heads), heads, phone_columns=len(heads) if len(heads) == 4 else 3)
    )
    section.blocks.append(Legend(drawing.gradient("turbo_r"), "near", "far", "depth; gray: unknown"))
    if errors:
        limit = f"{100 * pictures.DEPTH_ERROR_M:.0f} cm or more"
        section.blocks.append(Legend(drawing.gradient(drawing.ERROR_MAP), "0", limit, "error of the depth"))
    section.blocks.append(
        Text(
            "Normals have world axes as colors: the floor is even lavender, facing walls are even red or green."
        )
    )
    return section


def gaussians_section(g: Gathered) -> Section | None:
    """Gaussians' renders beside kept-out frames; nothing until the pipeline has that stage."""
    return None


def surface_section(g: Gathered) -> Section:
    """The fused surface from three sides."""
    section = Section("surface", "Surface", [])
    if g.surface is None:
        section.blocks.append(left_out("The fused surface", g.why_missing("surface")))
        return section
    items, heads = pictures.surface_views(g)
    section.blocks.append(Pictures(items, 3, heads, phone_columns=3))
    if g.truth is not None and g.truth.has_meshes:
        section.blocks.append(_distance_legend())
    surface = g.surface
    unseen = (np.asarray(surface.space.state) == 0).mean()
    section.blocks.append(
        Text(
            f"{len(surface.vertices):,} vertices, {len(surface.faces):,} triangles, voxels of "
            f"{1000 * surface.voxel_size_m:.0f} mm; {unseen:.0%} of the room's box was not looked into."
        )
    )
    return section


def _distance_legend() -> Legend:
    limit = f"{100 * pictures.SURFACE_ERROR_M:.0f} cm or more"
    return Legend(
        drawing.gradient(drawing.ERROR_MAP), "0", limit, "distance to the true surface; gray: never filmed"
    )


def instances_section(g: Gathered) -> Section:
    """Instances outlined and numbered on frames."""
    section = Section("instances", "Instances", [])
    if g.posed is None or g.instances is None:
        section.blocks.append(left_out("Outlines on frames", g.why_missing("poses", "world", "instances")))
        return section
    true = g.truth is not None and g.truth.has_meshes
    items = pictures.instance_frames(g, 4 if true else 6)
    heads = ["found", "true, in the color and number of its match"] if true else []
    section.blocks.append(Pictures(items, 2 if true else 3, heads, phone_columns=2 if true else 1))
    return section


def objects_section(g: Gathered) -> Section:
    """Each object's views, turntable and facts."""
    scores = {o["match"]: o for o in (g.evaluation or {}).get("objects", []) if o["match"] is not None}
    meshes = {m.id: m for m in g.object_meshes}
    cards = []
    for item in g.objects:
        mesh = meshes[item["id"]]
        first = item["views"][0] if item["views"] else None
        cards.append(
            Card(
                item["id"],
                f"{item['label']} {item['id']}",
                drawing.css_color(g.colors[item["id"]]),
                pictures.turntable(g, mesh, first),
                pictures.ANGLES,
                _object_facts(item, scores.get(item["id"])),
                pictures.object_views(g, mesh, list(item["views"])),
                [item["assembly"]["repair"]] if item.get("assembly", {}).get("repair") else [],
            )
        )
    blocks: list[Block] = []
    if g.posed is None or g.seen_poses is None:
        blocks.append(left_out("The objects' views", g.why_missing("poses", "world", "assets")))
    blocks.append(Cards(cards))
    return Section("objects", "Objects", blocks)


def _object_facts(item: dict, score: dict | None) -> list[tuple[str, str]]:
    size = " × ".join(f"{100 * side:.0f}" for side in item["scale"])
    out = [
        ("size", f"{size} cm"),
        (
            "mass",
            f"{item['mass_kg']:.2f} kg, {item['material']}, {'movable' if item['dynamic'] else 'fixed'}",
        ),
        (
            "seen",
            f"{item['provenance']['observed_fraction']:.0%} of its surface, in {len(item['views'])} frames",
        ),
        ("shape", f"{item['provenance']['geometry']}; {len(item['collision'])} collision parts"),
        ("label", f"{item['label']}, sure to {item['label_confidence']:.0%}"),
    ]
    if score is not None:
        out.append(
            (
                "truth",
                f"{score['name'].replace('_', ' ')}: box IoU {score['box_iou']:.2f}, "
                f"Chamfer {score['cd_cm']:.1f} cm, F 1 cm {score['f_1cm']:.0f} %",
            )
        )
    return out


def graph_section(g: Gathered) -> Section:
    """The scene graph, drawn and as a table."""
    edges = sorted(g.scene["graph"]["edges"], key=lambda e: e["child"])
    colors = {item: drawing.css_color(color) for item, color in g.colors.items()}
    wrong = {o["match"] for o in (g.evaluation or {}).get("objects", []) if o.get("relation_right") is False}
    rows = [
        [
            Cell(g.names[e["child"]], swatch=colors.get(e["child"], "")),
            Cell(e["relation"].replace("_", " "), "bad" if e["child"] in wrong else ""),
            Cell(g.names[e["parent"]], swatch=colors.get(e["parent"], "")),
            Cell(f"{e['confidence']:.2f}"),
            Cell(e["evidence"] if isinstance(e["evidence"], str) else json.dumps(e["evidence"])),
        ]
        for e in edges
    ]
    text = "Solid: supported by. Dashed: attached to. The fainter, the less sure."
    blocks: list[Block] = [
        Plots([plots.scene_graph(edges, g.names, colors)], wide=True, caption=text),
        Table(["object", "relation", "parent", "sure", "evidence"], rows, numeric=[3]),
    ]
    return Section("graph", "Scene graph", blocks)


def assembly_section(g: Gathered) -> Section:
    """The scene before and after assembly, what moved, and the result from three sides."""
    shown, moved = pictures.assembly_view(g)
    blocks: list[Block] = []
    if g.seen_poses is None:
        blocks.append(left_out("The scene before assembly", g.why_missing("assets")))
    shown += [] if moved is None else [moved]
    blocks.append(Pictures(shown, 2, phone_columns=1))
    rows = [
        [
            Cell(g.names[o["id"]], swatch=drawing.css_color(g.colors[o["id"]])),
            Cell(
                f"{100 * o['assembly']['moved_m']:.1f} cm", "warn" if o["assembly"]["moved_m"] > 0.02 else ""
            ),
            Cell(f"{o['assembly']['turned_deg']:.1f}°", "warn" if o["assembly"]["turned_deg"] > 5 else ""),
            Cell("movable" if o["dynamic"] else "fixed"),
            Cell(o["assembly"]["repair"] or "–"),
        ]
        for o in g.objects
        if "assembly" in o
    ]
    if rows:
        blocks.append(Table(["object", "moved", "turned", "kind", "what was done"], rows, numeric=[1, 2]))
    true = g.truth is not None and g.truth.has_meshes
    blocks.append(Pictures(pictures.scene_views(g), 3, phone_columns=3))
    if true:
        blocks.append(_distance_legend())
    return Section("assembly", "Assembly", blocks)


_THRESHOLDS = (
    ("stable", "< 2 cm, < 5°"),
    ("stable_10cm_0.1rad", "< 0.1 m, < 0.1 rad"),
    ("stable_5cm_drop_5deg", "< 5 cm drop, < 5°"),
)


def physics_section(g: Gathered) -> Section:
    """The report card, overall and for each object."""
    physics = g.scene["report"]["physics"]
    if "objects" not in physics:
        return Section("physics", "Physics", [left_out("The report card", "the bundle's report has none")])
    rates = {"stable": "stable_rate", **{key: f"stable_rate_{key[7:]}" for key, _ in _THRESHOLDS[1:]}}
    tiles = [
        Tile(f"{physics[rates[key]]:.0%}", text, _graded(physics[rates[key]], 1.0, 0.8))
        for key, text in _THRESHOLDS
    ]
    floating, overlap = physics["floating_rate"], physics["spawn_penetration_mm"]
    between = " and ".join(x.replace("_", " ") for x in physics.get("spawn_penetration_between", []))
    tiles.append(Tile(f"{floating:.0%}", "floating", _graded(-floating, 0.0, -0.2), "fall > 5 mm in 0.5 s"))
    tiles.append(
        Tile(f"{overlap:.2f} mm", "deepest overlap at spawn", _graded(-overlap, -1.0, -5.0), between)
    )
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
        f"All {physics['dynamic_objects']} movable objects together for {physics['duration_s']:.0f} s at "
        f"1/{1 / physics['timestep_s']:.0f} s, undamped, never asleep; {physics['fixed_objects']} objects are fixed."
    )
    blocks: list[Block] = [Tiles(tiles)]
    if rows:
        blocks.append(Table(columns, rows, numeric=[1, 2, 3]))
    return Section("physics", "Physics", blocks, lead)


def kept_out_section(g: Gathered) -> Section:
    """The scene at the cameras of frames that nothing was fitted to."""
    section = Section("kept-out", "Kept-out frames", [], short="Kept out")
    if g.posed is None:
        section.blocks.append(left_out("Kept-out frames", g.why_missing("poses", "world")))
        return section
    if not len(g.posed.held_out_indices):
        section.blocks.append(left_out("Kept-out frames", "no kept-out frame could be registered"))
        return section
    items, scores = pictures.kept_out_frames(g)
    section.blocks.append(Pictures(items, 3, ["frame", "scene", "color error"], phone_columns=3))
    limit = f"{pictures.COLOR_ERROR:.0f} of 255"
    section.blocks.append(
        Legend(drawing.gradient(drawing.ERROR_MAP), "0", limit, "color error; gray: nothing there")
    )
    if scores:
        psnr, ssim, covered = np.mean(scores, axis=0)
        section.blocks.append(
            Text(
                f"Of the {len(scores)} frames shown: PSNR {psnr:.1f} dB, SSIM {ssim:.2f}, coverage {covered:.0%}."
            )
        )
    return section


def cost_section(g: Gathered) -> Section:
    """Wall time, CPU time and peak memory of each stage."""
    from reconstruction.pipeline import STAGE_NAMES

    report = g.scene["report"]
    wall, volatile = report["timings_s"], report.get("volatile", {})
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
    backends = ", ".join(f"{stage}: {name}" for stage, name in sorted(report["backends"].items()))
    rows += [("versions", versions)] if versions else []
    rows += [("backends", backends)] if backends else []
    if rows:
        blocks.append(facts(rows))
    return Section("cost", "Time and memory", blocks, short="Cost")


def notes_section(g: Gathered) -> Section:
    """Notes of the stages, what differs from the default options, overrides, the whole config."""
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
    """List options that differ from the defaults: (stage.option, value, default)."""
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
