"""Cut what remains above the base into things: pieces, then supports, then touching neighbors, recursively."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.instances.bodies import find_bodies
from reconstruction.instances.boxes import quantiles
from reconstruction.instances.candidates import candidates_on
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.hollows import clings_to, hollows_on, looks_like, shell_and_contents
from reconstruction.instances.neighbors import neighbors_of
from reconstruction.instances.splitting import split_touching
from reconstruction.instances.supports import SupportRegion, find_supports
from reconstruction.surface.mesh_graph import MeshGraph

_MAX_DEPTH = 4
_CLEAR_M, _CONTACT_M = 0.015, 0.02
_RIM_M = 0.04  # how far a plate's low rim may reach beyond what rises above it
_SAME_GROUND_M = 0.006


@dataclass
class Thing:
    """A thing while it is being found; `rests_on` is another thing or None (the base)."""

    vertices: np.ndarray  # int (n,) sorted
    rests_on: "Thing | None" = None
    depth: int = 0
    attached: bool = False
    container: bool = (
        False  # an open one, whole by its rim: slats and rims of other colors are no things on it
    )
    foreign: bool = False  # told from what carries it by its color: no skirt of it, however low
    sheet: bool = False  # low, without a top, and of the colors of what carries it: smeared surface
    notes: list[str] = field(default_factory=list)


def segment(graph: MeshGraph, rest: np.ndarray, config: InstancesConfig) -> list[Thing]:
    """Cut vertices `rest` (indices, without the base) into things; parents come before what rests on them."""
    things: list[Thing] = []
    bodies = find_bodies(graph, rest, config)
    carriers = []
    for body in bodies.whole:
        carriers.append(_decompose(graph, body, None, 0, config))
        things.extend(carriers[-1])
    for vertices, index in bodies.standing:
        things.extend(
            _decompose(graph, vertices, _nearest_below(graph, vertices, carriers[index]), 1, config)
        )
    return _absorb_fragments(graph, things, config)


def _decompose(
    graph: MeshGraph,
    body: np.ndarray,
    rests_on: Thing | None,
    depth: int,
    config: InstancesConfig,
    ground_m: float = -np.inf,
) -> list[Thing]:
    """Split a connected body into itself and the things that stand on its supports.

    What is level at the height of the ground that it stands on itself, `ground_m`, is a rest of that ground.
    """
    own = Thing(body, rests_on, depth)
    if graph.areas[body].sum() < config.min_piece_area_m2 or depth >= _MAX_DEPTH:
        return [own]
    remaining = body
    carried: list[tuple[np.ndarray, float]] = []
    beside: list[np.ndarray] = []
    containers: list[np.ndarray] = []
    for support in find_supports(graph, body, config):
        if abs(support.height_m - ground_m) < _SAME_GROUND_M:
            continue
        if not np.isin(support.vertices, remaining, assume_unique=True).mean() > 0.5:
            continue  # it lies on something that was taken off already, whose own turn comes
        for hollow in hollows_on(graph, remaining, support):
            containers.append(hollow)
            remaining = np.setdiff1d(remaining, hollow, assume_unique=True)
        for candidate in candidates_on(graph, remaining, support, config):
            candidate = _flood_same_color(graph, candidate, remaining, support)
            carried.append((candidate, support.height_m))
            remaining = np.setdiff1d(remaining, candidate, assume_unique=True)
        if depth > 0:
            for neighbor in neighbors_of(graph, remaining, support, config):
                beside.append(neighbor)
                remaining = np.setdiff1d(remaining, neighbor, assume_unique=True)
    containers, carried = _with_handles(graph, containers, carried)
    own.vertices = remaining
    out: list[Thing] = []
    # Furniture has legs and cushions of other colors: only small things are looked at for touching neighbors.
    small = not carried and float(np.ptp(graph.points[remaining], axis=0).max()) < 0.5
    parts = split_touching(graph, remaining, config) if depth > 0 or small else [remaining]
    out.append(Thing(parts[0], rests_on, depth))
    for part in parts[1:]:
        out.append(Thing(part, _carrier(graph, part, out[0], rests_on), depth))
    carriers = list(out)
    for neighbor in beside:
        out.extend(_decompose(graph, neighbor, rests_on, depth, config, ground_m))
    lower: list[Thing] = []
    for container in containers:
        found = _container(graph, container, _nearest_below(graph, container, carriers), depth + 1, config)
        out.extend(found)
        lower.extend(found)
    for candidate, height in sorted(carried, key=lambda c: (graph.points[c[0], 2].min(), c[0][0])):
        on = next((thing for thing in lower if _lies_on(graph, candidate, thing)), None)
        parent = _nearest_below(graph, candidate, carriers) if on is None else on
        found = _decompose(graph, candidate, parent, depth + 1, config, height)
        out.extend(found)
        lower.extend(found)
    return out


def _with_handles(
    graph: MeshGraph, containers: list[np.ndarray], carried: list[tuple[np.ndarray, float]]
) -> tuple[list[np.ndarray], list[tuple[np.ndarray, float]]]:
    """Give the containers what clings to them in their color, and leave out the skirts behind them."""
    containers, kept = list(containers), []
    for part, height in carried:
        row = next((k for k, one in enumerate(containers) if clings_to(graph, part, one)), None)
        if row is None:
            kept.append((part, height))
        elif looks_like(graph, part, containers[row]):
            containers[row] = np.union1d(containers[row], part)
    return containers, kept


def _container(
    graph: MeshGraph, body: np.ndarray, rests_on: Thing, depth: int, config: InstancesConfig
) -> list[Thing]:
    """Return an open container as one thing, what is in it, and what it stands on if that is wider."""
    found = [t for t in _decompose(graph, body, rests_on, depth, config) if len(t.vertices)]
    under, own, contents = shell_and_contents(graph, body, [thing.vertices for thing in found])
    if not own:
        return found
    carrier = found[under[0]] if under else rests_on
    shell = Thing(np.sort(np.concatenate([found[k].vertices for k in own])), carrier, depth, container=True)
    within = {id(found[k]) for k in own + under}
    for k in contents:
        if found[k].rests_on is rests_on or id(found[k].rests_on) in within:
            found[k].rests_on = shell
    for k in under:
        found[k].rests_on = rests_on
    return [*(found[k] for k in under), shell, *(found[k] for k in contents)]


def _lies_on(graph: MeshGraph, upper: np.ndarray, lower: Thing) -> bool:
    """Tell whether most of a thing's foot is right above level surface of another one, clear of what carries both."""
    bottom = quantiles(graph.points[upper, 2], graph.areas[upper], (0.02,))[0]
    z = graph.points[lower.vertices, 2]
    if bottom < z.min() + _CLEAR_M:
        return False
    level = lower.vertices[(np.abs(z - bottom) < _CONTACT_M) & (graph.normals[lower.vertices, 2] > 0.7)]
    foot = upper[graph.points[upper, 2] < bottom + _CONTACT_M]
    if graph.areas[level].sum() < 1e-4:
        return False
    gap, _ = cKDTree(graph.points[level, :2]).query(graph.points[foot, :2], distance_upper_bound=_CONTACT_M)
    return float(np.average(np.isfinite(gap), weights=np.maximum(graph.areas[foot], 1e-12))) > 0.6


def _flood_same_color(
    graph: MeshGraph, candidate: np.ndarray, remaining: np.ndarray, support: SupportRegion
) -> np.ndarray:
    """Add the low rim of a thing that lies within the contact height (a plate's, say): its color, not the support's."""
    ground = np.linalg.norm(graph.lab - support.lab, axis=1)
    open_ = np.zeros(len(graph.points), bool)
    low, high = graph.points[candidate, :2].min(0), graph.points[candidate, :2].max(0)
    beside = graph.points[remaining, :2]
    open_[remaining[((beside > low - _RIM_M) & (beside < high + _RIM_M)).all(axis=1)]] = True
    rise = graph.points[:, 2] - support.height_m
    open_ &= (ground > 12.0) & (rise < 0.03) & (rise > max(0.003, 1.5 * support.noise_m))
    inside = np.zeros(len(graph.points), bool)
    inside[candidate] = True
    open_ &= ~inside
    edges = np.concatenate([graph.edges, graph.edges[:, ::-1]])
    edges = edges[open_[edges[:, 1]] & (inside[edges[:, 0]] | open_[edges[:, 0]])]
    step = np.linalg.norm(graph.lab[edges[:, 0]] - graph.lab[edges[:, 1]], axis=1)
    edges = edges[step < np.maximum(4.0, 0.5 * ground[edges[:, 1]])]
    grown = inside.copy()
    while True:
        reached = edges[grown[edges[:, 0]] & ~grown[edges[:, 1]], 1]
        if len(reached) == 0:
            break
        grown[reached] = True
    added = grown & ~inside
    limit = 0.6 * float(np.prod(high - low)) + 1e-3
    if graph.areas[added].sum() > limit:
        return candidate  # a pattern of the support, not a rim
    return np.flatnonzero(grown)


def _carrier(graph: MeshGraph, part: np.ndarray, main: Thing, rests_on: Thing | None) -> Thing | None:
    """A part split off its neighbor rests on it if it is over it, beside it on the same support otherwise."""
    low = quantiles(graph.points[part, 2], graph.areas[part], (0.03,))[0]
    inside, areas = graph.points[main.vertices], graph.areas[main.vertices]
    span_low, span_high = np.stack([quantiles(inside[:, k], areas, (0.03, 0.97)) for k in range(2)], axis=1)
    center = np.median(graph.points[part, :2], axis=0)
    within = bool(((center > span_low) & (center < span_high)).all())
    return main if within and low > quantiles(inside[:, 2], areas, (0.03,))[0] + 0.003 else rests_on


def _nearest_below(graph: MeshGraph, candidate: np.ndarray, carriers: list[Thing]) -> Thing:
    if len(carriers) == 1:
        return carriers[0]
    points = graph.points[candidate]
    foot = points[points[:, 2] < points[:, 2].min() + 0.02]
    gaps = [float(np.median(cKDTree(graph.points[c.vertices]).query(foot)[0])) for c in carriers]
    return carriers[int(np.argmin(gaps))]


def _absorb_fragments(graph: MeshGraph, things: list[Thing], config: InstancesConfig) -> list[Thing]:
    """Give pieces too small to be things to what they touch; drop those that touch nothing."""
    kept: list[Thing] = []
    small: list[Thing] = []
    for thing in things:
        if len(thing.vertices) == 0:
            small.append(thing)
            continue
        areas = graph.areas[thing.vertices]
        low, high = np.stack(
            [quantiles(graph.points[thing.vertices, k], areas, (0.02, 0.98)) for k in range(3)], axis=1
        )
        large = (
            np.sort(high - low)[1] >= 0.8 * config.min_object_m and areas.sum() >= config.min_piece_area_m2
        )
        raised = thing.rests_on is None or high[2] - low[2] > 0.012
        (kept if large and raised else small).append(thing)
    heirs: dict[int, Thing | None] = {}
    if kept:
        owner = np.concatenate([np.full(len(t.vertices), i) for i, t in enumerate(kept)])
        tree = cKDTree(graph.points[np.concatenate([t.vertices for t in kept])])
        for thing in small:
            if len(thing.vertices) == 0:
                heirs[id(thing)] = thing.rests_on
                continue
            distance, index = tree.query(graph.points[thing.vertices])
            heir = kept[int(owner[index[np.argmin(distance)]])] if distance.min() < 0.03 else None
            heirs[id(thing)] = heir
            if heir is not None:
                heir.vertices = np.sort(np.concatenate([heir.vertices, thing.vertices]))
    for thing in kept:
        while thing.rests_on is not None and id(thing.rests_on) in heirs:
            heir = heirs[id(thing.rests_on)]
            thing.rests_on = thing.rests_on.rests_on if heir is thing else heir
    return kept
