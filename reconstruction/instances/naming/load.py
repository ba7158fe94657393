"""Load the naming backend of the config, and apply it."""

from reconstruction.core.plugins import load_plugin
from reconstruction.core.progress import Progress
from reconstruction.core.types import InstanceSet, PosedFrames
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.naming.base import Namer, apply_names
from reconstruction.learned.models import ModelRequest

DEFAULT_CLIP_MODEL = "openai/clip-vit-base-patch32"


def load_namer(config: InstancesConfig) -> Namer | None:
    """Return the backend of `config.labels`; None for the embedded labels.

    Raises:
        EnvironmentMissing: a package, the weights or the endpoint are missing.
        UsageError: the vocabulary is invalid.
    """
    if config.labels == "embedded":
        return None
    if config.labels == "clip":
        from reconstruction.instances.naming.clip import ClipNamer, read_vocabulary

        model = config.labels_model or DEFAULT_CLIP_MODEL
        request = ModelRequest(model, "instances.labels", "instances.labels_model", config.learned_device)
        return ClipNamer(request, read_vocabulary(config.labels_vocabulary))
    if config.labels == "vlm":
        from reconstruction.instances.naming.vlm import VlmNamer
        from reconstruction.learned.vlm import Endpoint, VlmClient

        return VlmNamer(VlmClient(Endpoint.from_environment("instances.labels", config.labels_model)))
    return load_plugin("instances.labels", config.labels, InstancesConfig)(config)


def name_instances(
    namer: Namer, found: InstanceSet, posed: PosedFrames, *, progress: Progress
) -> InstanceSet:
    """Return the instances with the labels of a naming backend."""
    if not found.objects:
        return found
    names = namer.name_objects(found, posed, progress=progress)
    return apply_names(found, names, namer.name, progress=progress)
