"""Compute LPIPS and MUSIQ if their packages and weights are installed; nothing is downloaded."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import torch

LPIPS_WEIGHTS = "alexnet-owt-7be5be79.pth"  # torchvision's AlexNet, in torch's hub cache
MUSIQ_WEIGHTS = "musiq_koniq_ckpt-*.pth"  # in pyiqa's cache


def weight_files(pattern: str) -> list[Path]:
    """Return the cached weight files that match a pattern, in the caches of torch hub and pyiqa."""
    home = Path(os.environ.get("TORCH_HOME", Path.home() / ".cache" / "torch"))
    places = [home / "hub" / "checkpoints", home / "hub" / "pyiqa", Path.home() / ".cache" / "pyiqa"]
    return sorted(path for place in places if place.is_dir() for path in place.rglob(pattern))


def perceptual_scores(
    rendered: list[np.ndarray], true: list[np.ndarray]
) -> tuple[dict[str, float], dict[str, str]]:
    """Compute LPIPS (AlexNet, lower is better) and MUSIQ (KonIQ, higher is better) of images uint8 (h, w, 3).

    Returns:
        The mean scores by name, and the reason for each that is unavailable.
    """
    scores: dict[str, float] = {}
    left_out: dict[str, str] = {}
    try:
        scores["lpips"] = _lpips(rendered, true)
    except _Unavailable as error:
        left_out["lpips"] = str(error)
    try:
        scores["musiq"] = _musiq(rendered)
    except _Unavailable as error:
        left_out["musiq"] = str(error)
    return scores, left_out


class _Unavailable(Exception):
    """A package or its weights are missing."""


def _tensor(picture: np.ndarray) -> "torch.Tensor":
    import torch

    return torch.from_numpy(np.ascontiguousarray(picture)).permute(2, 0, 1)[None].float() / 255.0


def _lpips(rendered: list[np.ndarray], true: list[np.ndarray]) -> float:
    try:
        import torch
        import torchvision  # noqa: F401 # pyright: ignore[reportMissingImports] - torchmetrics imports it too late
        from torchmetrics.image.lpip import (  # pyright: ignore[reportMissingImports]
            LearnedPerceptualImagePatchSimilarity,
        )
    except ImportError as error:
        raise _Unavailable(f"torchmetrics with torchvision is not installed ({error})") from error
    if not weight_files(LPIPS_WEIGHTS):
        raise _Unavailable(
            f"its weights ({LPIPS_WEIGHTS}) are not in torch's hub cache; they are never downloaded here"
        )
    metric = LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True).eval()
    with torch.inference_mode():
        return float(np.mean([float(metric(_tensor(a), _tensor(b))) for a, b in zip(rendered, true)]))


def _musiq(rendered: list[np.ndarray]) -> float:
    try:
        import pyiqa  # pyright: ignore[reportMissingImports]
        import torch
    except ImportError as error:
        raise _Unavailable(f"pyiqa is not installed ({error})") from error
    found = weight_files(MUSIQ_WEIGHTS)
    if not found:
        raise _Unavailable(
            f"its weights ({MUSIQ_WEIGHTS}) are not in pyiqa's cache; they are never downloaded here"
        )
    weights = str(found[-1])
    metric = pyiqa.create_metric("musiq", pretrained_model_path=weights, device=torch.device("cpu")).eval()
    with torch.inference_mode():
        return float(np.mean([float(metric(_tensor(picture))) for picture in rendered]))
