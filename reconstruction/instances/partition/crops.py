"""Crops of keyframes around proposals: color, and maps of mask, surface and depth, for the network that scores them.

A proposal is shown as the keyframes that see most of it show it, in a square around it with some of what is beside it.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import csr_matrix

from reconstruction.instances.partition.features import View
from reconstruction.poses.parallel import ordered_map

SIZE_PX = 96  # side of a crop's color
GRID = 24  # side of its maps
MAPS = ("inside", "other_thing", "nothing", "border", "normal_x", "normal_y", "normal_z", "depth")
SCALARS = ("log_size_m", "log_px", "cut_off", "log_shown", "filled", "depth_m")
VIEWS = 3  # keyframes of each proposal, those that show most of it
_AROUND = 1.5  # side of the crop over the longer side of the proposal's box
_LEAST_SIDE = 15  # least side of a crop, in pixels of id maps
_LEAST_PX = 12  # of a proposal in every keyframe but the best, in pixels of id maps
_FINE = 2 * GRID  # maps are drawn at this side and averaged
_BLANK = (127, 127, 127)  # color outside of the keyframe
_FULL = 127  # integer of the value 1 in the maps


@dataclass(frozen=True)
class Crops:
    """Crops of m proposals, those of each in a row."""

    color: np.ndarray  # uint8 (k, SIZE_PX, SIZE_PX, 3) RGB
    maps: np.ndarray  # int8 (k, len(MAPS), GRID, GRID) of -1 to 1 in steps of 1 / 127
    scalars: np.ndarray  # float32 (k, len(SCALARS))
    proposal: np.ndarray  # int64 (k,) row of the members


def crops_of(view: View, region: np.ndarray, members: csr_matrix, rows: np.ndarray) -> Crops:
    """Return crops of proposals.

    Args:
        view: the surface and its keyframes.
        region: int (v,) cluster of each vertex; numbers from n on are no clusters of things.
        members: (m, n) 1 = the cluster is in the proposal.
        rows: int (r,) proposals to show, ascending.
    """
    count = members.shape[1]  # pyright: ignore[reportOptionalSubscript]
    sheets = [_Sheet.of(view, k, region, count) for k in range(len(view.frames))]
    shown = (
        members[rows] @ np.stack([s.pixels for s in sheets], axis=1) if sheets else np.zeros((len(rows), 0))
    )
    best = np.argsort(-shown, axis=1, kind="stable")[:, :VIEWS]

    def of(k: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        own = members.indices[members.indptr[rows[k]] : members.indptr[rows[k] + 1]]
        frames = [f for n, f in enumerate(best[k]) if shown[k, f] >= (1 if n == 0 else _LEAST_PX)]
        return [sheets[f].crop(own, float(shown[k, f])) for f in frames]

    every = list(ordered_map(of, range(len(rows))))
    flat = [crop for found in every for crop in found]
    proposal = np.repeat(rows, [len(found) for found in every]).astype(np.int64)
    if not flat:
        return Crops(
            np.zeros((0, SIZE_PX, SIZE_PX, 3), np.uint8), np.zeros((0, len(MAPS), GRID, GRID), np.int8),
            np.zeros((0, len(SCALARS)), np.float32), proposal,
        )  # fmt: skip
    color, maps, scalars = (np.stack(part) for part in zip(*flat))
    return Crops(color, maps, scalars, proposal)


@dataclass(frozen=True)
class _Sheet:
    """One keyframe to cut crops from; maps have half the keyframe's resolution."""

    color: list[np.ndarray]  # uint8 (h, w, 3), then at a half, a quarter, ... of the resolution
    ids: np.ndarray  # float32 (h / 2, w / 2) cluster of each pixel, n = other surface, n + 1 = nothing
    shape: np.ndarray  # float32 (h / 2, w / 2, 4) normal in the camera's frame, depth in metres; 0 = nothing
    pixels: np.ndarray  # int (n,) of each cluster
    low: np.ndarray  # int (n, 2) column and row of each cluster's box
    high: np.ndarray  # int (n, 2) first column and row beyond it
    focal: float  # of the maps, pixels

    @classmethod
    def of(cls, view: View, number: int, region: np.ndarray, count: int) -> "_Sheet":
        frame = view.frames[number]
        there, vertex = frame.vertex >= 0, np.maximum(frame.vertex, 0)
        ids = np.where(there, np.minimum(region[vertex], count), count + 1)
        shape = np.zeros((*ids.shape, 4), np.float32)
        shape[..., :3] = view.mesh.normals[vertex] @ frame.camera_from_world[:3, :3].T
        shape[..., 3] = frame.drawn[::2, ::2]
        shape[~there] = 0
        low, high = np.full((count, 2), max(ids.shape)), np.zeros((count, 2), np.int64)
        row, column = np.nonzero(ids < count)
        own, at = ids[row, column], np.stack([column, row], axis=1)
        np.minimum.at(low, own, at)
        np.maximum.at(high, own, at + 1)
        pixels = np.bincount(own, minlength=count)
        return cls(
            list(_pyramid(frame.picture)),
            ids.astype(np.float32),
            shape,
            pixels,
            low,
            high,
            0.5 * frame.camera.fx,
        )

    def crop(self, own: np.ndarray, shown: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return color, maps and scalars of a set of clusters that this keyframe shows with a number of pixels."""
        low, high = self.low[own].min(axis=0), self.high[own].max(axis=0)
        side = max(float((high - low).max() * _AROUND), _LEAST_SIDE)
        corner = 0.5 * (low + high) - 0.5 * side
        nothing = len(self.pixels) + 1
        level = min(int(np.log2(max(2 * side / SIZE_PX, 1.0))), len(self.color) - 1)
        color = _cut(self.color[level], corner, side, SIZE_PX, 2.0 / 2**level, cv2.INTER_LINEAR, _BLANK)
        ids = _cut(self.ids, corner, side, _FINE, 1.0, cv2.INTER_NEAREST, nothing).astype(np.int64)
        shape = _cut(self.shape, corner, side, _FINE, 1.0, cv2.INTER_NEAREST, 0)
        inside = np.isin(ids, own)
        measured = shape[..., 3] > 0
        depth = float(np.median(shape[..., 3][inside & measured])) if (inside & measured).any() else 1.0
        size_m = side * depth / self.focal
        away = np.where(measured, np.clip((shape[..., 3] - depth) / max(size_m, 0.02), -1, 1), 0)
        flags = [
            2.0 * x - 1.0 for x in (inside, (ids < nothing - 1) & ~inside, ids == nothing, _borders(ids))
        ]
        fine = np.stack([*flags, *np.moveaxis(shape[..., :3], -1, 0), away])
        maps = fine.reshape(len(MAPS), GRID, 2, GRID, 2).mean(axis=(2, 4))
        h, w = self.ids.shape
        cut_off = bool((low <= 1).any() or high[0] >= w - 1 or high[1] >= h - 1)
        scalars = [
            np.log(max(size_m, 0.01)), np.log(2 * side / SIZE_PX), cut_off, np.log1p(shown),
            shown / float(np.prod(high - low)), depth,
        ]  # fmt: skip
        return color, np.round(maps * _FULL).astype(np.int8), np.array(scalars, np.float32)


def _pyramid(picture: np.ndarray) -> Iterator[np.ndarray]:
    yield picture
    while min(picture.shape[:2]) > SIZE_PX:
        h, w = picture.shape[:2]
        picture = cv2.resize(picture, (-(-w // 2), -(-h // 2)), interpolation=cv2.INTER_AREA)
        yield picture


def _cut(
    image: np.ndarray, corner: np.ndarray, side: float, size: int, scale: float, sampling: int, beyond
) -> np.ndarray:
    """Return a square of an image as (size, size, ...).

    Args:
        image: (h, w, ...).
        corner: column and row of the square's corner.
        side: of the square.
        size: of the result.
        scale: pixels of the image in a unit of `corner` and `side`.
        sampling: OpenCV's interpolation.
        beyond: value outside of the image.
    """
    step = size / (side * scale)
    shift = 0.5 * step - 0.5 - corner * scale * step
    image_to_crop = np.array([[step, 0, shift[0]], [0, step, shift[1]]])
    value = beyond if isinstance(beyond, tuple) else (beyond,) * 4
    return cv2.warpAffine(
        image, image_to_crop, (size, size), flags=sampling, borderMode=cv2.BORDER_CONSTANT, borderValue=value
    )


def _borders(ids: np.ndarray) -> np.ndarray:
    """Return which pixels (h, w) have another id to the right, to the left, above or below."""
    out = np.zeros(ids.shape, bool)
    down, right = ids[1:] != ids[:-1], ids[:, 1:] != ids[:, :-1]
    out[1:] |= down
    out[:-1] |= down
    out[:, 1:] |= right
    out[:, :-1] |= right
    return out
