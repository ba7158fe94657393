"""Features of regions and of their borders, from the mesh and from the evidence of keyframes.

Lengths are in metres, gravity is -z. The features of a border are symmetric in its two sides.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.core.types import Surface
from reconstruction.depth.channels import OFFSETS_PX
from reconstruction.instances.base import base_planes
from reconstruction.instances.colors import LIGHTNESS_WEIGHT
from reconstruction.instances.partition.evidence import FrameLook, VertexEvidence, gather, look
from reconstruction.instances.partition.graph import RegionGraph
from reconstruction.instances.sightings import Sighting
from reconstruction.poses.parallel import ordered_map
from reconstruction.surface.base_planes import behind_base

NODE_FEATURES = (
    "log_area", "length", "width", "thickness", "flatness", "coherence", "normal_z", "height", "height_of_foot",
    "gap_below", "to_side", "of_height", "on_floor", "on_wall", "on_ceiling", "on_support", "wall_distance",
    "shown", "unseen", "agreed", "through", "before", "facing", "edge", "jump", "spread", "weight",
    "free_front", "free_back", "color_spread", "together_4", "together_12",
    "sheet_log_area", "sheet_length", "sheet_top", "sheet_foot",
)  # fmt: skip
EDGE_FEATURES = (
    "touching", "gap", "log_border", "border_share", "concavity", "concavity_low", "angle", "convexity",
    "step_out", "color_step", "color_far", "color_relative", "edge", "edge_relative", "jump", "chord_free",
    "chord_depth", "slope", "agreed", "through", "facing", "in_common",
    "together_1", "together_4", "together_12", "pixel_pairs",
)  # fmt: skip
# "gap_below": reach in plan, how far the surface below may rise over the foot, least z of its normals
_BELOW_REACH_M, _BELOW_STEP_M, _UP = 0.08, 0.01, 0.7
_FREE_REACH_M = 0.04  # distance to the surface at which free space is looked up
_USUAL_FRAMES = 36.0  # counts of keyframes are normalized to this number
_SHEET_COSINE, _SHEET_STEP_M = 0.97, 0.012  # least cosine and largest step between coplanar neighbors
_CHORD_CAP_M = 0.05
_TINY = 1e-9
_LOG_ODDS = np.log((np.arange(256) + 1.0) / (256.0 - np.arange(256)))  # of affinities stored as uint8
_FEW_PAIRS = 4.0  # weight of the prior log-odds 0, in pixel pairs


@dataclass(frozen=True)
class View:
    """Input of the features: the surface, its keyframes, and their evidence."""

    mesh: MeshGraph
    surface: Surface
    frames: list[Sighting]
    looks: list[FrameLook]
    evidence: VertexEvidence

    @classmethod
    def of(cls, mesh: MeshGraph, surface: Surface, frames: list[Sighting]) -> "View":
        """Collect the evidence of all keyframes."""
        looks = list(ordered_map(lambda frame: look(frame, mesh.points, mesh.normals), frames))
        return cls(mesh, surface, frames, looks, gather(looks))


@dataclass(frozen=True)
class Shapes:
    """Area-weighted shape and color of each region."""

    area: np.ndarray  # float64 (n,)
    center: np.ndarray  # float64 (n, 3)
    normal: np.ndarray  # float64 (n, 3) unit
    coherence: np.ndarray  # float64 (n,) length of the mean normal
    spread: np.ndarray  # float64 (n, 3) standard deviations along the principal axes, ascending
    color: np.ndarray  # float64 (n, 3) weighted CIELAB
    color_spread: np.ndarray  # float64 (n,)

    @classmethod
    def of(cls, mesh: MeshGraph, graph: RegionGraph) -> "Shapes":
        """Measure the regions."""
        weight = np.maximum(mesh.areas, _TINY)
        area = np.bincount(graph.region, weights=weight, minlength=graph.count)
        center = _means(graph, weight, mesh.points)
        normal = _means(graph, weight, mesh.normals)
        coherence = np.linalg.norm(normal, axis=1)
        away = mesh.points - center[graph.region]
        products = (away[:, :, None] * away[:, None, :]).reshape(-1, 9)
        covariance = _means(graph, weight, products).reshape(-1, 3, 3)
        spread = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance), 0.0))
        lab = mesh.lab.astype(np.float64) * LIGHTNESS_WEIGHT
        color = _means(graph, weight, lab)
        off = ((lab - color[graph.region]) ** 2).sum(axis=1)
        return cls(
            area, center, normal / np.maximum(coherence, _TINY)[:, None], coherence, spread, color,
            np.sqrt(_means(graph, weight, off[:, None])[:, 0]),
        )  # fmt: skip


@dataclass(frozen=True)
class Together:
    """Mean affinities of the mending network over keyframes: log-odds that pixels 1, 4, 12 px apart are one object."""

    inside: np.ndarray  # float64 (n, 3) of pixel pairs inside a region, 0 = unknown
    across: np.ndarray  # float64 (e, 3) of pixel pairs across a border
    pixel_pairs: np.ndarray  # float64 (e,) number of pixel pairs 12 px apart

    @classmethod
    def of(cls, view: View, graph: RegionGraph) -> "Together":
        """Average the affinities of all keyframes that have them."""
        count, pairs = graph.count, len(graph.pairs)
        keys = graph.pairs[:, 0].astype(np.int64) * count + graph.pairs[:, 1]
        sums, shown = np.zeros((len(OFFSETS_PX), count + pairs)), np.zeros((len(OFFSETS_PX), count + pairs))
        for frame in view.frames:
            if frame.affinity is None:
                continue
            region = np.where(frame.vertex >= 0, graph.region[np.maximum(frame.vertex, 0)], -1)
            for scale, px in enumerate(OFFSETS_PX):
                for axis in (1, 0):
                    step = max(px // 2, 1)  # `vertex` has every second pixel: the nearest pair is 2 px apart
                    first = np.moveaxis(region, axis, 0)[:-step].ravel()
                    other = np.moveaxis(region, axis, 0)[step:].ravel()
                    channel = frame.affinity[2 * scale + (1 - axis)]
                    said = np.moveaxis(channel, axis, 0)[:-step].ravel()
                    known = (first >= 0) & (other >= 0)
                    low, high = np.minimum(first, other)[known], np.maximum(first, other)[known]
                    place = np.where(low == high, low, count + _places(keys, low * np.int64(count) + high))
                    found = place < count + pairs
                    odds = _LOG_ODDS[said[known][found]]
                    sums[scale] += np.bincount(place[found], weights=odds, minlength=count + pairs)
                    shown[scale] += np.bincount(place[found], minlength=count + pairs)
        mean = (sums / (shown + _FEW_PAIRS)).T
        return cls(mean[:count], mean[count:], shown[-1, count:])


def _places(keys: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """Return the row of each number in sorted keys; the number of keys where it is missing."""
    row = np.searchsorted(keys, asked)
    there = keys[np.minimum(row, len(keys) - 1)] == asked if len(keys) else np.zeros(len(asked), bool)
    return np.where(there, row, len(keys))


def node_features(view: View, graph: RegionGraph, shapes: Shapes, together: Together) -> np.ndarray:
    """Return float32 (n, len(NODE_FEATURES)) for the regions of a graph."""
    mesh, evidence = view.mesh, view.evidence
    weight = np.maximum(mesh.areas, _TINY)
    shown = _USUAL_FRAMES / max(len(view.frames), 1) * evidence.shown
    support = np.asarray(view.surface.weights, np.float64)
    usual = max(float(np.median(support)), 1.0) if len(support) else 1.0
    seen = np.stack(
        [np.log1p(shown), evidence.shown == 0, evidence.agreed, evidence.through, evidence.before,
         evidence.facing, np.log1p(evidence.edge), evidence.jump_m, np.log1p(evidence.spread),
         np.log(0.1 + support / usual)], axis=1,
    )  # fmt: skip
    low, high = _box_of_room(view)
    center = shapes.center
    to_side = np.maximum(np.minimum(center - low, high - center)[:, :2].min(axis=1), 0.0)
    foot = np.full(graph.count, np.inf)
    np.minimum.at(foot, graph.region, mesh.points[:, 2])
    free = [view.surface.space.lookup(mesh.points + s * _FREE_REACH_M * mesh.normals) == 1 for s in (1, -1)]
    own = np.column_stack(
        [np.log(shapes.area), shapes.spread[:, ::-1], shapes.spread[:, 0] / (shapes.spread[:, 1] + _TINY),
         shapes.coherence, shapes.normal[:, 2], center[:, 2], foot, _gap_below(shapes, foot), to_side,
         center[:, 2] / max(high[2], _TINY)]
    )  # fmt: skip
    planes = _means(graph, weight, _on_planes(view))
    views = _means(graph, weight, seen)
    around = _means(graph, weight, np.stack(free, axis=1).astype(np.float64))
    parts = [own, planes, views, around, np.log1p(shapes.color_spread)[:, None], together.inside[:, 1:],
             _sheets(mesh, graph, shapes)]  # fmt: skip
    return np.concatenate(parts, axis=1).astype(np.float32)


def _box_of_room(view: View) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounding box (3,), (3,) of the surface, without what lies behind walls or below the floor.

    Noise, mirror images and views out of windows and doors are there.
    """
    inside = ~behind_base(view.mesh, base_planes(view.surface))
    points = view.mesh.points[inside] if inside.any() else view.mesh.points
    return points.min(axis=0), points.max(axis=0)


def _sheets(mesh: MeshGraph, graph: RegionGraph, shapes: Shapes) -> np.ndarray:
    """Return log area, length, top and foot (n, 4) of the planar sheet of connected regions that each region is in."""
    a, b = graph.pairs[graph.touching].T
    off = [np.abs((shapes.normal[k] * (shapes.center[b] - shapes.center[a])).sum(axis=1)) for k in (a, b)]
    flat = ((shapes.normal[a] * shapes.normal[b]).sum(axis=1) > _SHEET_COSINE) & (
        np.maximum(*off) < _SHEET_STEP_M
    )
    links = csr_matrix((np.ones(flat.sum()), (a[flat], b[flat])), shape=(graph.count, graph.count))
    count, sheet = connected_components(links, directed=False)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, sheet[graph.region], mesh.points)
    np.maximum.at(high, sheet[graph.region], mesh.points)
    area = np.bincount(sheet, weights=shapes.area, minlength=count)
    length = np.linalg.norm((high - low)[:, :2], axis=1)
    return np.column_stack([np.log(area), length, high[:, 2], low[:, 2]])[sheet]


def edge_features(view: View, graph: RegionGraph, shapes: Shapes, together: Together) -> np.ndarray:
    """Return float32 (e, len(EDGE_FEATURES)) for the pairs of a graph."""
    mesh, evidence = view.mesh, view.evidence
    p, q = graph.links[:, 0], graph.links[:, 1]
    step = mesh.points[q] - mesh.points[p]
    length = np.linalg.norm(step, axis=1)
    direction = step / np.maximum(length, _TINY)[:, None]
    bend = ((mesh.normals[q] - mesh.normals[p]) * direction).sum(axis=1)  # > 0: convex
    color = np.linalg.norm(mesh.lab[p] * LIGHTNESS_WEIGHT - mesh.lab[q] * LIGHTNESS_WEIGHT, axis=1)
    both = np.stack(
        [length, bend, color, np.abs(direction[:, 2]), np.minimum(evidence.agreed[p], evidence.agreed[q]),
         np.maximum(evidence.through[p], evidence.through[q]), np.minimum(evidence.facing[p], evidence.facing[q])],
        axis=1,
    )  # fmt: skip
    mean = _link_means(graph, both)
    lowest = np.full(len(graph.pairs), np.inf)
    np.minimum.at(lowest, graph.link_pair, bend)
    a, b = graph.pairs[:, 0], graph.pairs[:, 1]
    border = np.bincount(graph.link_pair, minlength=len(graph.pairs)) * mesh.spacing_m
    share = border / np.sqrt(np.minimum(shapes.area[a], shapes.area[b]))
    far = np.linalg.norm(shapes.color[a] - shapes.color[b], axis=1)
    relative = far / (1.0 + shapes.color_spread[a] + shapes.color_spread[b])
    edge, jump, common = _along_borders(view, graph)
    inside = np.log1p(_means(graph, np.maximum(mesh.areas, _TINY), evidence.edge[:, None])[:, 0])
    chord_free, chord_depth = _chords(view, shapes.center[a], shapes.center[b])
    return np.column_stack(
        [graph.touching, mean[:, 0], np.log(border), np.log(share), mean[:, 1], lowest,
         *_bends(shapes, a, b), np.log1p(mean[:, 2]), np.log1p(far), relative, np.log1p(edge),
         np.log1p(edge) - np.minimum(inside[a], inside[b]), jump, chord_free, chord_depth, mean[:, 3:], common,
         together.across, np.log1p(together.pixel_pairs)]
    ).astype(np.float32)  # fmt: skip


def _bends(shapes: Shapes, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return 1 - cosine of the angle between two regions, convexity, and distance of one from the other's plane."""
    apart = shapes.center[b] - shapes.center[a]
    distance = np.maximum(np.linalg.norm(apart, axis=1), _TINY)[:, None]
    angle = 1.0 - (shapes.normal[a] * shapes.normal[b]).sum(axis=1)
    convexity = ((shapes.normal[b] - shapes.normal[a]) * apart / distance).sum(axis=1)
    off = [np.abs((shapes.normal[k] * apart).sum(axis=1)) for k in (a, b)]
    return angle, convexity, np.minimum(*off)


def _means(graph: RegionGraph, weight: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the weighted means (n, k) of values (v, k) over the vertices of each region."""
    total = np.bincount(graph.region, weights=weight, minlength=graph.count)
    sums = [np.bincount(graph.region, weights=weight * column, minlength=graph.count) for column in values.T]
    return np.stack(sums, axis=1) / total[:, None]


def _link_means(graph: RegionGraph, values: np.ndarray) -> np.ndarray:
    count = len(graph.pairs)
    total = np.bincount(graph.link_pair, minlength=count)
    sums = [np.bincount(graph.link_pair, weights=column, minlength=count) for column in values.T]
    return np.stack(sums, axis=1) / total[:, None]


def _on_planes(view: View) -> np.ndarray:
    """Return (v, 5): 1 if on the floor, a wall, the ceiling, a support plane; signed distance to the nearest wall."""
    labels = ("floor", "wall", "ceiling", "support")
    out = np.zeros((len(view.mesh.points), len(labels) + 1))
    nearest = np.full(len(out), 1.0)
    for plane in view.surface.planes:
        out[plane.vertices, labels.index(plane.label)] = 1.0
        if plane.label == "wall":
            distance = view.mesh.points @ plane.surface.plane[:3] + plane.surface.plane[3]
            nearest = np.where(np.abs(distance) < np.abs(nearest), distance, nearest)
    out[:, -1] = nearest
    return out


def _gap_below(shapes: Shapes, foot: np.ndarray) -> np.ndarray:
    """Return the smallest gap (n,) between each region's foot and an up-facing region below, else its height."""
    up = np.flatnonzero(shapes.normal[:, 2] > _UP)
    out = foot.copy()
    if len(up) == 0:
        return out
    tree, every = cKDTree(shapes.center[up, :2]), cKDTree(shapes.center[:, :2])
    near = every.sparse_distance_matrix(tree, _BELOW_REACH_M, output_type="coo_matrix")
    gap = foot[near.row] - shapes.center[up[near.col], 2]
    below = gap > -_BELOW_STEP_M
    np.minimum.at(out, near.row[below], gap[below])
    return out


def _along_borders(view: View, graph: RegionGraph) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return image evidence along borders, (e,) each, from the frames in which they are visible.

    Returns:
        Median color gradient, median distance to depth edges, and of all (frame, link) combinations in which a vertex
        of the link is visible the share in which both are.
    """
    count, frames = len(graph.pairs), len(view.looks)
    edge, jump = (np.full((frames, count), np.nan, np.float32) for _ in range(2))
    both, either = np.zeros(count), np.zeros(count)
    p, q = graph.links[:, 0], graph.links[:, 1]
    for row, seen in enumerate(view.looks):
        there = seen.shown[p] & seen.shown[q]
        pair = graph.link_pair[there]
        shown = np.bincount(pair, minlength=count)
        has = shown > 0
        p_there, q_there = p[there], q[there]
        sums = np.bincount(pair, weights=0.5 * (seen.edge[p_there] + seen.edge[q_there]), minlength=count)
        edge[row, has] = sums[has] / shown[has]
        sums = np.bincount(
            pair, weights=np.minimum(seen.jump_m[p_there], seen.jump_m[q_there]), minlength=count
        )
        jump[row, has] = sums[has] / shown[has]
        both += shown
        either += np.bincount(graph.link_pair[seen.shown[p] | seen.shown[q]], minlength=count)
    return _median(edge), _median(jump), both / np.maximum(either, 1)


def _median(values: np.ndarray) -> np.ndarray:
    """Return the lower median (e,) of columns (k, e), ignoring nan; 0 where all are nan."""
    known = np.isfinite(values).sum(axis=0)
    ordered = np.sort(values, axis=0)  # nan last
    out = ordered[np.maximum(known - 1, 0) // 2, np.arange(values.shape[1])]
    return np.where(known > 0, out, 0.0)


def _chords(view: View, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the share of frames in which the middle of each chord is in free space, and the mean margin in metres.

    A chord between two sides of a convex object runs inside of it: frames measure smaller depth than its middle has.
    """
    middle = 0.5 * (first + second)
    free, judged, ahead = (np.zeros(len(middle)) for _ in range(3))
    for frame in view.frames:
        row, column, z = frame.seen_at(middle)
        measured = frame.measured[row, column]
        margin = np.clip(measured - z, -_CHORD_CAP_M, _CHORD_CAP_M)
        known = (z > 0) & (measured > 0) & (measured > z - _CHORD_CAP_M)  # else occluded
        judged += known
        free += known & (margin > 0)
        ahead += np.where(known, margin, 0.0)
    judged = np.maximum(judged, 1)
    return free / judged, ahead / judged
