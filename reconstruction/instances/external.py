"""What the stage reads besides its config and the stages before it: folders, and the endpoint's model."""

import os
from pathlib import Path

from reconstruction.cache import digest_input
from reconstruction.instances.config import InstancesConfig


def outside_inputs(config: InstancesConfig) -> tuple[str, ...]:
    """Return what is behind the names in the config: other masks or weights in a folder must not reuse a result.

    A model that is named as on the hub stands for itself.
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
    """Say what made the masks and the labels, for the bundle."""
    from reconstruction.instances.masks import DEFAULT_MODELS
    from reconstruction.instances.naming import DEFAULT_CLIP_MODEL

    model = config.masks_model or DEFAULT_MODELS.get(config.masks, "")
    masks = f"{config.masks} ({model})" if config.masks in DEFAULT_MODELS else config.masks
    defaults = {"clip": DEFAULT_CLIP_MODEL, "vlm": os.environ.get("SIMRECON_VLM_MODEL", "")}
    labels = config.labels
    if labels in defaults:
        labels = f"{labels} ({config.labels_model or defaults[labels]})"
    return {"masks": masks, "labels": labels}
