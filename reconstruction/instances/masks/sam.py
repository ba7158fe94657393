"""Masks by SAM 2 and SAM 3 through `transformers`: of everything, by a grid of points, or of given concepts.

The grid follows the models' automatic mask generators: three masks per point, filtered by predicted IoU and stability,
then non-maximum suppression. With SAM 3, concepts (noun phrases) can be given instead: every instance is returned.
"""

from typing import Any

import numpy as np

from reconstruction.instances.masks.base import flatten_masks
from reconstruction.learned.models import ModelRequest, SquareImages, load_model, load_part, masks_of

_POINTS_A_BATCH = 64
_MIN_IOU = 0.8  # predicted by the model
_MIN_STABILITY, _STABILITY_OFFSET = 0.95, 1.0  # IoU of the masks at logits this far above and below 0
_NMS_IOU = 0.7  # of bounding boxes
_MIN_SHARE = 1e-4  # of the image; smaller masks are dropped
_MIN_CONCEPT_SCORE = 0.5
_TEXT_TOKENS = 32  # length that SAM 3 was trained with


class PointGridMasks:
    """An `ImageSegmenter` by SAM 2, or by the tracker of SAM 3, prompted with a grid of points."""

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
                good = (trust > _MIN_IOU) & (stability(logits) > _MIN_STABILITY)
                kept.append(logits[good])
                scores.append(trust[good])
            logits, trust = torch.cat(kept), torch.cat(scores).float().cpu().numpy()
            rows = without_doubles(boxes_of((logits > 0).cpu().numpy()), trust)
            masks = masks_of(logits[torch.from_numpy(rows).to(logits.device)], *image.shape[:2])
        return flatten_large(masks, trust[rows])


class ConceptMasks:
    """An `ImageSegmenter` by SAM 3 that returns every instance of the given concepts."""

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
    """Return the centers (n * n, 2) of the cells of a grid over the unit square, x before y."""
    along = ((np.arange(points_a_side) + 0.5) / points_a_side).astype(np.float32)
    return np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)


def stability(logits: Any) -> Any:
    """Return the stability scores (k,), 0 to 1, of a tensor of mask logits (k, h, w): IoU between two thresholds."""
    inner = (logits > _STABILITY_OFFSET).flatten(1).sum(1)
    outer = (logits > -_STABILITY_OFFSET).flatten(1).sum(1)
    return inner / outer.clamp(min=1)


def boxes_of(masks: np.ndarray) -> np.ndarray:
    """Return the boxes float64 (k, 4) of masks bool (k, h, w): x0, y0, x1, y1, with x1 and y1 exclusive."""
    boxes = np.zeros((len(masks), 4))
    for axis, (low, high) in ((1, (0, 2)), (2, (1, 3))):
        hit = np.any(masks, axis)
        some = hit.any(axis=1)
        boxes[some, low] = hit.argmax(axis=1)[some]
        boxes[some, high] = hit.shape[1] - hit[:, ::-1].argmax(axis=1)[some]
    return boxes


def without_doubles(boxes: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Return rows int64 (m,) of boxes (k, 4) after non-maximum suppression, the best first, without empty boxes."""
    area = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    open_rows = np.lexsort((np.arange(len(boxes)), -scores))
    open_rows = open_rows[area[open_rows] > 0]
    kept = []
    while len(open_rows):
        first, rest = open_rows[0], open_rows[1:]
        kept.append(first)
        low = np.maximum(boxes[first, :2], boxes[rest, :2])
        high = np.minimum(boxes[first, 2:], boxes[rest, 2:])
        common = np.prod(np.clip(high - low, 0, None), axis=1)
        open_rows = rest[common <= _NMS_IOU * (area[first] + area[rest] - common)]
    return np.array(kept, np.int64)


def flatten_large(masks: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Return the id image of masks bool (k, h, w), without tiny ones; see `flatten_masks`."""
    large = masks.sum(axis=(1, 2)) >= _MIN_SHARE * np.prod(masks.shape[1:])
    return flatten_masks(masks[large], scores[large])


def _side(size: Any) -> int:
    """Return the side of a model's square input; its config has one number or two."""
    return int(size if isinstance(size, int) else size[0])
