# pyright: strict, reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
"""Physics report card (CONTRACT section 4): simulate bodies, compare contacts with the scene graph, return JSON.

All movable objects are simulated together, without damping and without sleeping. Assembly, `simrecon verify --physics`
and `simrecon evaluate` use this function.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from registry.geometry import rigid
from registry.simulation import TIMESTEP_S, BodySpec, Contact, Physics, build_physics, pose_change

VERIFY_DURATION_S = 10.0
STABLE_MOVE_M, STABLE_TURN_DEG = 0.02, 5.0  # a stable object changes its pose by less
MOST_PENETRATION_MM = 1.0  # at the start
MOST_GAP_MM = 2.0  # between an immovable or attached object and its parent
REST_J_PER_KG = 5e-5  # maximum specific kinetic energy at rest: that of 1 cm/s
_FLOAT_WINDOW_S, _FLOAT_DROP_M = 0.5, 0.005  # an object that drops farther in this time floated at the start
_REST_WINDOW_S = 0.1  # final interval in which impulses are summed and motion is measured
_TOUCHING_SHARE = 0.02  # minimum share of an object's upward impulse that counts as support
_CARRYING_SHARE = 0.5  # minimum share of a main support
_PROBE_M = 0.015  # maximum separation of reported contacts; PhysX finds them a little farther apart
_FAR_AWAY_M = 1e3  # distance (down) reported for a diverged body, because JSON needs finite numbers


class GraphEdge(Protocol):
    """An edge of the scene graph, from a bundle or a stage."""

    @property
    def child(self) -> int:
        """Return the id of the object that is supported or attached."""
        ...

    @property
    def relation(self) -> str:
        """Return "supported_by" or "attached_to"."""
        ...

    @property
    def parent(self) -> int:
        """Return the id of the support."""
        ...


def spawn_contacts(specs: Sequence[BodySpec], max_separation_m: float = 0.0) -> list[Contact]:
    """Return all contacts at the given poses with at most this separation.

    All objects are movable in this one time step, because PhysX reports no contact between two immovable bodies.
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
    """Simulate all bodies and measure the report card.

    Args:
        specs: All bodies, floor and walls included.
        edges: Edges of the scene graph; compared with the supports at the end.
        duration_s: Simulated time.
        timestep_s: Time step of the simulation.

    Returns:
        JSON. Rates are shares of the movable objects; with no such object, the criteria count as met.
    """
    specs = list(specs)
    names = {spec.id: spec.name for spec in specs}
    near = spawn_contacts(specs, _PROBE_M)
    deepest = min(near, key=lambda c: c.separation_m, default=None)
    penetration = 0.0 if deepest is None else max(0.0, -deepest.separation_m * 1e3)
    between = [names[deepest.first], names[deepest.second]] if deepest and penetration else []
    physics = build_physics(specs, timestep_s)
    moving = [spec for spec in specs if spec.dynamic and not spec.base]
    steps, early_steps = round(duration_s / timestep_s), round(_FLOAT_WINDOW_S / timestep_s)
    last_steps = min(round(_REST_WINDOW_S / timestep_s), max(steps - early_steps, 0))
    physics.step(early_steps)
    early = {spec.id: _finite(physics.pose(spec.id)) for spec in moving}
    physics.step(steps - early_steps - last_steps)
    before = {spec.id: physics.pose(spec.id) for spec in moving}
    push = _pushes(physics, last_steps)
    objects: list[dict[str, Any]] = []
    for spec in moving:
        energy = physics.energy_of_motion(spec.id, before[spec.id], max(last_steps, 1) * timestep_s)
        objects.append(_object_entry(spec, physics, early[spec.id], _depth_mm(near, spec.id), energy))
    fixed = [spec for spec in specs if not spec.dynamic and not spec.base]
    return {
        "duration_s": duration_s,
        "timestep_s": timestep_s,
        "dynamic_objects": len(objects),
        "fixed_objects": len(fixed),
        "without_collision": [spec.name for spec in fixed if not spec.parts],
        "stable_rate": _rate(objects, "stable", 1.0),
        "stable_rate_10cm_0.1rad": _rate(objects, "stable_10cm_0.1rad", 1.0),
        "stable_rate_5cm_drop_5deg": _rate(objects, "stable_5cm_drop_5deg", 1.0),
        "floating_rate": _rate(objects, "floating", 0.0),
        "spawn_penetration_mm": round(penetration, 4),
        "spawn_penetration_between": between,
        "energy_at_rest_j": float(f"{sum(entry['energy_j'] for entry in objects):.3g}"),
        "at_rest_rate": _rate(objects, "at_rest", 1.0),
        "contacts": contact_graph(specs, edges, push, near),
        "objects": objects,
        "fixed": [{"id": s.id, "name": s.name, "spawn_penetration_mm": _depth_mm(near, s.id)} for s in fixed],
    }


def failures(report: dict[str, Any]) -> list[str]:
    """Return the failed criteria of a report card, one line each; empty if the scene is at rest.

    Differences between contacts and the scene graph are no failures.
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
    """Compare the edges of the scene graph with the supports in the simulation.

    An edge of a movable child is real if the parent pushes the child up at rest. An edge of an immovable or attached
    child is real if the two are within 2 mm. A body that bears half or more of a movable object must be its parent;
    lesser supports are only counted, because an object has one parent.

    Args:
        specs: All bodies.
        edges: Edges of the scene graph.
        push: Upward impulse (N s) by (child, carrier) at the end.
        near: Contacts at the start, with separations up to `_PROBE_M`.
    """
    by_id = {spec.id: spec for spec in specs}
    total: dict[int, float] = {}
    for (child, _), value in push.items():
        total[child] = total.get(child, 0.0) + value
    share = {pair: value / total[pair[0]] for pair, value in push.items() if total[pair[0]] > 0}
    real = {"supported_by": [0, 0], "attached_to": [0, 0]}
    parents: dict[int, int] = {}
    unreal: list[dict[str, Any]] = []
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
            found = {"child": edge.child, "relation": edge.relation, "parent": edge.parent, "gap_mm": shown}
            unreal.append(found)
    carried = [pair for pair in sorted(share) if by_id[pair[0]].fixed_to is None]
    main = [pair for pair in carried if share[pair] >= _CARRYING_SHARE]
    wrong = [pair for pair in main if parents and parents.get(pair[0]) != pair[1]]
    small = [pair for pair in carried if _TOUCHING_SHARE < share[pair] < _CARRYING_SHARE]
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
        "lesser_supports": sum(parents.get(child) != carrier for child, carrier in small),
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


def _rate(objects: list[dict[str, Any]], key: str, empty: float) -> float:
    return float(np.mean([o[key] for o in objects])) if objects else empty


def _pushes(physics: Physics, steps: int) -> dict[tuple[int, int], float]:
    """Simulate `steps` and return the summed upward impulse (N s) by (object, carrier)."""
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
    """Return the largest penetration of a body at the start."""
    depth = max((-c.separation_m for c in near if body_id in (c.first, c.second)), default=0.0)
    return round(max(depth, 0.0) * 1e3, 4)


def _gap_mm(near: list[Contact], one: int, other: int) -> float:
    """Return the gap between two bodies at the start: 0 if they overlap, infinite if no contact was reported."""
    gap = min((c.separation_m for c in near if {c.first, c.second} == {one, other}), default=np.inf)
    return max(gap, 0.0) * 1e3


def _finite(pose: np.ndarray) -> np.ndarray:
    """Replace a diverged pose by a finite one far below the floor."""
    if np.isfinite(pose).all() and np.abs(pose[:3, 3]).max() < _FAR_AWAY_M:
        return pose
    return rigid(np.diag([1.0, -1.0, -1.0]), np.array([0, 0, -_FAR_AWAY_M]))
