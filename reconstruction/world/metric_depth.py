"""Estimate metric scale by a learned metric depth model: backend interface and a `transformers` backend."""

from typing import Protocol

import cv2
import numpy as np

from reconstruction.core.plugins import load_plugin
from reconstruction.core.types import Camera, DepthMaps, PosedFrames
from reconstruction.learned.depth_model import DepthModel
from reconstruction.world.config import WorldConfig
from reconstruction.world.samples import choose_frames
from registry.errors import InputError, UsageError

_FRAMES = 8  # number of frames to predict, at most
_MODEL_SIGMA = 0.08  # relative scale error of such models on indoor benchmarks
_MIN_PIXELS = 500  # with both depths, for a frame to count


class MetricDepthBackend(Protocol):
    """Predicts depth in metres from single images."""

    name: str

    def predict(self, image: np.ndarray, camera: Camera) -> np.ndarray:
        """Return z-depth in metres, float32 (h, w), for an RGB image uint8 (h, w, 3)."""
        ...


class TransformersBackend:
    """A depth-estimation model of the Hugging Face hub (or a local folder)."""

    name = "transformers"

    def __init__(self, model: str) -> None:
        """Load the model."""
        self._model = DepthModel(model, asked_by="world.metric_depth")
        if not self._model.predicts_metres:
            raise UsageError(
                f"world.metric_depth: model {model!r} predicts depth without scale; choose a metric model with "
                "--set world.metric_depth_model=NAME"
            )

    def predict(self, image: np.ndarray, camera: Camera) -> np.ndarray:
        """See `MetricDepthBackend.predict`."""
        (depth,) = self._model.predict([image])
        return cv2.resize(depth, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)


def load_backend(config: WorldConfig) -> MetricDepthBackend | None:
    """Return the backend that the config asks for, or None."""
    if config.metric_depth == "none":
        return None
    if config.metric_depth == "transformers":
        return TransformersBackend(config.metric_depth_model)
    return load_plugin("world.metric_depth", config.metric_depth, WorldConfig)(config)


def metres_per_unit(backend: MetricDepthBackend, posed: PosedFrames, depth: DepthMaps) -> tuple[float, float]:
    """Return metres per `sfm` unit and its relative standard deviation, by the ratio of predicted to measured depth.

    Raises:
        InputError: no frame has enough pixels with both depths.
    """
    ratios = []
    for row in choose_frames(len(posed.images), _FRAMES):
        measured = np.where(np.asarray(depth.confidence[row]) >= 2, np.asarray(depth.depth[row]), 0)
        size = (depth.camera.width, depth.camera.height)
        image = cv2.resize(np.asarray(posed.images[row]), size, interpolation=cv2.INTER_AREA)
        predicted = backend.predict(image, depth.camera)
        good = (measured > 0) & (predicted > 0) & np.isfinite(predicted)
        if good.sum() >= _MIN_PIXELS:
            ratios.append(np.median(predicted[good] / measured[good]))
    if not ratios:
        raise InputError(
            f"world: too few pixels have both measured depth and depth of the metric depth backend {backend.name}; "
            "leave out --set world.metric_depth, or use --scale"
        )
    centre = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(np.array(ratios) / centre - 1)))
    return centre, float(np.hypot(_MODEL_SIGMA, spread / np.sqrt(len(ratios))))
