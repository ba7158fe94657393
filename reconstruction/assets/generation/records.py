"""Records of generations in a folder: pictures, exchanges and meshes. Recorded meshes are not requested or paid again.

The name is a digest of everything that determines the mesh: generator, settings, label and pixels. `DIGEST.glb` is the
unchanged mesh, `DIGEST.json` its inputs and exchanges. `DIGEST.pending.json` is a paid task that was not fetched; the
next run resumes it.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

from reconstruction.assets.generation.base import GenerationBackend, GenerationError, Job, ObjectPictures
from reconstruction.assets.generation.pictures import encode_png, pixel_digest
from reconstruction.learned.requesting import write_whole


class Records:
    """The records of one generator."""

    def __init__(self, folder: Path, backend: GenerationBackend) -> None:
        """Set the folder; nothing is read or written yet."""
        self._folder, self._backend = folder, backend

    def any_kept(self) -> bool:
        """Tell whether there is any mesh of this generator."""
        return any(self._folder.glob(f"{self._backend.name}-*.glb"))

    def has(self, pictures: ObjectPictures) -> bool:
        """Tell whether there is a mesh of these pictures."""
        return self._file(pictures, ".glb").is_file()

    def is_paid(self, pictures: ObjectPictures) -> bool:
        """Tell whether these pictures cost nothing more: their mesh is recorded, or its task pending."""
        return self.has(pictures) or self._file(pictures, ".pending.json").is_file()

    def generate(self, pictures: ObjectPictures) -> bytes:
        """Return the recorded mesh of an object, or generate and record it.

        Raises:
            GenerationError: the generator made none.
        """
        mesh = self._file(pictures, ".glb")
        if mesh.is_file():
            return mesh.read_bytes()
        waiting = self._file(pictures, ".pending.json")
        job = Job(read_task(waiting), lambda task: _keep_task(waiting, task))
        record = self._description(pictures)
        try:
            data = self._backend.generate(pictures, job)
        except GenerationError as error:
            self._note(pictures, record | {"exchanges": job.exchanges, "failed": str(error)})
            raise
        write_whole(mesh, data)
        facts = {"cost_credits": self._backend.cost, "sha256": hashlib.sha256(data).hexdigest()}
        self._note(pictures, record | facts | {"exchanges": job.exchanges})
        return data

    def _note(self, pictures: ObjectPictures, record: dict[str, Any]) -> None:
        for picture in pictures.pictures:
            shown = self._folder / f"{pixel_digest(picture)}.png"
            if not shown.is_file():
                write_whole(shown, encode_png(picture.cut_out()))
        write_whole(self._file(pictures, ".json"), json.dumps(record, indent=1).encode())

    def _description(self, pictures: ObjectPictures) -> dict[str, Any]:
        return {
            "generator": self._backend.name,
            "settings": self._backend.settings(),
            "label": pictures.label,
            "pictures": [f"{pixel_digest(picture)}.png" for picture in pictures.pictures],
        }

    def _file(self, pictures: ObjectPictures, suffix: str) -> Path:
        text = json.dumps(self._description(pictures), sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()[:32]
        return self._folder / f"{self._backend.name}-{digest}{suffix}"


def read_task(file: Path) -> dict[str, str] | None:
    """Return a pending task; None where there is none, or the file is damaged."""
    try:
        task = json.loads(file.read_text())
    except (OSError, ValueError):
        return None
    return task if isinstance(task, dict) and all(isinstance(value, str) for value in task.values()) else None


def _keep_task(file: Path, task: dict[str, str] | None) -> None:
    if task is None:
        file.unlink(missing_ok=True)
    else:
        write_whole(file, json.dumps(task).encode())
