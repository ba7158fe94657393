"""Read a ground-truth folder (CONTRACT section 3; docs/evaluation.md).

Two forms: `scene.json` with cameras and entities, and `cameras.json` with a sensor's own tracking and no entities.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from reconstruction.core.types import Camera
from registry.errors import UsageError

if TYPE_CHECKING:
    import trimesh

_MIN_VISIBLE_PIXELS, _AT_PIXELS = 2000, 640 * 480
_MILLIMETRE = np.float32(1e-3)


@dataclass(frozen=True)
class TrueEntity:
    """One true thing: floor, wall or object."""

    id: int
    name: str
    label: str
    base: bool
    relation: str | None  # "supported_by" | "attached_to"; None for the base
    parent: int | None
    fixed: bool
    visible_pixels: int
    mesh_path: Path

    @cached_property
    def mesh(self) -> "trimesh.Trimesh":
        """The true surface in world space, in metres."""
        import trimesh

        try:
            mesh = trimesh.load(self.mesh_path, force="mesh", process=False)
        except Exception as error:  # trimesh raises whatever its many readers raise
            raise UsageError(f"ground truth: {self.mesh_path} cannot be read as a mesh: {error}") from error
        if not len(mesh.faces):
            raise UsageError(f"ground truth: {self.mesh_path} has no triangles")
        return mesh


@dataclass(frozen=True)
class GroundTruth:
    """What is true of a capture. Entities are empty where only cameras (and depth) are known."""

    folder: Path
    camera: Camera
    world_from_camera: Mapping[int, np.ndarray]  # video frame number -> float64 (4, 4), OpenCV
    entities: tuple[TrueEntity, ...]
    up: np.ndarray  # float64 (3,) unit, against gravity, in the truth's own world

    @classmethod
    def load(cls, folder: Path) -> "GroundTruth":
        """Read a folder.

        Raises:
            UsageError: it is missing or malformed.
        """
        folder = Path(folder)
        if not folder.is_dir():
            raise UsageError(f"ground truth {folder}: no such folder")
        names = [name for name in ("scene.json", "cameras.json") if (folder / name).is_file()]
        if not names:
            inside = folder / "ground_truth"
            if inside.is_dir():
                return cls.load(inside)
            raise UsageError(
                f"ground truth {folder}: holds neither scene.json (cameras, entities) nor cameras.json"
            )
        path = folder / names[0]
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
            return cls(folder, _camera(data), _poses(data), _entities(data, folder), _up(data))
        except json.JSONDecodeError as error:
            raise UsageError(f"ground truth {path}: not JSON ({error})") from error
        except (KeyError, TypeError, ValueError) as error:
            raise UsageError(f"ground truth {path}: malformed ({type(error).__name__}: {error})") from error

    @property
    def evaluated(self) -> tuple[TrueEntity, ...]:
        """Objects that are seen well enough to be asked for (2,000 pixels of a 640x480 video, in proportion)."""
        least = _MIN_VISIBLE_PIXELS * self.camera.width * self.camera.height / _AT_PIXELS
        return tuple(e for e in self.entities if not e.base and e.visible_pixels >= least)

    @property
    def base(self) -> tuple[TrueEntity, ...]:
        """Floor, walls and ceiling."""
        return tuple(e for e in self.entities if e.base)

    def depth(self, index: int) -> np.ndarray | None:
        """Return float32 (h, w) z-depth in metres of a video frame, 0 where unknown; None where there is no file."""
        image = self._image("depth", index)
        return None if image is None else image.astype(np.float32) * _MILLIMETRE

    def instances(self, index: int) -> np.ndarray | None:
        """Return uint16 (h, w) entity ids of a video frame; None where there is no file."""
        image = self._image("instances", index)
        return None if image is None else image.astype(np.uint16)

    def indices(self, kind: str) -> list[int]:
        """Return the frame numbers that have `depth` or `instances`."""
        return sorted(int(path.stem) for path in (self.folder / kind).glob("*.png") if path.stem.isdigit())

    def _image(self, kind: str, index: int) -> np.ndarray | None:
        import cv2

        path = self.folder / kind / f"{index:05d}.png"
        if not path.is_file():
            return None
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None or image.ndim != 2:
            raise UsageError(f"ground truth {path}: expected a single-channel PNG")
        return image


def _camera(data: dict) -> Camera:
    k = data["intrinsics"]
    return Camera(
        int(data["width"]),
        int(data["height"]),
        float(k["fx"]),
        float(k["fy"]),
        float(k["cx"]),
        float(k["cy"]),
    )


def _poses(data: dict) -> dict[int, np.ndarray]:
    poses = {}
    for frame in data["frames"]:
        pose = np.asarray(frame["world_from_camera"], np.float64)
        if pose.shape != (4, 4):
            raise ValueError(
                f"frame {frame['index']}: world_from_camera has shape {pose.shape}, expected (4, 4)"
            )
        if np.isfinite(pose).all():  # a sensor that lost track writes NaN
            poses[int(frame["index"])] = pose
    if not poses:
        raise ValueError("no frame has a pose")
    return poses


def _entities(data: dict, folder: Path) -> tuple[TrueEntity, ...]:
    ids = {entry["name"]: int(entry["id"]) for entry in data.get("entities", [])}
    out = []
    for entry in data.get("entities", []):
        parent = entry.get("parent")
        if parent is not None and parent not in ids:
            raise ValueError(f"entity {entry['name']}: its parent {parent!r} is not an entity")
        out.append(
            TrueEntity(
                id=int(entry["id"]),
                name=str(entry["name"]),
                label=str(entry["label"]),
                base=bool(entry["base"]),
                relation=entry.get("relation"),
                parent=None if parent is None else ids[parent],
                fixed=bool(entry.get("fixed", entry["base"])),
                visible_pixels=int(entry["visible_pixels"]),
                mesh_path=folder / entry["mesh"],
            )
        )
    return tuple(out)


def _up(data: dict) -> np.ndarray:
    if "gravity" in data:
        down = np.asarray(data["gravity"], np.float64)
        return -down / np.linalg.norm(down)
    return np.array([0.0, 0.0, 1.0])
