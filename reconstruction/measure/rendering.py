"""Render the assembled scene at held-out cameras and compare it with the held-out frames: PSNR, SSIM, coverage."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reconstruction.core.types import Camera, TexturedMesh
from reconstruction.publish.preview import render_textured

_SSIM_SIGMA = 1.5  # pixels, standard deviation of the window


@dataclass(frozen=True)
class RenderScore:
    """Image similarity over the covered pixels; means over frames."""

    psnr_db: float
    ssim: float
    coverage: float  # share of covered pixels
    frames: int


def score_pictures(
    rendered: list[np.ndarray], covered: list[np.ndarray], true: list[np.ndarray]
) -> RenderScore | None:
    """Compare images uint8 (h, w, 3) over the covered pixels bool (h, w); None if no frame has any.

    PSNR of a frame is 10 log10(255^2 / MSE over its covered pixels and channels). SSIM (Wang et al. 2004) has a
    Gaussian window of sigma 1.5; its map is averaged over the covered pixels. Uncovered frames add coverage 0.
    """
    from skimage.metrics import structural_similarity

    psnr, ssim, coverage = [], [], []
    for picture, mask, truth in zip(rendered, covered, true):
        coverage.append(float(mask.mean()))
        if not mask.any():
            continue
        error = (picture.astype(np.float64) - truth.astype(np.float64))[mask]
        psnr.append(10 * np.log10(255.0**2 / max(float((error**2).mean()), 1e-10)))
        # Outside of the covered pixels both images are made equal, so that the background does not affect the window.
        filled = np.where(mask[..., None], picture, truth)
        _, full = structural_similarity(  # pyright: ignore[reportAssignmentType]
            truth,
            filled,
            channel_axis=2,
            data_range=255,
            gaussian_weights=True,
            sigma=_SSIM_SIGMA,
            use_sample_covariance=False,
            full=True,
        )
        ssim.append(float(full[mask].mean()))
    if not psnr:
        return None
    return RenderScore(float(np.mean(psnr)), float(np.mean(ssim)), float(np.mean(coverage)), len(coverage))


def render_views(
    meshes: list[tuple[TexturedMesh, np.ndarray]], camera: Camera, poses: list[np.ndarray]
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Render textured meshes, each with its `world_from_mesh`; return images and masks of covered pixels."""
    pictures, covered = [], []
    for pose in poses:
        picture, depth = render_textured(meshes, camera, pose)
        pictures.append(picture)
        covered.append(depth > 0)
    return pictures, covered


def before_backdrop(
    pictures: list[np.ndarray],
    covered: list[np.ndarray],
    backdrop: TexturedMesh | None,
    camera: Camera,
    poses: list[np.ndarray],
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Fill the uncovered pixels of images with a backdrop; return images and masks of covered pixels."""
    if backdrop is None:
        return pictures, covered
    behind, shown = render_views([(backdrop, np.eye(4))], camera, poses)
    filled = [np.where(mask[..., None], near, far) for near, mask, far in zip(pictures, covered, behind)]
    return filled, [near | far for near, far in zip(covered, shown)]


def video_frames(video: Path, indices: list[int], camera: Camera) -> dict[int, np.ndarray]:
    """Decode frames of a video, or read images of a folder, by index; resized to the camera, not undistorted."""
    import cv2

    from reconstruction.frames.decoding import ImageFolder, VideoReader

    side = max(camera.width, camera.height)
    found = {}
    if video.is_dir():
        folder = ImageFolder(video)
        found = {i: folder.load_rgb(i, side) for i in indices if i < len(folder.files)}
    else:
        reader = VideoReader(video)
        for number, _, _, frame in reader.frames():
            if number in set(indices):
                found[number] = reader.to_rgb(frame, side)
            if number >= max(indices, default=-1):
                break
    size = (camera.width, camera.height)
    return {i: cv2.resize(x, size, interpolation=cv2.INTER_AREA) for i, x in found.items() if x is not None}
