"""Conversations with a vision-language model: typed answers, asked again with the reason, recorded, replayable.

Whoever asks says what the answer must look like (a Pydantic model, sent along as a JSON schema) and what else must
hold; an answer that does not fit is asked for again with the reason. Exchanges can be kept in a folder: what is in it
is not asked again, so a run can be repeated offline and gives the same answers.
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

_ANSWERS = 3  # times that an answer which does not fit is asked for
_JPEG_QUALITY = 90
Reply = TypeVar("Reply", bound=BaseModel)


class VlmError(SimReconError):
    """This question got no usable answer; another one may."""

    def __init__(self, message: str, answer: BaseModel | None = None) -> None:
        """Keep the last answer that was well-formed, though what it says cannot be."""
        super().__init__(message)
        self.answer = answer


class VlmUnavailable(VlmError):
    """The model does not answer questions at all: it is away, refuses the key, or is something else."""


class Conversation:
    """Asks a model; the exchanges of one question follow each other. What sends them is up to the heirs."""

    def __init__(self, name: str, records: Path | None = None) -> None:
        """Name the model, and the folder that exchanges are kept in and taken from."""
        self.name, self.records = name, records

    def ask(
        self,
        prompt: str,
        images: Sequence[np.ndarray],
        reply: type[Reply],
        check: Callable[[Reply], None] | None = None,
    ) -> Reply:
        """Return the answer to a prompt about RGB images uint8 (h, w, 3).

        Args:
            prompt: The question; it should say what to answer in words, too, for endpoints that ignore schemas.
            images: Shown after the prompt, in order.
            reply: What the answer is parsed into.
            check: Raises ValueError, with a message for the model, where a well-formed answer makes no sense.

        Raises:
            VlmUnavailable: the model cannot be used, or there is none and the answer is not recorded.
            VlmError: no answer fitted; it holds the last one that `check` refused.
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
        """Return the text of one answer, from the records or from the model."""
        described = {"model": self.name, "schema": schema, "messages": _described(messages)}
        digest = hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()[:32]
        file = self.records / f"{digest}.json" if self.records else None
        if file is not None and file.is_file():
            return _recorded(file)
        text = self._request(messages, schema, schema_name, f"{digest}.json")
        if file is not None:
            _record(file, described | {"answer": text}, messages)
        return text

    def _request(self, messages: list[dict], schema: dict, schema_name: str, record: str) -> str:
        """Return the model's answer to messages whose images are parts {"type": "image", "image": RGB array}.

        Raises:
            VlmUnavailable: it cannot be used; `record` is the file that would have held the answer.
            VlmError: it refuses this question.
        """
        raise NotImplementedError


def json_part(text: str) -> str:
    """Return the JSON object in an answer: models wrap it in fences, and think aloud before it."""
    text = re.sub(r"<think>.*?</think>", "", text, flags=re.DOTALL)
    start, end = text.find("{"), text.rfind("}")
    if start < 0 or end < start:
        raise ValueError("there is no JSON object in it")
    return text[start : end + 1]


def map_images(messages: list[dict], turn: Callable[[np.ndarray], dict]) -> list[dict]:
    """Return messages with every image replaced by what `turn` makes of it."""
    out = []
    for message in messages:
        content: Any = message["content"]
        if isinstance(content, list):
            content = [turn(part["image"]) if part["type"] == "image" else part for part in content]
        out.append({"role": message["role"], "content": content})
    return out


def jpeg(image: np.ndarray) -> bytes:
    """Encode an RGB image."""
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()


def _image_digest(image: np.ndarray) -> str:
    return hashlib.sha256(str(image.shape).encode() + image.tobytes()).hexdigest()[:32]


def _described(messages: list[dict]) -> list[dict]:
    """Return the messages with digests of the pixels (not of a JPEG, which differs with its library)."""
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
        raise VlmError(
            f"{file}: not a recorded exchange; remove it to have the question asked again"
        ) from error
