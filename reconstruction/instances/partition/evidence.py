"""Evidence of keyframes per vertex: visibility, agreement with measured depth, image and depth edges, color spread."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.instances.sightings import Sighting

_JUMP = 1.03  # ratio of neighboring depths at a depth discontinuity
_AGREES = 0.015  # of the depth: measured depth within this of a vertex confirms it
_FAR_M = 0.1  # cap of distances to depth edges


@dataclass(frozen=True)
class FrameLook:
    """Evidence of one keyframe at each vertex."""

    shown: np.ndarray  # bool (v,) inside of the image and not occluded by the mesh
    inside: np.ndarray  # bool (v,) inside of the image, occluded or not
    beyond: np.ndarray  # float32 (v,) measured depth over the vertex's depth, less 1; nan where unmeasured
    color: np.ndarray  # float32 (v, 3) weighted CIELAB
    edge: np.ndarray  # float32 (v,) strongest color gradient within a pixel, CIELAB a pixel
    jump_m: np.ndarray  # float32 (v,) distance to the nearest depth edge, capped
    cosine: np.ndarray  # float32 (v,) between normal and direction to the camera


def look(frame: Sighting, points: np.ndarray, normals: np.ndarray) -> FrameLook:
    """Return the evidence of one keyframe at points (v, 3) with normals (v, 3) in world space."""
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
    return FrameLook(shown, z > 0, beyond, frame.lab[row, column], edge, jump, cosine.astype(np.float32))


def _gradient(lab: np.ndarray) -> np.ndarray:
    """Return the largest color gradient (h, w) in the 3 x 3 neighborhood of each pixel, CIELAB per pixel."""
    smooth = cv2.GaussianBlur(lab, (0, 0), 1.0)
    squares = sum(cv2.Sobel(smooth, cv2.CV_32F, dx, dy, scale=1 / 8) ** 2 for dx, dy in ((1, 0), (0, 1)))
    return cv2.dilate(np.sqrt(squares.sum(axis=2)), np.ones((3, 3), np.uint8))  # pyright: ignore[reportAttributeAccessIssue]


def _jump_distance(depth: np.ndarray) -> np.ndarray:
    """Return the distance (h, w) in pixels to the nearest depth discontinuity."""
    around = np.ones((3, 3), np.uint8)
    high = cv2.dilate(depth, around)
    low = cv2.erode(np.where(depth > 0, depth, high.max(initial=0.0)), around)
    steps = high > low * _JUMP
    if not steps.any():
        return np.full(depth.shape, 1e6, np.float32)
    return cv2.distanceTransform((~steps).astype(np.uint8), cv2.DIST_L2, 3)


@dataclass(frozen=True)
class VertexEvidence:
    """Means over the keyframes in which a vertex is visible, float32 (v,) each; zeros where `shown` is 0."""

    shown: np.ndarray  # number of keyframes
    agreed: np.ndarray  # share of them that measured the vertex's depth
    through: np.ndarray  # share of the keyframes with the vertex in the image that measured larger depth
    before: np.ndarray  # share of the keyframes that show it and measured smaller depth
    facing: np.ndarray  # largest cosine between normal and direction to a camera; -1 where `shown` is 0
    edge: np.ndarray  # mean color gradient
    jump_m: np.ndarray  # mean distance to depth edges
    spread: np.ndarray  # standard deviation of the color over keyframes, CIELAB


def gather(looks: list[FrameLook]) -> VertexEvidence:
    """Aggregate the evidence of all keyframes."""
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
