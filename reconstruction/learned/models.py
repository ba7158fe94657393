"""Load models by `transformers`: classes, weights, devices, and errors that say what is missing.

Weights come from a folder or from the local cache of the Hugging Face hub, which downloads them if it may.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image

from registry.errors import EnvironmentMissing

EXTRA = "models"
_MISSING_SHARE = 0.05  # of the parameters, that a checkpoint may leave out
_MASKS_AT_ONCE = 32  # upsampled together, which bounds memory


@dataclass(frozen=True)
class ModelRequest:
    """A model to load, and the options to name in messages."""

    model: str  # name on the hub, or a folder with config and weights
    asked_by: str  # the option that selects it
    model_option: str  # the option that names it
    device: str = "auto"  # "cpu", "cuda", "cuda:1", ...; "auto" is cuda if available


def transformers_class(name: str, asked_by: str) -> Any:
    """Return a class of `transformers`.

    Raises:
        EnvironmentMissing: transformers or torch is not installed, or transformers lacks the class.
    """
    install = f"`pip install -U 'simrecon[{EXTRA}]'`, or leave that option out"
    try:
        import torch  # noqa: F401  (without it, classes are placeholders that fail only when used)
        import transformers
    except ImportError as error:
        raise EnvironmentMissing(f"{asked_by} needs {error.name}; {install}") from error
    try:
        return getattr(transformers, name)
    except AttributeError as error:
        version = transformers.__version__
        raise EnvironmentMissing(f"{asked_by}: transformers {version} has no {name}; {install}") from error


def load_part(request: ModelRequest, class_name: str) -> Any:
    """Load an image processor or tokenizer of a model.

    Raises:
        EnvironmentMissing: transformers or the files are missing or cannot be loaded.
    """
    cls = transformers_class(class_name, request.asked_by)
    try:
        return cls.from_pretrained(request.model)
    except (ImportError, OSError, ValueError, RuntimeError) as error:
        raise _not_loaded(request, error) from error


def load_model(request: ModelRequest, class_name: str) -> Any:
    """Load a model for inference onto its device.

    Raises:
        EnvironmentMissing: transformers or the weights are missing, or the weights are of another architecture, for
            which transformers itself would use random ones.
    """
    cls = transformers_class(class_name, request.asked_by)
    try:
        model, info = cls.from_pretrained(request.model, output_loading_info=True)
        model = model.to(pick_device(request.device)).eval()
    except (ImportError, OSError, ValueError, RuntimeError, AttributeError) as error:
        raise _not_loaded(request, error) from error
    sizes = {name: parameter.numel() for name, parameter in model.named_parameters()}
    missing = sorted(name for name in info["missing_keys"] if name in sizes)
    # Some published weights lack a layer that is never used.
    if sum(sizes[name] for name in missing) > _MISSING_SHARE * sum(sizes.values()):
        raise EnvironmentMissing(
            f"{request.asked_by}: {request.model!r} holds no weights for {len(missing)} of the {len(sizes)} parts of "
            f"a {class_name} ({missing[0]}, ...): it is another kind of model. Name one that fits with --set "
            f"{request.model_option}=NAME"
        )
    return model


def pick_device(device: str) -> str:
    """Return the torch device name; "auto" is cuda if available."""
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
    """Image preprocessor of SAM models: stretch to a square, normalize.

    Replaces the image processors of these models, which need torchvision.
    """

    def __init__(self, request: ModelRequest, side_px: int) -> None:
        """Read mean and standard deviation from the model's preprocessing file."""
        mixin = transformers_class("ImageProcessingMixin", request.asked_by)
        try:
            settings, _ = mixin.get_image_processor_dict(request.model)
            self._mean = np.asarray(settings["image_mean"], np.float32)
            self._std = np.asarray(settings["image_std"], np.float32)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise _not_loaded(request, error) from error
        self.side_px = side_px

    def __call__(self, image: np.ndarray) -> Any:
        """Convert an RGB image uint8 (h, w, 3) to a tensor float32 (1, 3, side, side)."""
        import torch

        side = self.side_px
        resized = Image.fromarray(np.ascontiguousarray(image)).resize((side, side), Image.Resampling.BILINEAR)
        values = (np.asarray(resized, np.float32) / 255.0 - self._mean) / self._std
        return torch.from_numpy(np.ascontiguousarray(values.transpose(2, 0, 1)))[None]


def masks_of(logits: Any, height: int, width: int) -> np.ndarray:
    """Upsample mask logits, a tensor (k, h, w), bilinearly and threshold at 0: bool (k, height, width)."""
    import torch

    out = np.zeros((len(logits), height, width), bool)
    for first in range(0, len(logits), _MASKS_AT_ONCE):
        some = logits[None, first : first + _MASKS_AT_ONCE].float()
        larger = torch.nn.functional.interpolate(some, (height, width), mode="bilinear", align_corners=False)
        out[first : first + _MASKS_AT_ONCE] = (larger[0] > 0).cpu().numpy()
    return out
