"""LPIPS and MUSIQ, where a package and its weights are on the machine. Nothing is downloaded here."""

import os
from pathlib import Path

import numpy as np

LPIPS_WEIGHTS = "alexnet-owt-7be5be79.pth"  # torchvision's AlexNet, in torch's hub cache
MUSIQ_WEIGHTS = "musiq_koniq_ckpt-*.pth"  # in pyiqa's cache


def weight_files(pattern: str) -> list[Path]:
    """Return cached weight files of this name under torch's hub folder and pyiqa's."""
    home = Path(os.environ.get("TORCH_HOME", Path.home() / ".cache" / "torch"))
    places = [home / "hub" / "checkpoints", home / "hub" / "pyiqa", Path.home() / ".cache" / "pyiqa"]
    return sorted(path for place in places if place.is_dir() for path in place.rglob(pattern))


def perceptual_scores(
    rendered: list[np.ndarray], true: list[np.ndarray]
) -> tuple[dict[str, float], dict[str, str]]:
    """Compute LPIPS (AlexNet, lower is better) and MUSIQ (KonIQ, higher is better) of pictures uint8 (h, w, 3).

    Returns:
        The scores by name, and for each that is left out the reason.
    """
    scores: dict[str, float] = {}
    left_out: dict[str, str] = {}
    try:
        scores["lpips"] = _lpips(rendered, true)
    except _LeftOut as error:
        left_out["lpips"] = str(error)
    try:
        scores["musiq"] = _musiq(rendered)
    except _LeftOut as error:
        left_out["musiq"] = str(error)
    return scores, left_out


class _LeftOut(Exception):
    """Why a score cannot be computed here."""


def _tensor(picture: np.ndarray):
    import torch

    return torch.from_numpy(np.ascontiguousarray(picture)).permute(2, 0, 1)[None].float() / 255.0


def _lpips(rendered: list[np.ndarray], true: list[np.ndarray]) -> float:
    try:
        import torch
        import torchvision  # noqa: F401 - torchmetrics asks for it only when it is too late for a clear message
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity
    except ImportError as error:
        raise _LeftOut(f"torchmetrics with torchvision is not installed ({error})") from error
    if not weight_files(LPIPS_WEIGHTS):
        raise _LeftOut(
            f"its weights ({LPIPS_WEIGHTS}) are not in torch's hub cache; they are never downloaded here"
        )
    metric = LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True).eval()
    with torch.inference_mode():
        return float(np.mean([float(metric(_tensor(a), _tensor(b))) for a, b in zip(rendered, true)]))


def _musiq(rendered: list[np.ndarray]) -> float:
    try:
        import pyiqa
        import torch
    except ImportError as error:
        raise _LeftOut(f"pyiqa is not installed ({error})") from error
    found = weight_files(MUSIQ_WEIGHTS)
    if not found:
        raise _LeftOut(
            f"its weights ({MUSIQ_WEIGHTS}) are not in pyiqa's cache; they are never downloaded here"
        )
    metric = pyiqa.create_metric(
        "musiq", pretrained_model_path=str(found[-1]), device=torch.device("cpu")
    ).eval()
    with torch.inference_mode():
        return float(np.mean([float(metric(_tensor(picture))) for picture in rendered]))
