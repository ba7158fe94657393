"""Client of Rodin (Hyper3D), a paid service: submit pictures, poll the jobs, download the mesh.

The protocol is that of https://developer.hyper3d.ai/api-specification/rodin-generation-gen2 (POST /api/v2/rodin,
multipart, replies with `uuid` and `jobs.subscription_key`), .../check-status (POST /api/v2/status: Waiting,
Generating, Done or Failed for each job), .../download-results (POST /api/v2/download: names and addresses that expire
soon) and .../check_balance. The key of the environment is sent to that host as a bearer token and stored nowhere.
"""

import os
from typing import Any

from pydantic import BaseModel, Field

from reconstruction.assets.generation.base import (
    GenerationError,
    GeneratorUnavailable,
    Job,
    ObjectPictures,
    RequestRefused,
)
from reconstruction.assets.generation.pictures import encode_png
from reconstruction.assets.generation.service import Service, ServiceLimits
from registry.errors import EnvironmentMissing

RODIN_URL = "https://api.hyper3d.com"
RODIN_KEY = "SIMRECON_RODIN_KEY"
DEFAULT_TIER = "Gen-2"
_CREDITS = {"Gen-2.5-Extreme-High": 1.0}  # all other tiers: half a credit, by the pages above
_FACES = 18_000


class _Jobs(BaseModel):
    subscription_key: str = ""


class _Submitted(BaseModel):
    error: str | None = None
    message: str | None = None
    uuid: str = ""
    jobs: _Jobs | None = None


class _JobState(BaseModel):
    uuid: str = ""
    status: str


class _Status(BaseModel):
    error: str | None = None
    jobs: list[_JobState] = Field(default_factory=list)


class _File(BaseModel):
    name: str
    url: str


class _Downloads(BaseModel):
    error: str | None = None
    files: list[_File] = Field(default_factory=list, alias="list")


class _Balance(BaseModel):
    balance: float


class Rodin:
    """See `GenerationBackend`."""

    name = "rodin"
    most_pictures = 5
    at_once = 3

    def __init__(self, url: str, tier: str, seed: int, limits: ServiceLimits) -> None:
        """Read the key from the environment; nothing is sent."""
        self._tier, self._seed = tier or DEFAULT_TIER, seed
        self._key = os.environ.get(RODIN_KEY, "")
        self._service = Service("Rodin", url or RODIN_URL, self._key, limits)
        self.sends_to = self._service.url
        self.cost = _CREDITS.get(self._tier, 0.5)

    def settings(self) -> dict[str, Any]:
        """See `GenerationBackend.settings`."""
        return {
            "tier": self._tier,
            "seed": self._seed % 65536,
            "geometry_file_format": "glb",
            "material": "PBR",
            "mesh_mode": "Raw",
            "quality_override": _FACES,
            "use_original_alpha": "true",
        }

    def check(self) -> None:
        """See `GenerationBackend.check`."""
        if not self._key:
            raise EnvironmentMissing(
                f"assets.generator=rodin needs a key of the Hyper3D API: set {RODIN_KEY} (https://developer.hyper3d.ai)"
            )

    def balance(self) -> float:
        """Return the credits that the account has left."""
        deadline = self._service.deadline()
        return self._service.ask(Job(), "GET", "/api/v2/check_balance", _Balance, deadline).balance

    def generate(self, pictures: ObjectPictures, job: Job) -> bytes:
        """See `GenerationBackend.generate`; a paid task that was not fetched is resumed."""
        if not self._key:
            raise GeneratorUnavailable(f"{RODIN_KEY} is not set, and no mesh of this object is kept")
        deadline = self._service.deadline()
        task = job.pending
        if task is None:
            task = self._submit(pictures, job, deadline)
            job.remember(task)
        try:
            self._until_done(task, job, deadline)
            data = self._download(task, job, deadline)
        except RequestRefused:
            job.remember(None)  # the service does not know the task any more
            raise
        job.remember(None)
        return data

    def _submit(self, pictures: ObjectPictures, job: Job, deadline: float) -> dict[str, str]:
        parts: list[tuple] = [
            ("images", (f"{number}.png", encode_png(picture.cut_out()), "image/png"))
            for number, picture in enumerate(pictures.pictures)
        ]
        parts += [(name, (None, str(value))) for name, value in self.settings().items()]
        if pictures.label:
            parts.append(("prompt", (None, pictures.label)))
        reply = self._service.ask(job, "POST", "/api/v2/rodin", _Submitted, deadline, paid=True, files=parts)
        if _is_error(reply.error) or not reply.uuid or reply.jobs is None or not reply.jobs.subscription_key:
            raise GenerationError(
                f"Rodin did not take the task: {reply.error or 'no task in its answer'} {reply.message or ''}".strip()
            )
        return {"uuid": reply.uuid, "subscription_key": reply.jobs.subscription_key}

    def _until_done(self, task: dict[str, str], job: Job, deadline: float) -> None:
        body = {"subscription_key": task["subscription_key"]}
        while True:
            reply = self._service.ask(job, "POST", "/api/v2/status", _Status, deadline, json=body)
            states = [state.status for state in reply.jobs]
            if _is_error(reply.error) or "Failed" in states or "Canceled" in states:
                job.remember(None)
                why = reply.error if _is_error(reply.error) else ", ".join(states)
                raise GenerationError(f"Rodin's task {task['uuid']} failed ({why})")
            if states and all(state == "Done" for state in states):
                return
            self._service.wait(deadline)

    def _download(self, task: dict[str, str], job: Job, deadline: float) -> bytes:
        """Return the .glb of a finished task, the PBR one where there are several."""
        body = {"task_uuid": task["uuid"]}
        reply = self._service.ask(job, "POST", "/api/v2/download", _Downloads, deadline, json=body)
        found = [file for file in reply.files if file.name.lower().endswith(".glb")]
        if _is_error(reply.error) or not found:
            names = ", ".join(file.name for file in reply.files) or "nothing"
            raise GenerationError(
                f"Rodin's task {task['uuid']} has no .glb: {reply.error or ''} it has {names}"
            )
        best = min(found, key=lambda file: ("pbr" not in file.name.lower(), file.name))
        return self._service.fetch(job, "GET", best.url, deadline)


def _is_error(text: str | None) -> bool:
    return text not in (None, "", "OK")
