"""Labels by a vision-language model: one question per object, with up to three views."""

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from reconstruction.core.progress import Progress
from reconstruction.core.types import Instance, InstanceSet, PosedFrames
from reconstruction.instances.naming.base import Name, is_label
from reconstruction.instances.naming.views import ObjectView, best_views, collage
from reconstruction.learned.vlm import VlmClient, VlmError, VlmUnavailable

# Models overestimate their certainty. An "unsure" answer replaces no label.
_CONFIDENCE = {"certain": 0.8, "likely": 0.5}


class NamedObject(BaseModel):
    """What the model answers."""  # part of the JSON schema, and so of the key of recorded answers

    model_config = ConfigDict(extra="forbid")

    id: int
    label: str
    certainty: Literal["certain", "likely", "unsure"]


class VlmNamer:
    """A `Namer` that asks an OpenAI-compatible endpoint."""

    def __init__(self, client: VlmClient) -> None:
        self._client = client
        self._prompt = (Path(__file__).parent / "prompt.txt").read_text()
        self.name = client.name

    def name_objects(
        self, found: InstanceSet, posed: PosedFrames, *, progress: Progress
    ) -> list[Name | None]:
        """See `Namer.name_objects`; failed questions are noted, and an unavailable endpoint is not asked again."""
        views = best_views(found, posed)
        progress.start(len(found.objects), f"names by {self.name}")
        names: list[Name | None] = []
        for item in found.objects:
            try:
                names.append(self._ask(item, views[item.id]) if views[item.id] else None)
            except VlmUnavailable as error:
                left = len(found.objects) - len(names)
                progress.note(f"labels: {error}; {left} objects are not asked about")
                return names + [None] * left
            except VlmError as error:
                progress.note(f"labels: object {item.id}: {error}")
                names.append(None)
            progress.advance()
        return names

    def _ask(self, item: Instance, views: list[ObjectView]) -> Name | None:
        x, y, z = (max(1, round(100 * float(side))) for side in item.extents_m)
        prompt = self._prompt.format(id=item.id, views=len(views), width_cm=x, depth_cm=y, height_cm=z)

        def check(answer: NamedObject) -> None:
            if answer.id != item.id:
                raise ValueError(f"there is no object {answer.id} in the pictures; the id is {item.id}")
            if not is_label(answer.label.strip().lower()):
                raise ValueError("the label is not one to three plain words")

        answer = self._client.ask(prompt, [collage([view.outlined() for view in views])], NamedObject, check)
        label = answer.label.strip().lower()
        if label == "unknown" or answer.certainty not in _CONFIDENCE:
            return None
        return Name(label, _CONFIDENCE[answer.certainty])
