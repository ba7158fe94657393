"""The CPU rasterizer of 2D Gaussians: forward and backward pass around the compiled kernels."""

from dataclasses import dataclass

import numpy as np

from reconstruction.core.types import Camera
from reconstruction.gaussians.scratch import Scratch
from reconstruction.gaussians.threads import run_over
from registry.geometry import invert_rigid


@dataclass(frozen=True, kw_only=True)
class RasterSettings:
    """Cut-offs of blending. Active viewpoint optimization relaxes them for unbiased pose gradients."""

    sigma_cutoff: float = 2.6
    """Standard deviations at which a splat ends."""

    alpha_min: float = 1.0 / 255.0
    """Alpha below which a splat ends."""

    alpha_max: float = 0.99
    """Largest alpha of a splat."""

    transmittance_stop: float = 1e-3
    """Transmittance below which a pixel is finished."""

    near: float = 0.01
    """Depth of the near plane, in the units of the scene."""

    reference_depth: float = 1.0
    """Unit r of depth distortion, which is measured in 4 r / (r + z): relative depth where z is near r, bounded
    elsewhere. The median depth makes it scale-free."""


@dataclass(frozen=True)
class Rasterized:
    """One rendered image and the inputs of the backward pass."""

    features: np.ndarray  # (h, w, 13), columns of kernels.F_*
    contributions: np.ndarray | None  # (n,) sum over pixels of weight alpha T; None without pixel weights
    parameters: np.ndarray  # (n, 13) as rendered
    rows: np.ndarray  # int32 (k,) visible Gaussians, near to far
    splats: np.ndarray  # (k, 17) projected, near to far
    boxes: np.ndarray  # int32 (k, 4) pixel bounds, near to far
    bins: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # of `bin_to_tiles`
    pose: tuple[np.ndarray, np.ndarray]  # camera_from_world: rotation (3, 3), translation (3,)
    intrinsics: np.ndarray  # float64 (4,)
    settings: RasterSettings


@dataclass(frozen=True)
class RasterGradients:
    """Gradients of a loss; rows of Gaussians that are not in view are zero."""

    parameters: np.ndarray  # (n, 13)
    pose: np.ndarray  # (6,) by xi of world_from_camera exp(xi): translation, rotation in camera axes
    position_px: np.ndarray  # (n, 2) by the projected center
    contributions: np.ndarray  # (n,) sum over pixels of alpha T
    errors: np.ndarray  # (n,) sum over pixels of alpha T error


def _tile_order(count: int) -> np.ndarray:
    """Return an interleaved order of tiles, in which equal shares are about equal work."""
    return np.concatenate([np.arange(residue, count, 8) for residue in range(8)])


def _scalars(settings: RasterSettings, dtype: np.dtype) -> np.ndarray:
    return np.array([settings.alpha_max, settings.transmittance_stop, settings.reference_depth], dtype)


def rasterize(
    parameters: np.ndarray,
    camera: Camera,
    world_from_camera: np.ndarray,
    settings: RasterSettings,
    pixel_weights: np.ndarray | None = None,
    scratch: Scratch | None = None,
) -> Rasterized:
    """Render packed Gaussians.

    Args:
        parameters: (n, 13) mean, quaternion wxyz, log scales, opacity logit, color; float32, or float64 to check.
        camera: pinhole camera.
        world_from_camera: (4, 4) rigid.
        settings: cut-offs.
        pixel_weights: (h, w) weights of the pixels in `Rasterized.contributions`; None omits these.
        scratch: memory for the result, which is then valid until the next call with it.
    """
    from reconstruction.gaussians import blend_kernels, kernels

    dtype, scratch = parameters.dtype, scratch or Scratch()
    camera_from_world = invert_rigid(world_from_camera)
    rotation, translation = camera_from_world[:3, :3].copy(), camera_from_world[:3, 3].copy()
    intrinsics = camera.intrinsics
    n, width, height = len(parameters), camera.width, camera.height
    splats = scratch.empty("splats", (n, kernels.N_PROJECTED), dtype)
    boxes = scratch.empty("boxes", (n, 4), np.int32)
    run_over(
        n, kernels.project, parameters, rotation, translation, intrinsics, (width, height), settings.near,
        settings.sigma_cutoff, settings.alpha_min, splats, boxes,
    )  # fmt: skip
    tiles_x, tiles_y = -(-width // kernels.TILE), -(-height // kernels.TILE)
    rows = kernels.sort_by_depth(splats, boxes)
    bins = kernels.bin_to_tiles(rows, boxes, tiles_x, tiles_y)
    near_splats = scratch.empty("near_splats", (len(rows), kernels.N_PROJECTED), dtype)
    near_boxes = scratch.empty("near_boxes", (len(rows), 4), np.int32)
    run_over(len(rows), kernels.gather, splats, boxes, rows, near_splats, near_boxes)
    features = scratch.empty("features", (height, width, kernels.N_FEATURES), dtype)
    wanted = pixel_weights is not None
    weights = np.ascontiguousarray(pixel_weights, dtype) if wanted else np.empty((0, 0), dtype)
    entry_values = np.empty((len(bins[1]) if wanted else 0, 1), dtype)
    run_over(
        tiles_x * tiles_y, blend_kernels.blend, near_splats, near_boxes, bins[0], bins[1],
        _tile_order(tiles_x * tiles_y), tiles_x, _scalars(settings, dtype), weights, features, entry_values[:, 0],
    )  # fmt: skip
    contributions = None
    if wanted:
        total = np.zeros((n, 1), dtype)
        run_over(len(rows), kernels.reduce_entries, entry_values, bins[2], bins[3], rows, total)
        contributions = total[:, 0]
    return Rasterized(
        features, contributions, parameters, rows, near_splats, near_boxes, bins, (rotation, translation), intrinsics,
        settings,
    )  # fmt: skip


def rasterize_backward(
    image: Rasterized,
    image_gradients: np.ndarray,
    error: np.ndarray | None = None,
    scratch: Scratch | None = None,
) -> RasterGradients:
    """Backpropagate through `rasterize`.

    Args:
        image: of `rasterize`.
        image_gradients: (h, w, 9) gradient by summed color (3), depth, normal (3), opacity and distortion.
        error: (h, w) pixel errors to attribute to Gaussians, for `RasterGradients.errors`.
        scratch: memory for the result, which is then valid until the next call with it.
    """
    from reconstruction.gaussians import blend_kernels, kernels

    height, width = image.features.shape[:2]
    dtype, n, scratch = image.parameters.dtype, len(image.parameters), scratch or Scratch()
    tiles_x, tiles_y = -(-width // kernels.TILE), -(-height // kernels.TILE)
    entry_gradients = scratch.empty("entries", (len(image.bins[1]), kernels.N_SPLAT_GRADIENTS), dtype)
    if error is None:
        error = np.zeros((height, width), dtype)
    run_over(
        tiles_x * tiles_y, blend_kernels.blend_backward, image.splats, image.boxes, image.bins[0], image.bins[1],
        _tile_order(tiles_x * tiles_y), tiles_x, _scalars(image.settings, dtype), image.features, image_gradients,
        error, entry_gradients,
    )  # fmt: skip
    splat_gradients = scratch.zeros("splat_gradients", (n, kernels.N_SPLAT_GRADIENTS), dtype)
    run_over(
        len(image.rows), kernels.reduce_entries, entry_gradients, image.bins[2], image.bins[3], image.rows,
        splat_gradients,
    )  # fmt: skip
    gradients = scratch.zeros("gradients", (n, kernels.N_PARAMETERS), dtype)
    pose_gradients = scratch.empty("pose", (len(image.rows), 6), np.float64)
    run_over(
        len(image.rows), kernels.project_backward, image.parameters, image.rows, *image.pose, image.intrinsics,
        image.splats, splat_gradients, gradients, pose_gradients,
    )  # fmt: skip
    return RasterGradients(
        gradients, pose_gradients.sum(axis=0), splat_gradients[:, :2], splat_gradients[:, kernels.S_CONTRIBUTION],
        splat_gradients[:, kernels.S_ERROR],
    )  # fmt: skip
