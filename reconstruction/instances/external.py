"""Inputs of the stage besides its config and the earlier stages: folders of masks and weights, the endpoint's model."""

import os
from pathlib import Path

from reconstruction.cache import digest_input
from reconstruction.instances.config import InstancesConfig


def outside_inputs(config: InstancesConfig) -> tuple[str, ...]:
    """Return digests of the folders that the config names, and the endpoint's model, for the cache key of the stage.

    Models on the hub are identified by their names in the config.
    """
    named = {
        "masks": config.masks_path if config.masks == "folder" else config.masks_model,
        "labels": config.labels_model if config.labels == "clip" else "",
    }
    out = []
    for what, name in named.items():
        if name and getattr(config, what) != "embedded" and Path(name).exists():
            out.append(f"{what} {digest_input(Path(name))}")
    if config.labels == "vlm":
        out.append(f"labels {config.labels_model or os.environ.get('SIMRECON_VLM_MODEL', '')}")
    return tuple(out)


def backends(config: InstancesConfig) -> dict[str, str]:
    """Return the backends of masks and labels, with their models, for the bundle's report."""
    from reconstruction.instances.masks import DEFAULT_MODELS
    from reconstruction.instances.naming import DEFAULT_CLIP_MODEL

    model = config.masks_model or DEFAULT_MODELS.get(config.masks, "")
    masks = f"{config.masks} ({model})" if config.masks in DEFAULT_MODELS else config.masks
    defaults = {"clip": DEFAULT_CLIP_MODEL, "vlm": os.environ.get("SIMRECON_VLM_MODEL", "")}
    labels = config.labels
    if labels in defaults:
        labels = f"{labels} ({config.labels_model or defaults[labels]})"
    return {"masks": masks, "labels": labels}
