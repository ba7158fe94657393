"""Infer support and attachment relations from geometry: the default relation backend.

Each cell of a child's underside is supported by the highest upward-facing surface at or just below it. The parent is
the candidate that supports most of the underside, weighted by closeness, with the instance stage's hint as a prior.
An unsupported object is attached to a wall or ceiling if it is close to one. Reconstructed surfaces are off by about a
centimetre, hence the tolerances, and the vote on which of two overlapping objects is the upper one.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from reconstruction.core.types import AssetSet
from reconstruction.scene_graph.base import LocalGraph, Question, SaidEdge
from reconstruction.scene_graph.checking import find_cycles
from reconstruction.scene_graph.surfaces import SampledBase, SampledObject, sample_assets, sample_structure


@dataclass(frozen=True)
class RelationConfig:
    """Tolerances of the geometric relation backend."""

    contact_gap_m: float = 0.035
    """Largest gap between an underside and its supporting surface."""
    contact_sink_m: float = 0.025
    """Largest penetration of an underside into its supporting surface."""
    deep_sink_m: float = 0.06
    """Largest penetration in a second search, for objects without a support."""
    min_contact: float = 0.10
    """Least share of the underside, weighted by closeness, that a support carries."""
    wall_gap_m: float = 0.05
    """Largest distance to a wall or ceiling that an object is attached to."""
    wall_thickness_m: float = 0.15
    """Largest thickness, along the wall's normal, of an attached object; or a third of its size if that is more."""
    bridge_gap_m: float = 0.15
    """Largest gap below an unsupported object that is explained by missing surface."""
    near_object_m: float = 0.08
    """Largest distance between an unsupported object and the object that it is attached to."""


@dataclass(frozen=True)
class _Candidate:
    relation: str
    parent: int
    score: float
    evidence: str


class GeometryRelations:
    """The geometric `RelationBackend`; surfaces are sampled once, at construction."""

    name = "geometry"

    def __init__(self, assets: AssetSet, config: RelationConfig) -> None:
        """Sample the surfaces of all assets."""
        self.config = config
        self._base, self._objects = sample_assets(assets)
        self._structure = None if assets.structure is None else sample_structure(assets.structure)
        self._floors = [b for b in self._base.values() if b.label == "floor"]
        self._trees: dict[int, cKDTree] = {}
        self._gaps: dict[tuple[int, int, bool], np.ndarray] = {}

    def infer(self, question: Question) -> LocalGraph:
        """See `RelationBackend.infer`."""
        present = tuple(i for i in question.visible if i in self._objects)
        ranked = {i: self.candidates(i, present) for i in present}
        return LocalGraph(tuple(_without_cycles(ranked)), present)

    def distance_m(self, child: int, parent: int) -> float:
        """Return a lower bound of the distance from an object to its parent: by boxes, or points to a base plane."""
        own = self._objects[child]
        if parent in self._base:
            return max(0.0, float(np.abs(self._base[parent].distance(own.points)).min()))
        other = self._objects.get(parent) or self._structure
        assert other is not None  # parents are base entities, objects, or the structure
        return float(np.linalg.norm(np.maximum(0.0, np.maximum(own.low - other.high, other.low - own.high))))

    def candidates(self, child_id: int, present: Iterable[int]) -> list[_Candidate]:
        """Rank the possible parents of an object among those present and the base, best first; never empty."""
        child = self._objects[child_id]
        others = [self._objects[i] for i in sorted(present) if i != child_id]
        others += [] if self._structure is None else [self._structure]
        supports = self._supports(child, others, deep=False) or self._supports(child, others, deep=True)
        hanging = self._hanging(child)
        floating = self._floating(child, others)
        best_support = supports[0].score if supports else 0.0
        wanted = child.attached_hint and best_support < 0.5
        if hanging and (best_support < self.config.min_contact or wanted):
            order = hanging + supports + floating
        else:
            order = supports + hanging + floating
        seen: set[int] = set()
        return [c for c in order if not (c.parent in seen or seen.add(c.parent))]

    def _supports(self, child: SampledObject, others: list[SampledObject], deep: bool) -> list[_Candidate]:
        """Rank supports by the share of the underside that they carry; `deep` tolerates more penetration."""
        low, high = child.low - 0.02, child.high + 0.02
        reach = self.config.contact_gap_m + child.underside[:, 2].max() - child.low[2]
        near = [o for o in others if np.all(o.high[:2] > low[:2]) and np.all(o.low[:2] < high[:2])]
        carriers = [o for o in near if o.high[2] > child.low[2] - reach and self._is_above(child, o)]
        gaps = [self._gap(child, o, deep) for o in carriers]
        gaps += [self._plane_gap(child, floor, deep) for floor in self._floors]
        if not gaps:
            return []
        table = np.stack(gaps)  # (candidates, cells), NaN where nothing is near
        # The highest surface wins a cell: a plate between a bowl and a table carries the bowl. A candidate that rests
        # on another one hides it, even where noise has pushed the lower surface through the upper one.
        filled = np.where(np.isnan(table), np.inf, table)
        for upper, carrier in enumerate(carriers):
            for row in range(len(table)):
                other = carriers[row] if row < len(carriers) else None
                if other is None or (row != upper and self._rests_on(carrier, other)):
                    filled[row, ~np.isnan(table[upper])] = np.inf
        winner = np.where(np.isfinite(filled.min(axis=0)), filled.argmin(axis=0), -1)
        named = [(o.id, o.name) for o in carriers] + [(floor.id, floor.label) for floor in self._floors]
        out = []
        for row, (parent, name) in enumerate(named):
            cells = winner == row
            if not cells.any():
                continue
            gap = table[row, cells]
            share = float(np.sum(_closeness(gap, self.config, deep)) / table.shape[1])
            prior = 1.5 if child.support_hint == parent else 1.0
            if share < self.config.min_contact / (2 if prior > 1 else 1):
                continue
            evidence = f"{cells.mean():.0%} of its underside lies {_gap_words(float(np.median(gap)))} {name}"
            evidence += ", as its view suggests" * (prior > 1)
            score = min(share * prior, 1.0) * (0.6 if deep else 1.0)
            out.append(_Candidate("supported_by", parent, score, evidence))
        return _best_first(out)

    def _rests_on(self, upper: SampledObject, lower: SampledObject) -> bool:
        """Tell whether one object clearly rests on another."""
        apart = np.any(upper.low[:2] > lower.high[:2]) or np.any(upper.high[:2] < lower.low[:2])
        if apart or not self._is_above(upper, lower):
            return False
        gap = self._gap(upper, lower, False)
        return float(np.sum(_closeness(gap, self.config, False))) / len(gap) > 0.3

    def _gap(self, child: SampledObject, parent: SampledObject, deep: bool) -> np.ndarray:
        """Return the height of each underside cell above the parent's highest surface there, NaN without; cached."""
        key = (child.id, parent.id, deep)
        if key not in self._gaps:
            self._gaps[key] = self._measure_gap(child, parent, deep)
        return self._gaps[key]

    def _measure_gap(self, child: SampledObject, parent: SampledObject, deep: bool) -> np.ndarray:
        cells = child.underside
        out = np.full(len(cells), np.nan)
        if len(parent.up) == 0:
            return out
        if parent.id not in self._trees:
            self._trees[parent.id] = cKDTree(parent.up[:, :2])
        radius = max(1.2 * parent.spacing_m, 0.008)
        sink = self._sink(child, deep)
        for i, found in enumerate(self._trees[parent.id].query_ball_point(cells[:, :2], radius)):
            gap = cells[i, 2] - parent.up[found, 2]
            fits = (gap >= -sink) & (gap <= self.config.contact_gap_m)
            if fits.any():
                out[i] = gap[fits].min()
        return out

    def _plane_gap(self, child: SampledObject, floor: SampledBase, deep: bool) -> np.ndarray:
        gap = floor.distance(np.asarray(child.underside))
        fits = (gap >= -max(self._sink(child, deep), 0.05)) & (gap <= self.config.contact_gap_m)
        return np.where(fits, gap, np.nan)

    def _sink(self, child: SampledObject, deep: bool) -> float:
        """Return the largest tolerated penetration, metres."""
        height = child.high[2] - child.low[2]
        if deep:
            return max(min(self.config.deep_sink_m, 0.9 * height), 1.5 * self.config.contact_sink_m)
        return self.config.contact_sink_m

    def _is_above(self, child: SampledObject, parent: SampledObject) -> bool:
        """Vote whether `child` is the upper one of two that touch; antisymmetric. The structure is the lower."""
        if self._structure is not None and self._structure.id in (child.id, parent.id):
            return parent is self._structure

        def clip(x: float, bound: float) -> float:
            return float(np.clip(x, -bound, bound))

        def contact(a: SampledObject, b: SampledObject) -> float:
            gap = self._gap(a, b, False)
            return float(np.nansum(_closeness(gap, self.config, False)) / len(gap))

        vote = clip((child.center[2] - parent.center[2]) / 0.05, 2)
        vote += clip((child.low[2] - parent.low[2]) / 0.015, 2)
        vote += clip(0.7 * np.log(parent.footprint_m2 / child.footprint_m2), 2)
        vote += 4 * (contact(child, parent) - contact(parent, child))
        vote += 3.0 * (child.support_hint == parent.id) - 3.0 * (parent.support_hint == child.id)
        return vote > 0 or (vote == 0 and child.id > parent.id)

    def _hanging(self, child: SampledObject) -> list[_Candidate]:
        """Rank walls and ceilings that the child is close to."""
        out = []
        for base in self._base.values():
            if base.label == "floor":
                continue
            distance = base.distance(child.points)
            near, far = np.percentile(distance, [3, 97])
            thick, size = far - near, float(np.max(child.high - child.low))
            bound = self.config.wall_gap_m * (2 if child.attached_hint else 1)
            beside = np.all(child.center > base.low - 0.3) and np.all(child.center < base.high + 0.3)
            thin = thick < max(self.config.wall_thickness_m, size / 3)
            # An object may reach a few centimetres behind the fitted plane, but most of it is in the room.
            if abs(near) > bound or far < -0.01 or not beside or not (thin or child.attached_hint):
                continue
            score = 0.9 - 0.4 * abs(near) / bound
            where = f"{near * 100:.1f} cm off {base.label} {base.id}"
            evidence = f"nothing below it; {where} and {thick * 100:.0f} cm thick"
            out.append(_Candidate("attached_to", base.id, score, evidence))
        return _best_first(out)

    def _floating(self, child: SampledObject, others: list[SampledObject]) -> list[_Candidate]:
        """Rank parents of an unsupported object: the next surface below, a neighbor, a wall, the floor."""
        below = []
        for other in others:
            over = np.all(other.high[:2] > child.low[:2]) and np.all(other.low[:2] < child.high[:2])
            if not over or not self._is_above(child, other) or len(other.up) == 0:
                continue
            inside = np.all((other.up[:, :2] > child.low[:2]) & (other.up[:, :2] < child.high[:2]), axis=1)
            under = other.up[inside & (other.up[:, 2] < child.low[2] + self.config.contact_sink_m)]
            if len(under):
                below.append((child.low[2] - float(np.percentile(under[:, 2], 95)), other.id, other.name))
        for floor in self._floors:
            gap = float(floor.distance(np.array([[child.center[0], child.center[1], child.low[2]]]))[0])
            below.append((gap, floor.id, floor.label))
        below.sort()
        bridged, distant = [], []
        for gap, parent, name in below:
            if gap < self.config.bridge_gap_m:
                evidence = f"nothing touches it; {name} is the next surface, {gap * 100:.0f} cm below"
                bridged.append(_Candidate("supported_by", parent, 0.3, evidence))
            else:
                # No camera saw its support; it must not fall.
                evidence = f"what carries it was not seen; held where it is, {gap * 100:.0f} cm above {name}"
                distant.append(_Candidate("attached_to", parent, 0.1, evidence))
        beside = []
        for other in others:
            if np.any(other.low > child.high + 0.1) or np.any(other.high < child.low - 0.1):
                continue
            gap = float(np.percentile(cKDTree(other.points).query(child.points[::8])[0], 1))
            if gap < self.config.near_object_m and other.footprint_m2 > child.footprint_m2:
                evidence = f"nothing below it; {gap * 100:.1f} cm beside {other.name}"
                beside.append(_Candidate("attached_to", other.id, 0.25, evidence))
        gap_below_m = min((gap for gap, *_ in below), default=np.inf)
        return bridged + _best_first(beside) + self._held_by_wall(child, gap_below_m) + distant

    def _held_by_wall(self, child: SampledObject, gap_below_m: float) -> list[_Candidate]:
        """Rank walls that are nearer to an unsupported object than any surface below it."""
        out = []
        for base in self._base.values():
            if base.label != "wall":
                continue
            near = float(np.percentile(base.distance(child.points), 3))
            beside = np.all(child.center > base.low - 0.6) and np.all(child.center < base.high + 0.6)
            if beside and near < min(gap_below_m, float(np.max(child.high - child.low))):
                evidence = f"nothing carries it; {base.label} {base.id} is {near * 100:.0f} cm behind it"
                out.append(_Candidate("attached_to", base.id, 0.2 - 0.01 * max(near, 0.0), evidence))
        return _best_first(out)


def _best_first(candidates: list[_Candidate]) -> list[_Candidate]:
    return sorted(candidates, key=lambda c: (-c.score, c.parent))


def _closeness(gap: np.ndarray, config: RelationConfig, deep: bool) -> np.ndarray:
    """Weight gaps by a Gaussian: 1 at contact, 0 for NaN."""
    below = config.deep_sink_m if deep else 0.8 * config.contact_sink_m
    width = np.where(gap > 0, 0.6 * config.contact_gap_m, below)
    return np.nan_to_num(np.exp(-((gap / width) ** 2)), nan=0.0)


def _gap_words(gap_m: float) -> str:
    if abs(gap_m) < 0.001:
        return "on"
    return f"{abs(gap_m) * 1000:.0f} mm {'above' if gap_m > 0 else 'inside'}"


def _without_cycles(ranked: dict[int, list[_Candidate]]) -> list[SaidEdge]:
    """Give each child its best parent, and the weakest child of a cycle its next one until no cycle is left."""
    choice = dict.fromkeys(ranked, 0)
    while True:
        cycles = find_cycles({i: ranked[i][choice[i]].parent for i in ranked})
        if not cycles:
            break
        # The floor is among all objects' candidates, so that some object of a cycle has a next candidate.
        open_ended = [i for i in cycles[0] if choice[i] + 1 < len(ranked[i])]
        weakest = min(open_ended, key=lambda i: (ranked[i][choice[i]].score, i))
        choice[weakest] += 1
    out = []
    for i in sorted(ranked):
        chosen = ranked[i][choice[i]]
        rest = max((c.score for n, c in enumerate(ranked[i]) if n != choice[i]), default=0.0)
        confidence = chosen.score / (chosen.score + 0.5 * rest) * min(1.0, 0.1 + 1.2 * chosen.score)
        confidence = round(float(min(confidence, 0.99)), 3)
        out.append(SaidEdge(i, chosen.relation, chosen.parent, confidence, chosen.evidence))
    return out
