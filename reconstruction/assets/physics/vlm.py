"""Material and mass by a vision-language model, one question per object with pictures from up to three sides."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from reconstruction.assets.physics.materials import MATERIALS, MaterialChoice
from reconstruction.core.progress import Progress
from reconstruction.core.types import Instance, InstanceSet, PosedFrames
from reconstruction.instances.naming.views import ObjectView, best_views, collage
from reconstruction.learned.vlm import VlmClient, VlmError, VlmUnavailable
from reconstruction.views import SceneViews, View

_HEAVIEST_KG_M3 = 8000.0  # a block of steel that fills the box
_LIGHTEST_KG_M3 = 2.0  # a wire basket
_FRAMES_BESIDE = 2  # keyframes shown beside a drawn view
_MOST_APART = 100.0  # greatest ratio of the mass range


class Described(BaseModel):
    """What the model answers."""  # part of the JSON schema, and so of the key of recorded answers

    model_config = ConfigDict(extra="forbid")

    id: int
    material: str
    filling: Literal["solid", "open", "empty", "full"]
    lightest_kg: float = Field(gt=0)
    heaviest_kg: float = Field(gt=0)


class VlmPhysicist:
    """A `Physicist` behind an OpenAI-compatible endpoint."""

    def __init__(self, client: VlmClient) -> None:
        """Load the prompt."""
        self._client = client
        self._prompt = (Path(__file__).parent / "prompt.txt").read_text()
        self.name = client.name

    def choose(
        self, found: InstanceSet, posed: PosedFrames, *, views: SceneViews | None = None, progress: Progress
    ) -> dict[int, MaterialChoice]:
        """See `Physicist.choose`; failures are noted, and an unreachable endpoint ends the questions."""
        frames = best_views(found, posed)
        said: dict[int, MaterialChoice] = {}
        for number, item in enumerate(found.objects):
            pictures = shown_pictures(frames[item.id], () if views is None else views.of(item.id))
            if not pictures:
                continue
            try:
                said[item.id] = self._ask(item, pictures)
            except VlmUnavailable as error:
                left = len(found.objects) - number
                progress.note(f"physics: {error}; the table decides on {left} objects")
                return said
            except VlmError as error:
                progress.note(f"physics: object {item.id}: {error}; the table decides")
        return said

    def _ask(self, item: Instance, views: list[ObjectView]) -> MaterialChoice:
        width, depth, height = (max(1, round(100 * float(side))) for side in item.extents_m)
        prompt = self._prompt.format(
            id=item.id, label=item.label, views=len(views), width_cm=width, depth_cm=depth, height_cm=height,
            materials=", ".join(MATERIALS),
        )  # fmt: skip
        pictures = [collage([view.outlined() for view in views])]
        answer = self._client.ask(prompt, pictures, Described, lambda answer: _check(answer, item))
        return MaterialChoice(
            answer.material,
            answer.filling == "empty",
            None,
            f"{self.name}: {answer.material}, {answer.filling}",
            mass_kg=(answer.lightest_kg, answer.heaviest_kg),
        )


def shown_pictures(frames: list[ObjectView], views: Sequence[View]) -> list[ObjectView]:
    """Return the pictures for the model: the best drawn view without occluders first, then two keyframes.

    A drawn view shows the whole object, a keyframe its material. Without a view, all keyframes are returned.
    """
    drawn = next(filter(None, (view.cleared() for view in views)), None)
    if drawn is None:
        return frames
    return [ObjectView(-1, *drawn), *frames[:_FRAMES_BESIDE]]


def _check(answer: Described, item: Instance) -> None:
    """Raise ValueError, with a text for the model, where an answer is about another object or impossible."""
    low, high, volume = answer.lightest_kg, answer.heaviest_kg, float(item.extents_m.prod())
    if answer.id != item.id:
        raise ValueError(f"there is no object {answer.id} in the pictures; the id is {item.id}")
    if answer.material not in MATERIALS:
        raise ValueError(f"there is no material {answer.material!r}; there are {', '.join(MATERIALS)}")
    if low > high:
        raise ValueError(f"lightest_kg {low:g} is more than heaviest_kg {high:g}")
    if high > _MOST_APART * low:
        raise ValueError(f"from {low:g} to {high:g} kg says nothing; they are to be within a factor of 100")
    if high < _LIGHTEST_KG_M3 * volume or low > _HEAVIEST_KG_M3 * volume:
        raise ValueError(f"{low:g} to {high:g} kg in a box of {1000 * volume:.3g} liters is not possible")
