"""Learned depth from single images: the models of `transformers`, for the depth stage and for the scale ladder.

Any model that `AutoModelForDepthEstimation` opens will do: Depth Anything, DPT and MiDaS predict inverse depth up to
scale and shift; their metric variants, ZoeDepth and Depth Pro predict metres. Weights are read from a folder or from
the local cache of the Hugging Face hub, which downloads them where it may.
"""

import cv2
import numpy as np

from registry.errors import EnvironmentMissing

EXTRA = "depth-models"
_METRIC_FAMILIES = ("zoedepth", "depth_pro")


class DepthModel:
    """A depth-estimation model of the Hugging Face hub, or of a local folder."""

    def __init__(self, model: str, *, asked_by: str, device: str = "auto") -> None:
        """Load the model.

        Args:
            model: Name on the hub, or a folder with config, weights and image processor.
            asked_by: The option that asks for it, for messages.
            device: "cpu", "cuda", "cuda:1", ...; "auto" is cuda where there is one.

        Raises:
            EnvironmentMissing: transformers or the model is not there, or cannot be loaded.
        """
        try:
            import torch
            from transformers import AutoImageProcessor, AutoModelForDepthEstimation
        except ImportError as error:
            raise EnvironmentMissing(
                f"{asked_by} needs {error.name}; `pip install 'simrecon[{EXTRA}]'`, or leave that option out"
            ) from error
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        try:
            self._processor = AutoImageProcessor.from_pretrained(model)
            self._model = AutoModelForDepthEstimation.from_pretrained(model).to(device).eval()
        except (ImportError, OSError, ValueError, RuntimeError) as error:
            raise EnvironmentMissing(
                f"{asked_by}: the depth model {model!r} cannot be loaded ({error}); download it first, "
                f"or name its folder with --set {asked_by}_model=DIR"
            ) from error
        self.name = model
        self.device = device
        config = self._model.config
        self.predicts_metres = (
            getattr(config, "depth_estimation_type", "relative") == "metric"
            or config.model_type in _METRIC_FAMILIES
        )

    def predict(self, images: list[np.ndarray]) -> list[np.ndarray]:
        """Return what the model says of RGB images uint8 (h, w, 3), one float32 (h, w) each.

        That is z-depth in metres where `predicts_metres`, else inverse depth up to scale and shift.
        """
        import torch

        inputs = self._processor(images=images, return_tensors="pt").to(self.device)
        with torch.inference_mode():
            predicted = self._model(**inputs).predicted_depth
        maps = predicted.reshape(len(images), *predicted.shape[-2:]).float().cpu().numpy()
        return [
            cv2.resize(one, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_LINEAR)
            for one, image in zip(maps, images)
        ]
