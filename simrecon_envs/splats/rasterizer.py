"""Draw Gaussians of moving bodies into an image, on several threads."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np

from simrecon_envs.splats import kernels
from simrecon_envs.splats.scene import SplatScene

_NEAR_M = 0.01  # as SAPIEN's cameras


@dataclass(frozen=True)
class Drawn:
    """An image of Gaussians; arrays are valid until the next call of the same `Rasterizer`."""

    planes: np.ndarray  # float32 (5, h, w), planes of `kernels`: color (3), depth, transmittance
    front: np.ndarray  # int32 (h, w) the Gaussian at which half of the light is stopped, or -1
    splats: np.ndarray  # float32 (n, 16) projected Gaussians, columns of `kernels`


class Rasterizer:
    """Draws a `SplatScene`. Its buffers are used again: fresh memory would take as long as drawing."""

    def __init__(self, scene: SplatScene) -> None:
        """Allocate the buffers that do not depend on the image's size."""
        self.scene = scene
        self.colors = scene.colors.copy()
        """Colors (n, 3) that are drawn; may be changed."""
        self._splats = np.zeros((len(scene.rows), kernels.N_PROJECTED), np.float32)
        self._boxes = np.zeros((len(scene.rows), 4), np.int32)
        self._images: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}

    def draw(
        self,
        camera_from_body: np.ndarray,
        intrinsics: np.ndarray,
        limits: np.ndarray,
        owners: np.ndarray,
        *,
        softness: float = 0.01,
        threads: int = 1,
    ) -> Drawn:
        """Draw the Gaussians as seen by a pinhole camera.

        Args:
            camera_from_body: (b, 3, 4), OpenCV camera axes; `world_from_body` as captured is already undone in it, so
                that it applies to the captured positions.
            intrinsics: (4,) fx, fy, cx, cy in pixels; the middle of the first pixel is (0.5, 0.5).
            limits: float32 (h, w) depth behind which Gaussians do not count, metres.
            owners: int32 (h, w) the body whose Gaussians count behind the limit, too; -1 for none.
            softness: Depth over which Gaussians fade out before the limit, metres.
            threads: Number of threads; the image does not depend on it.
        """
        scene, splats, boxes = self.scene, self._splats, self._boxes
        height, width = limits.shape
        if (height, width) not in self._images:
            planes = np.empty((kernels.N_PLANES, height, width), np.float32)
            self._images[height, width] = planes, np.empty((height, width), np.int32)
        planes, front = self._images[height, width]
        moves = np.ascontiguousarray(camera_from_body, np.float64)
        lens = np.ascontiguousarray(intrinsics, np.float64)
        count = len(scene.rows)
        cuts = [count * k // threads for k in range(threads + 1)]
        _each(
            threads, kernels.project, list(pairwise(cuts)),
            scene.rows, scene.bodies, self.colors, moves, lens, width, height, _NEAR_M, splats, boxes,
        )  # fmt: skip
        rows = kernels.sort_by_depth(splats, boxes)
        tiles_x, tiles_y = -(-width // kernels.TILE_X), -(-height // kernels.TILE_Y)
        tile_start, entries = kernels.bin_to_tiles(rows, boxes, tiles_x, tiles_y)
        _each(
            threads, kernels.blend, [(k, threads) for k in range(threads)],
            splats, boxes, scene.bodies, tiles_x, tile_start, entries, limits, owners, softness, planes, front,
        )  # fmt: skip
        return Drawn(planes, front, splats)


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="splats")


def _each(threads: int, kernel: Callable[..., None], shares: list[tuple[int, int]], *arguments: Any) -> None:
    """Call a kernel for each share of its work; kernels release the interpreter lock."""
    if threads == 1:
        kernel(*shares[0], *arguments)
        return
    for call in [_pool(threads).submit(kernel, *share, *arguments) for share in shares]:
        call.result()
