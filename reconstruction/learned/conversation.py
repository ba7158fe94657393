"""Ask a vision-language model for typed answers, with retries and recorded exchanges.

The caller gives a Pydantic model, sent as a JSON schema, and an optional check. Invalid answers are returned to the
model with the reason, and it is asked again. Exchanges can be recorded in a folder; recorded questions are answered
from it, so that runs can be repeated offline with the same answers.
"""

import hashlib
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from pydantic import BaseModel, ValidationError

from reconstruction.learned.requesting import write_whole
from registry.errors import SimReconError

_ANSWERS = 3  # attempts per question
_JPEG_QUALITY = 90
Reply = TypeVar("Reply", bound=BaseModel)


class VlmError(SimReconError):
    """A question got no usable answer; other questions may."""

    def __init__(self, message: str, answer: BaseModel | None = None) -> None:
        """Keep the last answer that was well-formed, but failed the check."""
        super().__init__(message)
        self.answer = answer


class VlmUnavailable(VlmError):
    """The model answers no questions: it cannot be reached, refuses the key, or is not such a model."""


class Conversation:
    """Asks a model, one question at a time; subclasses implement `request`, which sends messages."""

    def __init__(self, name: str, records: Path | None = None) -> None:
        """Set the model's name and the folder of recorded exchanges."""
        self.name, self.records = name, records

    def ask(
        self,
        prompt: str,
        images: Sequence[np.ndarray],
        reply: type[Reply],
        check: Callable[[Reply], None] | None = None,
    ) -> Reply:
        """Ask about RGB images uint8 (h, w, 3); return the parsed answer.

        Args:
            prompt: the question; should describe the answer in words too, for endpoints that ignore schemas.
            images: follow the prompt, in order.
            reply: type of the answer.
            check: raises ValueError, with a message for the model, for a well-formed but wrong answer.

        Raises:
            VlmUnavailable: the model cannot be used, or there is none and the answer is not recorded.
            VlmError: all answers were invalid; it holds the last one that `check` refused.
        """
        content: list[dict] = [{"type": "text", "text": prompt}]
        content += [{"type": "image", "image": np.ascontiguousarray(image)} for image in images]
        messages: list[dict] = [{"role": "user", "content": content}]
        schema = reply.model_json_schema()
        reason, kept = "", None
        for _ in range(_ANSWERS):
            text = self._exchange(messages, schema, reply.__name__)
            try:
                answer = reply.model_validate_json(json_part(text))
                kept = answer
                if check is not None:
                    check(answer)
                return answer
            except ValidationError as error:
                reason = "; ".join(
                    f"{'.'.join(map(str, e['loc'])) or 'the answer'}: {e['msg']}" for e in error.errors()[:5]
                )
            except ValueError as error:
                reason = str(error)
            again = f"That answer cannot be used: {reason}. Answer again, with nothing but the JSON object."
            messages = [*messages, {"role": "assistant", "content": text}, {"role": "user", "content": again}]
        raise VlmError(f"{self.name}: no usable answer in {_ANSWERS} attempts; at last: {reason}", kept)

    def _exchange(self, messages: list[dict], schema: dict, schema_name: str) -> str:
        """Return the text of one answer, recorded or from the model."""
        described = {"model": self.name, "schema": schema, "messages": _described(messages)}
        digest = hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()[:32]
        file = self.records / f"{digest}.json" if self.records else None
        if file is not None and file.is_file():
            return _recorded(file)
        text = self.request(messages, schema, schema_name, f"{digest}.json")
        if file is not None:
            _record(file, described | {"answer": text}, messages)
        return text

    def request(self, messages: list[dict], schema: dict, schema_name: str, record: str) -> str:
        """Send messages, with images as parts {"type": "image", "image": RGB array}; return the answer.

        Raises:
            VlmUnavailable: the model cannot be used; `record` is the file name of the missing record.
            VlmError: the model refuses this question.
        """
        raise NotImplementedError


def json_part(text: str) -> str:
    """Return the JSON object in an answer, without code fences and reasoning around it."""
    text = re.sub(r"<think>.*?</think>", "", text, flags=re.DOTALL)
    start, end = text.find("{"), text.rfind("}")
    if start < 0 or end < start:
        raise ValueError("there is no JSON object in it")
    return text[start : end + 1]


def map_images(messages: list[dict], encode: Callable[[np.ndarray], dict]) -> list[dict]:
    """Return messages with each image part replaced by `encode(image)`."""
    out = []
    for message in messages:
        content: Any = message["content"]
        if isinstance(content, list):
            content = [encode(part["image"]) if part["type"] == "image" else part for part in content]
        out.append({"role": message["role"], "content": content})
    return out


def jpeg(image: np.ndarray) -> bytes:
    """Encode an RGB image uint8 (h, w, 3) as JPEG."""
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()


def _image_digest(image: np.ndarray) -> str:
    return hashlib.sha256(str(image.shape).encode() + image.tobytes()).hexdigest()[:32]


def _described(messages: list[dict]) -> list[dict]:
    """Replace images by digests of their pixels (not of the JPEG, which depends on the library)."""
    return map_images(messages, lambda image: {"type": "image", "file": f"{_image_digest(image)}.jpg"})


def _record(file: Path, exchange: dict, messages: list[dict]) -> None:
    for message in messages:
        for part in message["content"] if isinstance(message["content"], list) else ():
            if part["type"] == "image":
                write_whole(file.parent / f"{_image_digest(part['image'])}.jpg", jpeg(part["image"]))
    write_whole(file, json.dumps(exchange, indent=1).encode())


def _recorded(file: Path) -> str:
    try:
        return str(json.loads(file.read_text())["answer"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise VlmError(f"{file}: not a recorded exchange; remove it to ask the question again") from error
