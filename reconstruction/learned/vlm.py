"""Ask a vision-language model behind an OpenAI-compatible endpoint (vLLM, Ollama, a hosted one).

Environment: SIMRECON_VLM_URL (as in http://localhost:8000/v1), SIMRECON_VLM_MODEL, SIMRECON_VLM_KEY (if the endpoint
needs one; never written to disk), SIMRECON_VLM_RECORDS (folder of recorded exchanges).
"""

import base64
import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import requests

from reconstruction.learned.conversation import (
    Conversation,
    VlmError,
    VlmUnavailable,
    jpeg,
    json_part,
    map_images,
)
from reconstruction.learned.requesting import asked_pause, excerpt
from registry.errors import EnvironmentMissing

__all__ = ["Endpoint", "VlmClient", "VlmError", "VlmUnavailable", "json_part"]

_TRIES = 5  # requests to a busy or failing endpoint
_LONGEST_PAUSE_S = 60.0
_MAX_TOKENS = 2048
_OPTIONAL = ("response_format", "seed", "max_tokens")  # fields that some endpoints refuse


@dataclass(frozen=True)
class Endpoint:
    """Address and model of an endpoint."""

    url: str  # base of the API; "": only recorded answers
    model: str
    key: str = ""
    records: Path | None = None  # folder of recorded exchanges
    timeout_s: float = 180.0  # for one answer
    pause_s: float = 1.0  # before the second request; doubled before each further one

    @staticmethod
    def from_environment(asked_by: str, model: str = "") -> "Endpoint":
        """Read the SIMRECON_VLM_ variables; `model`, if given, overrides SIMRECON_VLM_MODEL.

        Raises:
            EnvironmentMissing: there is no endpoint and no records, or no model.
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
                f"SIMRECON_VLM_URL is {url!r}; a URL like http://localhost:8000/v1 is expected"
            )
        return Endpoint(url, model, get("SIMRECON_VLM_KEY", ""), Path(records) if records else None)


class VlmClient(Conversation):
    """Sends questions to an endpoint."""

    def __init__(self, endpoint: Endpoint) -> None:
        """Prepare a session; nothing is sent yet."""
        super().__init__(endpoint.model, endpoint.records)
        self._endpoint = endpoint
        self._session = requests.Session()
        self._refused: set[str] = set()  # optional fields that the endpoint refuses

    def request(self, messages: list[dict], schema: dict, schema_name: str, record: str) -> str:
        """Answer from the endpoint; see `Conversation`."""
        if not self._endpoint.url:
            raise VlmUnavailable(
                f"{self.records}: no recorded answer of {self.name} to this question ({record}), and SIMRECON_VLM_URL "
                f"is not set"
            )
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


def _text_of(response: requests.Response) -> str:
    """Return the answer in a chat completions response."""
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


def _encoded(messages: list[dict]) -> list[dict]:
    def encode(image: np.ndarray) -> dict:
        data = base64.b64encode(jpeg(image)).decode()
        return {"type": "image_url", "image_url": {"url": f"data:image/jpeg;base64,{data}"}}

    return map_images(messages, encode)
