"""The physics report card of CONTRACT section 4: bodies and the edges of the scene graph in, JSON out.

All movable objects together, undamped, never asleep. Measured by assembly, by `simrecon verify --physics` and by
`simrecon evaluate`, in the same way.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from registry.geometry import rigid
from registry.simulation import TIMESTEP_S, BodySpec, Contact, Physics, build_physics, pose_change

VERIFY_DURATION_S = 10.0
STABLE_MOVE_M, STABLE_TURN_DEG = 0.02, 5.0
MOST_PENETRATION_MM = 1.0
MOST_GAP_MM = 2.0  # between what is immovable and what carries it or what it hangs on
REST_J_PER_KG = 5e-5  # of a body that moves at 1 cm/s
_FLOAT_WINDOW_S, _FLOAT_DROP_M = 0.5, 0.005
_REST_WINDOW_S = 0.1  # at the end, over which contacts are summed and motion is measured
_TOUCHING_SHARE = 0.02  # of what an object is pushed up by; less is no support
_CARRYING_SHARE = 0.5
_PROBE_M = 0.015  # PhysX reports contacts a little farther apart than this
_FAR_AWAY_M = 1e3  # where a body that left the world is said to be: reports hold finite numbers only


class GraphEdge(Protocol):
    """An edge of the scene graph, of a bundle or of a stage."""

    child: int
    relation: str
    parent: int


def spawn_contacts(specs: Sequence[BodySpec], max_separation_m: float = 0.0) -> list[Contact]:
    """Return every contact at the given poses that is no farther apart, fixed objects against everything included.

    PhysX reports no contact between two immovable bodies, so all objects are movable for this one step.
    """
    physics = build_physics([replace(spec, dynamic=not spec.base, fixed_to=None) for spec in specs])
    physics.step()
    return physics.contacts(max_separation_m)


def physics_report(
    specs: Sequence[BodySpec],
    edges: Iterable[GraphEdge] = (),
    *,
    duration_s: float = VERIFY_DURATION_S,
    timestep_s: float = TIMESTEP_S,
) -> dict[str, Any]:
    """Measure the report card.

    Args:
        specs: All bodies, floor and walls too.
        edges: Of the scene graph; compared with who carries whom at the end.
        duration_s: How long everything is let go.
        timestep_s: Of the simulation.

    Returns:
        JSON. Rates are shares of the movable objects (1.0 where there is none; `dynamic_objects` says so).
    """
    specs = list(specs)
    names = {spec.id: spec.name for spec in specs}
    near = spawn_contacts(specs, _PROBE_M)
    deepest = min(near, key=lambda c: c.separation_m, default=None)
    penetration = 0.0 if deepest is None else max(0.0, -deepest.separation_m * 1e3)
    physics = build_physics(specs, timestep_s)
    moving = [spec for spec in specs if spec.dynamic and not spec.base]
    steps, early_steps = round(duration_s / timestep_s), round(_FLOAT_WINDOW_S / timestep_s)
    last_steps = min(round(_REST_WINDOW_S / timestep_s), max(steps - early_steps, 0))
    physics.step(early_steps)
    early = {spec.id: _finite(physics.pose(spec.id)) for spec in moving}
    physics.step(steps - early_steps - last_steps)
    before = {spec.id: physics.pose(spec.id) for spec in moving}
    push = _pushes(physics, last_steps)
    objects = []
    for spec in moving:
        energy = physics.energy_of_motion(spec.id, before[spec.id], max(last_steps, 1) * timestep_s)
        objects.append(_object_entry(spec, physics, early[spec.id], _depth_mm(near, spec.id), energy))
    fixed = [spec for spec in specs if not spec.dynamic and not spec.base]

    def rate(key: str, empty: float) -> float:
        return float(np.mean([o[key] for o in objects])) if objects else empty

    return {
        "duration_s": duration_s,
        "timestep_s": timestep_s,
        "dynamic_objects": len(objects),
        "fixed_objects": len(fixed),
        "without_collision": [spec.name for spec in fixed if not spec.parts],
        "stable_rate": rate("stable", 1.0),
        "stable_rate_10cm_0.1rad": rate("stable_10cm_0.1rad", 1.0),
        "stable_rate_5cm_drop_5deg": rate("stable_5cm_drop_5deg", 1.0),
        "floating_rate": rate("floating", 0.0),
        "spawn_penetration_mm": round(penetration, 4),
        "spawn_penetration_between": [names[deepest.first], names[deepest.second]] if penetration else [],
        "energy_at_rest_j": float(f"{sum(entry['energy_j'] for entry in objects):.3g}"),
        "at_rest_rate": rate("at_rest", 1.0),
        "contacts": contact_graph(specs, edges, push, near),
        "objects": objects,
        "fixed": [
            {"id": spec.id, "name": spec.name, "spawn_penetration_mm": _depth_mm(near, spec.id)}
            for spec in fixed
        ],
    }


def failures(report: dict[str, Any]) -> list[str]:
    """Return what a report card falls short of, one line each; empty: the scene rests.

    Edges that are no contacts, and contacts that are no edges, are in the report and do not count here.
    """
    found = [
        f"{o['name']} does not stay put: moved {100 * o['moved_m']:.1f} cm, turned {o['turned_deg']:.1f} degrees"
        for o in report["objects"]
        if not o["stable"]
    ]
    found += [f"{o['name']} floats at the start" for o in report["objects"] if o["floating"]]
    found += [
        f"{o['name']} is not at rest after {report['duration_s']:g} s: {o['energy_j']:.2g} J"
        for o in report["objects"]
        if o["stable"] and not o["at_rest"]
    ]
    if report["spawn_penetration_mm"] > MOST_PENETRATION_MM:
        pair = " and ".join(report["spawn_penetration_between"])
        found.append(f"{pair} overlap by {report['spawn_penetration_mm']:.1f} mm at the start")
    return found


def contact_graph(
    specs: Sequence[BodySpec],
    edges: Iterable[GraphEdge],
    push: dict[tuple[int, int], float],
    near: list[Contact],
) -> dict[str, Any]:
    """Compare the edges of the scene graph with who carries whom.

    An edge is real if what carries a movable child pushes it up at rest; of immovable and attached children, if they
    are within 2 mm of their parent. Who bears half of a movable object or more must be its parent; lesser carriers
    are counted, since an object has one parent only.

    Args:
        specs: All bodies.
        edges: Of the scene graph.
        push: Upward impulse by (child, carrier) at the end.
        near: Contacts at the start, up to a few millimetres apart.
    """
    by_id = {spec.id: spec for spec in specs}
    total: dict[int, float] = {}
    for (child, _), value in push.items():
        total[child] = total.get(child, 0.0) + value
    share = {pair: value / total[pair[0]] for pair, value in push.items() if total[pair[0]] > 0}
    parents, real, unreal = {}, {"supported_by": [0, 0], "attached_to": [0, 0]}, []
    for edge in edges:
        parents[edge.child] = edge.parent
        child = by_id[edge.child]
        gap = _gap_mm(near, edge.child, edge.parent)
        free = child.dynamic and child.fixed_to is None
        holds = share.get((edge.child, edge.parent), 0.0) > _TOUCHING_SHARE if free else gap <= MOST_GAP_MM
        real[edge.relation][0] += holds
        real[edge.relation][1] += 1
        if not holds:
            shown = round(gap, 2) if np.isfinite(gap) else None
            unreal.append(
                {"child": edge.child, "relation": edge.relation, "parent": edge.parent, "gap_mm": shown}
            )
    carried = [pair for pair in sorted(share) if by_id[pair[0]].fixed_to is None]
    main = [pair for pair in carried if share[pair] >= _CARRYING_SHARE]
    wrong = [pair for pair in main if parents and parents.get(pair[0]) != pair[1]]
    lesser = sum(
        _TOUCHING_SHARE < share[pair] < _CARRYING_SHARE and parents.get(pair[0]) != pair[1]
        for pair in carried
    )
    return {
        "support_edges": real["supported_by"][1],
        "support_edges_real": real["supported_by"][0],
        "attached_edges": real["attached_to"][1],
        "attached_edges_real": real["attached_to"][0],
        "edges_without_contact": unreal,
        "main_supports": len(main),
        "supports_without_edge": [
            {"child": child, "carrier": carrier, "share": round(share[child, carrier], 2)}
            for child, carrier in wrong
        ],
        "lesser_supports": lesser,
    }


def _object_entry(
    spec: BodySpec, physics: Physics, early: np.ndarray, depth_mm: float, energy: float
) -> dict[str, Any]:
    start, end = np.asarray(spec.world_from_object), _finite(physics.pose(spec.id))
    moved, turned = pose_change(start, end)
    drop = float(start[2, 3] - end[2, 3])
    energy = energy if np.isfinite(energy) else 0.5 * spec.mass_kg * _FAR_AWAY_M**2
    return {
        "id": spec.id,
        "name": spec.name,
        "moved_m": round(moved, 6),
        "turned_deg": round(turned, 4),
        "drop_m": round(drop, 6),
        "floating": bool(start[2, 3] - early[2, 3] > _FLOAT_DROP_M),
        "stable": bool(moved < STABLE_MOVE_M and turned < STABLE_TURN_DEG),
        "stable_10cm_0.1rad": bool(moved < 0.1 and np.deg2rad(turned) < 0.1),
        "stable_5cm_drop_5deg": bool(drop < 0.05 and turned < 5.0),
        "spawn_penetration_mm": depth_mm,
        "energy_j": float(f"{energy:.3g}"),
        "at_rest": bool(energy <= REST_J_PER_KG * spec.mass_kg),
    }


def _pushes(physics: Physics, steps: int) -> dict[tuple[int, int], float]:
    """Step, and return the summed upward impulse (N s) by (object, who pushes it)."""
    push: dict[tuple[int, int], float] = {}
    for _ in range(steps):
        physics.step()
        for c in physics.contacts(_PROBE_M):
            upward = float(c.impulse[2])
            pair = (c.first, c.second) if upward > 0 else (c.second, c.first)
            if upward and not physics.specs[pair[0]].base:
                push[pair] = push.get(pair, 0.0) + abs(upward)
    return {pair: value for pair, value in push.items() if physics.specs[pair[0]].dynamic}


def _depth_mm(near: list[Contact], body_id: int) -> float:
    """Return how deep a body is in any other at the start."""
    depth = max((-c.separation_m for c in near if body_id in (c.first, c.second)), default=0.0)
    return round(max(depth, 0.0) * 1e3, 4)


def _gap_mm(near: list[Contact], one: int, other: int) -> float:
    """Return how far apart two bodies are at the start; infinite if more than was looked for, 0 if they overlap."""
    gap = min((c.separation_m for c in near if {c.first, c.second} == {one, other}), default=np.inf)
    return max(gap, 0.0) * 1e3


def _finite(pose: np.ndarray) -> np.ndarray:
    """Replace a pose that diverged or left the world by a finite one far away."""
    if np.isfinite(pose).all() and np.abs(pose[:3, 3]).max() < _FAR_AWAY_M:
        return pose
    return rigid(np.diag([1.0, -1.0, -1.0]), np.array([0, 0, -_FAR_AWAY_M]))
