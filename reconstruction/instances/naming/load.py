"""Which backend names things: what the config asks for, loaded and applied."""

from reconstruction.core.progress import Progress
from reconstruction.core.types import InstanceSet, PosedFrames
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.naming.base import Namer, apply_names
from reconstruction.learned.models import ModelRequest

DEFAULT_CLIP_MODEL = "openai/clip-vit-base-patch32"


def load_namer(config: InstancesConfig) -> Namer | None:
    """Return the backend that `config.labels` asks for; None for the embedded labels.

    Raises:
        EnvironmentMissing: it needs something that is not installed, weights or an endpoint that are not there.
        UsageError: the vocabulary is none.
    """
    if config.labels == "clip":
        from reconstruction.instances.naming.clip import ClipNamer, read_vocabulary

        model = config.labels_model or DEFAULT_CLIP_MODEL
        request = ModelRequest(model, "instances.labels", "instances.labels_model", config.learned_device)
        return ClipNamer(request, read_vocabulary(config.labels_vocabulary))
    if config.labels == "vlm":
        from reconstruction.instances.naming.vlm import VlmNamer
        from reconstruction.learned.vlm import Endpoint, VlmClient

        return VlmNamer(VlmClient(Endpoint.from_environment("instances.labels", config.labels_model)))
    return None


def name_instances(
    namer: Namer, found: InstanceSet, posed: PosedFrames, *, progress: Progress
) -> InstanceSet:
    """Return the instances under the names that a backend gives them."""
    if not found.objects:
        return found
    return apply_names(
        found, namer.name_objects(found, posed, progress=progress), namer.name, progress=progress
    )
