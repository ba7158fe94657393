"""Evidence of keyframes for each vertex of the fused mesh: visibility, agreement of depth, edges, spread of color."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.instances.sightings import Sighting

_JUMP = 1.03  # ratio of neighboring depths from which they are of two surfaces
_AGREES = 0.015  # of depth: measured depth this near to a vertex confirms it
_FAR_M = 0.1  # distances to depth edges are capped here


@dataclass(frozen=True)
class FrameLook:
    """One keyframe's look at the vertices."""

    shown: np.ndarray  # bool (v,) in view, and nothing of the mesh hides it
    inside: np.ndarray  # bool (v,) in view, hidden or not
    beyond: (
        np.ndarray
    )  # float32 (v,) measured depth less the vertex's, over the vertex's; nan where unmeasured
    color: np.ndarray  # float32 (v, 3) weighted CIELAB
    edge: np.ndarray  # float32 (v,) strongest color gradient within a pixel, CIELAB a pixel
    jump_m: np.ndarray  # float32 (v,) distance to the nearest depth edge of the frame, capped
    cosine: np.ndarray  # float32 (v,) between normal and ray


def look(frame: Sighting, points: np.ndarray, normals: np.ndarray) -> FrameLook:
    """Return what one keyframe says of vertices (v, 3) with normals (v, 3), world metres."""
    row, column, z = frame.seen_at(points)
    shown = frame.shown(row, column, z)
    measured = frame.measured[row, column]
    with np.errstate(divide="ignore", invalid="ignore"):
        beyond = np.where((measured > 0) & (z > 0), measured / z - 1.0, np.nan).astype(np.float32)
    metres_px = z / frame.camera.fx
    jump = np.minimum(_jump_distance(frame.measured)[row, column] * metres_px, _FAR_M).astype(np.float32)
    rays = frame.eye - points
    cosine = (rays * normals).sum(axis=1) / np.maximum(np.linalg.norm(rays, axis=1), 1e-9)
    edge = _gradient(frame.lab)[row, column]
    return FrameLook(
        shown, z > 0, beyond, frame.lab[row, column], edge, jump, cosine.astype(np.float32)
    )  # fmt: skip


def _gradient(lab: np.ndarray) -> np.ndarray:
    """Return the strongest color gradient (h, w) within a pixel of each pixel, CIELAB a pixel."""
    smooth = cv2.GaussianBlur(lab, (0, 0), 1.0)
    squares = sum(cv2.Sobel(smooth, cv2.CV_32F, dx, dy, scale=1 / 8) ** 2 for dx, dy in ((1, 0), (0, 1)))
    return cv2.dilate(np.sqrt(squares.sum(axis=2)), np.ones((3, 3), np.uint8))


def _jump_distance(depth: np.ndarray) -> np.ndarray:
    """Return the distance (h, w) in pixels to the nearest step between measured depths."""
    around = np.ones((3, 3), np.uint8)
    high = cv2.dilate(depth, around)
    low = cv2.erode(np.where(depth > 0, depth, high.max(initial=0.0)), around)
    steps = high > low * _JUMP
    if not steps.any():
        return np.full(depth.shape, 1e6, np.float32)
    return cv2.distanceTransform((~steps).astype(np.uint8), cv2.DIST_L2, 3)


@dataclass(frozen=True)
class VertexEvidence:
    """Means over the keyframes that show a vertex; where none does, zeros, and `shown` is 0."""

    shown: np.ndarray  # float32 (v,) number of keyframes
    agreed: np.ndarray  # share of them that measured the vertex's depth
    through: np.ndarray  # share of all keyframes with the vertex in view that look through it
    before: np.ndarray  # share of those that show it and measured something before it
    facing: np.ndarray  # greatest cosine between normal and ray
    edge: np.ndarray  # mean color gradient
    jump_m: np.ndarray  # mean distance to depth edges
    spread: np.ndarray  # standard deviation of color between keyframes, CIELAB


def gather(looks: list[FrameLook]) -> VertexEvidence:
    """Return what all keyframes together say of each vertex."""
    count = len(looks[0].shown)
    sums = {
        name: np.zeros(count) for name in ("shown", "inside", "agreed", "through", "before", "edge", "jump_m")
    }
    facing = np.full(count, -1.0)
    color, squares = np.zeros((count, 3)), np.zeros((count, 3))
    for seen in looks:
        with np.errstate(invalid="ignore"):
            through = seen.inside & (seen.beyond > _AGREES)
            before = seen.shown & (seen.beyond < -_AGREES)
            agreed = seen.shown & (np.abs(seen.beyond) <= _AGREES)
        for name, mask in (("shown", seen.shown), ("inside", seen.inside), ("agreed", agreed),
                           ("through", through), ("before", before)):  # fmt: skip
            sums[name] += mask
        sums["edge"] += np.where(seen.shown, seen.edge, 0.0)
        sums["jump_m"] += np.where(seen.shown, seen.jump_m, 0.0)
        facing = np.where(seen.shown, np.maximum(facing, seen.cosine), facing)
        chosen = np.where(seen.shown[:, None], seen.color, 0.0)
        color += chosen
        squares += chosen**2
    seen_by, in_view = np.maximum(sums["shown"], 1), np.maximum(sums["inside"], 1)
    variance = np.maximum(squares / seen_by[:, None] - (color / seen_by[:, None]) ** 2, 0).sum(axis=1)
    arrays = (
        sums["shown"], sums["agreed"] / seen_by, sums["through"] / in_view, sums["before"] / seen_by, facing,
        sums["edge"] / seen_by, sums["jump_m"] / seen_by, np.sqrt(variance),
    )  # fmt: skip
    return VertexEvidence(*(a.astype(np.float32) for a in arrays))
