"""Stage 9, assembly: assets and graph in, a scene at rest in SAPIEN out, with its physics report card.

Objects are placed on the static base, parents first: each is moved out of collisions, simulated until it rests, and
held there. Then all are simulated together and measured (CONTRACT section 4). Unstable objects are repaired within
bounds; `PlacedObject.repair` says how.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from reconstruction.assembly.base import base_slabs
from reconstruction.assembly.baselines import in_situ, mcmc
from reconstruction.assembly.config import ASSEMBLY_PRESETS, AssemblyConfig
from reconstruction.assembly.place import Placer
from reconstruction.assembly.placement import Placement, base_specs
from reconstruction.assembly.structure import clear_structure
from reconstruction.assembly.workbench import object_spec
from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.core.types import AssembledScene, AssetSet, Edge, PlacedObject, SceneGraph
from reconstruction.scene_graph.merge import breadth_first
from registry.errors import SimReconError
from registry.report_card import (
    MOST_PENETRATION_MM,
    STABLE_MOVE_M,
    STABLE_TURN_DEG,
    VERIFY_DURATION_S,
    physics_report,
    spawn_contacts,
)
from registry.simulation import TIMESTEP_S, BodySpec, build_physics, pose_change

_MARGIN = 0.5  # share of each bound of the report card beyond which an object is repaired
_FREE_S = 0.5  # of simulation without damping, after the damped joint settling


def assemble(
    assets: AssetSet,
    graph: SceneGraph,
    config: AssemblyConfig,
    *,
    movable: dict[int, bool] | None = None,
    progress: Progress = NO_PROGRESS,
) -> AssembledScene:
    """Assemble a scene at rest.

    Args:
        assets: base surfaces, the structure, and objects.
        graph: one parent for every object.
        config: method and bounds.
        movable: by object id, whether it is dynamic, where the user says so.
        progress: receives steps and objects that do not stand.

    Raises:
        SimReconError: an object has no path to the base.
    """
    movable = movable or {}
    by_id = {o.id: o for o in assets.objects}
    assets = clear_structure(assets, config)
    edges = breadth_first(graph.edges, list(assets.static_labels))
    missing = sorted(set(by_id) - {e.child for e in edges})
    if missing:
        raise SimReconError(
            f"assembly: the scene graph does not connect objects {missing} to the base; "
            "every object needs exactly one parent and there must be no cycle"
        )
    base = base_specs(assets)
    if config.method == "hierarchical":
        found, report = _build_up(assets, edges, movable, config, progress)
    else:
        if config.method == "in-situ":
            found = in_situ(assets, edges, movable, config)
        else:
            found = mcmc(assets, edges, movable, config, progress)
        report = _report(assets, found, base)
    stable = {entry["id"]: entry["stable"] for entry in report["objects"]}
    placed = tuple(_finish(found[o.id], stable.get(o.id, True)) for o in assets.objects)
    structure = () if assets.structure is None else assets.structure.collision
    return AssembledScene(
        placed, SceneGraph(tuple(found[e.child].edge for e in graph.edges)), report, structure
    )


def _build_up(
    assets: AssetSet, edges: list[Edge], movable: dict[int, bool], config: AssemblyConfig, progress: Progress
) -> tuple[dict[int, Placement], dict]:
    """Place every object after its parent, then settle all together."""
    by_id = {o.id: o for o in assets.objects}
    progress.start(len(edges) + config.joint_rounds, "placing objects")
    placer = Placer(assets, edges, config, movable)
    for edge in _lowest_first(edges, by_id):
        placement = placer.place(by_id[edge.child], edge)
        for note in placement.notes if not placement.stands else ():
            progress.note(f"assembly: {by_id[edge.child].label} {edge.child}: {note}")
        progress.advance()
    report = _settle_together(placer, base_specs(assets), config, progress)
    for placement in placer.placed.values():
        if not placement.parts:
            progress.note(f"assembly: {placement.asset.label} {placement.asset.id}: {placement.notes[-1]}")
    return placer.placed, report


def _report(assets: AssetSet, placed: dict[int, Placement], base: list[BodySpec]) -> dict:
    """Measure the placed scene, with bodies in the order of the bundle, as its readers will."""
    in_order = [placed[o.id] for o in assets.objects]
    return physics_report(scene_specs(in_order, base), [p.edge for p in in_order])


def scene_specs(placements: Iterable[Placement], base: list[BodySpec]) -> list[BodySpec]:
    """Return the bodies of the placed scene, as the bundle describes them."""
    specs = list(base)
    for p in placements:
        fixed_to = p.edge.parent if p.edge.relation == "attached_to" and p.dynamic else None
        specs.append(object_spec(p.asset, p.parts, p.pose, dynamic=p.dynamic, fixed_to=fixed_to))
    return specs


def _lowest_first(edges: list[Edge], by_id: dict) -> list[Edge]:
    """Order edges by depth in the graph, then by height, so that stacks are built from below."""
    depth: dict[int, int] = {}
    for edge in edges:
        depth[edge.child] = depth.get(edge.parent, 0) + 1
    heights = {i: float(asset.world_from_object[2, 3]) for i, asset in by_id.items()}
    return sorted(edges, key=lambda e: (depth[e.child], heights[e.child], e.child))


def _settle_together(
    placer: Placer, base: list[BodySpec], config: AssemblyConfig, progress: Progress
) -> dict:
    """Alternate joint simulation and repair of moving objects; keep the best round, fix the rest in place."""
    best: tuple[tuple, dict[int, Placement], dict] | None = None
    for round_number in range(config.joint_rounds):
        # Later rounds run free for as long as stability is verified: objects may creep.
        free_s = _FREE_S if round_number == 0 else VERIFY_DURATION_S
        _joint_settle(placer, base, config.joint_settle_s, free_s)
        report = _report(placer.assets, placer.placed, base)
        progress.advance()
        restless = restless_objects(report)
        deep = report["spawn_penetration_mm"] > _MARGIN * MOST_PENETRATION_MM
        key = (-report["stable_rate"], report["floating_rate"], deep, len(restless))
        if best is None or key < best[0]:
            best = key, dict(placer.placed), report
        if key == (-1.0, 0.0, False, 0) or round_number == config.joint_rounds - 1:
            break
        _repair_movers(placer, restless)
    assert best is not None
    placer.placed = best[1]
    report = best[2]
    for placement in list(placer.placed.values()):
        placer.commit(placement)  # the workbench may hold the poses of a worse round
    return _hold_the_rest(placer, base, report, config, progress)


def _hold_the_rest(
    placer: Placer, base: list[BodySpec], report: dict, config: AssemblyConfig, progress: Progress
) -> dict:
    """Fix unstable objects in place, clear of their neighbors, until none is left; return the report."""
    held: set[int] = set()
    while faults := faults_of(placer, base, report, held):
        done = "it was made immovable" if config.freeze_unstable else "it was left as it is"
        for i, fault in faults.items():
            progress.note(f"assembly: {placer.placed[i].asset.label} {i} {fault}; {done}")
        if not config.freeze_unstable:
            break
        for i, fault in faults.items():
            placer.hold(i, f"made immovable: it {fault}")
        held |= set(faults)
        # Objects that leaned on them may move now.
        _joint_settle(placer, base, config.joint_settle_s, _FREE_S)
        report = _report(placer.assets, placer.placed, base)
    return report


def faults_of(placer: Placer, base: list[BodySpec], report: dict, held: set[int]) -> dict[int, str]:
    """Describe overlaps, floating and instability, by object id; overlaps only of objects not in `held`."""
    found: dict[int, str] = {}
    if report["spawn_penetration_mm"] > MOST_PENETRATION_MM:
        order = {i: number for number, i in enumerate(placer.placed)}
        specs = scene_specs(placer.placed.values(), base)
        names = {spec.id: spec.name.replace("_", " ") for spec in specs}
        for contact in spawn_contacts(specs, -1e-3 * MOST_PENETRATION_MM):
            # The object placed later is at fault.
            first, second = sorted((contact.first, contact.second), key=lambda i: order.get(i, -1))
            if second not in held:
                found[second] = f"overlaps {names[first]}"
    for entry in report["objects"]:
        if entry["floating"]:
            found[entry["id"]] = "is carried by nothing where it was seen"
        if not entry["stable"]:
            found[entry["id"]] = "does not stay where it was seen"
    return found


def restless_objects(report: dict) -> set[int]:
    """Return the ids of floating objects and of those beyond the margin of the stability bounds."""
    most_m, most_deg = _MARGIN * STABLE_MOVE_M, _MARGIN * STABLE_TURN_DEG
    objects = report["objects"]
    return {o["id"] for o in objects if o["floating"] or o["moved_m"] > most_m or o["turned_deg"] > most_deg}


def _joint_settle(placer: Placer, base: list[BodySpec], damped_s: float, free_s: float) -> None:
    """Simulate all objects from their poses, damped, then free, and commit the poses at rest."""
    physics = build_physics(scene_specs(list(placer.placed.values()), base))
    moving = [i for i, p in placer.placed.items() if p.dynamic]
    chunk = round(0.1 / TIMESTEP_S)
    for damping, seconds in ((5.0, damped_s), (0.0, free_s)):
        for i in moving:
            physics.set_damping(i, damping, damping)
        for _ in range(max(1, round(seconds / 0.1))):
            before = {i: physics.pose(i) for i in moving}
            physics.step(chunk)
            changes = [pose_change(before[i], physics.pose(i)) for i in moving]
            if all(moved < 1e-5 and turned < 0.01 for moved, turned in changes):
                break
    for i in moving:
        pose = physics.pose(i)
        moved, turned = pose_change(placer.placed[i].pose, pose)
        # Objects that move far stay where they were placed: the report finds them unstable.
        if np.isfinite(pose).all() and moved < 0.05 and turned < 15:
            placer.commit(replace(placer.placed[i], pose=pose))


def _repair_movers(placer: Placer, moved: set[int]) -> None:
    """Flatten the undersides of objects that moved; not of those whose parent moved, which may be the only cause."""
    for i in [i for i, p in placer.placed.items() if i in moved and p.edge.parent not in moved]:
        placer.again(i)


def _finish(placement: Placement, stable: bool) -> PlacedObject:
    moved, turned = pose_change(placement.asset.world_from_object, placement.pose)
    changed = placement.parts is not placement.asset.collision
    return PlacedObject(
        id=placement.asset.id,
        world_from_object=placement.pose,
        dynamic=placement.dynamic,
        moved_m=moved,
        turned_deg=turned,
        repair="; ".join(placement.notes),
        stable=stable and placement.stands,
        collision=placement.parts if changed else None,
    )


__all__ = ["ASSEMBLY_PRESETS", "AssemblyConfig", "assemble", "base_slabs"]
