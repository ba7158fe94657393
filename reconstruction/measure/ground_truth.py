"""Read a ground-truth folder (CONTRACT section 3; docs/evaluation.md).

It holds `scene.json` with cameras and entities, or `cameras.json` with tracked cameras only.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from reconstruction.core.types import Camera
from reconstruction.measure.scene import joined
from registry.errors import UsageError

if TYPE_CHECKING:
    import trimesh

_MIN_VISIBLE_PIXELS, _AT_PIXELS = (
    2000,
    640 * 480,
)  # CONTRACT section 4: least visible pixels, at this image size
_MILLIMETRE = np.float32(1e-3)


@dataclass(frozen=True)
class TrueEntity:
    """A true object or base surface."""

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
        """The complete surface in world space, in metres.

        Raises:
            UsageError: the file cannot be read or has no triangles.
        """
        import trimesh

        try:
            mesh = trimesh.load(self.mesh_path, force="mesh", process=False)
        except Exception as error:  # trimesh raises whatever its many readers raise
            raise UsageError(f"ground truth: {self.mesh_path} cannot be read as a mesh: {error}") from error
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            raise UsageError(f"ground truth: {self.mesh_path} has no triangles")
        return mesh

    @property
    def bounds(self) -> np.ndarray:
        """Lower and upper corner (2, 3) of the axis-aligned bounding box."""
        bounds = self.mesh.bounds
        assert bounds is not None  # the mesh has triangles
        return bounds


@dataclass(frozen=True)
class GroundTruth:
    """The ground truth of a capture; without entities if only cameras (and depth) are known."""

    folder: Path
    camera: Camera
    world_from_camera: Mapping[int, np.ndarray]  # video frame number -> float64 (4, 4), OpenCV
    entities: tuple[TrueEntity, ...]
    up: np.ndarray  # float64 (3,) unit vector against gravity, in the true world

    @classmethod
    def load(cls, folder: Path) -> "GroundTruth":
        """Read a ground-truth folder, or its subfolder `ground_truth`.

        Raises:
            UsageError: the folder is missing or malformed.
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
        """The evaluated objects: those with 2,000 visible pixels at 640x480, in proportion to the image size."""
        least = _MIN_VISIBLE_PIXELS * self.camera.width * self.camera.height / _AT_PIXELS
        return tuple(e for e in self.entities if not e.base and e.visible_pixels >= least)

    @property
    def base(self) -> tuple[TrueEntity, ...]:
        """Floor, walls and ceiling."""
        return tuple(e for e in self.entities if e.base)

    @cached_property
    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """All entities as one mesh: vertices (v, 3) in the true world, faces (f, 3)."""
        return joined([e.mesh for e in self.entities])

    @cached_property
    def face_ids(self) -> np.ndarray:
        """Entity id int64 (f,) of each face of `mesh`."""
        return np.repeat([e.id for e in self.entities], [len(e.mesh.faces) for e in self.entities])

    @property
    def poses(self) -> list[np.ndarray]:
        """All true poses world_from_camera (4, 4)."""
        return list(self.world_from_camera.values())

    def depth(self, index: int) -> np.ndarray | None:
        """Read the z-depth of a video frame: float32 (h, w) in metres, 0 = unknown; None if there is no file."""
        image = self._image("depth", index)
        return None if image is None else image.astype(np.float32) * _MILLIMETRE

    def instances(self, index: int) -> np.ndarray | None:
        """Read the entity ids of a video frame: uint16 (h, w), 0 = none; None if there is no file."""
        image = self._image("instances", index)
        return None if image is None else image.astype(np.uint16)

    def indices(self, kind: str) -> list[int]:
        """Return the video frames that have an image of `kind` ("depth" or "instances")."""
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
    intrinsics = [float(data["intrinsics"][name]) for name in ("fx", "fy", "cx", "cy")]
    return Camera(int(data["width"]), int(data["height"]), *intrinsics)


def _poses(data: dict) -> dict[int, np.ndarray]:
    poses = {}
    for frame in data["frames"]:
        pose = np.asarray(frame["world_from_camera"], np.float64)
        if pose.shape != (4, 4):
            raise ValueError(
                f"frame {frame['index']}: world_from_camera has shape {pose.shape}, expected (4, 4)"
            )
        if np.isfinite(pose).all():  # frames where tracking was lost have NaN
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
