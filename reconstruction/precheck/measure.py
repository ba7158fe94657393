"""Measure a sampled film: every figure that the check judges."""

from dataclasses import dataclass

import numpy as np

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.poses.parallel import ordered_map
from reconstruction.precheck.coverage import Coverage, measure_coverage
from reconstruction.precheck.exposure import Exposure, measure_exposure
from reconstruction.precheck.sampling import Film, distinct_views, gray_of
from reconstruction.precheck.sharpness import edge_blur_px
from reconstruction.precheck.two_view import match_frames, measure_parallax
from reconstruction.world.config import WorldConfig
from reconstruction.world.markers import detect_markers
from reconstruction.world.samples import choose_frames

_GRID = 8  # cells along each side of a frame
_MARKER_FRAMES = 12


@dataclass(frozen=True)
class Figures:
    """The measured figures of a film; the arrays are by sampled frame."""

    views: int  # different views among the metered frames
    blur_px: np.ndarray  # at the edges, at the sampled size
    matches: np.ndarray  # inliers with the best neighbor
    spread: np.ndarray  # share of the cells of a grid that hold an inlier
    parallax_deg: np.ndarray  # largest over the frame's pairs, not explained by a rotation
    connected: float  # share of the frames in the largest connected part
    exposure: Exposure
    coverage: Coverage
    markers: tuple[int, ...]  # AprilTag ids seen in two or more frames

    def judged(self) -> dict[str, float]:
        """Return the scalar figures that limits exist for."""
        return {
            "views": float(self.views),
            "blur_px": float(np.median(self.blur_px)),
            "matches": float(np.median(self.matches)),
            "spread": float(np.median(self.spread)),
            "parallax_deg": float(np.median(self.parallax_deg)),
            "connected": self.connected,
            "bright": float(np.median(self.exposure.bright)),
            "clipped": float(np.median(self.exposure.clipped)),
            "drift_stops": self.exposure.drift_stops,
            "yaw_deg": self.coverage.yaw_deg,
        }


def measure_film(film: Film, progress: Progress = NO_PROGRESS) -> Figures:
    """Measure sharpness, parallax, overlap, exposure, directions and markers of a film."""
    progress.start(0, "matching frames")
    grays = [gray_of(image) for image in film.images]
    count = len(grays)
    size = (grays[0].shape[1], grays[0].shape[0])
    pairs = match_frames(film.images, ordered=film.fps > 0)
    parallax = measure_parallax(pairs, size, film.focal_prior_px)
    matches, spread, apart = np.zeros(count), np.zeros(count), np.zeros(count)
    for pair, degrees in zip(pairs, parallax.degrees):
        for row, points in zip(pair.rows, (pair.first, pair.second)):
            matches[row] = max(matches[row], len(points))
            spread[row] = max(spread[row], _spread(points, size))
            apart[row] = max(apart[row], degrees)
    coverage = measure_coverage(grays, pairs, film.focal_prior_px)
    progress.start(0, "looking for markers")
    return Figures(
        views=distinct_views(film),
        blur_px=np.array(list(ordered_map(edge_blur_px, grays))),
        matches=matches,
        spread=spread,
        parallax_deg=apart,
        connected=len(coverage.rows) / count if len(coverage.rows) > 1 else 0.0,
        exposure=measure_exposure(grays, pairs),
        coverage=coverage,
        markers=_markers(film),
    )


def _spread(points: np.ndarray, size: tuple[int, int]) -> float:
    cells = np.floor(points / np.array(size) * _GRID).astype(int).clip(0, _GRID - 1)
    return len(np.unique(cells[:, 0] * _GRID + cells[:, 1])) / _GRID**2


def _markers(film: Film) -> tuple[int, ...]:
    rows = choose_frames(len(film.images), _MARKER_FRAMES)
    seen = detect_markers(film.images, WorldConfig().marker_dictionaries[:1], rows)
    return tuple(sorted(marker for (_, marker), views in seen.items() if len(views) >= 2))
