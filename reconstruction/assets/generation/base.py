"""What a generation backend is given, what it returns, and how it may fail."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from registry.errors import SimReconError

_SENT_SIDE_PX = (256, 1024)  # smallest and largest side of the square picture that is sent
_SENT_MARGIN = 0.1  # around the object, of its longer side


class GenerationError(SimReconError):
    """No mesh of this object; another object may have one."""


class GeneratorUnavailable(GenerationError):
    """The generator makes no meshes at all: it is away, refuses the key, or is something else."""


class RequestRefused(GenerationError):
    """The service does not take this request, or does not know what it is about."""


@dataclass(frozen=True)
class Picture:
    """An object in one frame, cropped with some of what is around it."""

    color: np.ndarray  # uint8 (h, w, 3) RGB
    mask: np.ndarray  # bool (h, w): the object

    def cut_out(self) -> np.ndarray:
        """Return a square picture of nothing but the object: uint8 (s, s, 4) RGBA, white and clear around it."""
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
    """What a generator is told of one object."""

    id: int
    label: str  # "" where it is not known well
    pictures: tuple[Picture, ...]  # the best first


@dataclass
class Job:
    """One object's generation: what went to and fro, and what must not be lost while it is under way."""

    pending: dict[str, str] | None = None  # of a paid task that an earlier run began and did not fetch
    remember: Callable[[dict[str, str] | None], None] = lambda task: (
        None
    )  # keep such a task; None: it is over
    exchanges: list[dict[str, Any]] = field(default_factory=list)  # requests and replies, no keys


class GenerationBackend(Protocol):
    """Makes a textured mesh of an object from pictures.

    A mesh comes as the bytes of a binary glTF file, in the generator's own frame and units, upright as glTF is (+y
    up): bytes, so that what is kept is what came.
    """

    name: str
    cost: float  # credits for one object, 0 where nothing is paid
    sends_to: str  # where pictures go; "" where they stay on this machine
    most_pictures: int
    at_once: int  # generations that may run beside each other

    def settings(self) -> dict[str, Any]:
        """Return what shapes the mesh beside the pictures (JSON); with them it names a record."""

    def check(self) -> None:
        """Look whether it can be used at all, without sending or loading anything heavy.

        Raises:
            EnvironmentMissing: something is not installed, or a key is not set.
        """

    def generate(self, pictures: ObjectPictures, job: Job) -> bytes:
        """Return a .glb of the object.

        Raises:
            GeneratorUnavailable: it makes no meshes, whatever the object.
            GenerationError: not of this object.
        """
