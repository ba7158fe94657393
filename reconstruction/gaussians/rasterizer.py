"""The CPU rasterizer around the compiled kernels: parameters -> image features, and back."""

from dataclasses import dataclass

import numpy as np

from reconstruction.core.types import Camera
from reconstruction.gaussians.scratch import Scratch
from reconstruction.gaussians.threads import run_over
from registry.geometry import invert_rigid


@dataclass(frozen=True, kw_only=True)
class RasterSettings:
    """Where blending is cut off. Active viewpoint optimization relaxes both cut-offs for unbiased pose gradients."""

    sigma_cutoff: float = 2.6
    """A splat ends at this many standard deviations."""

    alpha_min: float = 1.0 / 255.0
    """A splat ends where its alpha falls below this."""

    alpha_max: float = 0.99
    """One splat hides at most this share of what lies behind it."""

    transmittance_stop: float = 1e-3
    """A pixel is finished when less than this share of light still passes."""

    near: float = 0.01
    """Splats nearer to the camera than this are not drawn, in the units of the scene."""

    reference_depth: float = 1.0
    """Depth distortion is measured in reference_depth / z; the scene's median depth makes it free of scale."""


@dataclass(frozen=True)
class Rasterized:
    """One rendered image, with what the backward pass needs."""

    features: np.ndarray  # (h, w, 13), columns of kernels.F_*
    contributions: np.ndarray | None  # (n,) sum over pixels of weight alpha T, where asked for
    parameters: np.ndarray  # (n, 13) as rendered
    rows: np.ndarray  # int32 (k,) visible Gaussians, near to far
    splats: np.ndarray  # (k, 17)
    boxes: np.ndarray  # int32 (k, 4)
    bins: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
    pose: tuple[np.ndarray, np.ndarray]  # rotation (3, 3), translation (3,): camera_from_world
    intrinsics: np.ndarray  # (4,)
    settings: RasterSettings


@dataclass(frozen=True)
class RasterGradients:
    """Derivatives of a loss; rows of Gaussians that are not in view are zero."""

    parameters: np.ndarray  # (n, 13)
    pose: np.ndarray  # (6,) translation, rotation: world_from_camera exp(xi), xi in camera axes
    position_px: np.ndarray  # (n, 2) by the projected center
    contributions: np.ndarray  # (n,) sum over pixels of alpha T
    errors: np.ndarray  # (n,) sum over pixels of alpha T error


def _tile_order(count: int) -> np.ndarray:
    """Interleave the tiles, so that equal shares of them are about equal work."""
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
        camera: The pinhole camera.
        world_from_camera: (4, 4) rigid.
        settings: Cut-offs.
        pixel_weights: (h, w) sums alpha T of every Gaussian over the pixels with these weights; None: not wanted.
        scratch: Memory for the result, which is then valid until the next call with it.
    """
    from reconstruction.gaussians import blend_kernels, kernels

    dtype, scratch = parameters.dtype, scratch or Scratch()
    camera_from_world = invert_rigid(world_from_camera)
    rotation, translation = camera_from_world[:3, :3].copy(), camera_from_world[:3, 3].copy()
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64)
    n, width, height = len(parameters), camera.width, camera.height
    splats = scratch.empty("splats", (n, kernels.N_PROJECTED), dtype)
    boxes = scratch.empty("boxes", (n, 4), np.int32)
    run_over(
        n,
        kernels.project,
        parameters,
        rotation,
        translation,
        intrinsics,
        (width, height),
        settings.near,
        settings.sigma_cutoff,
        settings.alpha_min,
        splats,
        boxes,
    )
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
        tiles_x * tiles_y,
        blend_kernels.blend,
        near_splats,
        near_boxes,
        bins[0],
        bins[1],
        _tile_order(tiles_x * tiles_y),
        tiles_x,
        _scalars(settings, dtype),
        weights,
        features,
        entry_values[:, 0],
    )
    contributions = None
    if wanted:
        total = np.zeros((n, 1), dtype)
        run_over(len(rows), kernels.reduce_entries, entry_values, bins[2], bins[3], rows, total)
        contributions = total[:, 0]
    return Rasterized(
        features,
        contributions,
        parameters,
        rows,
        near_splats,
        near_boxes,
        bins,
        (rotation, translation),
        intrinsics,
        settings,
    )


def rasterize_backward(
    image: Rasterized,
    image_gradients: np.ndarray,
    error: np.ndarray | None = None,
    scratch: Scratch | None = None,
) -> RasterGradients:
    """Differentiate a loss through `rasterize`.

    Args:
        image: The result of `rasterize`.
        image_gradients: (h, w, 9) derivative by summed color (3), depth, normal (3), opacity and distortion.
        error: (h, w) per-pixel error to attribute to the Gaussians that made it.
        scratch: Memory for the result, which is then valid until the next call with it.
    """
    from reconstruction.gaussians import blend_kernels, kernels

    height, width = image.features.shape[:2]
    dtype, n, scratch = image.parameters.dtype, len(image.parameters), scratch or Scratch()
    tiles_x, tiles_y = -(-width // kernels.TILE), -(-height // kernels.TILE)
    entry_gradients = scratch.empty("entries", (len(image.bins[1]), kernels.N_SPLAT_GRADIENTS), dtype)
    if error is None:
        error = np.zeros((height, width), dtype)
    run_over(
        tiles_x * tiles_y,
        blend_kernels.blend_backward,
        image.splats,
        image.boxes,
        image.bins[0],
        image.bins[1],
        _tile_order(tiles_x * tiles_y),
        tiles_x,
        _scalars(image.settings, dtype),
        image.features,
        image_gradients,
        error,
        entry_gradients,
    )
    splat_gradients = scratch.zeros("splat_gradients", (n, kernels.N_SPLAT_GRADIENTS), dtype)
    run_over(
        len(image.rows),
        kernels.reduce_entries,
        entry_gradients,
        image.bins[2],
        image.bins[3],
        image.rows,
        splat_gradients,
    )
    gradients = scratch.zeros("gradients", (n, kernels.N_PARAMETERS), dtype)
    pose_gradients = scratch.empty("pose", (len(image.rows), 6), np.float64)
    run_over(
        len(image.rows),
        kernels.project_backward,
        image.parameters,
        image.rows,
        *image.pose,
        image.intrinsics,
        image.splats,
        splat_gradients,
        gradients,
        pose_gradients,
    )
    return RasterGradients(
        gradients,
        pose_gradients.sum(axis=0),
        splat_gradients[:, :2],
        splat_gradients[:, kernels.S_CONTRIBUTION],
        splat_gradients[:, kernels.S_ERROR],
    )
