"""Things stacked on each other that the mesh holds for one: cut at the level seam where outline and color change.

A ledge of a centimetre has no level surface of its own in the mesh, and prints have edges as strong as those between
things. So no single sign cuts. At each height of a thing what rises above is compared, direction by direction around
it, with what is right below:

- the outline in plan steps in over much of the way around (a print or a lid does not step, a handle is one direction);
- both are steep beside the step (shoulders, bowls and roofs slant);
- the color, read from the keyframes, changes at that very height over most of the way around (what is of one piece
  mostly keeps its color);
- and it stays changed: the colors above and below differ as a whole.

A flat thing that reaches beyond what it lies on (a plate on a carton, a book on a box) steps out instead, and hides
from above where it lies: it is told by that step, and by the colors of its rim and of what is below.
"""

from dataclasses import dataclass

import numpy as np

from reconstruction.instances.boxes import quantiles
from reconstruction.instances.colors import LIGHTNESS_WEIGHT
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.image_colors import SurfaceSamples, surface_samples, with_colors
from reconstruction.instances.merging import nearest_of
from reconstruction.instances.segmentation import Thing
from reconstruction.progress import Progress
from reconstruction.surface.mesh_graph import MeshGraph, pieces
from reconstruction.types import DepthMaps, PosedFrames, Surface

_LARGEST_M = 0.6  # furniture has legs and tops of its own colors
_LOWEST_M = 0.015  # of the lower part
_STEP_M = 0.005  # between the heights tried
_NEAR_M, _FAR_M = 0.006, 0.035  # bands above and below a height, clear of its blur
_SEAM_M = 0.012  # colors this close to a height show a step of color
_DIRECTIONS = 16
_MIN_KNOWN = 8  # directions in which both are seen
_STEEP, _UPRIGHT, _LEVEL = 0.5, 0.35, 0.6  # of |z| of a normal
_LEDGE_M, _FLUSH_M = 0.007, 0.003  # a step in plan, and none
_REACH_M = 0.03  # how far beyond the upper part its ledge is looked for
_BESIDE_M = 0.04  # and the colors of what is below
_LEDGE_M2 = 3e-5
_SEAM_COLOR = 8.0
# What each sign must reach for the product of all to be enough; more of one makes up for less of another.
_LEDGES, _SEAMS, _ABOVE, _BELOW, _CONTRAST = 0.4, 0.65, 0.7, 0.5, 12.0
_LEAST_LEDGES = 0.3
_MIN_SAMPLES = 10
_THIN_M, _WIDE_M = 0.01, 0.13  # height of the flattest thing, and how wide flat things are at least
_FLAT_M = 0.07  # height of the highest that may lie across what is smaller
_OUT_M, _OUT, _LEAST_OUT = 0.01, 0.4, 0.3  # how far it reaches beyond that, in what share of directions
_RIM_SHARE = 90  # percentile of radii that is its rim
_TOP, _TOP_SHARE = 0.6, 0.35  # z of the normals of its top, and share of its outline that this is
_NEARLY = 0.85  # of the surest seam: as good as that
_STEM = 0.4  # of its reach: what is slimmer below is the stem of one thing


@dataclass(frozen=True)
class _Seam:
    score: float  # 1 and more is enough to cut
    height_m: float
    upper: np.ndarray  # sorted vertices


def cut_stacks(
    graph: MeshGraph,
    surface: Surface,
    things: list[Thing],
    posed: PosedFrames,
    depth: DepthMaps,
    config: InstancesConfig,
    progress: Progress,
    *,
    flats: bool = True,
) -> list[Thing]:
    """Cut stacks into the things that stand on each other.

    Args:
        graph: the surface as a graph.
        surface: the surface in world space.
        things: what was found; theirs are the vertices.
        posed: keyframes with cameras in world space.
        depth: their depth in metres.
        config: how large a thing is at least.
        progress: told of how many were cut off.
        flats: whether flat things that lie across smaller ones are looked for, too.

    Returns:
        The things, lower parts in the place of stacks, upper parts at the end; what rested on a stack rests on its part
        that is nearest.
    """
    small = [
        thing
        for thing in things
        if not (thing.attached or thing.container)
        and np.ptp(graph.points[thing.vertices], axis=0).max() < _LARGEST_M
    ]
    if not small:
        return things
    chosen = np.concatenate([thing.vertices for thing in small])
    samples = with_colors(surface_samples(graph, surface, chosen), posed, depth)
    out, waiting = list(things), list(small)
    while waiting:
        lower = waiting.pop()
        seam = _best_seam(graph, lower.vertices, samples, config, flats)
        if seam is None:
            continue
        upper = Thing(seam.upper, lower, lower.depth + 1)
        lower.vertices = np.setdiff1d(lower.vertices, seam.upper, assume_unique=True)
        for other in out:
            if other.rests_on is lower and nearest_of(graph, other, (lower, upper)) is upper:
                other.rests_on = upper
        out.append(upper)
        waiting += [lower, upper]
    if len(out) > len(things):
        progress.note(
            f"{len(out) - len(things)} things are cut off what they are stacked on, by outline and color"
        )
    return out


def _best_seam(
    graph: MeshGraph, body: np.ndarray, samples: SurfaceSamples, config: InstancesConfig, with_flats: bool
) -> _Seam | None:
    """Return the surest seam of a body, None if none is sure enough."""
    inside = np.zeros(len(graph.points), bool)
    inside[body] = True
    own = samples.of(inside[samples.vertex])
    z = graph.points[body, 2]
    best: _Seam | None = None
    flats: list[_Seam] = []
    for height in np.arange(z.min() + _LOWEST_M, z.max() - _THIN_M, _STEP_M):
        for piece in pieces(graph, body[z > height]):
            if graph.areas[piece].sum() < config.min_object_area_m2:
                break  # the largest come first
            extents = np.ptp(graph.points[piece], axis=0)
            flat = with_flats and height - z.min() > config.min_object_m and _is_flat(graph, piece)
            solid = min(np.sort(extents)[1], extents[2]) >= config.min_object_m
            if not (flat or solid):
                continue
            inside[:] = False
            inside[piece] = True
            above = inside[own.vertex] & (own.points[:, 2] > height - 0.003)
            if flat and (score := _score_of_flat(own, above, float(height))) >= 1.0:
                flats.append(_Seam(score, float(height), piece))
            score = _score(own, above, float(height)) if solid else 0.0
            if score >= (1.0 if best is None else best.score + 1e-9):
                best = _Seam(score, float(height), piece)
    if flats:  # what hangs down from a flat thing's rim is smeared: it lies as high as is sure
        surest = max(seam.score for seam in flats)
        if best is None or surest > best.score:
            best = [seam for seam in flats if seam.score > _NEARLY * surest][-1]
    if best is None:
        return None
    rest = np.setdiff1d(body, best.upper, assume_unique=True)
    if graph.areas[rest].sum() < config.min_object_area_m2:
        return None
    return best


def _is_flat(graph: MeshGraph, piece: np.ndarray) -> bool:
    """Tell what is low, wide and mostly a top: a plate, a book, a tray."""
    points, areas = graph.points[piece], graph.areas[piece]
    wide, deep, high = (np.ptp(quantiles(points[:, k], areas, (0.02, 0.98))) for k in range(3))
    if high > _FLAT_M or min(wide, deep) < _WIDE_M:
        return False
    return bool(areas[graph.normals[piece, 2] > _TOP].sum() > _TOP_SHARE * wide * deep)


def _score_of_flat(own: SurfaceSamples, above: np.ndarray, height: float) -> float:
    """Return how sure it is that samples `above` (mask) a height are of a flat thing that lies across those below."""
    z, steep = own.points[:, 2], np.abs(own.normals[:, 2]) < _STEEP
    upper = above & (z > height) & (z < height + _FAR_M)
    lower = ~above & (z < height - _NEAR_M) & (z > height - _FAR_M)
    column = lower & steep
    if column.sum() < _MIN_SAMPLES:
        return 0.0
    radius, turn = _around(own, column)
    below, reach = _medians(radius, turn, column), _medians(radius, turn, upper, _RIM_SHARE)
    known = np.isfinite(below) & np.isfinite(reach)
    if known.sum() < _MIN_KNOWN or np.median(below[known]) < _STEM * np.median(reach[known]):
        return 0.0
    out = float((reach - below > _OUT_M)[known].mean())
    if out < _LEAST_OUT:
        return 0.0
    rim = upper & (radius > below[turn] - _OUT_M)
    seen = np.isfinite(own.lab[:, 0])
    if min((rim & seen).sum(), (column & seen).sum()) < _MIN_SAMPLES:
        return 0.0
    lab = own.lab * LIGHTNESS_WEIGHT
    sides = [
        np.stack([_medians(lab[:, k], turn, side & seen) for k in range(3)], 1) for side in (rim, column)
    ]
    steps = np.linalg.norm(sides[0] - sides[1], axis=1)
    steps = steps[np.isfinite(steps)]
    if len(steps) < _MIN_KNOWN:
        return 0.0
    contrast = np.linalg.norm(np.median(lab[rim & seen], axis=0) - np.median(lab[column & seen], axis=0))
    upright = min(1.0, _upright_share(own, lower & (radius < below[turn] + _OUT_M)) / _BELOW)
    shape = min(1.0, out / _OUT) * upright
    return shape * float((steps > _SEAM_COLOR).mean()) / _SEAMS * min(2.0, float(contrast) / _CONTRAST)


def _around(own: SurfaceSamples, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far samples (n,) are from the middle of a column (mask) in plan, and in which direction."""
    flat = own.points[:, :2] - np.percentile(own.points[column, :2], [5, 95], axis=0).mean(axis=0)
    turn = np.floor(np.arctan2(flat[:, 1], flat[:, 0]) / (2 * np.pi) * _DIRECTIONS).astype(int) % _DIRECTIONS
    return np.hypot(flat[:, 0], flat[:, 1]), turn


def _score(own: SurfaceSamples, above: np.ndarray, height: float) -> float:
    """Return how sure it is that samples `above` (mask) a height are of another thing than those below."""
    z, slope = own.points[:, 2], np.abs(own.normals[:, 2])
    upper = above & (z > height + _NEAR_M) & (z < height + _FAR_M)
    lower = ~above & (z < height - _NEAR_M) & (z > height - _FAR_M)
    column = upper & (slope < _STEEP)
    if column.sum() < _MIN_SAMPLES:
        return 0.0
    radius, turn = _around(own, column)
    around = _medians(radius, turn, column)
    below = _medians(radius, turn, lower & (slope < _STEEP) & (radius > 0.4 * around[turn]))
    level = (own.normals[:, 2] > _LEVEL) & (np.abs(z - height) < 2 * _NEAR_M)
    level &= (radius > around[turn] + 0.002) & (radius < around[turn] + _REACH_M)
    ledge = np.bincount(turn[level], weights=own.areas[level], minlength=_DIRECTIONS) > _LEDGE_M2
    known = np.isfinite(around) & (np.isfinite(below) | ledge)
    if known.sum() < _MIN_KNOWN:
        return 0.0
    step = np.where(np.isfinite(below), below - around, np.inf)
    ledges = float(
        ((step > _LEDGE_M) & (np.isfinite(step) | ledge) | (ledge & (step > _FLUSH_M)))[known].mean()
    )
    if ledges < _LEAST_LEDGES:
        return 0.0
    beside = lower & (radius < around[turn] + _BESIDE_M)
    shape = [
        ledges / _LEDGES,
        min(1.0, _upright_share(own, upper) / _ABOVE),
        min(1.0, _upright_share(own, beside) / _BELOW),
    ]
    return float(np.prod(shape)) * _color_evidence(own, above, upper, beside, turn, height)


def _color_evidence(
    own: SurfaceSamples,
    above: np.ndarray,
    upper: np.ndarray,
    beside: np.ndarray,
    turn: np.ndarray,
    height: float,
) -> float:
    seen = np.isfinite(own.lab[:, 0])
    if min((upper & seen).sum(), (beside & seen).sum()) < _MIN_SAMPLES:
        return 0.0
    lab = own.lab * LIGHTNESS_WEIGHT
    rise, steep = own.points[:, 2] - height, np.abs(own.normals[:, 2]) < _STEEP
    high = above & seen & steep & (rise > 0.25 * _SEAM_M) & (rise < _SEAM_M)
    low = ~above & seen & steep & (rise < -0.25 * _SEAM_M) & (rise > -1.25 * _SEAM_M)
    sides = [np.stack([_medians(lab[:, k], turn, side) for k in range(3)], axis=1) for side in (high, low)]
    steps = np.linalg.norm(sides[0] - sides[1], axis=1)
    steps = steps[np.isfinite(steps)]
    seams = float((steps > _SEAM_COLOR).mean()) if len(steps) else 0.0
    contrast = np.linalg.norm(np.median(lab[upper & seen], axis=0) - np.median(lab[beside & seen], axis=0))
    return seams / _SEAMS * min(2.0, float(contrast) / _CONTRAST)


def _medians(values: np.ndarray, turn: np.ndarray, chosen: np.ndarray, percent: float = 50.0) -> np.ndarray:
    """Return the median of the chosen values, or another percentile, in each direction, nan where there are too few."""
    out = np.full(_DIRECTIONS, np.nan)
    rows = np.flatnonzero(chosen)
    for direction in range(_DIRECTIONS):
        there = values[rows[turn[rows] == direction]]
        if len(there) >= 3:
            out[direction] = np.percentile(there, percent)
    return out


def _upright_share(own: SurfaceSamples, chosen: np.ndarray) -> float:
    areas = own.areas[chosen]
    return float(areas @ (np.abs(own.normals[chosen, 2]) < _UPRIGHT)) / max(float(areas.sum()), 1e-12)
