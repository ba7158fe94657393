"""HTTP client of a generation service, with retries, time limits and validated replies."""

import hashlib
import time
from dataclasses import dataclass
from typing import Any, TypeVar
from urllib.parse import urlsplit

import requests
from pydantic import BaseModel, ValidationError

from reconstruction.assets.generation.base import GenerationError, GeneratorUnavailable, Job, RequestRefused
from reconstruction.learned.requesting import asked_pause, excerpt

_TRIES = 5
_LONGEST_PAUSE_S = 60.0
_LONGEST_REPLY_S = 120.0  # of a request that does not wait for a generation
_CONNECT_S = 10.0
_CHUNK = 1 << 18
_BUSY = (429, 500, 502, 503, 504)
_PERHAPS_TAKEN = (502, 504)  # gateway errors: the server behind it may have accepted the request
_MOST_TEXT = 1 << 20  # bytes of a JSON reply without a mesh
Reply = TypeVar("Reply", bound=BaseModel)


@dataclass(frozen=True)
class ServiceLimits:
    """Limits of time, size and polling."""

    timeout_s: float = 900.0  # for one object, from the first request to the last byte
    max_bytes: int = 100 << 20  # of one mesh
    pause_s: float = 1.0  # before the second try, doubled before each further one
    poll_s: float = 5.0  # between two polls of a job


class Service:
    """One service; every request and reply is logged in its job."""

    def __init__(self, name: str, url: str, key: str, limits: ServiceLimits) -> None:
        """Store the settings; nothing is sent yet."""
        self.name, self.url, self.limits = name, url.rstrip("/"), limits
        self._key = key

    def deadline(self) -> float:
        """Return the deadline of a job that starts now (monotonic seconds)."""
        return time.monotonic() + self.limits.timeout_s

    def ask(
        self, job: Job, method: str, path: str, reply: type[Reply], deadline: float, *, paid: bool = False,
        mesh_inside: bool = False, **content: Any,
    ) -> Reply:  # fmt: skip
        """Send a request and return its JSON reply.

        Args:
            job: logs the exchange.
            method: "GET" or "POST".
            path: below the address of the service.
            reply: type of the parsed reply.
            deadline: of the job.
            paid: do not send it again if it may have been accepted.
            mesh_inside: the reply may be as large as a mesh.
            content: arguments of `requests`: `json`, `files`, `data`.

        Raises:
            GeneratorUnavailable: the reply is not of this protocol.
        """
        most = self.limits.max_bytes * 2 if mesh_inside else _MOST_TEXT
        data, kind = self._exchange(
            job, method, f"{self.url}{path}", deadline, again=not paid, most=most, **content
        )
        try:
            parsed = reply.model_validate_json(data)
        except ValidationError as error:
            raise GeneratorUnavailable(
                f"{self.url}{path}: this is no {self.name} service: it answered with {kind or 'no type'} "
                f"({excerpt(data[:2000].decode(errors='replace')) or 'nothing'}: {error.errors()[0]['msg']})"
            ) from error
        job.exchanges[-1]["reply"] = excerpt(data[:2000].decode(errors="replace"))
        return parsed

    def fetch(
        self, job: Job, method: str, url: str, deadline: float, *, again: bool = True, **content: Any
    ) -> bytes:
        """Return the bytes of a .glb; the key is sent to the service's own host alone."""
        data, kind = self._exchange(
            job, method, url, deadline, again=again, most=self.limits.max_bytes, long=not again, **content
        )
        job.exchanges[-1] |= {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        if data[:4] != b"glTF":
            raise GenerationError(
                f"{self.name} sent no .glb but {kind or 'something without a type'} "
                f"({excerpt(data[:300].decode(errors='replace')) or 'nothing'})"
            )
        return data

    def wait(self, deadline: float) -> None:
        """Pause before the next poll of a job.

        Raises:
            GenerationError: the job's time is up.
        """
        if time.monotonic() + self.limits.poll_s > deadline:
            raise self._late()
        time.sleep(self.limits.poll_s)

    def _late(self) -> GenerationError:
        return GenerationError(f"{self.name} was not done within {self.limits.timeout_s:g} s")

    def _exchange(
        self, job: Job, method: str, url: str, deadline: float, *, again: bool, most: int, long: bool = False,
        **content: Any,
    ) -> tuple[bytes, str]:  # fmt: skip
        """Send a request until it succeeds; return the reply's body and content type.

        Raises:
            GenerationError: no mesh of this object: too late, too large, or not to be sent again.
            GeneratorUnavailable: the service cannot be reached, or refuses the key.
        """
        pause, problem, answered = self.limits.pause_s, "", True
        for attempt in range(_TRIES):
            if attempt:
                if time.monotonic() + pause > deadline:
                    break
                time.sleep(min(pause, _LONGEST_PAUSE_S))
                pause *= 2
            left = deadline - time.monotonic()
            if left <= 0:
                break
            entry: dict[str, Any] = {"method": method, "address": url.split("?")[0]}
            job.exchanges.append(entry)
            limit = left if long else min(left, _LONGEST_REPLY_S)
            try:
                with self._send(method, url, limit, content) as response:
                    entry["status"] = response.status_code
                    if response.ok:
                        return self._body(response, deadline, most), response.headers.get("Content-Type", "")
                    problem = f"HTTP {response.status_code}: {excerpt(self._text(response))}"
                    self._judge(response.status_code, problem, again)
                    pause = min(max(pause, asked_pause(response)), _LONGEST_PAUSE_S)
                    answered = True
            except requests.Timeout as error:
                entry["failed"] = "no answer in time"
                if not again and not isinstance(error, requests.ConnectTimeout):
                    raise GenerationError(
                        f"{self.name} gave no answer in time; as it may have taken the request, it is not sent again"
                    ) from error
                problem, answered = "no answer in time", False
            except requests.RequestException as error:
                entry["failed"] = type(error).__name__
                if not again and not _never_sent(error):
                    raise GenerationError(
                        f"{self.name}: the connection broke ({type(error).__name__}); as it may have taken the "
                        f"request, it is not sent again"
                    ) from error
                problem, answered = f"cannot be reached ({type(error).__name__})", False
        if not problem:
            raise self._late()
        raise (GenerationError if answered else GeneratorUnavailable)(f"{_host(url)}: {problem}")

    def _send(self, method: str, url: str, timeout_s: float, content: dict[str, Any]) -> requests.Response:
        own = urlsplit(url).netloc == urlsplit(self.url).netloc
        headers = {"Authorization": f"Bearer {self._key}"} if self._key and own else {}
        timeout = (min(_CONNECT_S, timeout_s), timeout_s)
        return requests.request(method, url, headers=headers, timeout=timeout, stream=True, **content)

    def _judge(self, status: int, problem: str, again: bool) -> None:
        """Raise for an error status, unless the request may be sent again."""
        if status in (401, 403):
            raise GeneratorUnavailable(f"{self.name} refuses the key ({problem})")
        if status == 402:
            raise GeneratorUnavailable(f"{self.name} wants more credits than the account has ({problem})")
        if status not in _BUSY:
            raise RequestRefused(f"{self.name} refused the request or failed ({problem})")
        if not again and status in _PERHAPS_TAKEN:
            raise GenerationError(
                f"{self.name}: {problem}; as it may have taken the request, it is not sent again"
            )

    def _body(self, response: requests.Response, deadline: float, most: int) -> bytes:
        """Read a reply in chunks, within the limits of size and time."""
        out = bytearray()
        for piece in response.iter_content(_CHUNK):
            out += piece
            if len(out) > most:
                raise GenerationError(
                    f"{self.name} sent more than {most / 1e6:.0f} MB; --set assets.generator_max_mb= allows more"
                )
            if time.monotonic() > deadline:
                raise self._late()
        return bytes(out)

    def _text(self, response: requests.Response) -> str:
        return next(response.iter_content(4096), b"").decode(errors="replace")


def _never_sent(error: requests.RequestException) -> bool:
    """Tell whether no connection was made."""
    reason = getattr(error.args[0] if error.args else None, "reason", None)
    return type(reason).__name__ in ("NewConnectionError", "ConnectTimeoutError", "NameResolutionError")


def _host(url: str) -> str:
    return f"{urlsplit(url).scheme}://{urlsplit(url).netloc}"
