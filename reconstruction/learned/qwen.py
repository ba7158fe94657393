"""Run Qwen2.5-VL in this process by `transformers`, with deterministic (greedy) decoding."""

import inspect
from pathlib import Path
from typing import Any

import numpy as np

from reconstruction.learned.conversation import Conversation, VlmUnavailable
from reconstruction.learned.models import ModelRequest, load_model, load_part

_IMAGE = "<|vision_start|><|image_pad|><|vision_end|>"
_PAD = "<|image_pad|>"
_SYSTEM = "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n"
_MAX_TOKENS = 2048


class QwenModel(Conversation):
    """Qwen2.5-VL of any size, loaded at the first question that is not recorded."""

    def __init__(
        self, request: ModelRequest, records: Path | None = None, max_tokens: int = _MAX_TOKENS
    ) -> None:
        """Set the model; nothing is loaded yet."""
        super().__init__(request.model, records)
        self._request_of, self._max_tokens = request, max_tokens
        self._model: Any = None

    def load(self) -> None:
        """Load weights, tokenizer and image settings.

        Raises:
            EnvironmentMissing: transformers or the weights are missing, or the weights are of another architecture.
        """
        request = self._request_of
        self._tokenizer = load_part(request, "AutoTokenizer")
        self._images = load_part(request, "Qwen2VLImageProcessorPil")  # needs no torchvision
        self._model = load_model(request, "Qwen2_5_VLForConditionalGeneration")

    def request(self, messages: list[dict], schema: dict, schema_name: str, record: str) -> str:
        """Answer from the local model; see `Conversation`."""
        import torch

        if self._model is None:
            self.load()
        assert self._model is not None
        inputs = self._inputs(messages)
        try:
            with torch.inference_mode():
                tokens = self._model.generate(**inputs, max_new_tokens=self._max_tokens, do_sample=False)
        except torch.OutOfMemoryError as error:
            remedy = "lower scene_graph.picture_side_px"
            raise VlmUnavailable(
                f"{self.name}: not enough memory for pictures of this size; {remedy}"
            ) from error
        return self._tokenizer.decode(tokens[0, inputs["input_ids"].shape[1] :], skip_special_tokens=True)

    def _inputs(self, messages: list[dict]) -> dict:
        """Tokenize messages, with one image token per visual feature."""
        pictures: list[np.ndarray] = []
        text = _SYSTEM
        for message in messages:
            text += f"<|im_start|>{message['role']}\n{_written(message['content'], pictures)}<|im_end|>\n"
        text += "<|im_start|>assistant\n"
        inputs: dict = {}
        if pictures:
            seen = self._images(images=pictures, return_tensors="pt")
            merged = self._images.merge_size**2
            parts = text.split(_PAD)
            counts = [int(grid.prod()) // merged for grid in seen["image_grid_thw"]]
            text = parts[0] + "".join(_PAD * n + part for n, part in zip(counts, parts[1:], strict=True))
            inputs |= {"pixel_values": seen["pixel_values"], "image_grid_thw": seen["image_grid_thw"]}
        tokens = self._tokenizer(text, return_tensors="pt")
        inputs |= {"input_ids": tokens["input_ids"], "attention_mask": tokens["attention_mask"]}
        # Newer versions of transformers need the token types.
        if "mm_token_type_ids" in inspect.signature(self._model.forward).parameters:
            inputs["mm_token_type_ids"] = (tokens["input_ids"] == self._model.config.image_token_id).int()
        return {name: value.to(self._model.device) for name, value in inputs.items()}


def _written(content: str | list[dict], pictures: list[np.ndarray]) -> str:
    """Format a message with image tokens before the text, as in training; append its images to `pictures`."""
    if isinstance(content, str):
        return content.replace(_PAD, "")
    images = [part["image"] for part in content if part["type"] == "image"]
    pictures.extend(images)
    words = "".join(part["text"] for part in content if part["type"] == "text").replace(_PAD, "")
    return _IMAGE * len(images) + words
