"""Build the sections of the report: one function per section, from the gathered inputs to blocks."""

import json

import numpy as np

from reconstruction.core.types import Camera
from reconstruction.measure.report import drawing, object_pictures, pictures, plots, scene_pictures
from reconstruction.measure.report.against_truth import truth_section
from reconstruction.measure.report.blocks import (
    Block,
    Card,
    Cards,
    Cell,
    Legend,
    Pictures,
    Plots,
    Section,
    Split,
    Table,
    Text,
    Tile,
    Tiles,
    facts,
    graded,
    left_out,
)
from reconstruction.measure.report.collect import Gathered
from reconstruction.measure.report.contact_sheet import anchor_text
from reconstruction.measure.report.outline_section import outline_section
from reconstruction.measure.report.report_card import cost_section, notes_section, physics_section


def all_sections(g: Gathered) -> list[Section]:
    """Return the page's sections in order."""
    makers = (
        truth_section, outline_section, cameras_section, depth_section, gaussians_section, surface_section,
        instances_section, objects_section, graph_section, assembly_section, held_out_section, physics_section,
        cost_section, notes_section,
    )  # fmt: skip
    return [section for maker in makers if (section := maker(g)) is not None]


def summary_tiles(g: Gathered) -> Tiles:
    """Return the highlighted figures at the top of the page."""
    scene, report = g.scene, g.scene["report"]
    physics, scale = report.get("physics", {}), scene["scale"]
    tiles = [Tile(str(len(scene["objects"])), "objects", detail=f"{len(scene['base'])} base surfaces")]
    if "stable_rate" in physics:
        rate = physics["stable_rate"]
        detail = f"of {physics.get('dynamic_objects', '?')} movable objects, 10 s"
        tiles.append(Tile(f"{rate:.0%}", "stable", graded(rate, 1.0, 0.8), detail))
    if "spawn_penetration_mm" in physics:
        depth = physics["spawn_penetration_mm"]
        tiles.append(Tile(f"{depth:.1f} mm", "deepest contact at spawn", graded(-depth, -1.0, -5.0)))
    sigma = scale.get("uncertainty")
    status = "bad" if sigma is None else graded(-sigma, -0.05, -0.2)
    tiles.append(Tile(_uncertainty(scale), "scale", status, scale["method"].replace("-", " ")))
    if "registration" in report:
        found = report["registration"]
        share = found["registered"] / max(found["keyframes"], 1)
        text = f"{found['registered']} of {found['keyframes']}"
        tiles.append(Tile(text, "keyframes registered", graded(share, 0.95, 0.7)))
    total = sum(report.get("timings_s", {}).values())
    peak_mb = report.get("peak_memory_mb")
    memory = "" if peak_mb is None else f"peak {peak_mb / 1024:.1f} GB"
    tiles.append(Tile(f"{total / 60:.1f} min" if total >= 90 else f"{total:.0f} s", "time", detail=memory))
    return Tiles(tiles)


def _uncertainty(scale: dict) -> str:
    """Format the relative uncertainty of the metric scale."""
    return "unknown" if scale.get("uncertainty") is None else f"± {scale['uncertainty']:.0%}"


def cameras_section(g: Gathered) -> Section:
    """Return keyframes, camera path, registration and scale."""
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
        error_px = f"reprojection error {found['reprojection_error_px']:.2f} px"
        rows.append(("registration", f"{found['registered']} of {found['keyframes']} keyframes, {error_px}"))
    c = g.camera
    rows.append(("camera", f"{c.width}×{c.height}, focal length {c.fx:.0f} px, field of view {_fov(c):.0f}°"))
    scale = scene["scale"]
    detail = f"; {scale['detail']}" if scale.get("detail") else ""
    spread = "" if scale.get("uncertainty") is None else f", {_uncertainty(scale)} (1 σ)"
    rows.append(("scale", f"{scale['method']}{spread}{detail}"))
    world = scene.get("world")
    if world:
        floor = "observed" if world["floor_observed"] else "assumed below the lowest observed point"
        rows.append(
            ("gravity", f"{world['gravity_method']}, ± {world['gravity_sigma_deg']:.1f}°; floor {floor}")
        )
    caption = (
        "The assembled scene from above. Full dots are keyframes, empty dots held-out frames; lines are viewing "
        "directions."
    )
    path = Pictures([pictures.camera_path(g)], 1, phone_columns=1, caption=caption)
    blocks.append(Split(path, facts(rows)))
    return Section("cameras", "Video and cameras", blocks, short="Cameras")


def _fov(camera: Camera) -> float:
    return float(np.degrees(2 * np.arctan(camera.width / 2 / camera.fx)))


def depth_section(g: Gathered) -> Section:
    """Return color, depth, normals and depth errors of keyframes."""
    if g.posed is None or g.depth is None:
        missing = left_out("Depth and normals", g.why_missing("poses", "depth", "world"))
        return Section("depth", "Depth", [missing])
    items, errors = pictures.depth_rows(g)
    heads = ["color", "depth", "normals"] + (["error"] if pictures.depth_is_compared(g) else [])
    blocks: list[Block] = [
        Pictures(items, len(heads), heads, phone_columns=len(heads)),
        Legend(drawing.gradient("turbo_r"), "near", "far", "depth; gray: unknown"),
    ]
    if errors:
        limit = f"{100 * pictures.DEPTH_ERROR_M:.0f} cm or more"
        blocks.append(_error_legend(limit, "depth error"))
    elif g.truth is not None:
        blocks.append(left_out("The depth's error map", "no true depth of these frames is known"))
    text = "Colors of normals are world axes: the floor is uniformly lavender, a wall has one color."
    return Section("depth", "Depth", [*blocks, Text(text)])


def surface_section(g: Gathered) -> Section:
    """Return the fused surface from three sides, and its error maps."""
    surface = g.surface
    if surface is None:
        return Section("surface", "Surface", [left_out("The fused surface", g.why_missing("surface"))])
    items, heads = scene_pictures.surface_views(g)
    blocks: list[Block] = [Pictures(items, 3, heads, phone_columns=3)]
    if g.truth is not None and g.truth.has_meshes:
        blocks.append(_distance_legend())
    elif g.truth is not None:
        blocks.append(left_out("The surface's error map", "the truth has no meshes"))
    unseen = (np.asarray(surface.space.state) == 0).mean()
    text = (
        f"{len(surface.vertices):,} vertices, {len(surface.faces):,} triangles, voxels of "
        f"{1000 * surface.voxel_size_m:.0f} mm; {unseen:.0%} of the room's bounding box is unobserved."
    )
    return Section("surface", "Surface", [*blocks, Text(text)])


def _distance_legend() -> Legend:
    limit = f"{100 * scene_pictures.SURFACE_ERROR_M:.0f} cm or more"
    return _error_legend(limit, "distance to the true surface; gray: not visible in the video")


def _error_legend(limit: str, text: str) -> Legend:
    return Legend(drawing.gradient(drawing.ERROR_MAP), "0", limit, text)


def instances_section(g: Gathered) -> Section:
    """Return frames with outlined, numbered instances."""
    if g.posed is None or g.instances is None:
        missing = left_out("Outlines on frames", g.why_missing("poses", "world", "instances"))
        return Section("instances", "Instances", [missing])
    true = g.truth is not None and g.truth.has_meshes
    items = pictures.instance_frames(g, 4 if true else 6)
    heads = ["found", "true, in the color of the match"] if true else []
    shown = Pictures(items, 2 if true else 3, heads, phone_columns=2 if true else 1)
    return Section("instances", "Instances", [shown])


def objects_section(g: Gathered) -> Section:
    """Return each object's turntable, facts and views."""
    scores = {o["match"]: o for o in (g.evaluation or {}).get("objects", []) if o["match"] is not None}
    meshes = {m.id: m for m in g.object_meshes}
    cards = []
    for item in g.objects:
        mesh = meshes[item["id"]]
        first = item["views"][0] if item["views"] else None
        cards.append(
            Card(
                item["id"],
                f"{item.get('name') or item['label']} {item['id']}",
                drawing.css_color(g.colors[item["id"]]),
                object_pictures.turntable(g, mesh, first),
                object_pictures.ANGLES,
                _object_facts(item, scores.get(item["id"])),
                object_pictures.object_views(g, mesh, list(item["views"])),
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
    kind, observed = "movable" if item["dynamic"] else "fixed", item["provenance"]["observed_fraction"]
    out = [
        ("size", f"{size} cm"),
        ("mass", f"{item['mass_kg']:.2f} kg, {item['material']}, {kind}"),
        ("observed", f"{observed:.0%} of its surface, in {len(item['views'])} frames"),
        ("shape", f"{item['provenance']['geometry']}; {len(item['collision'])} collision parts"),
        ("label", f"{item['label']}, confidence {item['label_confidence']:.0%}"),
    ]
    if "anchor" in item:
        out.append(("for --overrides", anchor_text(item)))
    if score is not None:
        surface = f"Chamfer {score['cd_cm']:.1f} cm, F 1 cm {score['f_1cm']:.0f}%"
        name = score["name"].replace("_", " ")
        out.append(("truth", f"{name}: box IoU {score['box_iou']:.2f}, {surface}"))
    return out


def graph_section(g: Gathered) -> Section:
    """Return the scene graph, drawn and as a table."""
    edges = sorted(g.scene["graph"]["edges"], key=lambda e: e["child"])
    colors = {item: drawing.css_color(color) for item, color in g.colors.items()}
    wrong = {o["match"] for o in (g.evaluation or {}).get("objects", []) if o.get("relation_right") is False}
    rows = [
        [
            Cell(g.names[e["child"]], swatch=colors.get(e["child"], "")),
            Cell(e["relation"].replace("_", " "), "bad" if e["child"] in wrong else ""),
            Cell(g.names[e["parent"]], swatch=colors.get(e["parent"], "")),
            Cell(f"{e['confidence']:.2f}"),
            Cell(e.get("said_by", "")),
            Cell(e["evidence"] if isinstance(e["evidence"], str) else json.dumps(e["evidence"])),
        ]
        for e in edges
    ]
    text = "Solid: supported by. Dashed: attached to. Fainter: less confident."
    blocks: list[Block] = [
        Plots([plots.scene_graph(edges, g.names, colors)], wide=True, caption=text),
        Table(["object", "relation", "parent", "confidence", "source", "evidence"], rows, numeric=[3]),
    ]
    return Section("graph", "Scene graph", blocks)


def assembly_section(g: Gathered) -> Section:
    """Return the scene before and after assembly, the displacements, and the result from three sides."""
    shown, moved = pictures.assembly_view(g)
    blocks: list[Block] = []
    if g.seen_poses is None:
        blocks.append(left_out("The scene before assembly", g.why_missing("assets")))
    shown += [] if moved is None else [moved]
    blocks.append(Pictures(shown, 2, phone_columns=1))
    rows = [
        [
            Cell(g.names[o["id"]], swatch=drawing.css_color(g.colors[o["id"]])),
            Cell(f"{100 * done['moved_m']:.1f} cm", "warn" if done["moved_m"] > 0.02 else ""),
            Cell(f"{done['turned_deg']:.1f}°", "warn" if done["turned_deg"] > 5 else ""),
            Cell("movable" if o["dynamic"] else "fixed"),
            Cell(done["repair"] or "–"),
        ]
        for o in g.objects
        if (done := o.get("assembly"))
    ]
    if rows:
        blocks.append(Table(["object", "moved", "turned", "kind", "repair"], rows, numeric=[1, 2]))
    blocks.append(Pictures(scene_pictures.scene_views(g), 3, phone_columns=3))
    if g.truth is not None and g.truth.has_meshes:
        text = (
            "Second row: distance from the scene to the true surface. Third row: from the truth to the scene."
        )
        blocks += [Text(text), _distance_legend()]
    return Section("assembly", "Assembly", blocks)


def gaussians_section(g: Gathered) -> Section:
    """Return color, depth and normals of the Gaussians at held-out cameras."""
    missing = ""
    if g.posed is None or g.gaussians is None:
        missing = g.why_missing("poses", "world", "gaussians")
    elif not len(g.posed.held_out_indices):
        missing = "no held-out frame could be registered"
    if g.gaussians is None or missing:
        return Section("gaussians", "Gaussians", [left_out("The Gaussians", missing)])
    heads = ["frame", "color", "depth", "normals"]
    text = (
        f"{len(g.gaussians):,} disks, fitted to the keyframes and rendered at the cameras of held-out frames. Colors "
        "of normals are world axes."
    )
    shown = Pictures(pictures.gaussian_rows(g), len(heads), heads, phone_columns=2)
    return Section("gaussians", "Gaussians", [shown, Text(text)])


def held_out_section(g: Gathered) -> Section:
    """Return held-out frames beside the renderings at their cameras."""
    blocks: list[Block] = []
    missing = ""
    if g.posed is None:
        missing = g.why_missing("poses", "world")
    elif not len(g.posed.held_out_indices):
        missing = "no held-out frame could be registered"
    if missing:
        return Section(
            "kept-out", "Held-out frames", [left_out("Held-out frames", missing)], short="Held out"
        )
    if "gaussians" in g.stages.missing:
        blocks.append(left_out("Gaussians", g.why_missing("gaussians")))
    renderers = pictures.renderers(g)
    items, scores = pictures.held_out_frames(g, renderers)
    heads = ["frame"] + [head for name in renderers for head in (name, f"error of the {name}")]
    blocks.append(Pictures(items, len(heads), heads, phone_columns=3))
    blocks.append(_error_legend(f"{pictures.COLOR_ERROR:.0f} of 255", "color error; gray: not covered"))
    for name, found in scores.items():
        if found:
            psnr, ssim, covered = np.mean(found, axis=0)
            figures = f"PSNR {psnr:.1f} dB, SSIM {ssim:.2f}, coverage {covered:.0%}"
            blocks.append(Text(f"The {name} in the {len(found)} frames shown: {figures}."))
    return Section("kept-out", "Held-out frames", blocks, short="Held out")
