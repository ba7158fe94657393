"""Load the mask backend of the config."""

from pathlib import Path

from reconstruction.core.plugins import load_plugin
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.masks.base import ImageSegmenter, KeyframeMasks, MaskBackend
from reconstruction.instances.masks.folder import FolderMasks
from reconstruction.learned.models import ModelRequest

# Used where `masks_model` is empty. Licenses: docs/masks.md.
DEFAULT_MODELS = {
    "sam2": "facebook/sam2.1-hiera-small",
    "sam3": "facebook/sam3",
    "mask2former": "facebook/mask2former-swin-large-ade-panoptic",
}


def load_mask_backend(config: InstancesConfig) -> MaskBackend | None:
    """Return the backend of `config.masks`; None for the embedded partition, which needs no masks.

    Raises:
        UsageError: `masks_path` is not a folder of id images.
        EnvironmentMissing: a package or the weights of a model are missing.
    """
    if config.masks == "embedded":
        return None
    if config.masks == "folder":
        return FolderMasks(Path(config.masks_path))
    if config.masks in DEFAULT_MODELS:
        return KeyframeMasks(_load_segmenter(config))
    return load_plugin("instances.masks", config.masks, InstancesConfig)(config)


def _load_segmenter(config: InstancesConfig) -> ImageSegmenter:
    model = config.masks_model or DEFAULT_MODELS[config.masks]
    request = ModelRequest(model, "instances.masks", "instances.masks_model", config.learned_device)
    if config.masks == "mask2former":
        from reconstruction.instances.masks.mask2former import QueryMasks

        return QueryMasks(request)
    from reconstruction.instances.masks.sam import ConceptMasks, PointGridMasks

    concepts = tuple(word.strip() for word in config.masks_concepts.split(",") if word.strip())
    if config.masks == "sam3" and concepts:
        return ConceptMasks(request, concepts)
    class_name = "Sam2Model" if config.masks == "sam2" else "Sam3TrackerModel"
    return PointGridMasks(request, class_name, config.masks_points)
