"""Crops of a dataset as training samples: costs, color, true place in bins, true ids, augmented."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reconstruction.depth.aggregation import place_of_depth
from reconstruction.depth.channels import BINS

ARRAYS = {
    "color": "uint8 (n, h, w, 3) keyframes at sweep resolution",
    "cost": "uint8 (n, h, w, 48) least cost inside each bin, 127 * (1 - correlation), far to near",
    "smoothed": "uint8 (n, h, w, 48) what semi-global aggregation says of each bin, 255 for the winner",
    "winner": "float32 (n, h, w) depth by semi-global aggregation, the hand-made way",
    "true_depth": "float32 (n, h, w) z-depth in metres, 0 = nothing",
    "true_ids": "uint16 (n, h, w) entities, 0 = nothing",
    "picture": "uint8 (n, H, W, 3) keyframes at depth resolution",
    "depth": "float16 (n, H, W) the pipeline's depth before mending, 0 = unknown",
    "origin": "uint8 (n, H, W) 0 unknown, 1 completed, 2 measured, 3 predicted",
    "agree": "uint8 (n, H, W) views that see the same point as `depth`",
    "through": "uint8 (n, H, W) views that look through it",
    "agreed": "float16 (n, H, W) what was measured and confirmed, before completion",
    "agreed_agree": "uint8 (n, H, W) views that see the same point as `agreed`",
    "agreed_through": "uint8 (n, H, W) views that look through it",
    "correlation": "uint8 (n, H, W) of the refined windows, percent",
    "surety": "uint8 (n, H, W) of predicted depth, percent",
    "exact_depth": "float16 (n, H, W) z-depth in metres, 0 = nothing",
    "exact_ids": "uint16 (n, H, W) entities, 0 = nothing",
    "range": "float64 (n, 2) far and near end of the sweep",
    "world_from_camera": "float64 (n, 4, 4) true cameras",
    "intrinsics": "float64 (4,) fx, fy, cx, cy at sweep resolution",
    "gaussians_depth": "float16 (n, H, W) depth corrected by the Gaussians",
    "mesh_vertices": "float32 (v, 3) of the fused surface, metres",
    "mesh_faces": "int32 (f, 3)",
    "mesh_colors": "uint8 (v, 3)",
    "mesh_superpoints": "int32 (v,) superpoint of each vertex",
    "mesh_true_ids": "uint16 (v,) true entity of each vertex, 0: far from all (`surfaces.true_ids`)",
}
"""Arrays of a room's folder, by name; `priors.dataset --keep` chooses among them."""
CROP = (192, 224)
JUMP = 1.03  # ratio of depths from which two neighbors are two surfaces


@dataclass(frozen=True)
class Room:
    """The arrays of a room, mapped into memory."""

    folder: Path
    arrays: dict[str, np.ndarray]

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self.arrays["world_from_camera"])


def open_rooms(folder: Path, needed: tuple[str, ...] = ()) -> list[Room]:
    """Open the finished rooms of a split that hold all the needed arrays, in order."""
    files = [
        f for f in sorted(folder.glob("*/room.json")) if f.parent.suffix != ".part"
    ]  # that is being written
    rooms = [
        Room(f.parent, {p.stem: np.load(p, mmap_mode="r") for p in f.parent.glob("*.npy")}) for f in files
    ]
    return [room for room in rooms if set(needed) <= set(room.arrays)]


@dataclass(frozen=True)
class Sample:
    """One keyframe, or a crop of it."""

    correlation: np.ndarray  # float32 (bins, h, w)
    smoothed: np.ndarray  # float32 (bins, h, w) 0 to 1
    color: np.ndarray  # float32 (3, h, w) 0 to 1
    place: np.ndarray  # float32 (h, w) true place in bins, -1 = unknown
    ids: np.ndarray  # int32 (h, w)
    rho: tuple[float, float]  # inverse depth at place 0, and its step from bin to bin


def load_sample(room: Room, row: int, window: tuple[slice, slice] = (slice(None), slice(None))) -> Sample:
    """Read a keyframe, or a window of it, as it is."""
    a = room.arrays
    cost = a["cost"][row][window]
    far, near = a["range"][row]
    place, rho = place_of_depth(np.asarray(a["true_depth"][row][window], np.float64), far, near)
    correlation = (np.float32(1) - cost.astype(np.float32) / 127).transpose(2, 0, 1)
    smoothed = a["smoothed"][row][window].astype(np.float32).transpose(2, 0, 1) / 255
    color = np.asarray(a["color"][row][window], np.float32).transpose(2, 0, 1) / 255
    ids = a["true_ids"][row][window].astype(np.int32)
    return Sample(correlation, smoothed, color, place.astype(np.float32), ids, rho)


def draw_sample(room: Room, rng: np.random.Generator) -> Sample:
    """Draw a keyframe, a crop of it, and disturb what does not matter."""
    row = int(rng.integers(len(room)))
    h, w = room.arrays["color"].shape[1:3]
    ch, cw = min(CROP[0], h), min(CROP[1], w)
    y, x = int(rng.integers(h - ch + 1)), int(rng.integers(w - cw + 1))
    sample = load_sample(room, row, (slice(y, y + ch), slice(x, x + cw)))
    correlation, smoothed, color = sample.correlation, sample.smoothed, sample.color
    place, ids, rho = sample.place, sample.ids, sample.rho
    if rng.random() < 0.5:
        correlation, smoothed, color, place, ids = (
            np.ascontiguousarray(v[..., ::-1]) for v in (correlation, smoothed, color, place, ids)
        )
    if rng.random() < 0.7:
        (correlation, smoothed), place, rho = _other_range((correlation, smoothed), place, rho, rng)
    return Sample(correlation, smoothed, other_light(color, rng), place, ids, rho)


def _other_range(volumes, place, rho, rng):
    """Sweep another range of depths: bins are left out, repeated or empty."""
    step = float(rng.uniform(0.75, 1.25))
    first = float(rng.uniform(-0.15, 0.15)) * BINS
    old = first + step * np.arange(BINS)
    rows = np.round(old).astype(int)
    inside, rows = ((rows >= 0) & (rows < BINS))[:, None, None], np.clip(rows, 0, BINS - 1)
    out = [np.where(inside, volume[rows], np.float32(0)) for volume in volumes]
    moved = np.where(place >= 0, (place - first) / step, -1).astype(np.float32)
    moved[(moved < 0) | (moved > BINS - 1)] = -1
    return out, moved, (rho[0] + first * rho[1], step * rho[1])


def other_light(color, rng):
    """Another exposure, contrast and color, sometimes gray, blurred, noisy, or no picture at all."""
    import cv2

    out = color
    if rng.random() < 0.3:
        out = out[rng.permutation(3)]
    if rng.random() < 0.15:
        out = np.broadcast_to(out.mean(0, keepdims=True), out.shape)
    gain = np.exp(rng.normal(0, 0.25)) * np.exp(rng.normal(0, 0.1, (3, 1, 1)))
    out = np.clip(out, 0, 1) ** np.exp(rng.normal(0, 0.25)) * gain + rng.normal(0, 0.04)
    out = out.astype(np.float32)
    if rng.random() < 0.25:
        out = cv2.GaussianBlur(
            np.ascontiguousarray(out.transpose(1, 2, 0)), (0, 0), rng.uniform(0.4, 1.1)
        ).transpose(2, 0, 1)
    if rng.random() < 0.5:
        out = out + rng.uniform(0, 0.03) * rng.standard_normal(out.shape, np.float32)
    if rng.random() < 0.03:
        out = np.full_like(out, 0.5)
    return np.clip(out, 0, 1).astype(np.float32)


def border_of(place: np.ndarray, rho: tuple[float, float], reach_px: int = 4) -> np.ndarray:
    """Return which pixels (h, w) lie within `reach_px` of a step in the true depth."""
    return near_steps(np.where(place >= 0, rho[0] + rho[1] * place, 0), reach_px)


def near_steps(values: np.ndarray, reach_px: int) -> np.ndarray:
    """Return which pixels (h, w) lie within `reach_px` of a step of depth, or of inverse depth (h, w), 0 = unknown."""
    import cv2

    step = np.zeros(values.shape, np.uint8)
    for axis in (0, 1):
        a, b = np.moveaxis(values, axis, 0)[1:], np.moveaxis(values, axis, 0)[:-1]
        jump = (np.maximum(a, b) > JUMP * np.minimum(a, b)).astype(np.uint8)
        view = np.moveaxis(step, axis, 0)
        view[1:] |= jump
        view[:-1] |= jump
    return cv2.dilate(step, np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)) > 0


def stack(samples: list[Sample]):
    """Return correlation, smoothed, color, place, ids, border, rho as tensors with a batch axis."""
    import torch

    columns = [
        np.stack([s.correlation for s in samples]), np.stack([s.smoothed for s in samples]),
        np.stack([s.color for s in samples]),
        np.stack([s.place for s in samples]), np.stack([s.ids for s in samples]),
        np.stack([border_of(s.place, s.rho) for s in samples]), np.array([s.rho for s in samples], np.float32),
    ]  # fmt: skip
    return [torch.from_numpy(np.ascontiguousarray(c)) for c in columns]
