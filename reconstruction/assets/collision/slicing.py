"""Cuts at the heights of a solid's level faces: boards, floors of containers, undersides of table tops.

Furniture falls into slabs, legs and panels, which are convex, a container into its floor and the ring of its walls.
Carrying surfaces stay level.
"""

import numpy as np

from reconstruction.assets.solid import Solid, from_manifold, manifold_of

_LEVEL = 0.97  # least z of a level face's normal
_LEVEL_SHARE, _LEVEL_MIN_M2 = (
    0.12,
    4e-4,
)  # least area of level faces at a cut: of the bounding rectangle, absolute
_NOISE_M, _APART_M = 0.003, 0.004  # height range of one level; least distance between levels
_OUTER_SHARE, _OFF_M = 0.8, 0.0002  # share of a level's area inside its cut; distance of the cut beyond that
_CARRYING_APART_M, _LOWEST_M = 0.02, 0.008  # least distance between contacts; least height of a contact
_MAX_LEVELS = 12
_CRUMB_SHARE = 0.002  # of the solid's volume: smaller pieces are crumbs
_BUMP_M = 0.012  # lower pieces right above a carrying level are crumbs, too: noise of its surface


def sliced(solid: Solid, carrying: tuple[float, ...]) -> tuple[list[Solid], list[Solid]]:
    """Cut a solid into layers.

    Args:
        solid: closed.
        carrying: heights of children's contacts.

    Returns:
        The bodies of all layers, and crumbs; the solid alone where there is nothing to cut.
    """
    heights: dict[float, bool] = {}
    low, high = float(solid.vertices[:, 2].min()), float(solid.vertices[:, 2].max())
    for height in sorted(carrying):
        inside = low + _LOWEST_M < height < high - 0.001
        if inside and all(abs(height - other) > _CARRYING_APART_M for other in heights):
            heights[height] = True
    for height in own_levels(solid):
        if all(abs(height - other) > _APART_M for other in heights):
            heights[height] = False
    body = manifold_of(solid) if heights else None
    if body is None:
        return [solid], []
    pieces: list[Solid] = []
    crumbs: list[Solid] = []
    on_carrying = False
    for height in [*sorted(heights), None]:
        below = body
        if height is not None:
            body, below = body.split_by_plane((0.0, 0.0, 1.0), height)
        for part in below.decompose() if not below.is_empty() else []:
            made = from_manifold(part)
            whole = made.volume > _CRUMB_SHARE * solid.volume and (
                made.extents[2] > _BUMP_M or not on_carrying
            )
            (pieces if whole else crumbs).append(made)
        on_carrying = height is not None and heights[height]
    return (pieces, crumbs) if pieces else ([solid], [])


def own_levels(solid: Solid) -> list[float]:
    """Return cut heights just above the upward and just below the downward level faces, without bottom and top."""
    corner = solid.vertices[solid.faces]
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(cross, axis=1) / 2
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    height = corner[:, :, 2].mean(axis=1)
    wanted = max(_LEVEL_SHARE * float(np.prod((high - low)[:2])), _LEVEL_MIN_M2)
    inside = (height > low[2] + _APART_M) & (height < high[2] - _APART_M)
    found: list[tuple[float, float]] = []
    for side in (1.0, -1.0):
        level = inside & (side * cross[:, 2] > 2 * _LEVEL * np.maximum(area, 1e-15))
        found += _plateaus(side * height[level], area[level], wanted, side)
    apart: list[float] = []
    for _, at in sorted(found, reverse=True)[:_MAX_LEVELS]:
        if all(abs(at - other) > _APART_M for other in apart):
            apart.append(at)
    return apart


def _plateaus(height: np.ndarray, area: np.ndarray, wanted: float, side: float) -> list[tuple[float, float]]:
    """Return area and cut height of each cluster of heights; cuts clear the faces, so that no film remains."""
    order = np.argsort(height, kind="stable")
    height, area = height[order], area[order]
    total = np.concatenate([[0.0], np.cumsum(area)])
    first = np.searchsorted(height, height - _NOISE_M, "left")
    until = np.searchsorted(height, height + _NOISE_M, "right")
    covered = total[until] - total[first]
    found: list[tuple[float, float]] = []
    taken = np.zeros(len(height), bool)
    for k in np.argsort(-covered, kind="stable"):
        if covered[k] < wanted:
            break
        if not taken[k]:
            near = slice(first[k], until[k])
            outer = np.quantile(height[near], _OUTER_SHARE, weights=area[near], method="inverted_cdf")
            found.append((float(covered[k]), float(side * (outer + _OFF_M))))
            taken |= np.abs(height - height[k]) <= 2 * _NOISE_M
    return found
