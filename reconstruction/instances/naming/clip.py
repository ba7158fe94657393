"""Zero-shot labels by a CLIP-like model (`transformers`): the word most similar to an object's images."""

from pathlib import Path

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.core.types import InstanceSet, PosedFrames
from reconstruction.instances.naming.base import LABEL_RULE, Name, is_label
from reconstruction.instances.naming.views import best_views
from reconstruction.learned.models import ModelRequest, load_model, load_part
from registry.errors import UsageError

# Negative prompts: an object that is more similar to one of these gets no name.
_NO_THING = ("a photo of a wall", "a photo of a floor", "a blurry photo", "a photo of nothing in particular")
_TEMPLATE = "a photo of a {}"
_MIN_MARGIN = 0.1  # least margin in probability over the second-best text


class ClipNamer:
    """A `Namer` with a joint embedding of texts and images: CLIP, SigLIP, ..."""

    def __init__(self, request: ModelRequest, vocabulary: tuple[str, ...]) -> None:
        """Load the model and embed the vocabulary.

        Raises:
            EnvironmentMissing: transformers or the weights are missing, or do not fit.
        """
        import torch

        self._words = vocabulary
        self._model = load_model(request, "AutoModel")
        self._processor = load_part(request, "AutoImageProcessor")
        tokenizer = load_part(request, "AutoTokenizer")
        texts = [*(_TEMPLATE.format(word) for word in vocabulary), *_NO_THING]
        length = self._model.config.text_config.max_position_embeddings
        siglip = self._model.config.model_type.startswith("siglip")  # trained with padding to the full length
        padding = "max_length" if siglip else True
        tokens = tokenizer(texts, padding=padding, truncation=True, max_length=length, return_tensors="pt")
        with torch.inference_mode():
            embedded = self._model.get_text_features(**tokens.to(self._model.device))
            self._texts = _directions(embedded)
        self.name = request.model

    def name_objects(
        self, found: InstanceSet, posed: PosedFrames, *, progress: Progress
    ) -> list[Name | None]:
        """See `Namer.name_objects`."""
        views = best_views(found, posed)
        progress.start(len(found.objects), f"names by {self.name}")
        names = []
        for item in found.objects:
            pictures = [view.dimmed() for view in views[item.id]]
            names.append(choose(self._words, self.probabilities(pictures)) if pictures else None)
            progress.advance()
        return names

    def probabilities(self, pictures: list[np.ndarray]) -> np.ndarray:
        """Return (views, words + negative prompts), each row summing to 1."""
        import torch

        inputs = self._processor(images=pictures, return_tensors="pt").to(self._model.device)
        with torch.inference_mode():
            images = _directions(self._model.get_image_features(**inputs))
            likeness = self._model.logit_scale.exp() * images @ self._texts.T
        return likeness.softmax(dim=-1).double().cpu().numpy()


def choose(words: tuple[str, ...], probabilities: np.ndarray) -> Name | None:
    """Return the word with the highest mean probability; None for a negative prompt or too small a margin.

    The confidence is the margin over the best other text, averaged over the views.

    Args:
        words: the vocabulary.
        probabilities: (views, k), k >= len(words); columns after the words belong to negative prompts.
    """
    mean = probabilities.mean(axis=0)
    best = int(np.argmax(mean))
    margin = float((probabilities[:, best] - np.delete(probabilities, best, axis=1).max(axis=1)).mean())
    if best >= len(words) or margin < _MIN_MARGIN:
        return None
    return Name(words[best], min(margin, 1.0))


def read_vocabulary(listed: str) -> tuple[str, ...]:
    """Return the words of a comma-separated list; an empty one stands for the built-in list of household objects.

    Raises:
        UsageError: fewer than two words, or one that cannot be a label.
    """
    if listed.strip():
        words = [word.strip().lower() for word in listed.split(",") if word.strip()]
    else:
        lines = (Path(__file__).parent / "vocabulary.txt").read_text().splitlines()
        words = [line.strip() for line in lines if line.strip() and not line.startswith("#")]
    words = list(dict.fromkeys(words))
    for word in words:
        if not is_label(word):
            raise UsageError(f"instances.labels_vocabulary: {word!r} is no label: {LABEL_RULE}")
    if len(words) < 2:
        raise UsageError("instances.labels_vocabulary: at least two words are needed to choose from")
    return tuple(words)


def _directions(embedded):
    """Return normalized embeddings (n, d); older versions of `transformers` return the tensor itself."""
    vectors = getattr(embedded, "pooler_output", embedded)
    return vectors / vectors.norm(dim=-1, keepdim=True)
