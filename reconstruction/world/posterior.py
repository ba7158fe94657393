"""Join what is usual of cameras, furniture and rooms into one posterior over the scale.

The scale is the only unknown, so the posterior is computed on a grid of its logarithm. Every support surface has a
mixture of furniture classes as its likelihood, and a broad component for what is none of them.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from reconstruction.world.supports import SupportSurface


@dataclass(frozen=True)
class FurnitureClass:
    """Usual size of a support surface; sigmas are of logarithms."""

    name: str
    height_m: float
    height_sigma: float
    long_m: float
    short_m: float
    extent_sigma: float
    share: float  # of support surfaces in homes; a guess


# Heights: see the table with sources in docs/world_frame.md. Extents are rough: pieces are seen in part.
FURNITURE = (
    FurnitureClass("seat", 0.455, 0.05, 0.46, 0.42, 0.20, 0.20),
    FurnitureClass("coffee table", 0.45, 0.09, 1.10, 0.60, 0.30, 0.15),
    FurnitureClass("bed", 0.52, 0.10, 1.98, 1.30, 0.25, 0.10),
    FurnitureClass("side table", 0.58, 0.10, 0.50, 0.42, 0.25, 0.08),
    FurnitureClass("table or desk", 0.74, 0.025, 1.35, 0.78, 0.30, 0.30),
    FurnitureClass("worktop", 0.90, 0.03, 1.50, 0.60, 0.40, 0.10),
    FurnitureClass("bar table", 1.06, 0.04, 0.70, 0.60, 0.30, 0.02),
)
_MEASURED_SIGMA = 0.015  # of a height: layers are 1.2 % of the median depth thick
_OTHER_HEIGHTS_M = (0.15, 2.2)  # of surfaces of no class, log-uniform
_OTHER_LONG_M, _OTHER_SHORT_M, _OTHER_EXTENT_SIGMA = 0.7, 0.45, 0.9
# Chosen on the even ones of 126 generated rooms with cameras at 1.0 to 1.8 m (docs/world_frame.md).
_OTHER_SHARE = 0.5  # of surfaces that belong to no class
_POWER = 0.7  # of each surface's likelihood: surfaces of one room are not independent
_CEILING_M, _CEILING_SIGMA, _CEILING_EXCEPTIONS = 2.5, 0.08, 0.03  # halls, lofts
_CEILING_COUNTS = 0.05  # share of the prior that the ceiling excludes, from which it is reported
_GRID = np.linspace(-1.2, 1.2, 961)  # of log scale, around the scale by the camera's height


@dataclass(frozen=True)
class ScalePosterior:
    """Posterior of metres per unit, and the part that every surface had in it."""

    per_unit: float  # median
    low: float  # 16 % quantile
    high: float  # 84 % quantile
    parts: tuple[tuple[str, float], ...]  # per surface: likeliest class, and its posterior probability
    ceiling_counts: bool  # the highest seen point excludes a part of the scales

    @property
    def sigma(self) -> float:
        """Return half the width of the 68 % interval of log scale."""
        return 0.5 * float(np.log(self.high / self.low))


def infer_scale(
    eye_height: float, supports: list[SupportSurface], top: float, *, camera_height_m: float, camera_sigma: float
) -> ScalePosterior:  # fmt: skip
    """Compute the posterior of metres per unit.

    Args:
        eye_height: of the camera above the floor, units.
        supports: level surfaces above the floor, units.
        top: height of the highest seen point above the floor, units; 0 if unknown.
        camera_height_m: median of the prior of the camera's height.
        camera_sigma: its spread, of the logarithm.
    """
    log_scale = np.log(camera_height_m / eye_height) + _GRID
    total = norm.logpdf(_GRID, scale=camera_sigma)
    below = np.ones_like(_GRID)
    if top > 0:
        below = norm.sf((log_scale + np.log(top / _CEILING_M)) / _CEILING_SIGMA)
        total = total + np.log(_CEILING_EXCEPTIONS + (1 - _CEILING_EXCEPTIONS) * below)
    likelihoods = [_of_classes(surface, log_scale) for surface in supports]
    for likelihood in likelihoods:
        total = total + _POWER * np.log(likelihood.sum(axis=0))
    mass = np.exp(total - total.max())
    mass /= mass.sum()
    low, middle, high = np.exp(np.interp((0.16, 0.5, 0.84), np.cumsum(mass) - 0.5 * mass, log_scale))
    names = [c.name for c in FURNITURE] + ["none of these"]
    parts = []
    for likelihood in likelihoods:
        shares = (likelihood / likelihood.sum(axis=0)) @ mass
        parts.append((names[int(shares.argmax())], float(shares.max())))
    excluded = np.average(1 - below, weights=norm.pdf(_GRID, scale=camera_sigma))
    counts = bool(excluded > _CEILING_COUNTS)
    return ScalePosterior(float(middle), float(low), float(high), tuple(parts), counts)


def _of_classes(surface: SupportSurface, log_scale: np.ndarray) -> np.ndarray:
    """Return the likelihood (classes + 1, grid) of a surface, with the shares of the classes; the last is no class."""
    height, long, short = (log_scale + np.log(v) for v in (surface.height, surface.long, surface.short))
    rows = []
    for c in FURNITURE:
        part = norm.pdf(height, np.log(c.height_m), np.hypot(c.height_sigma, _MEASURED_SIGMA))
        part = part * norm.pdf(long, np.log(c.long_m), c.extent_sigma)
        rows.append(c.share * part * norm.pdf(short, np.log(c.short_m), c.extent_sigma))
    known = np.array(rows) / sum(c.share for c in FURNITURE)
    other = norm.pdf(long, np.log(_OTHER_LONG_M), _OTHER_EXTENT_SIGMA)
    other = other * norm.pdf(short, np.log(_OTHER_SHORT_M), _OTHER_EXTENT_SIGMA)
    other = other / np.log(_OTHER_HEIGHTS_M[1] / _OTHER_HEIGHTS_M[0])
    return np.concatenate([(1 - _OTHER_SHARE) * known, _OTHER_SHARE * other[None]])
