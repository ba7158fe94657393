"""Masks by SAM 2 and SAM 3 through `transformers`: everything in an image from a grid of points, or named concepts.

The grid is that of the models' own automatic mask generators: three masks a point, kept where the model trusts them
and where they hardly change with the threshold, of near doubles the most trusted. SAM 3 can be asked for concepts
(noun phrases) instead, and then returns every instance of each.
"""

from typing import Any

import numpy as np

from reconstruction.instances.masks.base import flatten_masks
from reconstruction.learned.models import ModelRequest, SquareImages, load_model, load_part, masks_of

_POINTS_A_BATCH = 64
_MIN_TRUST = 0.8  # IoU that the model expects of its mask with the truth
_MIN_STABILITY, _STABILITY_OFFSET = 0.95, 1.0  # IoU of the masks at thresholds that far above and below 0
_DOUBLE = 0.7  # boxes with a larger IoU are of one thing
_MIN_SHARE = 1e-4  # of the image; smaller masks are specks
_MIN_CONCEPT_SCORE = 0.5
_TEXT_TOKENS = 32  # what SAM 3 was trained with


class PointGridMasks:
    """SAM 2, or the tracker half of SAM 3, prompted with a grid of points: an `ImageSegmenter`."""

    def __init__(self, request: ModelRequest, class_name: str, points_a_side: int) -> None:
        """Load `Sam2Model` or `Sam3TrackerModel`.

        Raises:
            EnvironmentMissing: transformers or the weights are missing, or do not fit.
        """
        self._model = load_model(request, class_name)
        self._square = SquareImages(request, _side(self._model.config.prompt_encoder_config.image_size))
        self._grid = point_grid(points_a_side) * self._square.side_px
        self.name = request.model

    def segment(self, image: np.ndarray) -> np.ndarray:
        """See `ImageSegmenter.segment`."""
        import torch

        points = torch.from_numpy(self._grid).to(self._model.device)
        kept, scores = [], []
        with torch.inference_mode():
            pixels = self._square(image).to(self._model.device)
            embeddings = self._model.get_image_embeddings(pixels)
            for batch in points.split(_POINTS_A_BATCH):
                out = self._model(
                    image_embeddings=embeddings,
                    input_points=batch[None, :, None],
                    input_labels=torch.ones((1, len(batch), 1), dtype=torch.int64, device=batch.device),
                    multimask_output=True,
                )
                logits, trust = out.pred_masks[0].flatten(0, 1), out.iou_scores[0].flatten()
                good = (trust > _MIN_TRUST) & (stability(logits) > _MIN_STABILITY)
                kept.append(logits[good])
                scores.append(trust[good])
            logits, trust = torch.cat(kept), torch.cat(scores).float().cpu().numpy()
            rows = without_doubles(boxes_of((logits > 0).cpu().numpy()), trust)
            masks = masks_of(logits[torch.from_numpy(rows).to(logits.device)], *image.shape[:2])
        return flatten_large(masks, trust[rows])


class ConceptMasks:
    """SAM 3 asked for every instance of some concepts: an `ImageSegmenter`."""

    def __init__(self, request: ModelRequest, concepts: tuple[str, ...]) -> None:
        """Load `Sam3Model` and its tokenizer, and encode the concepts once.

        Raises:
            EnvironmentMissing: transformers or the weights are missing, or do not fit.
        """
        import torch

        self._model = load_model(request, "Sam3Model")
        tokenizer = load_part(request, "AutoTokenizer")
        self._square = SquareImages(request, _side(self._model.config.image_size))
        self._concepts = []
        with torch.inference_mode():
            for concept in concepts:
                tokens = tokenizer(
                    concept,
                    return_tensors="pt",
                    padding="max_length",
                    truncation=True,
                    max_length=_TEXT_TOKENS,
                ).to(self._model.device)
                ids, seen = tokens["input_ids"], tokens["attention_mask"]
                text = self._model.get_text_features(input_ids=ids, attention_mask=seen, return_dict=True)
                self._concepts.append((text, seen))
        self.name = f"{request.model} ({', '.join(concepts)})"

    def segment(self, image: np.ndarray) -> np.ndarray:
        """See `ImageSegmenter.segment`."""
        import torch

        masks, scores = [], []
        with torch.inference_mode():
            vision = self._model.get_vision_features(pixel_values=self._square(image).to(self._model.device))
            for text, seen in self._concepts:
                out = self._model(vision_embeds=vision, text_embeds=text, attention_mask=seen)
                score = out.pred_logits[0].sigmoid() * out.presence_logits[0].sigmoid()
                good = score > _MIN_CONCEPT_SCORE
                masks.append(masks_of(out.pred_masks[0][good], *image.shape[:2]))
                scores.append(score[good].float().cpu().numpy())
        return flatten_large(np.concatenate(masks), np.concatenate(scores))


def point_grid(points_a_side: int) -> np.ndarray:
    """Return points (n * n, 2), x then y, in the middle of the cells of a grid over the unit square."""
    along = ((np.arange(points_a_side) + 0.5) / points_a_side).astype(np.float32)
    return np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)


def stability(logits: Any) -> Any:
    """Return (k,) of mask logits (k, h, w), a tensor: how little the masks change with the threshold, 0 to 1."""
    inner = (logits > _STABILITY_OFFSET).flatten(1).sum(1)
    outer = (logits > -_STABILITY_OFFSET).flatten(1).sum(1)
    return inner / outer.clamp(min=1)


def boxes_of(masks: np.ndarray) -> np.ndarray:
    """Return the boxes float64 (k, 4), x0 y0 x1 y1 with the far edges outside, of masks bool (k, h, w)."""
    boxes = np.zeros((len(masks), 4))
    for axis, (low, high) in ((1, (0, 2)), (2, (1, 3))):
        hit = masks.any(axis=axis)
        some = hit.any(axis=1)
        boxes[some, low] = hit.argmax(axis=1)[some]
        boxes[some, high] = hit.shape[1] - hit[:, ::-1].argmax(axis=1)[some]
    return boxes


def without_doubles(boxes: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Return rows int64 (m,), the best first, of boxes (k, 4) after greedy suppression; empty boxes are left out."""
    area = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    open_rows = np.lexsort((np.arange(len(boxes)), -scores))
    open_rows = open_rows[area[open_rows] > 0]
    kept = []
    while len(open_rows):
        first, rest = open_rows[0], open_rows[1:]
        kept.append(first)
        low, high = (
            np.maximum(boxes[first, :2], boxes[rest, :2]),
            np.minimum(boxes[first, 2:], boxes[rest, 2:]),
        )
        common = np.prod(np.clip(high - low, 0, None), axis=1)
        open_rows = rest[common <= _DOUBLE * (area[first] + area[rest] - common)]
    return np.array(kept, np.int64)


def flatten_large(masks: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Return the id image of masks bool (k, h, w), specks left out."""
    large = masks.sum(axis=(1, 2)) >= _MIN_SHARE * np.prod(masks.shape[1:])
    return flatten_masks(masks[large], scores[large])


def _side(size: Any) -> int:
    """Return the side of the square images that a model wants; its config holds one number or two."""
    return int(size if isinstance(size, int) else size[0])
