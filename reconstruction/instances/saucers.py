"""What an open container stands on, a plate under a bowl, a saucer under a cup, told from it by color.

A container is whole by its rim, whatever colors it has, so that what lies under it low and wide is held for its foot.
But a foot is as wide as what it carries at most; what reaches further out and has hardly a color in common with the
container is a thing of its own.
"""

import numpy as np

from reconstruction.instances.boxes import quantiles
from reconstruction.instances.columns import MIN_KNOWN, MIN_SAMPLES, medians, polar
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.image_colors import SurfaceSamples
from reconstruction.instances.two_colors import Paint
from reconstruction.surface.mesh_graph import MeshGraph

_LOWEST_M, _HIGHEST_M, _HIGHEST = 0.01, 0.05, 0.5  # of a saucer: its top, in metres and of the whole height
_STEP_M = 0.003  # between the heights tried
_BAND_M = 0.02  # of the container's side above a height, whose width counts
_RIM_PERCENT = 90.0  # of radii in a direction: how far it reaches
_OUT_M, _OUT = 0.015, 0.6  # how far it reaches beyond that, more than ledges do, in what share of directions
_MOST_COMMON = 0.25  # share of either's area in colors that the other has, too


def on_saucer(
    graph: MeshGraph, body: np.ndarray, samples: SurfaceSamples, config: InstancesConfig
) -> np.ndarray | None:
    """Return the sorted vertices of the container on a saucer, None where there is no saucer.

    Args:
        graph: the surface.
        body: sorted vertices of a container with what may be a saucer under it.
        samples: of the same, with colors.
        config: how large a thing is at least.
    """
    seen = samples.of(np.isfinite(samples.lab[:, 0]))
    if not len(seen.points):
        return None
    paint = Paint.of(seen)
    bottom, top = quantiles(graph.points[body, 2], graph.areas[body], (0.01, 0.99))
    best, found = _MOST_COMMON, None
    for rise in np.arange(_LOWEST_M, min(_HIGHEST_M, _HIGHEST * (top - bottom)), _STEP_M):
        height = bottom + rise
        low = seen.points[:, 2] < height
        if not _reaches_out(seen, low, height):
            continue
        common = paint.common(low)
        if common < best:
            best, found = common, height
    if found is None:
        return None
    upper = body[graph.points[body, 2] >= found]
    areas = [graph.areas[part].sum() for part in (upper, np.setdiff1d(body, upper, assume_unique=True))]
    return upper if min(areas) > config.min_object_area_m2 else None


def _reaches_out(samples: SurfaceSamples, low: np.ndarray, height: float) -> bool:
    """Tell whether what is low (mask) reaches beyond the side right above it in most directions."""
    band = ~low & (samples.points[:, 2] < height + _BAND_M)
    if min(band.sum(), low.sum()) < MIN_SAMPLES:
        return False
    radius, turn = polar(samples, band)
    out = medians(radius, turn, low, _RIM_PERCENT) - medians(radius, turn, band, _RIM_PERCENT)
    known = np.isfinite(out)
    return bool(known.sum() >= MIN_KNOWN and (out[known] > _OUT_M).mean() >= _OUT)
