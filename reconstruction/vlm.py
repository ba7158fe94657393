"""A vision-language model behind any OpenAI-compatible endpoint (vLLM, Ollama, a hosted one): questions with pictures.

Whoever asks says what the answer must look like (a Pydantic model, sent along as a JSON schema) and what else must
hold; an answer that does not fit is asked for again with the reason. Exchanges can be kept in a folder: what is in it
is not asked again, so a run can be repeated offline and gives the same answers.

Environment: SIMRECON_VLM_URL (as in http://localhost:8000/v1), SIMRECON_VLM_MODEL, SIMRECON_VLM_KEY (where the
endpoint wants one; never written anywhere), SIMRECON_VLM_RECORDS (the folder).
"""

import base64
import hashlib
import json
import os
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import requests
from pydantic import BaseModel, ValidationError

from reconstruction.requesting import asked_pause, excerpt, write_whole
from registry.errors import EnvironmentMissing, SimReconError

_ANSWERS = 3  # times that an answer which does not fit is asked for
_TRIES = 5  # times that a request is sent to a busy or failing endpoint
_LONGEST_PAUSE_S = 60.0
_MAX_TOKENS = 1024
_JPEG_QUALITY = 90
_OPTIONAL = ("response_format", "seed", "max_tokens")  # some endpoints refuse them
Reply = TypeVar("Reply", bound=BaseModel)


class VlmError(SimReconError):
    """This question got no usable answer; another one may."""


class VlmUnavailable(VlmError):
    """The endpoint does not answer questions at all: it is away, refuses the key, or is something else."""


@dataclass(frozen=True)
class Endpoint:
    """Where questions go."""

    url: str  # base of the API; "" where only recorded answers are used
    model: str
    key: str = ""
    records: Path | None = None  # exchanges are kept here, and taken from here
    timeout_s: float = 180.0  # for one answer
    pause_s: float = 1.0  # before the second try; doubled before each further one

    @staticmethod
    def from_environment(asked_by: str, model: str = "") -> "Endpoint":
        """Read the SIMRECON_VLM_ variables; `model` takes the place of theirs.

        Raises:
            EnvironmentMissing: no endpoint and no records, or no model.
        """
        get = os.environ.get
        url, model = get("SIMRECON_VLM_URL", ""), model or get("SIMRECON_VLM_MODEL", "")
        records = get("SIMRECON_VLM_RECORDS", "")
        if not model or not (url or records):
            raise EnvironmentMissing(
                f"{asked_by} needs an OpenAI-compatible endpoint: set SIMRECON_VLM_URL (as in "
                f"http://localhost:8000/v1), SIMRECON_VLM_MODEL, and SIMRECON_VLM_KEY where it wants one. "
                f"`vllm serve Qwen/Qwen2.5-VL-7B-Instruct` is such an endpoint."
            )
        if url and not url.startswith(("http://", "https://")):
            raise EnvironmentMissing(
                f"SIMRECON_VLM_URL is {url!r}; an address as in http://localhost:8000/v1 is expected"
            )
        return Endpoint(url, model, get("SIMRECON_VLM_KEY", ""), Path(records) if records else None)


class VlmClient:
    """Asks an endpoint; the exchanges of one question follow each other."""

    def __init__(self, endpoint: Endpoint) -> None:
        """Nothing is sent yet."""
        self._endpoint = endpoint
        self._session = requests.Session()
        self._refused: set[str] = set()  # optional fields that the endpoint does not take
        self.name = endpoint.model

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
            VlmUnavailable: the endpoint cannot be used, or there is none and the answer is not recorded.
            VlmError: no answer fitted.
        """
        content: list[dict] = [{"type": "text", "text": prompt}]
        content += [{"type": "image", "image": np.ascontiguousarray(image)} for image in images]
        messages: list[dict] = [{"role": "user", "content": content}]
        schema = reply.model_json_schema()
        reason = ""
        for _ in range(_ANSWERS):
            text = self._exchange(messages, schema, reply.__name__)
            try:
                answer = reply.model_validate_json(json_part(text))
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
        raise VlmError(f"{self.name}: no usable answer in {_ANSWERS} attempts; at last: {reason}")

    def _exchange(self, messages: list[dict], schema: dict, schema_name: str) -> str:
        """Return the text of one answer, from the records or from the endpoint."""
        described = {"model": self.name, "schema": schema, "messages": _described(messages)}
        digest = hashlib.sha256(json.dumps(described, sort_keys=True).encode()).hexdigest()[:32]
        folder = self._endpoint.records
        file = folder / f"{digest}.json" if folder else None
        if file is not None and file.is_file():
            return _recorded(file)
        if not self._endpoint.url:
            raise VlmUnavailable(
                f"{folder}: no recorded answer of {self.name} to this question ({digest}.json), and SIMRECON_VLM_URL "
                f"is not set"
            )
        text = self._request(messages, schema, schema_name)
        if file is not None:
            _record(file, described | {"answer": text}, messages)
        return text

    def _request(self, messages: list[dict], schema: dict, schema_name: str) -> str:
        body = {
            "model": self.name,
            "messages": _encoded(messages),
            "temperature": 0,
            "seed": 0,
            "max_tokens": _MAX_TOKENS,
            "response_format": {
                "type": "json_schema",
                "json_schema": {"name": schema_name, "schema": schema, "strict": True},
            },
        }
        pause, problem = self._endpoint.pause_s, ""
        for attempt in range(_TRIES):
            if attempt:
                time.sleep(min(pause, _LONGEST_PAUSE_S))
                pause *= 2
            sent = {name: value for name, value in body.items() if name not in self._refused}
            try:
                response = self._post(sent)
            except requests.Timeout:
                problem = f"no answer within {self._endpoint.timeout_s:g} s, {attempt + 1} times"
                if attempt:
                    break
                continue
            except requests.RequestException as error:
                problem = f"cannot be reached ({type(error).__name__})"
                continue
            if response.ok:
                return _text_of(response)
            problem = f"HTTP {response.status_code}: {excerpt(response.text)}"
            if response.status_code in (400, 422) and not self._refused.issuperset(_OPTIONAL):
                self._refused.update(_OPTIONAL)
            elif response.status_code == 429 or response.status_code >= 500:
                pause = max(pause, asked_pause(response))
            elif response.status_code in (400, 413, 422):
                raise VlmError(f"{self.name}: the question was refused: {problem}")
            else:
                break
        raise VlmUnavailable(f"{self._address()}: {problem}")

    def _post(self, body: dict) -> requests.Response:
        headers = {"Authorization": f"Bearer {self._endpoint.key}"} if self._endpoint.key else {}
        timeout = (min(10.0, self._endpoint.timeout_s), self._endpoint.timeout_s)
        return self._session.post(self._address(), json=body, headers=headers, timeout=timeout)

    def _address(self) -> str:
        base = self._endpoint.url.rstrip("/")
        return base if base.endswith("/chat/completions") else f"{base}/chat/completions"


def json_part(text: str) -> str:
    """Return the JSON object in an answer: models wrap it in fences, and think aloud before it."""
    text = re.sub(r"<think>.*?</think>", "", text, flags=re.DOTALL)
    start, end = text.find("{"), text.rfind("}")
    if start < 0 or end < start:
        raise ValueError("there is no JSON object in it")
    return text[start : end + 1]


def _text_of(response: requests.Response) -> str:
    """Return the answer in a response of the chat completions protocol."""
    try:
        content = response.json()["choices"][0]["message"]["content"]
    except (ValueError, KeyError, IndexError, TypeError) as error:
        kind = response.headers.get("Content-Type", "no type")
        raise VlmUnavailable(
            f"{response.url}: this is no chat completions endpoint ({kind}: {excerpt(response.text)}). "
            f"SIMRECON_VLM_URL is the base of the API, as in http://localhost:8000/v1"
        ) from error
    if isinstance(content, list):
        content = "".join(part.get("text", "") for part in content if isinstance(part, dict))
    return content if isinstance(content, str) else ""


def _map_images(messages: list[dict], turn: Callable[[np.ndarray], dict]) -> list[dict]:
    """Return the messages with every image replaced by what `turn` makes of it."""
    out = []
    for message in messages:
        content: Any = message["content"]
        if isinstance(content, list):
            content = [turn(part["image"]) if part["type"] == "image" else part for part in content]
        out.append({"role": message["role"], "content": content})
    return out


def _jpeg(image: np.ndarray) -> bytes:
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()


def _encoded(messages: list[dict]) -> list[dict]:
    def turn(image: np.ndarray) -> dict:
        data = base64.b64encode(_jpeg(image)).decode()
        return {"type": "image_url", "image_url": {"url": f"data:image/jpeg;base64,{data}"}}

    return _map_images(messages, turn)


def _image_digest(image: np.ndarray) -> str:
    return hashlib.sha256(str(image.shape).encode() + image.tobytes()).hexdigest()[:32]


def _described(messages: list[dict]) -> list[dict]:
    """Return the messages with digests of the pixels (not of a JPEG, which differs with its library)."""
    return _map_images(messages, lambda image: {"type": "image", "file": f"{_image_digest(image)}.jpg"})


def _record(file: Path, exchange: dict, messages: list[dict]) -> None:
    for message in messages:
        for part in message["content"] if isinstance(message["content"], list) else ():
            if part["type"] == "image":
                write_whole(file.parent / f"{_image_digest(part['image'])}.jpg", _jpeg(part["image"]))
    write_whole(file, json.dumps(exchange, indent=1).encode())


def _recorded(file: Path) -> str:
    try:
        return str(json.loads(file.read_text())["answer"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise VlmError(
            f"{file}: not a recorded exchange; remove it to have the question asked again"
        ) from error
