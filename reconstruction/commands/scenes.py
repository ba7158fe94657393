"""`simrecon list`, `show`, `verify`, `remove`: the scenes of the registry."""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from reconstruction.commands.options import (
    add_common,
    add_scene,
    add_verb,
    output_errors,
    path_or_address,
    write_output,
)
from registry import SceneBundle, SceneRecord, open_registry
from registry.errors import UsageError
from registry.plain_text import plain


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Add the verbs."""

    def add(name: str, text: str, run: object, scene: bool = True) -> argparse.ArgumentParser:
        parser = add_verb(verbs, name, text, text[0].upper() + text[1:] + ".")
        if scene:
            add_scene(parser)
        add_common(parser)
        parser.set_defaults(run=run)
        return parser

    add("list", "list the scenes of the registry", run_list, scene=False)
    show = add("show", "show objects, relations, scale, stability and files of a scene", run_show)
    show.add_argument(
        "--card",
        action="store_true",
        help="print the scene's card, as `simrecon pack` writes it (Markdown): source, licence, figures, warning",
    )
    show.add_argument(
        "--instances",
        action="store_true",
        help="list every object with an anchor for --overrides, and write contact sheets: frames with outlined, "
        "numbered objects, and a picture of each object",
    )
    show.add_argument(
        "--views",
        action="store_true",
        help="write contact sheets of the views that show most of each object (docs/avo.md), with and without its "
        "occluders; computed from the stage cache of the scene, and kept there",
    )
    show.add_argument(
        "--graph",
        action="store_true",
        help="print the source of each edge of the scene graph, and write a picture of each merge step: the view, the "
        "edges found in it, the graph after it (docs/scene_graph.md); views are rendered from the stage cache",
    )
    show.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="avo.OPTION=VALUE",
        help="with --views: an option of avo, for example avo.strategy=canonical",
    )
    show.add_argument(
        "--work-dir",
        type=path_or_address,
        metavar="DIR",
        help="with --views or --graph: as given to reconstruct",
    )
    show.add_argument(
        "--out", type=Path, metavar="DIR", help="folder of the pictures (default: SCENE_instances and so on)"
    )
    show.add_argument(
        "--overrides-template",
        type=Path,
        metavar="FILE",
        help="with --instances: also write a file for --overrides with a commented line for each object",
    )
    verify = add("verify", "check every file of a scene against its hash and its schema", run_verify)
    verify.add_argument(
        "--physics", action="store_true", help="also simulate 10 s, and recompute the physics report"
    )
    remove = add("remove", "remove a scene and its files from the registry", run_remove)
    remove.add_argument("--yes", action="store_true", help="do not ask")


def run_list(arguments: argparse.Namespace) -> int:
    """Print one line for each scene."""
    registry = open_registry(arguments.registry)
    records, problems = registry.list_with_problems()
    for problem in problems:
        print(f"simrecon list: {plain(problem)}", file=sys.stderr)
    if arguments.json:
        print(json.dumps([_record_json(r) for r in records], indent=2))
        return 0
    if not records and not problems:
        print(f"no scenes in {registry.where} yet; make one with: simrecon reconstruct VIDEO")
        return 0
    width = max((len(r.scene_id) for r in records), default=0)
    for record in records:
        stable = record.metrics.get("stable_rate")
        shown = "" if stable is None else f"  stable {stable:.0%}"
        print(
            f"SimRecon/{record.scene_id:<{width}}  {record.n_objects:3d} objects{shown}  "
            f"{record.created_utc[:16]}  {record.source_file}"
        )
    return 0


def run_show(arguments: argparse.Namespace) -> int:
    """Print one scene."""
    registry = open_registry(arguments.registry)
    record = registry.get(arguments.scene)
    bundle = registry.load(arguments.scene)
    _check_show_flags(arguments)
    if arguments.card:
        from registry.exchange.card import scene_card

        print(scene_card(bundle.scene, bundle.revision), end="")
        return 0
    if arguments.instances:
        return _show_instances(arguments, bundle)
    if arguments.views:
        from reconstruction.commands.views import show_views

        return show_views(arguments, bundle, registry.root)
    if arguments.graph:
        from reconstruction.commands.graph import show_graph

        return show_graph(arguments, bundle, registry.root)
    if arguments.json:
        from reconstruction.costs import costs_json

        costs = costs_json(bundle.scene["report"])
        print(json.dumps({"record": _record_json(record), "costs": costs, "scene": bundle.scene}, indent=2))
    else:
        print(describe_scene(record, bundle))
    return 0


def _check_show_flags(arguments: argparse.Namespace) -> None:
    """Raise `UsageError` for flags of `show` that do not go together."""
    asked = [flag for flag in ("card", "instances", "views", "graph") if getattr(arguments, flag)]
    if len(asked) > 1:
        raise UsageError(
            "--card, --instances, --views and --graph print different things; give only one of them"
        )
    for flag, partners in (
        ("set", ("views",)),
        ("work_dir", ("views", "graph")),
        ("overrides_template", ("instances",)),
        ("out", ("instances", "views", "graph")),
    ):
        if getattr(arguments, flag) and not set(partners) & set(asked):
            with_one = " or ".join(f"--{partner}" for partner in partners)
            raise UsageError(
                f"--{flag.replace('_', '-')} needs {with_one}: simrecon show SCENE --{partners[0]}"
            )


def _show_instances(arguments: argparse.Namespace, bundle: SceneBundle) -> int:
    """Write contact sheets, and print every object with its anchor."""
    from reconstruction.measure.report.contact_page import overrides_template, write_contact_sheets
    from reconstruction.measure.report.contact_sheet import ContactSheet, anchor_text

    sheet = ContactSheet.of(bundle)
    folder = arguments.out or Path(f"{arguments.scene}_instances")
    template = arguments.overrides_template
    with output_errors(folder):
        if template is not None:
            if template.exists():
                raise UsageError(f"{template} exists; it may hold your corrections and is not overwritten")
            write_output(template, overrides_template(sheet), "--overrides-template")
        files = write_contact_sheets(sheet, folder)
    if arguments.json:
        keys = ("label", "label_confidence", "scale", "anchor")
        things = [
            {"id": number} | {key: item.get(key) for key in keys} for number, item in sheet.objects.items()
        ]
        print(json.dumps({"things": things, "files": [str(path) for path in files]}, indent=2))
        return 0
    for number, item in sheet.objects.items():
        label, confidence, size, held = sheet.facts(number)
        print(f"{number:4d}  {label:<22} {confidence:>4}  {size:<18} {held:<24} {anchor_text(item)}")
    print(f"contact sheets: {folder / 'index.html'} and {len(files) - 1} pictures beside it")
    if template is not None:
        print(f"corrections to edit: {template}")
    return 0


def describe_scene(record: SceneRecord, bundle: SceneBundle) -> str:
    """Return a text with the objects, scale, physics, notes, costs and files of a scene."""
    from reconstruction.costs import describe_costs
    from registry.exchange.card import licence_of

    scene = bundle.scene
    names = {b["id"]: b["label"] for b in scene["base"]} | {o["id"]: o["label"] for o in scene["objects"]}
    parents = {e["child"]: e for e in scene["graph"]["edges"]}
    lines = [f"{len(scene['objects'])} objects, {len(scene['base'])} base surfaces"]
    for item in sorted(scene["objects"], key=lambda o: o["id"]):
        edge = parents.get(item["id"])
        relation = (
            ""
            if edge is None
            else f"{edge['relation'].replace('_', ' ')} {names[edge['parent']]} ({edge['parent']})"
        )
        size = " x ".join(f"{100 * side:.0f}" for side in item["scale"])
        kind = "movable" if item["dynamic"] else "fixed"
        name = item.get("name") or item["label"]
        lines.append(
            f"  {item['id']:3d}  {name:<26} {size + ' cm':<18} {item['mass_kg']:7.2f} kg  {kind:<8}"
            f"{relation:<32} seen {item['provenance']['observed_fraction']:.0%}"
        )
    scale = scene["scale"]
    sigma = "unknown" if scale.get("uncertainty") is None else f"{100 * scale['uncertainty']:.0f} %"
    lines.append(f"scale: {scale['method']}, 1 sigma {sigma}. {scale.get('detail', '')}")
    physics = scene["report"].get("physics", {})
    found = {
        "stable_rate": "{:.0%} of the movable objects stay at rest for 10 s",
        "spawn_penetration_mm": "deepest overlap {:.1f} mm",
        "floating_rate": "{:.0%} float",
    }
    figures = [text.format(physics[key]) for key, text in found.items() if key in physics]
    if figures:
        lines.append(f"physics: {'; '.join(figures)}")
    lines += [f"note: {note}" for note in scene["report"].get("notes", [])]
    if scene["report"].get("timings_s"):
        lines.append(describe_costs(scene["report"]))
    lines.append(
        f"licence: {licence_of(scene)}; the pictures are of a real room (card: simrecon show {record.scene_id} --card)"
    )
    lines.append(f"files: {record.path}")
    return "\n".join(lines)


def run_verify(arguments: argparse.Namespace) -> int:
    """Check the files of a scene against their hashes, and its physics if asked for."""
    registry = open_registry(arguments.registry)
    report = registry.verify(arguments.scene)
    result = asdict(report)
    if arguments.physics and report.ok:
        from registry.report_card import physics_report
        from registry.simulation import specs_from_bundle

        bundle = registry.load(arguments.scene)
        result["physics"] = physics_report(specs_from_bundle(bundle), bundle.edges)
    if arguments.json:
        print(json.dumps(result, indent=2, default=str))
    else:
        for problem in report.problems:
            print(plain(problem))
        print(
            f"{arguments.scene}: {'all files are intact' if report.ok else 'damaged; reconstruct it again'}"
        )
        if "physics" in result:
            print("\n".join(describe_physics(result["physics"])))
    return 0 if report.ok else 1


def describe_physics(physics: dict) -> list[str]:
    """Return a physics report as lines of text."""
    from registry.report_card import failures

    contacts = physics["contacts"]
    edges = contacts["support_edges"] + contacts["attached_edges"]
    real = contacts["support_edges_real"] + contacts["attached_edges_real"]
    lines = [
        f"physics: stable {physics['stable_rate']:.0%}, "
        f"deepest overlap {physics['spawn_penetration_mm']:.2f} mm, floating {physics['floating_rate']:.0%}, "
        f"{physics['energy_at_rest_j']:.1e} J left after {physics['duration_s']:g} s",
        f"contacts: {real} of {edges} edges are in contact; of {contacts['main_supports']} supports that bear half "
        f"of an object or more, {len(contacts['supports_without_edge'])} have no edge",
    ]
    lines += [
        f"  {e['child']} {e['relation']} {e['parent']}: no contact" for e in contacts["edges_without_contact"]
    ]
    lines += [f"  {e['child']} rests on {e['carrier']}: no edge" for e in contacts["supports_without_edge"]]
    lines += [f"  {name.replace('_', ' ')} has no collision shape" for name in physics["without_collision"]]
    return lines + [f"  {line}" for line in failures(physics)]


def run_remove(arguments: argparse.Namespace) -> int:
    """Remove a scene; ask first if standard input is a terminal."""
    registry = open_registry(arguments.registry)
    record = registry.get(arguments.scene)
    if not arguments.yes and sys.stdin.isatty():
        answer = input(f"remove {record.scene_id} ({record.n_objects} objects, {record.path})? [y/N] ")
        if answer.strip().lower() not in ("y", "yes"):
            print("kept")
            return 0
    registry.remove(arguments.scene)
    print(json.dumps({"removed": arguments.scene}) if arguments.json else f"removed {arguments.scene}")
    return 0


def _record_json(record: SceneRecord) -> dict:
    data = asdict(record)
    data["path"] = str(record.path)
    data["env_id"] = f"SimRecon/{record.scene_id}"
    return data
