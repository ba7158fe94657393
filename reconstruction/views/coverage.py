"""Bookkeeping of what views have shown of a target: of its Gaussians, and of its closed shape."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

LEAST_PX = 0.05  # smallest contribution of a Gaussian, in pixels, that counts as a view of it
_SEEN_AT = 0.1  # share of its largest contribution at which a Gaussian counts as seen
_CLEAR_SHARE = 0.2  # share of a Gaussian's weight that decays only with its full contribution
_CLOSED = 0.4  # weight of the closed shape; the rest is that of the Gaussians
_REVISIONS, _LEAST_REVISION = 2, 1e-4  # passes over the chosen views; smallest improvement of an exchange


class Coverage:
    """Remaining effective opacities of the target's Gaussians, which decay with each view that shows them.

    Each Gaussian has a front, which frames saw, and a back with less weight, which shows through unseen sides. A view
    shows a side by its rendered contribution relative to the largest contribution at any start. A tenth of it counts as
    seen; a fifth of the weight remains until a view is as good as the best.
    """

    def __init__(self, opacities: np.ndarray, most: np.ndarray, back_weight: float) -> None:
        """Start with nothing seen.

        Args:
            opacities: (m,) of the target's Gaussians.
            most: (2, m) largest contributions of fronts and backs, sums over pixels of alpha T; sides below LEAST_PX do
                not count.
            back_weight: weight of backs relative to fronts.
        """
        sides = np.where(most > LEAST_PX, np.array([[1.0], [back_weight]]), 0.0)
        self._opacities = np.asarray(opacities, np.float64) * sides
        self._total = max(float(self._opacities.sum()), 1e-12)
        self._sides, self._most = sides, np.maximum(most, LEAST_PX)
        self._unseen, self._unclear = np.ones(most.shape), np.ones(most.shape)

    @property
    def left(self) -> np.ndarray:
        """Remaining share (2, m) of each side."""
        return (1.0 - _CLEAR_SHARE) * self._unseen + _CLEAR_SHARE * self._unclear

    @property
    def worth(self) -> np.ndarray:
        """Remaining share (2, m) of each side, times the weight of the side."""
        return self._sides * self.left

    @property
    def remaining(self) -> float:
        """Remaining share of the target's total opacity."""
        return float((self._opacities * self.left).sum()) / self._total

    def gain(self, contributions: np.ndarray) -> float:
        """Return the share of the total opacity that a view with these contributions (2, m) newly shows."""
        return self.remaining - self.after(contributions).remaining

    def after(self, contributions: np.ndarray) -> "Coverage":
        """Return the coverage after a view with these contributions (2, m)."""
        out = copy(self)
        unseen, unclear = self.decays(contributions)
        out._unseen, out._unclear = self._unseen * unseen, self._unclear * unclear
        return out

    def decays(self, contributions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the factors (..., 2, m) on the unseen and the unclear share after views with these contributions."""
        share = contributions / self._most
        return 1.0 - np.clip(share / _SEEN_AT, 0.0, 1.0), 1.0 - np.clip(share, 0.0, 1.0)

    @property
    def shares(self) -> np.ndarray:
        """Share (2, m) of each side in the total opacity."""
        return self._opacities / self._total


@dataclass(frozen=True)
class Unseen:
    """The unseen part of a target: of its Gaussians, and of the surface of its closed shape.

    Gaussians measure how well a view shows seen surface; the closed shape stands for surface that no frame saw. Points
    that no start sees do not count.
    """

    coverage: Coverage
    points: np.ndarray  # float64 (n,) remaining shares of the closed shape's surface

    @classmethod
    def of(cls, coverage: Coverage, areas: np.ndarray, sights: np.ndarray) -> "Unseen":
        """Return the state before the first view.

        Args:
            coverage: of the Gaussians.
            areas: (n,) of the closed shape's points.
            sights: (k, n) visibility of the points from every start, in [0, 1].
        """
        points = areas * (sights > 0.0).any(axis=0)
        return cls(coverage, points / max(float(points.sum()), 1e-12))

    @property
    def remaining(self) -> float:
        """Remaining share of the target."""
        return (1.0 - _CLOSED) * self.coverage.remaining + _CLOSED * float(self.points.sum())

    def gain(self, contributions: np.ndarray, sight: np.ndarray) -> float:
        """Return the share that a view with contributions (2, m) and visibilities (n,) newly shows."""
        return self.remaining - self.after(contributions, sight).remaining

    def worth_of(self, shown: np.ndarray, sights: np.ndarray) -> np.ndarray:
        """Return the normalized gain (k,) of views with contributions (k, 2, m) and visibilities (k, n)."""
        gains = np.array([self.coverage.gain(contributions) for contributions in shown])
        closed = np.einsum("kn,n->k", sights, self.points)
        return (1.0 - _CLOSED) * gains / max(gains.max(), 1e-9) + _CLOSED * closed / max(closed.max(), 1e-9)

    def revised(self, chosen: Sequence[int], shown: np.ndarray, sights: np.ndarray) -> list[int]:
        """Improve greedily chosen views by exchange: replace each in turn by the best candidate given the others.

        Args:
            chosen: rows of the chosen views.
            shown: (k, 2, m) contributions of all candidates.
            sights: (k, n) visibilities of the closed shape's points from all candidates.
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
        """Return the state after a view with contributions (2, m) and visibilities (n,)."""
        return replace(self, coverage=self.coverage.after(contributions), points=self.points * (1.0 - sight))
