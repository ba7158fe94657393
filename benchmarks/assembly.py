"""How scenes stand after assembly, and after what it is compared with.

    python -m benchmarks.assembly --rooms 50                               # generated rooms, true shapes
    python -m benchmarks.assembly --captures ../shared/bench ../shared/real   # reconstructed up to the scene graph
    python -m benchmarks.assembly --page-only

Captures are reconstructed in the work folder that `python -m benchmarks.run` uses, too, so that only what is not kept
there is done. Results are kept as <out>/assembly/scenes/<scene>.json; the page is written from all of them.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.assembly_page import write_assembly_page
from benchmarks.assembly_rooms import room_task
from benchmarks.captures import Capture, find_captures
from benchmarks.command import guarded
from benchmarks.instances import stage_run, work_of
from benchmarks.machine import ROOT, describe_code, describe_machine
from benchmarks.table import DEFAULT_OUT
from reconstruction.assembly import AssemblyConfig, assemble
from reconstruction.core.types import AssembledScene, AssetSet, SceneGraph
from registry.geometry import transform_points
from registry.report_card import failures

DEFAULT_PAGE = ROOT / "docs" / "assembly_benchmark.md"
METHODS = ("hierarchical", "in-situ", "mcmc")
RESULTS = (
    Path("assembly") / "scenes"
)  # below --out: deeper than the results of `benchmarks.run`, which may share it
_FEWEST, _MOST = 5, 40  # objects of a generated room
_SAME_THING = 0.25  # box IoU


def measure(
    name: str,
    group: str,
    assets: AssetSet,
    graph: SceneGraph,
    true_centers: dict[int, np.ndarray],
    methods: Sequence[str] = METHODS,
    true_from_scene: float = 1.0,
) -> dict[str, Any]:
    """Assemble one scene with some methods.

    Args:
        name: Of the scene.
        group: Of scenes that are pooled on the page.
        assets: What is assembled.
        graph: What carries what.
        true_centers: By object, where the middle (3,) of its box truly is, in the scene's world.
        methods: Of `assembly.method`.
        true_from_scene: True metres a metre of the scene: how far things are off is said in true ones.
    """
    record = {"scene": name, "group": group, "objects": len(assets.objects), "methods": {}}
    record |= {"machine": describe_machine(), **describe_code()}
    for method in methods:
        wall, cpu = time.perf_counter(), time.process_time()
        scene = assemble(assets, graph, replace(AssemblyConfig(), method=method))
        cost = {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}
        figures = record["methods"][method] = cost | _figures(scene, assets, true_centers, true_from_scene)
        print(
            f"{name} {method}: {len(assets.objects)} objects, stable {figures['stable_rate']:.2f}, overlap "
            f"{figures['spawn_penetration_mm']:.1f} mm, floating {figures['floating_rate']:.2f}, "
            f"{figures['cpu_s']:.1f} s of CPU",
            flush=True,
        )
    return record


def _figures(
    scene: AssembledScene, assets: AssetSet, true_centers: dict[int, np.ndarray], true_from_scene: float
) -> dict[str, Any]:
    report = scene.physics_report
    keys = ("stable_rate", "floating_rate", "spawn_penetration_mm", "dynamic_objects", "energy_at_rest_j")
    contacts = report["contacts"]
    objects = {item.id: item for item in assets.objects}
    off = [
        true_from_scene
        * float(np.linalg.norm(_center(objects[p.id], p.world_from_object) - true_centers[p.id]))
        for p in scene.placed
        if p.id in true_centers
    ]
    return {
        **{key: report[key] for key in keys},
        "stable_objects": sum(entry["stable"] for entry in report["objects"]),
        "floating_objects": sum(entry["floating"] for entry in report["objects"]),
        "made_immovable": sum("made immovable" in p.repair for p in scene.placed),
        "moved_m": [p.moved_m for p in scene.placed],
        "off_m": off,
        **{key: value for key, value in contacts.items() if isinstance(value, int)},
        "edges_without_contact": len(contacts["edges_without_contact"]),
        "supports_without_edge": len(contacts["supports_without_edge"]),
        "failures": failures(report),
    }


def _center(item: Any, pose: np.ndarray) -> np.ndarray:
    vertices = np.asarray(item.visual.vertices, np.float64)
    return transform_points(pose, 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))[None])[0]


def measure_room(seed: int, objects: int, methods: Sequence[str] = METHODS) -> dict[str, Any]:
    """Measure one generated room."""
    task = room_task(seed, objects)
    centers = {item.id: _center(item, task.true_poses[item.id]) for item in task.assets.objects}
    return measure(
        f"generated_{seed}_{objects}", "generated rooms", task.assets, task.graph, centers, methods
    )


def measure_capture(capture: Capture, out: Path, methods: Sequence[str] = METHODS) -> dict[str, Any]:
    """Measure one capture, reconstructed with default options."""
    run = stage_run(capture.source, work_of(out, capture), [])
    run.execute("scene_graph")
    assets, graph = run.results["assets"], run.results["scene_graph"].plain()
    centers, scale = _true_centers(capture, run, assets) if capture.truth == "scene" else ({}, 1.0)
    group = "captures with truth" if capture.truth == "scene" else "captures without objects in their truth"
    return measure(capture.name, group, assets, graph, centers, methods, scale)


def _true_centers(capture: Capture, run: Any, assets: AssetSet) -> tuple[dict[int, np.ndarray], float]:
    """Return where the middles of the true things' boxes are in the reconstruction's world, by matched object.

    And how many true metres a metre of it is: the evaluation aligns by a similarity, too.
    """
    from reconstruction.measure.alignment import align
    from reconstruction.measure.ground_truth import GroundTruth
    from reconstruction.measure.matching import box_iou, match

    truth = GroundTruth.load(capture.ground_truth)
    posed, _ = run.in_world()
    poses = dict(zip(map(int, posed.indices), posed.world_from_camera))
    alignment = align(poses, truth.world_from_camera, truth.up)
    boxes = []
    for item in assets.objects:
        points = alignment.to_true(transform_points(item.world_from_object, item.visual.vertices))
        boxes.append([points.min(axis=0), points.max(axis=0)])
    wanted = [entity for entity in truth.entities if not entity.base]
    true_boxes = np.array([entity.mesh.bounds for entity in wanted])
    pairs = match(box_iou(true_boxes, np.array(boxes)), _SAME_THING)
    # The middle of the true mesh in the object's own box is not known; boxes are compared, tilt and yaw as they are.
    estimated = np.array(boxes).mean(axis=1)
    back = alignment.to_true(np.zeros((1, 3)))[0], alignment.to_true(np.eye(3))
    turn = (back[1] - back[0]).T
    centers = {}
    for row, column in pairs:
        item = assets.objects[column]
        away = np.linalg.solve(turn, true_boxes[row].mean(axis=0) - estimated[column])
        centers[item.id] = _center(item, item.world_from_object) + away
    return centers, alignment.scale


def build_parser() -> argparse.ArgumentParser:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.assembly",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--captures", type=Path, nargs="+", default=[], metavar="DIR", help="to reconstruct")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="only these captures")
    parser.add_argument(
        "--rooms", type=int, default=0, metavar="N", help="generated rooms of 5 to 40 objects"
    )
    parser.add_argument("--first-room", type=int, default=0, metavar="SEED", help="seed of the first of them")
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS, help="default: all")
    parser.add_argument("--out", type=Path, default=DEFAULT_OUT, metavar="DIR", help="where results are kept")
    parser.add_argument("--page", type=Path, default=DEFAULT_PAGE, metavar="FILE", help="the page to write")
    parser.add_argument("--page-only", action="store_true", help="measure nothing")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0, or the exit code of what is wrong."""
    arguments = build_parser().parse_args(argv)
    return guarded("benchmarks.assembly", lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    out = arguments.out.resolve()
    folder = out / RESULTS
    folder.mkdir(parents=True, exist_ok=True)
    captures = find_captures(arguments.captures, arguments.only) if arguments.captures else []
    if not arguments.page_only:
        for capture in captures:
            _keep(folder, measure_capture(capture, out, arguments.methods))
        for seed in range(arguments.first_room, arguments.first_room + arguments.rooms):
            _keep(folder, measure_room(seed, objects_of(seed), arguments.methods))
    kept = [json.loads(file.read_text()) for file in sorted(folder.glob("*.json"))]
    write_assembly_page(kept, arguments.page)
    print(f"{arguments.page} is written", flush=True)
    return 0


def objects_of(seed: int) -> int:
    """Return how many objects the generated room of a seed has: all sizes come up early."""
    return _FEWEST + (seed * 11) % (_MOST - _FEWEST + 1)


def _keep(folder: Path, record: dict[str, Any]) -> None:
    (folder / f"{record['scene']}.json").write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(main())
