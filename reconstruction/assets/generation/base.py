"""Interface of generators: inputs, outputs and errors."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from registry.errors import SimReconError

_SENT_SIDE_PX = (256, 1024)  # smallest and largest side of the picture that is sent
_SENT_MARGIN = 0.1  # border around the object, relative to its longer side


class GenerationError(SimReconError):
    """No mesh of this object; other objects may have one."""


class GeneratorUnavailable(GenerationError):
    """No mesh of any object: the generator is unreachable, refuses the key, or is not what was configured."""


class RequestRefused(GenerationError):
    """The service rejects this request, or does not know its task."""


@dataclass(frozen=True)
class Picture:
    """An object in one frame, cropped with a margin."""

    color: np.ndarray  # uint8 (h, w, 3) RGB
    mask: np.ndarray  # bool (h, w) the object

    def cut_out(self) -> np.ndarray:
        """Return the object on a square: uint8 (s, s, 4) RGBA, white and transparent around it."""
        import cv2

        rows, columns = np.flatnonzero(self.mask.any(axis=1)), np.flatnonzero(self.mask.any(axis=0))
        window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        mask = self.mask[window]
        height, width = mask.shape
        side = round(max(height, width) * (1 + 2 * _SENT_MARGIN))
        out = np.full((side, side, 4), (255, 255, 255, 0), np.uint8)
        top, left = (side - height) // 2, (side - width) // 2
        inner = out[top : top + height, left : left + width]
        inner[..., :3] = np.where(mask[..., None], self.color[window], 255)
        inner[..., 3] = mask * np.uint8(255)
        wanted = int(np.clip(side, *_SENT_SIDE_PX))
        if wanted == side:
            return out
        how = cv2.INTER_AREA if wanted < side else cv2.INTER_LINEAR
        return cv2.resize(out, (wanted, wanted), interpolation=how)


@dataclass(frozen=True)
class ObjectPictures:
    """A generator's input for one object."""

    id: int
    label: str  # "" where it is uncertain
    pictures: tuple[Picture, ...]  # best first


@dataclass
class Job:
    """The generation of one object: its exchanges with the service, and its paid task."""

    pending: dict[str, str] | None = None  # a paid task that an earlier run did not fetch
    remember: Callable[[dict[str, str] | None], None] = lambda task: (
        None
    )  # store such a task; None: it is over
    exchanges: list[dict[str, Any]] = field(default_factory=list)  # requests and replies, without keys


class GenerationBackend(Protocol):
    """Makes a textured mesh of an object from pictures.

    The mesh is the unchanged content of a binary glTF file, in the generator's own frame and units, +y up.
    """

    name: str
    cost: float  # credits per object, 0 where it is free
    sends_to: str  # address that receives pictures; "" where they stay on this machine
    most_pictures: int
    at_once: int  # parallel generations

    def settings(self) -> dict[str, Any]:
        """Return everything but the pictures that determines the mesh, as JSON; it names a record."""
        ...

    def check(self) -> None:
        """Check that the generator can be used, without sending or loading anything heavy.

        Raises:
            EnvironmentMissing: a package is not installed, or a key is not set.
        """

    def generate(self, pictures: ObjectPictures, job: Job) -> bytes:
        """Return a .glb of the object.

        Raises:
            GeneratorUnavailable: it makes no meshes at all.
            GenerationError: it makes none of this object.
        """
        ...
