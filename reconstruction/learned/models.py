"""Learned models through `transformers`: loading, devices, and messages for what is missing; shared by all of them.

Weights are read from a folder or from the local cache of the Hugging Face hub, which downloads them where it may.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image

from registry.errors import EnvironmentMissing

EXTRA = "models"
_MISSING_SHARE = 0.05
_MASKS_AT_ONCE = 32


@dataclass(frozen=True)
class ModelRequest:
    """Which model is asked for, and by which option."""

    model: str  # name on the hub, or a folder with config and weights
    asked_by: str  # the option that asks for it, for messages
    model_option: str  # the option that names it
    device: str = "auto"  # "cpu", "cuda", "cuda:1", ...; "auto" is cuda where there is one


def transformers_class(name: str, asked_by: str) -> Any:
    """Return a class of `transformers`.

    Raises:
        EnvironmentMissing: transformers or torch is not installed, or it is too old to have that class.
    """
    install = f"`pip install -U 'simrecon[{EXTRA}]'`, or leave that option out"
    try:
        import torch  # noqa: F401  (classes without it are hollow, and say so late)
        import transformers
    except ImportError as error:
        raise EnvironmentMissing(f"{asked_by} needs {error.name}; {install}") from error
    try:
        return getattr(transformers, name)
    except AttributeError as error:
        raise EnvironmentMissing(
            f"{asked_by}: transformers {transformers.__version__} has no {name}; {install}"
        ) from error


def load_part(request: ModelRequest, class_name: str) -> Any:
    """Load what goes with a model: its image processor, its tokenizer.

    Raises:
        EnvironmentMissing: transformers or the files are not there, or cannot be loaded.
    """
    cls = transformers_class(class_name, request.asked_by)
    try:
        return cls.from_pretrained(request.model)
    except (ImportError, OSError, ValueError, RuntimeError) as error:
        raise _not_loaded(request, error) from error


def load_model(request: ModelRequest, class_name: str) -> Any:
    """Load a model for inference, on its device.

    Raises:
        EnvironmentMissing: transformers or the weights are not there, or they are those of another kind of model
            (which transformers itself would replace by random ones).
    """
    cls = transformers_class(class_name, request.asked_by)
    try:
        model, info = cls.from_pretrained(request.model, output_loading_info=True)
        model = model.to(pick_device(request.device)).eval()
    except (ImportError, OSError, ValueError, RuntimeError, AttributeError) as error:
        raise _not_loaded(request, error) from error
    sizes = {name: parameter.numel() for name, parameter in model.named_parameters()}
    missing = sorted(name for name in info["missing_keys"] if name in sizes)
    # Some published weights leave out a layer that is never used.
    if sum(sizes[name] for name in missing) > _MISSING_SHARE * sum(sizes.values()):
        raise EnvironmentMissing(
            f"{request.asked_by}: {request.model!r} holds no weights for {len(missing)} of the {len(sizes)} parts of "
            f"a {class_name} ({missing[0]}, ...): it is another kind of model. Name one that fits with --set "
            f"{request.model_option}=NAME"
        )
    return model


def pick_device(device: str) -> str:
    """Return the torch device of a name; "auto" is cuda where there is one."""
    import torch

    if device != "auto":
        return device
    return "cuda" if torch.cuda.is_available() else "cpu"


def _not_loaded(request: ModelRequest, error: Exception) -> EnvironmentMissing:
    reason = " ".join(str(error).split())
    reason = reason if len(reason) <= 300 else reason[:300] + "..."
    return EnvironmentMissing(
        f"{request.asked_by}: the model {request.model!r} cannot be loaded ({reason}). Download it first "
        f"(`hf download {request.model}`), or name its folder with --set {request.model_option}=DIR"
    )


class SquareImages:
    """Images as SAM models want them: stretched to a square, normalized.

    Done here because the image processors of these models need torchvision, which SimRecon does not.
    """

    def __init__(self, request: ModelRequest, side_px: int) -> None:
        """Read mean and deviation from the model's own preprocessing file."""
        mixin = transformers_class("ImageProcessingMixin", request.asked_by)
        try:
            settings, _ = mixin.get_image_processor_dict(request.model)
            self._mean = np.asarray(settings["image_mean"], np.float32)
            self._std = np.asarray(settings["image_std"], np.float32)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise _not_loaded(request, error) from error
        self.side_px = side_px

    def __call__(self, image: np.ndarray) -> Any:
        """Return a float32 tensor (1, 3, side, side) of an RGB image uint8 (h, w, 3)."""
        import torch

        side = self.side_px
        resized = Image.fromarray(np.ascontiguousarray(image)).resize((side, side), Image.Resampling.BILINEAR)
        values = (np.asarray(resized, np.float32) / 255.0 - self._mean) / self._std
        return torch.from_numpy(np.ascontiguousarray(values.transpose(2, 0, 1)))[None]


def masks_of(logits: Any, height: int, width: int) -> np.ndarray:
    """Return masks bool (k, height, width): where mask logits, a tensor (k, h, w), are positive between its pixels."""
    import torch

    out = np.zeros((len(logits), height, width), bool)
    for first in range(0, len(logits), _MASKS_AT_ONCE):
        some = logits[None, first : first + _MASKS_AT_ONCE].float()
        larger = torch.nn.functional.interpolate(some, (height, width), mode="bilinear", align_corners=False)
        out[first : first + _MASKS_AT_ONCE] = (larger[0] > 0).cpu().numpy()
    return out
