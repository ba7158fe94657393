"""Learned pose backends: images in, approximate cameras out, to be refined by bundle adjustment on our matches."""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from reconstruction.core.plugins import load_plugin
from reconstruction.poses.config import PosesConfig
from registry.errors import EnvironmentMissing

_VGGT_WIDTH_PX = 518  # what its loader scales every image to


@dataclass(frozen=True)
class PredictedPoses:
    """One camera per image, in any space, with errors of at most a few degrees and a few percent."""

    world_from_camera: np.ndarray  # float64 (n, 4, 4) OpenCV
    focal_px: float  # shared, at the size of the images


class PoseBackend(Protocol):
    """Predicts cameras."""

    name: str

    def predict(self, images: np.ndarray) -> PredictedPoses:
        """Return one camera for each of the images uint8 (n, h, w, 3)."""
        ...


class VggtBackend:
    """VGGT (facebookresearch/vggt), if installed; its weights are downloaded on first use."""

    name = "vggt"

    def __init__(self, model: str = "facebook/VGGT-1B") -> None:
        """Load the weights.

        Raises:
            EnvironmentMissing: the package is not installed, or its weights cannot be loaded.
        """
        try:
            from vggt.models.vggt import VGGT  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise EnvironmentMissing(
                "poses: the backend vggt is not installed. Run: pip install "
                "'git+https://github.com/facebookresearch/vggt' (and a CUDA build of torch), or leave poses.backend out"
            ) from error
        import torch

        self._device = "cuda" if torch.cuda.is_available() else "cpu"
        try:
            self._model = VGGT.from_pretrained(model).to(self._device).eval()
        except OSError as error:
            raise EnvironmentMissing(f"poses: weights {model} of vggt cannot be loaded: {error}") from error

    def predict(self, images: np.ndarray) -> PredictedPoses:
        """See `PoseBackend.predict`."""
        import torch
        from vggt.utils.load_fn import load_and_preprocess_images  # pyright: ignore[reportMissingImports]
        from vggt.utils.pose_enc import pose_encoding_to_extri_intri  # pyright: ignore[reportMissingImports]

        with tempfile.TemporaryDirectory() as folder, torch.no_grad():
            files = [str(Path(folder) / f"{row:05d}.png") for row in range(len(images))]
            for file, image in zip(files, images):
                cv2.imwrite(file, cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2BGR))
            batch = load_and_preprocess_images(files).to(self._device)
            encoding = self._model(batch)["pose_enc"]
            extrinsic, intrinsic = pose_encoding_to_extri_intri(encoding, batch.shape[-2:])
        camera_from_world = np.tile(np.eye(4), (len(images), 1, 1))
        camera_from_world[:, :3] = extrinsic[0].double().cpu().numpy()
        focal = float(intrinsic[0, :, 0, 0].median()) * images.shape[2] / _VGGT_WIDTH_PX
        return PredictedPoses(np.linalg.inv(camera_from_world), focal)


def load_pose_backend(name: str) -> PoseBackend | None:
    """Return the backend of this name; None for `colmap`, which needs no prediction."""
    if name == "colmap":
        return None
    return VggtBackend() if name == "vggt" else load_plugin("poses.backend", name, PosesConfig)()
