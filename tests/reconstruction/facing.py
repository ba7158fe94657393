"""Cameras in a row that look along +y, as at a wall."""

import numpy as np

from reconstruction.core.types import Camera, PosedFrames, VideoSource
from registry.geometry import rigid

CAMERA = Camera(320, 240, 280.0, 280.0, 160.0, 120.0)
# Looks along +y: right is +x, down is -z.
FACING = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def frames(*eyes) -> PosedFrames:
    """Return black frames (240 x 320) of `CAMERA` at eyes (3,), all facing +y."""
    poses = np.array([rigid(FACING, np.array(eye, float)) for eye in eyes])
    n = len(poses)
    none = np.zeros((0, 240, 320, 3), np.uint8)
    source = VideoSource("x.mp4", "0" * 64, 320, 240, 12.0, n, n / 12)
    return PosedFrames(
        source, CAMERA, np.zeros((n, 240, 320, 3), np.uint8), np.arange(n, dtype=np.int32), np.arange(n) / 12, poses,
        np.ones(n, np.float32), none, np.zeros(0, np.int32), np.zeros(0), np.zeros((0, 4, 4)), np.zeros((0, 3)),
        np.zeros((0, 3), np.uint8), np.zeros(0, np.float32), np.zeros((0, 2), np.int32), n, True, 0.3,
    )  # fmt: skip
