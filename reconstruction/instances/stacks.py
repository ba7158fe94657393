"""Things stacked on each other that the mesh holds for one: cut at the level seam where outline and color change.

A ledge of a centimetre has no level surface of its own in the mesh, and prints have edges as strong as those between
things. So no single sign cuts. At each height of a thing what rises above is compared, direction by direction around
it, with what is right below:

- the outline in plan steps in over much of the way around (a print or a lid does not step, a handle is one direction);
- both are steep beside the step (shoulders, bowls and roofs slant);
- the color, read from the keyframes, changes at that very height over most of the way around (what is of one piece
  mostly keeps its color);
- and it stays changed: the colors above and below differ as a whole.

What stands turned or off the middle on something as wide as itself makes no ledge around, yet its outline crosses that
of the lower one: it steps in on some sides and out on others, which no thing of one piece does. Sides that slant alike
above and below, those of a tent or a cone, move the outline steadily: that is deducted.

A flat thing that reaches beyond what it lies on steps out instead (`lying_across`).
"""

from dataclasses import dataclass, replace

import numpy as np

from reconstruction.instances.colors import LIGHTNESS_WEIGHT
from reconstruction.instances.columns import (
    BELOW,
    CONTRAST,
    DIRECTIONS,
    FAR_M,
    MIN_KNOWN,
    MIN_SAMPLES,
    NEAR_M,
    SEAM_COLOR,
    SEAMS,
    STEEP,
    medians,
    middle_of,
    polar,
    upright_share,
)
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.image_colors import SurfaceSamples, surface_samples, with_colors
from reconstruction.instances.lying_across import is_flat, score_of_flat, without_sides
from reconstruction.instances.merging import nearest_of
from reconstruction.instances.saucers import on_saucer
from reconstruction.instances.segmentation import Thing
from reconstruction.progress import Progress
from reconstruction.surface.mesh_graph import MeshGraph, pieces
from reconstruction.types import DepthMaps, PosedFrames, Surface

_LARGEST_M = 0.6  # furniture has legs and tops of its own colors
_LOWEST_M = 0.015  # of the lower part
_STEP_M = 0.005  # between the heights tried
_SEAM_M = 0.012  # colors this close to a height show a step of color
_LEVEL = 0.6  # of |z| of a normal
_LEDGE_M, _FLUSH_M = 0.007, 0.003  # a step in plan, and none
_REACH_M = 0.03  # how far beyond the upper part its ledge is looked for
_CLOSE_M = 0.02  # half of a band
_BLUR_M = 0.0025  # what the outline of one thing moves by: where outlines cross, more in most directions
_BESIDE_M = 0.04  # and the colors of what is below
_LEDGE_M2 = 3e-5
# Outlines that cross: their mean gap in ledges, of it the lesser of in and out, and how upright what stands across is.
_CROSSED, _BALANCE, _COLUMN = 0.5, 0.25, 0.95
_LEAST_OUTWARD = 0.5  # of a normal in plan, for its slant to be told
# What signs must reach for the product of all to be enough, beside those of `columns`; more of one makes up for less of
# another.
_LEDGES, _ABOVE = 0.4, 0.7
_LEAST_LEDGES = 0.3
_THIN_M = 0.01  # height of the flattest thing
_NEARLY = 0.85  # of the surest seam: as good as that


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
        if not thing.attached and np.ptp(graph.points[thing.vertices], axis=0).max() < _LARGEST_M
    ]
    if not small:
        return things
    chosen = np.concatenate([thing.vertices for thing in small])
    samples = with_colors(surface_samples(graph, surface, chosen), posed, depth)
    inside = np.zeros(len(graph.points), bool)
    out, waiting = list(things), list(small)
    while waiting:
        lower = waiting.pop()
        inside[:] = False
        inside[lower.vertices] = True
        own = samples.of(inside[samples.vertex])
        if lower.container:
            above = on_saucer(graph, lower.vertices, own, config)
        else:
            seam = _best_seam(graph, lower.vertices, own, config, flats)
            above = None if seam is None else seam.upper
        if above is None:
            continue
        upper = Thing(above, lower, lower.depth + 1, container=lower.container)
        lower.vertices = np.setdiff1d(lower.vertices, above, assume_unique=True)
        lower.container = False
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
    graph: MeshGraph, body: np.ndarray, own: SurfaceSamples, config: InstancesConfig, with_flats: bool
) -> _Seam | None:
    """Return the surest seam of a body of which samples are given, None if none is sure enough."""
    inside = np.zeros(len(graph.points), bool)
    z = graph.points[body, 2]
    best: _Seam | None = None
    flats: list[_Seam] = []
    for height in np.arange(z.min() + _LOWEST_M, z.max() - _THIN_M, _STEP_M):
        for piece in pieces(graph, body[z > height]):
            if graph.areas[piece].sum() < config.min_object_area_m2:
                break  # the largest come first
            extents = np.ptp(graph.points[piece], axis=0)
            flat = with_flats and height - z.min() > config.min_object_m and is_flat(graph, piece)
            solid = min(np.sort(extents)[1], extents[2]) >= config.min_object_m
            if not (flat or solid):
                continue
            inside[:] = False
            inside[piece] = True
            above = inside[own.vertex] & (own.points[:, 2] > height - 0.003)
            if flat and (score := score_of_flat(own, above, float(height))) >= 1.0:
                flats.append(_Seam(score, float(height), piece))
            score = _score(own, above, float(height)) if solid else 0.0
            if score >= (1.0 if best is None else best.score + 1e-9):
                best = _Seam(score, float(height), piece)
    if flats:  # what hangs down from a flat thing's rim is smeared: it lies as high as is sure
        surest = max(seam.score for seam in flats)
        if best is None or surest > best.score:
            best = [seam for seam in flats if seam.score > _NEARLY * surest][-1]
            best = replace(best, upper=without_sides(graph, body, best.upper, best.height_m))
    if best is None:
        return None
    rest = np.setdiff1d(body, best.upper, assume_unique=True)
    if graph.areas[rest].sum() < config.min_object_area_m2:
        return None
    return best


def _score(own: SurfaceSamples, above: np.ndarray, height: float) -> float:
    """Return how sure it is that samples `above` (mask) a height are of another thing than those below."""
    z, slope = own.points[:, 2], np.abs(own.normals[:, 2])
    upper = above & (z > height + NEAR_M) & (z < height + FAR_M)
    lower = ~above & (z < height - NEAR_M) & (z > height - FAR_M)
    column = upper & (slope < STEEP)
    if column.sum() < MIN_SAMPLES:
        return 0.0
    radius, turn = polar(own, column)
    around = medians(radius, turn, column)
    side = lower & (slope < STEEP) & (radius > 0.4 * around[turn])
    below = medians(radius, turn, side)
    level = (own.normals[:, 2] > _LEVEL) & (np.abs(z - height) < 2 * NEAR_M)
    level &= (radius > around[turn] + 0.002) & (radius < around[turn] + _REACH_M)
    ledge = np.bincount(turn[level], weights=own.areas[level], minlength=DIRECTIONS) > _LEDGE_M2
    known = np.isfinite(around) & (np.isfinite(below) | ledge)
    if known.sum() < MIN_KNOWN:
        return 0.0
    gap = np.where(np.isfinite(below), below - around, np.inf)

    def share(step: np.ndarray) -> float:
        out = (step > _LEDGE_M) & (np.isfinite(step) | ledge) | (ledge & (step > _FLUSH_M))
        return float(out[known].mean())

    ledges = share(gap)
    if ledges >= _LEAST_LEDGES:
        ledges = share(gap - _slanted(own, radius, turn, column, side))
    beside = lower & (radius < around[turn] + _BESIDE_M)
    upright = upright_share(own, upper), upright_share(own, beside)
    if upright[0] > _COLUMN and _crossing(gap) > 0:
        close = np.abs(z - height) < _CLOSE_M  # a step in the midst of a band is none at this height
        near = medians(radius, turn, side & close) - medians(radius, turn, column & close)
        ledges = max(ledges, _LEDGES / _CROSSED * min(_crossing(gap), _crossing(near)))
    if ledges < _LEAST_LEDGES:
        return 0.0
    shape = [
        ledges / _LEDGES,
        min(1.0, upright[0] / _ABOVE),
        min(1.0, upright[1] / BELOW),
    ]
    return float(np.prod(shape)) * _color_evidence(own, above, upper, beside, turn, height)


def _slanted(
    own: SurfaceSamples, radius: np.ndarray, turn: np.ndarray, upper: np.ndarray, lower: np.ndarray
) -> np.ndarray:
    """Return how far (16,) the outline moves out from an upper to a lower band (masks) by the slant that both have.

    It is nan in directions in which too little faces outwards to tell the slant.
    """
    middle = own.points[:, :2] - middle_of(own, upper)
    outward = (own.normals[:, :2] * middle).sum(axis=1) / np.maximum(radius, 1e-9)
    told = outward > _LEAST_OUTWARD
    slant = own.normals[:, 2] / np.maximum(outward, _LEAST_OUTWARD)
    one, two = (_least_slant(slant, turn, band & told) for band in (upper, lower))
    drop = medians(own.points[:, 2], turn, upper) - medians(own.points[:, 2], turn, lower)
    return np.where(one * two < 0, 0.0, 0.5 * (one + two)) * drop


def _least_slant(slant: np.ndarray, turn: np.ndarray, band: np.ndarray) -> np.ndarray:
    """Return the slant (16,) that two thirds of a band have, either way: what is smoothed at a ledge has none."""
    low, high = (medians(slant, turn, band, percent) for percent in (33.0, 67.0))
    return np.where(low > 0, low, np.where(high < 0, high, 0.0 * low))


def _crossing(step: np.ndarray) -> float:
    """Return how far two outlines are apart, a ledge or more all around is 1; 0 unless they cross each other.

    Steps (16,) in where positive, nan where unknown.
    """
    step = step[np.isfinite(step)]
    if len(step) < MIN_KNOWN or np.median(np.abs(step)) < _BLUR_M:
        return 0.0
    step = np.clip(step / _LEDGE_M, -1.0, 1.0)
    inwards, outwards = (float(np.maximum(side, 0.0).mean()) for side in (step, -step))
    both = inwards + outwards
    return both if min(inwards, outwards) >= _BALANCE * both else 0.0


def _color_evidence(
    own: SurfaceSamples,
    above: np.ndarray,
    upper: np.ndarray,
    beside: np.ndarray,
    turn: np.ndarray,
    height: float,
) -> float:
    seen = np.isfinite(own.lab[:, 0])
    if min((upper & seen).sum(), (beside & seen).sum()) < MIN_SAMPLES:
        return 0.0
    lab = own.lab * LIGHTNESS_WEIGHT
    rise, steep = own.points[:, 2] - height, np.abs(own.normals[:, 2]) < STEEP
    high = above & seen & steep & (rise > 0.25 * _SEAM_M) & (rise < _SEAM_M)
    low = ~above & seen & steep & (rise < -0.25 * _SEAM_M) & (rise > -1.25 * _SEAM_M)
    sides = [np.stack([medians(lab[:, k], turn, side) for k in range(3)], axis=1) for side in (high, low)]
    steps = np.linalg.norm(sides[0] - sides[1], axis=1)
    steps = steps[np.isfinite(steps)]
    seams = float((steps > SEAM_COLOR).mean()) if len(steps) else 0.0
    contrast = np.linalg.norm(np.median(lab[upper & seen], axis=0) - np.median(lab[beside & seen], axis=0))
    return seams / SEAMS * min(2.0, float(contrast) / CONTRAST)
