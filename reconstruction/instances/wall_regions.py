"""Regions of a wall's picture that are no paint: closed, of another color, with a sharp and simple outline."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.wall_pictures import WallPicture

_NOISE = 3.5  # times the wall's own spread of color is no paint
_PAINT = 12.0  # what differs more from place to place is no painted wall: tiles, curtains, a full shelf
_GROUND_M, _COARSER = 0.35, 4  # over which the wall's light changes; its cells, of the picture's
_CLOSE_M, _OPEN_M = 0.025, 0.04  # gaps within a picture; leaves of a wallpaper

MIN_SIDE_M, _MIN_LONG_M = 0.08, 0.15  # of what hangs on a wall: a switch is smaller
_CORE_SHARE = 0.6  # of the widest disc within a region
_SHARP = 2.2  # CIELAB a cell: shadows and blotches change more slowly
_ALL_SHARP, _MOST_SHARP, _JUDGED = (
    0.85,
    0.7,
    0.35,
)  # of an outline; how much of it must not be at the pictures' edge
_ABOVE_FLOOR_M = 0.2
_SOLID, _TILTED, _BEHIND = 0.85, 0.8, 0.15
_GAP_M, _RING_M = 0.04, 0.12  # around a region, both sides together
_BARE, _LIT = 0.75, 0.4  # of that
_SLIM, _SLIM_SOLID = 2.5, 0.45  # width to height; the brackets of a shelf leave much of its outline free
_DARKEST, _SHADE_CHROMA = 0.45, 0.6


@dataclass(frozen=True)
class Ground:
    """The wall itself: its color everywhere, and how far from that is another thing."""

    lab: np.ndarray  # float32 (h, w, 3)
    plain: np.ndarray  # bool (h, w) where the wall shows
    limit: float

    @staticmethod
    def of(lab: np.ndarray, seen: np.ndarray, cell_m: float, config: InstancesConfig) -> "Ground":
        """Follow the wall's color, whose light changes slowly, leaving out what stands out from it."""
        size = (max(lab.shape[1] // _COARSER, 1), max(lab.shape[0] // _COARSER, 1))
        small = cv2.resize(
            np.where(seen[..., None], lab, 0).astype(np.float32), size, interpolation=cv2.INTER_AREA
        )
        share = cv2.resize(seen.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        small /= np.maximum(share, 1e-6)[..., None]
        known = share > 0.5
        around = np.median(small[known], axis=0) if known.any() else np.zeros(3)
        local = np.broadcast_to(around, small.shape).astype(np.float32)
        sigma = _GROUND_M / (_COARSER * cell_m)
        plain = known
        for _ in range(4):
            away = np.linalg.norm(small - local, axis=-1)
            plain = known & (away < max(6.0, 2.5 * float(np.median(away[known])) if known.any() else 0.0))
            weight = cv2.GaussianBlur(plain.astype(np.float32), (0, 0), sigma) + 1e-6
            blurred = cv2.GaussianBlur(small * plain[..., None].astype(np.float32), (0, 0), sigma)
            local = (blurred + 1e-6 * around.astype(np.float32)) / weight[..., None]
        local = cv2.resize(local, lab.shape[1::-1], interpolation=cv2.INTER_LINEAR)
        away = np.linalg.norm(lab - local, axis=-1)
        noise = float(np.median(away[seen])) / 0.8 if seen.any() else 0.0
        limit = max(config.wall_color_contrast, _NOISE * noise)
        return Ground(local, seen & (away < limit), limit)


@dataclass(frozen=True)
class Region:
    """One closed region of a wall's picture."""

    mask: np.ndarray  # bool (h, w)
    shaded: bool  # what is only darker than the wall is part of it
    slim: bool  # a board, perhaps, with what carries it


def find_regions(picture: WallPicture, config: InstancesConfig) -> tuple[Ground, list[Region]]:
    """Return what may hang on a wall, the largest first, and the wall itself."""
    seen = (picture.seen >= 2) & ~picture.hidden
    lab = picture.median()
    ground = Ground.of(lab, seen, picture.cell_m, config)
    if ground.limit > _PAINT:
        return ground, []
    slope = slopes(lab, seen)
    everywhere = np.s_[:, :]
    found: list[Region] = []
    taken = np.zeros(seen.shape, bool)
    for shaded, share in ((True, _ALL_SHARP), (False, _MOST_SHARP)):
        for whole in _parts(
            apart(lab, seen, ground, picture.cell_m, everywhere, shaded=shaded), picture.cell_m
        ):
            slim = not shaded and _is_slim(whole)
            mask = whole if slim else core(whole)
            if (mask & taken).any() or not _sharp(mask, slope, seen, share):
                continue
            alone = _is_alone(mask, lab, seen, ground, picture, shaded=shaded)
            if alone and _is_simple(mask, picture, _SLIM_SOLID if slim else _SOLID):
                found.append(Region(mask, shaded, slim))
                taken |= mask
    return ground, sorted(found, key=lambda r: -int(r.mask.sum()))


def _parts(mask: np.ndarray, cell_m: float) -> list[np.ndarray]:
    """Return the connected parts that are large enough for a thing."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    large = np.minimum(stats[:, 2], stats[:, 3]) * cell_m >= MIN_SIDE_M * 0.6
    large &= np.maximum(stats[:, 2], stats[:, 3]) * cell_m >= _MIN_LONG_M
    return [labels == k for k in range(1, count) if large[k]]


def core(mask: np.ndarray) -> np.ndarray:
    """Return the largest piece of a mask that a disc nearly as wide as it reaches: leaves that touch it go."""
    padded = np.pad(mask.astype(np.uint8), 1)
    across = 2.0 * float(cv2.distanceTransform(padded, cv2.DIST_L2, 5).max())
    cells = max(int(_CORE_SHARE * across), 1)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (cells, cells))
    opened = cv2.morphologyEx(padded, cv2.MORPH_OPEN, kernel)[1:-1, 1:-1]
    count, labels, stats, _ = cv2.connectedComponentsWithStats(opened)
    return labels == 1 + int(np.argmax(stats[1:, 4])) if count > 1 else mask


def _sharp(mask: np.ndarray, slope: np.ndarray, seen: np.ndarray, share: float) -> bool:
    """Tell whether so much of a region's outline is sharp; shadows and light are not."""
    line = outline(mask)
    inner = cv2.erode(seen.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    judged = line & inner
    if judged.sum() < _JUDGED * line.sum():
        return False
    return bool((slope[judged] > _SHARP).mean() >= share)


def outline(mask: np.ndarray) -> np.ndarray:
    """Return the cells of a mask's border, bool (h, w)."""
    return mask & ~(cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0)


def _is_alone(
    mask: np.ndarray, lab: np.ndarray, seen: np.ndarray, ground: Ground, picture: WallPicture, *,
    shaded: bool,
) -> bool:  # fmt: skip
    """Tell whether there is plain wall all around a region, as far as the pictures show: stripes have others beside."""
    near, far = (cv2.dilate(mask.astype(np.uint8), _disc(m, picture.cell_m)) > 0 for m in (_GAP_M, _RING_M))
    ring = far & ~near & (seen | picture.hidden)
    if not ring.any():
        return False
    plain = ground.plain & ring
    bare = (plain | (_shade(lab, ground.lab, ground.limit) & seen & ring)) if not shaded else plain
    return bool(bare.sum() > _BARE * ring.sum() and plain.sum() > _LIT * ring.sum())


def _is_slim(mask: np.ndarray) -> bool:
    rows, columns = np.nonzero(mask)
    return bool(np.ptp(columns) + 1 > _SLIM * (np.ptp(rows) + 1))


def _is_simple(mask: np.ndarray, picture: WallPicture, solid: float) -> bool:
    """Tell whether a region is bulging, upright, above the floor, and not what is behind a thing."""
    rows, columns = np.nonzero(mask)
    if picture.top - (rows.max() + 1) * picture.cell_m < _ABOVE_FLOOR_M:
        return False
    cells = np.column_stack([columns, rows]).astype(np.int32)
    hull = cv2.convexHull(cells)
    around = cv2.contourArea(hull) + 0.5 * cv2.arcLength(hull, True) + 1
    _, sides, _ = cv2.minAreaRect(cells)
    upright = float(np.ptp(rows) + 1) * float(np.ptp(columns) + 1)
    tilted = (sides[0] + 1) * (sides[1] + 1) < _TILTED * upright
    line = outline(mask)
    near = cv2.dilate(picture.hidden.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    return bool(mask.sum() > solid * around and not tilted and (line & near).sum() < _BEHIND * line.sum())


def apart(
    lab: np.ndarray, seen: np.ndarray, ground: Ground, cell_m: float, where: tuple[slice, slice], *, shaded: bool,
) -> np.ndarray:  # fmt: skip
    """Return bool (h, w), for a part of a wall: what has another color than the wall, closed, filled, without specks.

    Args:
        lab: colors float32 (h, w, 3) of that part, smoothed as a picture's are.
        seen: bool (h, w) where they are known.
        ground: the whole wall's.
        cell_m: size of a cell.
        where: the part.
        shaded: whether what is only darker than the wall counts.
    """
    local, plain = ground.lab[where], ground.plain[where] & seen
    offset = np.median((lab - local)[plain], axis=0) if plain.sum() > 50 else np.zeros(3, np.float32)
    local = local + offset
    away = np.linalg.norm(lab - local, axis=-1)
    other = seen & (away > ground.limit)
    if not shaded:
        other &= ~_shade(lab, local, ground.limit)
    other = other.astype(np.uint8)
    closed = cv2.morphologyEx(other, cv2.MORPH_CLOSE, _disc(_CLOSE_M, cell_m)) > 0
    filled = ndimage.binary_fill_holes(closed & seen)
    # what was not seen takes nothing away from what ends there
    opened = cv2.morphologyEx((filled | ~seen).astype(np.uint8), cv2.MORPH_OPEN, _disc(_OPEN_M, cell_m)) > 0
    return opened & seen & filled


def _shade(lab: np.ndarray, ground: np.ndarray, limit: float) -> np.ndarray:
    """Return where a color is the wall's with less light, bool (h, w)."""
    light = lab[..., 0] / np.maximum(ground[..., 0], 1e-3)
    chroma = np.linalg.norm(lab[..., 1:] - ground[..., 1:] * np.minimum(light, 1.0)[..., None], axis=-1)
    return (light > _DARKEST) & (light < 1.0) & (chroma < _SHADE_CHROMA * limit)


def _disc(size_m: float, cell_m: float) -> np.ndarray:
    cells = max(round(size_m / cell_m), 1)
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (cells, cells))


def slopes(lab: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return how fast colors change, float32 (h, w), in CIELAB a cell, the most of the cells around."""
    across = [cv2.Sobel(lab, cv2.CV_32F, *d, ksize=3, scale=0.125) for d in ((1, 0), (0, 1))]
    slope = np.sqrt((across[0] ** 2).sum(axis=-1) + (across[1] ** 2).sum(axis=-1))
    inner = cv2.erode(seen.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return cv2.dilate(np.where(inner, slope, 0).astype(np.float32), np.ones((5, 5), np.uint8))
