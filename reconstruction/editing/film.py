"""The film as clicks need it: the camera of each frame, and the pixel of a click."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from reconstruction.core.types import DepthMaps, PosedFrames
from reconstruction.editing.addresses import Address
from reconstruction.poses.lens import Lens
from registry.errors import UsageError

_GAP_S = 1.0  # cameras are interpolated between posed frames at most this far apart


@dataclass(frozen=True)
class Film:
    """Frames with cameras, their depth maps, and the lens distortion; all in one space."""

    posed: PosedFrames
    depth: DepthMaps  # its camera has the resolution of the id maps
    lens: Lens

    def camera_of(self, frame: int) -> tuple[int | None, np.ndarray]:
        """Return the row (None if it is no keyframe) and world_from_camera of a video frame.

        Between posed frames less than a second apart the pose is interpolated.

        Raises:
            UsageError: the camera of that frame is not known.
        """
        posed = self.posed
        row = np.flatnonzero(np.asarray(posed.indices) == frame)
        if len(row):
            return int(row[0]), np.asarray(posed.world_from_camera[row[0]])
        known = np.concatenate([posed.indices, posed.held_out_indices])
        poses = np.concatenate([posed.world_from_camera, posed.held_out_world_from_camera.reshape(-1, 4, 4)])
        exact = np.flatnonzero(known == frame)
        if len(exact):
            return None, poses[exact[0]]
        order = np.argsort(known, kind="stable")
        after = int(np.searchsorted(known[order], frame))
        if posed.ordered and 0 < after < len(known):
            a, b = order[after - 1], order[after]
            if known[b] - known[a] <= _GAP_S * posed.source.fps:
                share = float((frame - known[a]) / (known[b] - known[a]))
                return None, _between(poses[a], poses[b], share)
        nearest = sorted(sorted(known.tolist(), key=lambda k: abs(k - frame))[:6])
        raise UsageError(
            f"overrides: no camera is known of frame {frame} (the film has {posed.source.frame_count}); "
            f"the nearest with one are {', '.join(map(str, nearest))}"
        )

    def depth_pixel(self, address: Address) -> np.ndarray:
        """Return the pixel x, y (2,) of a click in the undistorted frame at depth resolution.

        Raises:
            UsageError: it lies outside of the frame, or in the margin that undistortion cuts off.
        """
        width, height = address.size or (self.posed.source.width, self.posed.source.height)
        x, y = address.pixel
        if not (0 <= x <= width and 0 <= y <= height):
            raise UsageError(f"overrides: {address} lies outside the frame of {width} x {height} pixels")
        filmed, camera = self.lens.camera, self.depth.camera
        working = np.array([[x / width * filmed.width, y / height * filmed.height]])
        scale = np.array([camera.width / filmed.width, camera.height / filmed.height])
        pixel = self.lens.at(address.frame).straightened(working)[0] * scale
        if not ((pixel >= 0) & (pixel <= [camera.width, camera.height])).all():
            raise UsageError(f"overrides: {address} lies in the margin that lens undistortion cuts off")
        return np.minimum(pixel, [camera.width - 1e-6, camera.height - 1e-6])


def _between(a: np.ndarray, b: np.ndarray, share: float) -> np.ndarray:
    """Interpolate two poses (4, 4)."""
    out = np.eye(4)
    turns = Rotation.from_matrix(np.stack([a[:3, :3], b[:3, :3]]))
    out[:3, :3] = Slerp([0, 1], turns)([share]).as_matrix()[0]
    out[:3, 3] = (1 - share) * a[:3, 3] + share * b[:3, 3]
    return out
