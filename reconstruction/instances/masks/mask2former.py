"""Masks by Mask2Former through `transformers`, with instance, panoptic or semantic weights; one mask per query."""

import numpy as np

from reconstruction.instances.masks.base import flatten_masks
from reconstruction.learned.models import ModelRequest, load_model, load_part, masks_of

_MIN_SCORE = 0.5


class QueryMasks:
    """An `ImageSegmenter` by Mask2Former."""

    def __init__(self, request: ModelRequest) -> None:
        """Load the model and its image processor.

        Raises:
            EnvironmentMissing: transformers or the weights are missing, or do not fit.
        """
        self._model = load_model(request, "Mask2FormerForUniversalSegmentation")
        self._processor = load_part(request, "AutoImageProcessor")
        self.name = request.model

    def segment(self, image: np.ndarray) -> np.ndarray:
        """See `ImageSegmenter.segment`.

        The score of a query is its class probability times the mean probability inside its mask, as in the model's own
        instance segmentation. Panoptic fusion is left out, since masks may lie within each other here.
        """
        import torch

        inputs = self._processor(images=[np.ascontiguousarray(image)], return_tensors="pt")
        with torch.inference_mode():
            out = self._model(pixel_values=inputs["pixel_values"].to(self._model.device))
            classes = out.class_queries_logits[0].softmax(dim=-1)[:, :-1].max(dim=-1).values
            logits = out.masks_queries_logits[0]
            inside = logits > 0
            sure = (logits.sigmoid() * inside).flatten(1).sum(1) / inside.flatten(1).sum(1).clamp(min=1)
            score = classes * sure
            good = score > _MIN_SCORE
            masks = masks_of(logits[good], *image.shape[:2])
        return flatten_masks(masks, score[good].float().cpu().numpy())
