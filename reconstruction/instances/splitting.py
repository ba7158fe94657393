"""Cut touching things apart where a concave crease and a change of color agree; prefer to leave them whole.

A label on a can has another color but no crease; the inside of a bowl has creases but one color: neither is cut.
"""

from heapq import heappop, heappush

import numpy as np

from reconstruction.instances.colors import LIGHTNESS_WEIGHT
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.convexity import MIN_BULGE, bulge, is_within
from reconstruction.instances.patches import Contacts, contacts_of, crease_patches, palette
from reconstruction.surface.mesh_graph import MeshGraph

_SHORT_M = 0.03  # borders shorter than this count for less
_STEEP_DEG = 85.0  # a crease cannot be more than a right angle's worth of evidence
_VIVID = 50.0  # nor a gap of colors more than this
_GROUND_M = 0.03  # how far above the ground of the whole a part that stands on it may begin
_LIES_SHARE = 0.3  # of a part's border along which a neighbor faces up, if it lies on that
_PALETTE = 24
_MIN_COLOR_SHARE = 0.05  # of a region: colors it has less of are strays


def split_touching(graph: MeshGraph, body: np.ndarray, config: InstancesConfig) -> list[np.ndarray]:
    """Split vertices `body` (sorted indices) into one or more parts, the largest first."""
    if len(body) < 4 * config.min_object_vertices:
        return [body]
    patch, links = crease_patches(graph, body)
    if patch.max() == 0:
        return [body]
    regions = Regions(graph, body, patch, contacts_of(graph, body, links, patch), config)
    regions.merge_alike()
    regions.merge_no_things()
    parts = [body[regions.label == i] for i in np.unique(regions.label)]
    return sorted(parts, key=lambda part: (-graph.areas[part].sum(), part[0]))


class Regions:
    """Patches of one body, merged step by step; what was measured of them and along their borders adds up."""

    def __init__(
        self,
        graph: MeshGraph,
        body: np.ndarray,
        patch: np.ndarray,
        contacts: Contacts,
        config: InstancesConfig,
    ) -> None:
        """Begin with every patch a region of its own."""
        self.graph, self.body, self.config = graph, body, config
        self.label = patch.copy()
        areas = graph.areas[body]
        self.area = np.bincount(patch, weights=areas)
        nearest, means = palette(graph.lab[body] * LIGHTNESS_WEIGHT, _PALETTE, 4.0)
        self.color_gaps = np.linalg.norm(means[:, None] - means[None], axis=2)
        count = len(self.color_gaps)
        flat = np.bincount(patch * count + nearest, weights=areas, minlength=len(self.area) * count)
        self.colors = flat.reshape(-1, count)  # area of each color
        # (a, b) with a < b -> length, length * bend, length * color, length where a, where b faces up
        self.border = {
            (int(a), int(b)): length * np.array([1.0, bend, color, *level])
            for (a, b), length, bend, color, level in zip(
                contacts.pairs, contacts.length_m, contacts.bend_deg, contacts.color, contacts.level
            )
        }
        self.neighbors: dict[int, set[int]] = {int(k): set() for k in np.unique(patch)}
        self.perimeter = np.zeros(len(self.area))
        for (a, b), sums in self.border.items():
            self.neighbors[a].add(b)
            self.neighbors[b].add(a)
            self.perimeter[[a, b]] += sums[0]

    def facts(self, pair: tuple[int, int]) -> tuple[float, float, float]:
        """Return the length in metres, mean bend in degrees and color gap of the border of two regions."""
        length, bend, color = self.border[pair][:3]
        small, large = sorted(pair, key=lambda k: (self.area[k], k))
        common = self.colors[large] > _MIN_COLOR_SHARE * self.area[large]
        foreign = self.color_gaps[:, common].min(axis=1) if common.any() else np.zeros(len(self.color_gaps))
        gap = float(self.colors[small] @ foreign) / max(self.area[small], 1e-12)
        return float(length), float(bend / length), max(float(color / length), gap)

    def separateness(self, pair: tuple[int, int]) -> float:
        """Return how surely two neighbors are two things: 1 and more is enough to cut."""
        length, bend, color = self.facts(pair)
        crease = np.clip(bend, 0.0, _STEEP_DEG) / self.config.split_angle_deg
        contrast = np.clip(color, 0.0, _VIVID) / self.config.split_color_contrast
        both = crease * contrast if min(crease, contrast) > 0.35 else 0.0
        return float(both * min(1.0, length / _SHORT_M))

    def likeness(self, pair: tuple[int, int]) -> float:
        """Return how much two neighbors look like one thing: smooth, of one color, with a long common border."""
        length, bend, color = self.facts(pair)
        around = max(min(self.perimeter[pair[0]], self.perimeter[pair[1]]), 1e-9)
        return float(np.sqrt(length / around) * np.exp(-bend / 20.0) / (color + 8.0))

    def merge(self, pair: tuple[int, int]) -> None:
        """Join the second region of a pair into the first."""
        keep, gone = pair
        self.label[self.label == gone] = keep
        self.area[keep] += self.area[gone]
        self.colors[keep] += self.colors[gone]
        self.perimeter[keep] += self.perimeter[gone] - 2.0 * self.border.pop(pair)[0]
        self.neighbors[keep].discard(gone)
        for third in self.neighbors.pop(gone) - {keep}:
            sums = self.border.pop((min(gone, third), max(gone, third)))
            key = (min(keep, third), max(keep, third))
            if (gone < third) != (keep < third):
                sums = sums[[0, 1, 2, 4, 3]]
            self.border[key] = self.border.get(key, np.zeros(5)) + sums
            self.neighbors[third].discard(gone)
            self.neighbors[third].add(keep)
            self.neighbors[keep].add(third)

    def merge_alike(self) -> None:
        """Merge what looks most like one thing until all that are left are separate; small patches go first."""
        small_m2 = 0.3 * self.config.min_object_area_m2
        changed = np.zeros(len(self.area), np.int64)
        queue: list[tuple] = []

        def put(pair: tuple[int, int]) -> None:
            tiny = bool(self.area[list(pair)].min() < small_m2)
            if tiny or self.separateness(pair) < 1.0:
                heappush(queue, (not tiny, -self.likeness(pair), pair, *changed[list(pair)]))

        for pair in self.border:
            put(pair)
        while queue:
            _, _, pair, *seen = heappop(queue)
            if pair not in self.border or list(changed[list(pair)]) != seen:
                continue  # one of the two has grown since
            self.merge(pair)
            keep = pair[0]
            changed[keep] += 1
            for third in sorted(self.neighbors[keep]):
                put((min(keep, third), max(keep, third)))

    def merge_no_things(self) -> None:
        """Give regions that are no things back to the neighbor that they look most like, the smallest first."""
        while True:
            for region in sorted(self.neighbors, key=lambda k: (self.area[k], k)):
                around = [(min(region, k), max(region, k)) for k in sorted(self.neighbors[region])]
                if around and not self._may_be_a_thing(region):
                    self.merge(max(around, key=lambda p: (self.likeness(p), -p[0], -p[1])))
                    break
            else:
                return

    def _may_be_a_thing(self, region: int) -> bool:
        """A thing is large enough, and stands on the ground of the whole or lies on a neighbor: no handle does."""
        points = self.graph.points[self.body[self.label == region]]
        if self.area[region] < self.config.min_object_area_m2:
            return False
        if np.sort(np.ptp(points, axis=0))[1] < self.config.min_object_m:
            return False
        chosen = self.body[self.label == region]
        around = [self.body[self.label == k] for k in sorted(self.neighbors[region])]
        if bulge(self.graph, chosen) < MIN_BULGE and any(is_within(self.graph, chosen, k) for k in around):
            return False  # the bottom or the inside of a container
        level = sum(
            self.border[region, k][4] if region < k else self.border[k, region][3]
            for k in sorted(self.neighbors[region])
        )
        low = points[:, 2].min() < self.graph.points[self.body, 2].min() + _GROUND_M
        return low or bool(level > _LIES_SHARE * self.perimeter[region])
