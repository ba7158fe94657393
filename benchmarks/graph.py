"""Relations by geometry, and merging under a backend that lies, on generated rooms with true shapes.

    python -m benchmarks.graph                                   # all rooms; writes docs/scene_graph_benchmark.md
    python -m benchmarks.graph --rooms 10 --lying-rooms 4 --seeds 2 --page /tmp/page.md

No video is filmed: the assets are the true meshes, so that relations and merging alone are measured.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.command import guarded
from benchmarks.graph_page import GeometryResult, LyingResult, write_graph_page
from benchmarks.lying import LyingRelations, TrueRelations
from benchmarks.machine import ROOT
from reconstruction.core.types import AssetSet
from reconstruction.scene_graph import (
    MergedGraph,
    SceneGraphConfig,
    infer_scene_graph,
    region_questions,
    synthesize,
)
from registry.errors import UsageError
from registry.geometry import rigid
from synthetic.containers import CONTAINER_KINDS
from synthetic.procedural import RoomSpec, plan_room, unpainted
from synthetic.room import Room
from synthetic.true_assets import true_assets, true_edges

DEFAULT_PAGE = ROOT / "docs" / "scene_graph_benchmark.md"
MERGINGS = ("online", "naive", "global")
LIES = ((0.0, 0.0), (0.1, 0.1), (0.2, 0.2), (0.3, 0.3))  # shares of edges wrong, missing
_CONTAINERS = {"crate", *(kind.label for kind in CONTAINER_KINDS.values())}


@dataclass(frozen=True)
class Disturbance:
    """How far things are from where they truly are."""

    moved_m: float = 0.0  # at most, along each axis
    tilted_deg: float = 0.0  # at most, about a level axis


DISTURBANCES = (Disturbance(), Disturbance(0.008, 0.8), Disturbance(0.016, 1.6))


def room_specs(rooms: int, first_seed: int = 1000) -> list[RoomSpec]:
    """Return rooms of five sorts in turn: mixed, stacked, with containers, with full walls, crowded."""
    sorts = (
        RoomSpec(),
        RoomSpec(stacks=0.6),
        RoomSpec(containers=0.2),
        RoomSpec(wall_things=0.35),
        RoomSpec(stacks=0.4, containers=0.15, clutter_gap_m=0.015, crowding=0.6),
    )
    return [replace(sorts[k % 5], seed=first_seed + k, objects=10 + (7 * k) % 24) for k in range(rooms)]


def kind_of(room: Room) -> dict[int, str]:
    """Say what sort of relation each object has."""
    entities = {e.id: e for e in room.entities}
    out = {}
    for item in room.objects:
        below, parent = 0, entities[item.parent]
        while not parent.base:
            below, parent = below + 1, entities[parent.parent]
        if item.relation == "attached_to":
            out[item.id] = "on a wall"
        elif entities[item.parent].label in _CONTAINERS:
            out[item.id] = "in a container"
        else:
            out[item.id] = ("on the floor", "on one thing", "on two things", "on three or more")[
                min(below, 3)
            ]
    return out


def disturbed(assets: AssetSet, by: Disturbance, seed: int) -> AssetSet:
    """Return the assets with every object moved and tilted a little."""
    rng = np.random.default_rng(seed)
    objects = []
    for item in assets.objects:
        angle, turn = np.radians(rng.uniform(-1, 1) * by.tilted_deg), rng.uniform(0, np.pi)
        axis = np.array([np.cos(turn), np.sin(turn), 0.0])
        cross = np.cross(np.eye(3), axis)
        rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        pose = item.world_from_object @ rigid(rotation, np.zeros(3))
        pose[:3, 3] += rng.uniform(-1, 1, 3) * by.moved_m
        objects.append(replace(item, world_from_object=pose))
    return replace(assets, objects=tuple(objects))


def measure_geometry(specs: Sequence[RoomSpec], by: Disturbance) -> GeometryResult:
    """Measure the embedded backend."""
    out = GeometryResult(by.moved_m, by.tilted_deg)
    for spec in specs:
        room = unpainted(plan_room(spec))
        truth, kinds = true_edges(room), kind_of(room)
        assets = disturbed(true_assets(room), by, spec.seed)
        started = time.process_time()
        graph = infer_scene_graph(assets, SceneGraphConfig())
        out.cpu_s.append(time.process_time() - started)
        names = {e.id: e.name for e in room.entities}
        for edge in graph.edges:
            true = truth[edge.child]
            right = (edge.relation, edge.parent) == (true.relation, true.parent)
            out.add(kinds[edge.child], right)
            if not right:
                out.errors.append(
                    f"room {spec.seed}: {names[edge.child]} {edge.relation} {names[edge.parent]}, "
                    f"not {true.relation} {names[true.parent]}"
                )
    return out


def measure_lies(specs: Sequence[RoomSpec], seeds: int, wrong: float, missing: float) -> list[LyingResult]:
    """Measure each way to merge; all of them are told the same lies where they ask the same."""
    out = {merging: LyingResult(merging, wrong, missing) for merging in MERGINGS}
    for spec in specs:
        room = unpainted(plan_room(spec))
        assets, truth = true_assets(room), true_edges(room)
        base = [e.id for e in room.base]
        questions = region_questions(assets, SceneGraphConfig())
        for seed in range(seeds):
            for merging, result in out.items():
                liar = LyingRelations(TrueRelations(truth), tuple(base), seed, wrong, missing)
                graph = synthesize(questions, base, sorted(truth), liar, merging=merging)
                right = [
                    (e.relation, e.parent) == (truth[e.child].relation, truth[e.child].parent)
                    for e in graph.edges
                ]
                result.f1.append(float(np.sum(right)) / len(truth))
                result.asked.append(liar.asked)
                result.orphans.append(float(np.mean([e.said_by == "nobody" for e in graph.edges])))
                result.forests.append(is_forest(graph, set(base), set(truth)))
    return list(out.values())


def is_forest(graph: MergedGraph, base: set[int], objects: set[int]) -> bool:
    """Tell whether every object has one parent and a path to the base."""
    parent = {e.child: e.parent for e in graph.edges}
    if len(parent) != len(graph.edges) or set(parent) != objects:
        return False
    for node in objects:
        for _ in objects:
            node = parent.get(node, node)
        if node not in base:
            return False
    return True


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.graph",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--rooms", type=int, default=60, help="rooms for geometry (default 60)")
    parser.add_argument("--lying-rooms", type=int, default=20, help="rooms with lies (default 20)")
    parser.add_argument("--seeds", type=int, default=5, help="seeds of lies a room (default 5)")
    parser.add_argument("--page", type=Path, default=DEFAULT_PAGE, help="where the tables go")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0, or the exit code of what is wrong."""
    arguments = build_parser().parse_args(argv)
    return guarded("benchmarks.graph", lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    if min(arguments.rooms, arguments.lying_rooms, arguments.seeds) < 1:
        raise UsageError("--rooms, --lying-rooms and --seeds must be at least 1")
    specs = room_specs(arguments.rooms)
    geometry = []
    for by in DISTURBANCES:
        geometry.append(measure_geometry(specs, by))
        print(f"geometry, {by}: F1 {geometry[-1].f1:.3f}", *geometry[-1].errors, sep="\n  ", flush=True)
    lies = []
    chosen = room_specs(arguments.lying_rooms, first_seed=2000)
    for wrong, missing in LIES:
        lies += measure_lies(chosen, arguments.seeds, wrong, missing)
        words = ", ".join(f"{r.merging} {np.mean(r.f1):.3f}" for r in lies[-3:])
        print(f"{wrong:.0%} wrong, {missing:.0%} missing: {words}", flush=True)
    write_graph_page(geometry, lies, arguments.lying_rooms, arguments.seeds, arguments.page)
    print(f"{arguments.page} is written", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
