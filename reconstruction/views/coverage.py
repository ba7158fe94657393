"""What views have shown of a target so far: of its Gaussians, and of the closed shape that it probably has."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

LEAST_PX = 0.05  # of a Gaussian; less is never a good view of it
_SEEN_AT, _CLEAR_SHARE = 0.1, 0.2
_CLOSED = 0.4  # of what is left to see is the closed shape's, the rest the Gaussians'
_REVISIONS, _LEAST_REVISION = 2, 1e-4


class Coverage:
    """What is left of the target's effective opacities: alpha_i decays by what each view shows of it.

    A Gaussian has a front, which frames saw, and a back, which shows through sides that no frame saw: it stands for
    what is there, with less weight. What a view shows of a side is its rendered contribution beside the most that any
    start shows of it. A tenth of that counts as seen; a fifth of the weight waits for a view as good as the best.
    """

    def __init__(self, opacities: np.ndarray, most: np.ndarray, back_weight: float) -> None:
        """Start with nothing seen.

        Args:
            opacities: (m,) of the target's Gaussians.
            most: (2, m) the largest contributions of their fronts and backs, sums over pixels of alpha T; what cannot
                be seen does not count.
            back_weight: of backs beside fronts.
        """
        sides = np.where(most > LEAST_PX, np.array([[1.0], [back_weight]]), 0.0)
        self._opacities = np.asarray(opacities, np.float64) * sides
        self._total = max(float(self._opacities.sum()), 1e-12)
        self._sides, self._most = sides, np.maximum(most, LEAST_PX)
        self._unseen, self._unclear = np.ones(most.shape), np.ones(most.shape)

    @property
    def left(self) -> np.ndarray:
        """What is left of each side (2, m), as a share of its own."""
        return (1.0 - _CLEAR_SHARE) * self._unseen + _CLEAR_SHARE * self._unclear

    @property
    def worth(self) -> np.ndarray:
        """What is left of the effective opacity of each side (2, m), as a share of a front's."""
        return self._sides * self.left

    @property
    def remaining(self) -> float:
        """Share of the opacity that is left."""
        return float((self._opacities * self.left).sum()) / self._total

    def gain(self, contributions: np.ndarray) -> float:
        """Return the share of the opacity that a view with these contributions (2, m) shows anew."""
        return self.remaining - self.after(contributions).remaining

    def after(self, contributions: np.ndarray) -> "Coverage":
        """Return what is left after a view with these contributions (2, m)."""
        out = copy(self)
        unseen, unclear = self.decays(contributions)
        out._unseen, out._unclear = self._unseen * unseen, self._unclear * unclear
        return out

    def decays(self, contributions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what views with these contributions (..., 2, m) leave unseen of each side, and unclear."""
        share = contributions / self._most
        return 1.0 - np.clip(share / _SEEN_AT, 0.0, 1.0), 1.0 - np.clip(share, 0.0, 1.0)

    @property
    def shares(self) -> np.ndarray:
        """What each side (2, m) is of the opacity."""
        return self._opacities / self._total


@dataclass(frozen=True)
class Unseen:
    """What is left to see of a target: of its Gaussians, and of the surface of its closed shape.

    Gaussians tell how well a view shows what is there, but most of what no frame saw has none. What no start sees does
    not count.
    """

    coverage: Coverage
    points: np.ndarray  # float64 (n,) shares of the closed shape's surface that are left

    @classmethod
    def of(cls, coverage: Coverage, areas: np.ndarray, sights: np.ndarray) -> "Unseen":
        """Return what is left before the first view.

        Args:
            coverage: Of the Gaussians.
            areas: (n,) of the closed shape's points.
            sights: (k, n) how well every start sees them, in [0, 1].
        """
        points = areas * (sights > 0.0).any(axis=0)
        return cls(coverage, points / max(float(points.sum()), 1e-12))

    @property
    def remaining(self) -> float:
        """Share that is left."""
        return (1.0 - _CLOSED) * self.coverage.remaining + _CLOSED * float(self.points.sum())

    def gain(self, contributions: np.ndarray, sight: np.ndarray) -> float:
        """Return the share that a view with these contributions (2, m) and these sights (n,) shows anew."""
        return self.remaining - self.after(contributions, sight).remaining

    def worth_of(self, shown: np.ndarray, sights: np.ndarray) -> np.ndarray:
        """Return what each of some views (k,) shows anew, beside the most that any of them does."""
        gains = np.array([self.coverage.gain(contributions) for contributions in shown])
        closed = np.einsum("kn,n->k", sights, self.points)
        return (1.0 - _CLOSED) * gains / max(gains.max(), 1e-9) + _CLOSED * closed / max(closed.max(), 1e-9)

    def revised(self, chosen: Sequence[int], shown: np.ndarray, sights: np.ndarray) -> list[int]:
        """Return views that leave less to see together: one after the other is changed for the best beside the rest.

        Args:
            chosen: rows of the views that were found one by one.
            shown: (k, 2, m) contributions of all that could be chosen.
            sights: (k, n) of the closed shape's points, alike.
        """
        out = list(chosen)
        unseen, unclear = self.coverage.decays(shown)
        hidden, weights = 1.0 - sights, self.coverage.shares
        for _ in range(_REVISIONS):
            before = list(out)
            for place in range(len(out)):
                rest = out[:place] + out[place + 1 :]
                seen, clear = weights * unseen[rest].prod(axis=0), weights * unclear[rest].prod(axis=0)
                gaussians = np.einsum("ksm,sm->k", unseen, seen) + np.einsum("ksm,sm->k", unclear, clear)
                closed = np.einsum("kn,n->k", hidden, self.points * hidden[rest].prod(axis=0))
                left = 0.5 * (1.0 - _CLOSED) * gaussians + _CLOSED * closed
                best = int(np.argmin(left))
                if left[best] < left[out[place]] - _LEAST_REVISION:
                    out[place] = best
            if out == before:
                break
        return out

    def after(self, contributions: np.ndarray, sight: np.ndarray) -> "Unseen":
        """Return what is left after a view."""
        return replace(self, coverage=self.coverage.after(contributions), points=self.points * (1.0 - sight))
