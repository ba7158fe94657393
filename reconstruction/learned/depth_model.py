"""Monocular depth estimation by models of `transformers`, for the depth stage and for metric scale.

Any model that `AutoModelForDepthEstimation` loads: Depth Anything, DPT and MiDaS predict inverse depth up to scale and
shift; their metric variants, ZoeDepth and Depth Pro predict metres.
"""

import cv2
import numpy as np

from reconstruction.learned.models import ModelRequest, load_model, load_part

_METRIC_FAMILIES = ("zoedepth", "depth_pro")


class DepthModel:
    """A depth estimation model from the Hugging Face hub or a local folder."""

    def __init__(self, model: str, *, asked_by: str, device: str = "auto") -> None:
        """Load the model.

        Args:
            model: name on the hub, or a folder with config, weights and image processor.
            asked_by: the option that selects it, for messages.
            device: "cpu", "cuda", "cuda:1", ...; "auto" is cuda if available.

        Raises:
            EnvironmentMissing: transformers or the model is missing or cannot be loaded.
        """
        request = ModelRequest(model, asked_by, f"{asked_by}_model", device)
        self._processor = load_part(request, "AutoImageProcessor")
        self._model = load_model(request, "AutoModelForDepthEstimation")
        self.name = model
        config = self._model.config
        self.predicts_metres = (
            getattr(config, "depth_estimation_type", "relative") == "metric"
            or config.model_type in _METRIC_FAMILIES
        )

    def predict(self, images: list[np.ndarray]) -> list[np.ndarray]:
        """Predict a depth map float32 (h, w) for each of the RGB images uint8 (h, w, 3).

        Values are z-depth in metres if `predicts_metres`, else inverse depth up to scale and shift.
        """
        import torch

        inputs = self._processor(images=images, return_tensors="pt").to(self._model.device)
        with torch.inference_mode():
            predicted = self._model(**inputs).predicted_depth
        maps = predicted.reshape(len(images), *predicted.shape[-2:]).float().cpu().numpy()
        return [
            cv2.resize(one, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_LINEAR)
            for one, image in zip(maps, images)
        ]
