"""Client of Hunyuan3D's own HTTP server (`api_server.py` of Tencent-Hunyuan/Hunyuan3D-2 and -2.1).

POST /generate replies with the .glb when it is made, or with status 404 and `{"text", "error_code"}` if that failed.
POST /send replies with `uid` at once, and GET /status/{uid} with "processing" ("texturing" in 2.1), then "completed"
and `model_base64`; after a failure there it stays at "processing" until the time limit.
"""

import base64
import binascii
import os
from typing import Any

from pydantic import BaseModel

from reconstruction.assets.generation.base import GenerationError, Job, ObjectPictures
from reconstruction.assets.generation.pictures import encode_png
from reconstruction.assets.generation.service import Service, ServiceLimits
from registry.errors import UsageError

HUNYUAN_URL = "http://localhost:8081"
HUNYUAN_VARIABLE = "SIMRECON_HUNYUAN3D_URL"
_FACES = 40_000


class _Sent(BaseModel):
    uid: str


class _Status(BaseModel):
    status: str
    model_base64: str | None = None
    message: str | None = None


class Hunyuan3D:
    """See `GenerationBackend`."""

    name = "hunyuan3d"
    cost = 0.0
    most_pictures = 1
    at_once = 1

    def __init__(
        self, url: str, model: str = "", *, textured: bool, poll: bool, seed: int, limits: ServiceLimits
    ) -> None:
        """Take the address from `url`, else from the environment, else this machine's port 8081.

        `model` names what the server runs, to tell its records apart; it is not sent.
        """
        url = url or os.environ.get(HUNYUAN_VARIABLE, "") or HUNYUAN_URL
        if not url.startswith(("http://", "https://")):
            raise UsageError(f"assets.generator_url is {url!r}; an address such as {HUNYUAN_URL} is expected")
        self._model, self._textured, self._poll, self._seed = model, textured, poll, seed
        self._service = Service("Hunyuan3D", url, "", limits)
        self.sends_to = self._service.url

    def settings(self) -> dict[str, Any]:
        """See `GenerationBackend.settings`."""
        return self._options() | {"model": self._model}

    def _options(self) -> dict[str, Any]:
        return {"texture": self._textured, "seed": self._seed, "face_count": _FACES, "type": "glb"}

    def check(self) -> None:
        """See `GenerationBackend.check`; an unreachable server shows at the first request."""

    def generate(self, pictures: ObjectPictures, job: Job) -> bytes:
        """See `GenerationBackend.generate`."""
        image = base64.b64encode(encode_png(pictures.pictures[0].cut_out())).decode()
        body = {"image": image} | self._options()
        deadline = self._service.deadline()
        if self._poll:
            return self._polled(body, job, deadline)
        # The reply comes after the generation: a second request would start another one.
        address = f"{self._service.url}/generate"
        return self._service.fetch(job, "POST", address, deadline, again=False, json=body)

    def _polled(self, body: dict[str, Any], job: Job, deadline: float) -> bytes:
        """Send a job or resume the pending one, and poll it."""
        if job.pending is None:
            sent = self._service.ask(job, "POST", "/send", _Sent, deadline, paid=True, json=body)
            uid = sent.uid
        else:
            uid = job.pending["uid"]
        job.remember({"uid": uid})
        while True:
            reply = self._service.ask(job, "GET", f"/status/{uid}", _Status, deadline, mesh_inside=True)
            if reply.status == "completed":
                break
            if reply.status == "error":
                job.remember(None)
                raise GenerationError(f"Hunyuan3D failed: {reply.message or 'no reason given'}")
            self._service.wait(deadline)
        job.remember(None)
        try:
            data = base64.b64decode(reply.model_base64 or "", validate=True)
        except binascii.Error as error:
            raise GenerationError(f"Hunyuan3D sent a model that is no base64 ({error})") from error
        if data[:4] != b"glTF":
            raise GenerationError("Hunyuan3D sent no .glb")
        return data
