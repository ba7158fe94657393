"""Evaluate the objective of a viewpoint and its gradient by the pose.

    L(v) = -1/P sum_p w(p) sum_i e_i alpha_i T_i(p)  +  lambda (D/d - 1)^2

i runs over the target's Gaussians. T_i is the transmittance of all Gaussians before i. e_i is the remaining effective
opacity of the visible side of i. D is the mean depth of the visible target, d the target distance. (The mean square
over pixels would also penalize the depth extent of the target and favor its flattest side.) w is the solid angle of a
pixel relative to the central one, with some more falloff: unweighted pixels cover more towards the border, which would
draw the target there. P normalizes by a number of pixels, so that lambda is independent of the target's size and shape.
"""

from dataclasses import dataclass, replace

import numpy as np

from reconstruction.core.types import Camera
from reconstruction.gaussians import kernels as shared
from reconstruction.gaussians.rasterizer import RasterSettings
from reconstruction.gaussians.threads import run_over
from reconstruction.views import kernels
from reconstruction.views.config import AvoConfig
from registry.geometry import invert_rigid

_ALPHA_MAX = 0.99
_NEAR_M = 0.02
_LEAST_SEEN = 1e-6  # mean opacity below which the target counts as not visible
# Splats are sorted by the distance of their centers, which is invariant to camera rotation. Those of the target count
# as this much nearer: on a support, the order would otherwise change with each step and the objective would jump.
_AHEAD_M = 0.01


@dataclass(frozen=True)
class Value:
    """The objective at one pose."""

    information: float  # pixels of the target, weighted by w and e, relative to `reference_px`
    seen: float  # pixels of the target, unweighted, relative to `reference_px`
    depth_term: float  # (D/d - 1)^2
    depth_m: float  # D, 0 if the target is not visible
    loss: float
    gradient: (
        np.ndarray
    )  # float64 (6,) by xi of world_from_camera exp(xi), translation and rotation; or zeros


class Objective:
    """The objective of one target at one resolution.

    Attributes:
        reference_px: P, the number of pixels that counts as 1.
        fronts: (m, 3) normals of the target's Gaussians towards the cameras that saw them; None: all sides are fronts.
    """

    def __init__(
        self, packed: np.ndarray, radii: np.ndarray, own_rows: np.ndarray, camera: Camera, config: AvoConfig
    ) -> None:
        """Prepare the objective.

        Args:
            packed: (n, 13) Gaussians in world space, metres; float32, or float64 to check derivatives.
            radii: (n,) radius at which each splat ends, metres.
            own_rows: (m,) rows of the target, ascending.
            camera: of the views.
            config: weights and cut-offs.
        """
        self.packed, self.radii, self.camera, self.reference_px = packed, radii, camera, 1.0
        self.fronts: np.ndarray | None = None
        self.own_rows = own_rows
        self._own = np.ascontiguousarray(packed[own_rows])
        self._is_own = np.zeros(len(packed), bool)
        self._is_own[own_rows] = True
        self._means = np.ascontiguousarray(packed[:, :3])
        self._ahead = np.where(self._is_own, _AHEAD_M, 0.0).astype(packed.dtype)
        self._marked = np.zeros(len(packed), np.uint8)
        self.settings = RasterSettings(
            sigma_cutoff=config.sigma_cutoff,
            alpha_min=config.alpha_min,
            alpha_max=_ALPHA_MAX,
            transmittance_stop=config.transmittance_stop,
            near=_NEAR_M,
        )

    def evaluate(
        self, world_from_camera: np.ndarray, worth: np.ndarray, target_distance_m: float, depth_weight: float,
        gradient: bool = True,
    ) -> Value:  # fmt: skip
        """Return the objective at a pose.

        Args:
            world_from_camera: (4, 4) rigid.
            worth: (2, m) e: remaining effective opacity of front and back of each of the target's Gaussians.
            target_distance_m: d.
            depth_weight: lambda.
            gradient: compute the gradient, too; else it is zero.
        """
        blended = self._blend(world_from_camera, worth)
        if blended is None:
            return Value(0.0, 0.0, 0.0, 0.0, 0.0, np.zeros(6))
        found, by_image = self._loss(blended, target_distance_m, depth_weight)
        return replace(found, gradient=self._backward(blended, by_image)) if gradient else found

    def scan(self, world_from_camera: np.ndarray, camera: Camera | None = None) -> tuple[np.ndarray, float]:
        """Return the contributions of the target's Gaussians to the image at a pose, and the target's depth.

        Args:
            world_from_camera: (4, 4) rigid.
            camera: replaces that of the views.

        Returns:
            Sum over pixels of alpha T of fronts and backs (2, m); mean depth in metres, 0 if the target is not visible.
        """
        out = np.zeros((2, len(self.own_rows)))
        blended = self._blend(world_from_camera, out, camera)
        if blended is None:
            return out, 0.0
        first, positions = blended.bins[2:]
        sums = np.zeros((len(blended.chosen), 1), self.packed.dtype)
        run_over(
            len(blended.rows), shared.reduce_entries, blended.weights, first, positions, blended.rows, sums
        )
        own = self._is_own[blended.chosen]
        where = np.searchsorted(self.own_rows, blended.chosen[own])
        side = np.where(self._facing(world_from_camera[:3, 3])[where], 0, 1)
        out[side, where] = sums[own, 0]
        return out, self._loss(blended, 1.0, 0.0)[0].depth_m

    def _loss(self, blended: "_Blended", distance: float, weight: float) -> tuple[Value, np.ndarray]:
        """Return the objective and its derivative by the blended image (h, w, 3)."""
        planes, pixels = blended.image.astype(np.float64), self.reference_px
        seen, worth, depth = (planes[..., c] for c in (kernels.SEEN, kernels.WORTH, kernels.DEPTH))
        size = _pixel_sizes(blended.camera)
        total, information = float(seen.sum()), float((size * worth).sum()) / pixels
        by_image = np.zeros_like(planes)
        by_image[..., kernels.WORTH] = -size / pixels
        if total <= _LEAST_SEEN * size.size:
            return Value(information, total / pixels, 0.0, 0.0, -information, np.zeros(6)), by_image
        mean = float(depth.sum()) / total
        off = mean / distance - 1.0
        by_image[..., kernels.SEEN] = -weight * 2.0 * off * mean / (distance * total)
        by_image[..., kernels.DEPTH] = weight * 2.0 * off / (distance * total)
        loss = -information + weight * off**2
        return Value(information, total / pixels, off**2, mean, loss, np.zeros(6)), by_image

    def _facing(self, eye: np.ndarray) -> np.ndarray:
        """Return the mask (m,) of the target's Gaussians whose front faces the eye (3,)."""
        if self.fronts is None:
            return np.ones(len(self.own_rows), bool)
        return np.einsum("mc,mc->m", self.fronts, eye - self._own[:, :3]) > 0

    def _blend(
        self, world_from_camera: np.ndarray, worth: np.ndarray, camera: Camera | None = None
    ) -> "_Blended | None":
        """Blend the target, cropped to the part of the image that it reaches; None if it is out of view."""
        camera_from_world = invert_rigid(world_from_camera)
        rotation, translation = camera_from_world[:3, :3].copy(), camera_from_world[:3, 3].copy()
        crop = self._crop(rotation, translation, camera or self.camera)
        if crop is None:
            return None
        camera, chosen = crop
        dtype = self.packed.dtype
        splats, boxes = self._project(self.packed[chosen], camera, rotation, translation)
        keys = np.zeros((len(chosen), shared.ZC + 1), dtype)
        eye = world_from_camera[:3, 3].astype(dtype)
        keys[:, shared.ZC] = np.linalg.norm(self._means[chosen] - eye, axis=1) - self._ahead[chosen]
        rows = shared.sort_by_depth(keys, boxes)
        tiles_x, tiles_y = -(-camera.width // shared.TILE), -(-camera.height // shared.TILE)
        bins = shared.bin_to_tiles(rows, boxes, tiles_x, tiles_y)
        splats, boxes = splats[rows], boxes[rows]
        value_of = np.zeros(len(self.packed), dtype)
        value_of[self.own_rows] = np.where(self._facing(world_from_camera[:3, 3]), worth[0], worth[1])
        own, value = self._is_own[chosen[rows]].astype(dtype), value_of[chosen[rows]]
        tile_end = kernels.last_of_target(bins[0], bins[1], own)
        scalars = np.array([self.settings.alpha_max, self.settings.transmittance_stop], dtype)
        image = np.empty((camera.height, camera.width, kernels.N_PLANES), dtype)
        weights = np.empty((len(bins[1]), 1), dtype)
        common = (splats, boxes, own, value, bins[0], tile_end, bins[1], tiles_x, scalars, image)
        run_over(tiles_x * tiles_y, kernels.blend_target, *common, weights)
        return _Blended(camera, chosen, rows, splats, bins, common, weights, (rotation, translation))

    def _backward(self, blended: "_Blended", by_image: np.ndarray) -> np.ndarray:
        """Return the gradient (6,) by the pose, given that by the blended image (h, w, 3)."""
        dtype, n, rows = self.packed.dtype, len(blended.chosen), blended.rows
        tiles = len(blended.bins[0]) - 1
        entry_gradients = np.empty((len(blended.bins[1]), kernels.N_GRADIENTS), dtype)
        run_over(
            tiles, kernels.blend_target_backward, *blended.common, blended.weights, by_image.astype(dtype),
            entry_gradients,
        )  # fmt: skip
        splat_gradients = np.zeros((n, shared.N_SPLAT_GRADIENTS), dtype)
        run_over(
            len(rows), shared.reduce_entries, entry_gradients, blended.bins[2], blended.bins[3], rows, splat_gradients
        )  # fmt: skip
        # Splats wholly behind the target have no gradient.
        relevant = np.flatnonzero(splat_gradients[rows].any(axis=1))
        rows, splats = rows[relevant], blended.splats[relevant]
        by_parameters = np.empty((n, shared.N_PARAMETERS), dtype)
        by_pose = np.empty((len(rows), 6), np.float64)
        run_over(
            len(rows), shared.project_backward, self.packed[blended.chosen], rows, *blended.pose,
            blended.camera.intrinsics, splats, splat_gradients, by_parameters, by_pose,
        )  # fmt: skip
        return by_pose.sum(axis=0)

    def _project(
        self, packed: np.ndarray, camera: Camera, rotation: np.ndarray, translation: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        splats = np.empty((len(packed), shared.N_PROJECTED), packed.dtype)
        boxes = np.empty((len(packed), 4), np.int32)
        settings = self.settings
        run_over(
            len(packed), shared.project, packed, rotation, translation, camera.intrinsics,
            (camera.width, camera.height), settings.near, settings.sigma_cutoff, settings.alpha_min, splats, boxes,
        )  # fmt: skip
        return splats, boxes

    def _crop(
        self, rotation: np.ndarray, translation: np.ndarray, camera: Camera
    ) -> tuple[Camera, np.ndarray] | None:
        """Return the camera of the part of the image that the target reaches, and the rows (k,) that may matter there.

        None if the target is out of view.
        """
        settings = self.settings
        splats, boxes = self._project(self._own, camera, rotation, translation)
        seen = boxes[:, 2] > 0
        if not seen.any():
            return None
        x0, y0 = (int(boxes[seen, c].min()) for c in (0, 1))
        x1, y1 = (int(boxes[seen, c].max()) for c in (2, 3))
        far = float((splats[seen, shared.ZC] + self.radii[self.own_rows[seen]]).max())
        spread = settings.sigma_cutoff  # of the screen-space filter, in pixels
        window = np.array([x0 - spread, y0 - spread, x1 + spread, y1 + spread])
        run_over(
            len(self.packed), kernels.mark_near_view, self._means, self.radii, rotation, translation,
            camera.intrinsics, window, far, settings.near, self._marked,
        )  # fmt: skip
        self._marked[self.own_rows] = seen
        cropped = Camera(x1 - x0, y1 - y0, camera.fx, camera.fy, camera.cx - x0, camera.cy - y0)
        return cropped, np.flatnonzero(self._marked)


@dataclass(frozen=True)
class _Blended:
    """A blended image and the inputs of the backward pass."""

    camera: Camera  # of the crop
    chosen: np.ndarray  # int64 (k,) rows of the packed Gaussians
    rows: np.ndarray  # int32 (v,) rows of `chosen`, near to far
    splats: np.ndarray  # (v, 17)
    bins: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # of `bin_to_tiles`
    common: tuple  # arguments of both passes
    weights: np.ndarray  # (e, 1) sum of alpha T of each entry
    pose: tuple[np.ndarray, np.ndarray]  # camera_from_world: rotation (3, 3), translation (3,)

    @property
    def image(self) -> np.ndarray:
        """The image (h, w, 3), planes SEEN, WORTH, DEPTH."""
        return self.common[-1]


def _pixel_sizes(camera: Camera) -> np.ndarray:
    """Return w (h, w): cos^4 of the angle to the optical axis (the solid angle is cos^3)."""
    rays = camera.pixel_rays()
    return 1.0 / (1.0 + rays[..., 0] ** 2 + rays[..., 1] ** 2) ** 2
