# pyright: strict, reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
"""Scene bundles on disk: write the manifest of a new bundle, open and check an untrusted one.

A bundle is a folder with `scene.json`, `manifest.json` (SHA-256 and size of every other file, and the revision)
and mesh files. Opening checks the schema, value ranges, sizes, hashes and paths. Nothing is pickled.
"""

import contextlib
import hashlib
import json
import os
import re
import stat
import weakref
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from registry.errors import BundleError, EnvironmentMissing
from registry.locks import lease_folder
from registry.meshfiles import check_mesh_files
from registry.regular_files import open_regular, read_regular
from registry.schema import JsonObject, as_object, check_relative_path, referenced_files, validate_scene
from registry.strict_json import parse_json
from registry.values import show

MANIFEST_FORMAT = "simrecon.manifest/1"
# Limits of a bundle; exceeding one raises BundleError.
MAX_FILE_BYTES = 256 << 20
MAX_TOTAL_BYTES = 4 << 30
MAX_SCENE_JSON_BYTES = 32 << 20
MAX_FILES = 20_000  # files and folders
MAX_DEPTH = 8  # nested folders
Files: TypeAlias = dict[str, tuple[str, int]]  # {path: (SHA-256, bytes)}
_SHA256 = re.compile(r"[0-9a-f]{64}")
REVISION = re.compile(r"[0-9a-f]{16}")
_VOLATILE_REPORT_KEYS = ("timings_s", "peak_memory_mb", "volatile")


@dataclass(frozen=True)
class BundleCameras:
    """Intrinsics and poses of the video frames; OpenCV camera axes."""

    model: str  # "PINHOLE" | "OPENCV"
    width: int
    height: int
    params: np.ndarray  # float64: fx, fy, cx, cy (then k1, k2, p1, p2)
    indices: np.ndarray  # int32 (n,) decoded video frame numbers
    times_s: np.ndarray  # float64 (n,) since the start of the video
    world_from_camera: np.ndarray  # float64 (n, 4, 4)


@dataclass(frozen=True)
class BundleBase:
    """A floor, wall or ceiling, or the structure; meshes in world space."""

    id: int
    label: str
    mesh: str  # path in the bundle
    collision: tuple[str, ...]  # paths in the bundle; may be empty
    plane: np.ndarray | None  # float64 (4,) n . x + d = 0, unit normal n into the room; None: the structure
    observed: bool


@dataclass(frozen=True)
class BundleObject:
    """A placed object; meshes in object space (+z up, metres)."""

    id: int
    label: str
    label_confidence: float
    world_from_object: np.ndarray  # float64 (4, 4) rigid
    scale: np.ndarray  # float64 (3,) extents of its bounding box, metres
    visual: str  # path in the bundle
    collision: tuple[str, ...]  # paths in the bundle
    material: str
    density_kg_m3: float
    mass_kg: float
    center_of_mass: np.ndarray  # float64 (3,) object space
    inertia: (
        np.ndarray | None
    )  # float64 (3, 3) kg m^2 about the centre of mass, object axes; None: not in the bundle
    friction: float
    restitution: float
    ranges: dict[str, tuple[float, float]]  # (low, high) of mass_kg, friction, restitution; may be empty
    dynamic: bool
    relation_fixed: bool  # attached to its parent, not resting on it
    provenance: JsonObject
    views: tuple[int, ...]  # video frame numbers, best first
    name: str = ""  # noun phrase, unique in the scene; "" in older bundles


@dataclass(frozen=True)
class BundleEdge:
    """An edge (child, relation, parent) of the scene graph."""

    child: int
    relation: str  # "supported_by" | "attached_to"
    parent: int
    confidence: float
    evidence: Any
    said_by: str = ""  # source: "geometry", a model, "assembly", "user"; "" in older bundles


class SceneBundle:
    """One revision of a scene, read only. Create it with `SceneBundle.open`.

    It holds a shared lock on its folder for its lifetime. Publishing a newer revision keeps a locked folder.
    """

    def __init__(self, root: Path, scene: JsonObject, revision: str, files: Files) -> None:
        self.root = root
        self.scene = scene
        self.revision = revision
        self.files = files  # all but manifest.json

    @classmethod
    def open(cls, folder: Path, check_hashes: bool = True) -> "SceneBundle":
        """Open and check an untrusted bundle.

        Args:
            folder: The bundle's folder.
            check_hashes: Compare the SHA-256 of every file, and decompress every PNG texture once. If false, the
                schema, the list of files, their sizes, the hash of scene.json, and every mesh and picture header are
                checked.

        Raises:
            BundleError: The bundle is malformed, unsafe or damaged.
            EnvironmentMissing: This user may not read it.
        """
        folder = Path(folder)
        if not folder.is_dir():
            raise BundleError(f"bundle {folder}: no such folder")
        if folder.is_symlink():
            raise BundleError(f"bundle {folder}: a symbolic link, not a folder")
        lease = None
        try:
            lease = lease_folder(folder)
            bundle = cls(folder, *_read(folder, check_hashes))
        except BaseException as error:
            if lease is not None:
                os.close(lease)
            if isinstance(error, PermissionError):
                raise EnvironmentMissing(
                    f"bundle {folder}: this user may not read {error.filename or 'it'}; fix its permissions"
                ) from error
            if isinstance(error, OSError):
                raise BundleError(f"bundle {folder}: cannot be read ({error})") from error
            raise
        if lease is not None:
            weakref.finalize(bundle, os.close, lease)
        return bundle

    def resolve(self, path: str) -> Path:
        """Return the location on disk of a file of the bundle, always inside the folder.

        Raises:
            BundleError: The path is unsafe, is not in the manifest, or contains a symbolic link.
        """
        check_relative_path(path, f"bundle {self.root}")
        if path not in self.files:
            raise BundleError(f"bundle {self.root}: {path!r} is not in its manifest")
        place = self.root
        for part in path.split("/"):
            place = place / part
            if place.is_symlink():
                raise BundleError(f"bundle {self.root}: {path!r} leads through a symbolic link")
        return place

    @cached_property
    def cameras(self) -> BundleCameras:
        """Cameras of the video frames."""
        c, frames = self.scene["cameras"], self.scene["cameras"]["frames"]
        poses = np.array([f["world_from_camera"] for f in frames], np.float64)
        return BundleCameras(
            model=c["model"],
            width=c["width"],
            height=c["height"],
            params=np.array(c["params"], np.float64),
            indices=np.array([f["index"] for f in frames], np.int32),
            times_s=np.array([f["time_s"] for f in frames], np.float64),
            world_from_camera=poses.reshape(-1, 4, 4),
        )

    @cached_property
    def base(self) -> tuple[BundleBase, ...]:
        """Floors, walls, ceilings, and the structure."""
        return tuple(
            BundleBase(
                id=b["id"],
                label=b["label"],
                mesh=b["mesh"],
                collision=tuple(b.get("collision", ())),
                plane=np.array(b["plane"], np.float64) if "plane" in b else None,
                observed=b["observed"],
            )
            for b in self.scene["base"]
        )

    @property
    def backdrop(self) -> str | None:
        """Path of the mesh behind everything, in world space, drawn and never in contact; None: there is none."""
        return self.scene["backdrop"]["mesh"] if "backdrop" in self.scene else None

    @cached_property
    def objects(self) -> tuple[BundleObject, ...]:
        """Placed objects."""
        arrays = ("world_from_object", "scale", "center_of_mass")
        plain = ("id", "label", "label_confidence", "visual", "material", "density_kg_m3", "mass_kg")
        plain += ("friction", "restitution", "dynamic", "provenance")
        return tuple(
            BundleObject(
                **{key: np.array(o[key], np.float64) for key in arrays},
                **{key: o[key] for key in plain},
                collision=tuple(o["collision"]),
                inertia=np.array(o["inertia"], np.float64) if "inertia" in o else None,
                ranges={name: tuple(span) for name, span in o.get("ranges", {}).items()},
                relation_fixed=o.get("relation_fixed", False),
                views=tuple(o["views"]),
                name=o.get("name", ""),
            )
            for o in self.scene["objects"]
        )

    @cached_property
    def edges(self) -> tuple[BundleEdge, ...]:
        """Edges of the scene graph."""
        keys = ("child", "relation", "parent", "confidence", "evidence")
        return tuple(
            BundleEdge(**{key: e[key] for key in keys}, said_by=e.get("said_by", ""))
            for e in self.scene["graph"]["edges"]
        )


def seal_bundle(folder: Path, scene: JsonObject) -> str:
    """Write scene.json and manifest.json into a folder of mesh files; return the revision.

    Raises:
        BundleError: The scene is not valid, it names a missing file, or the folder exceeds a limit.
    """
    folder = Path(folder)
    try:
        text = json.dumps(scene, indent=1, sort_keys=True, allow_nan=False, ensure_ascii=False)
    except (TypeError, ValueError) as error:
        raise BundleError(f"scene.json: only finite JSON values can be written ({error})") from error
    scene = parse_json(text.encode("utf-8", "surrogatepass"), "scene.json")
    validate_scene(scene)
    (folder / "scene.json").write_text(text + "\n", encoding="utf-8")
    with contextlib.suppress(FileNotFoundError):
        (folder / "manifest.json").unlink()
    sizes = _list_files(folder)
    _check_references(scene, sizes)
    check_mesh_files(folder, sizes)
    files = {name: (hash_file(folder / name), size) for name, size in sizes.items()}
    revision = content_revision(scene, files)
    listed = {name: {"sha256": digest, "bytes": size} for name, (digest, size) in files.items()}
    manifest = {"format": MANIFEST_FORMAT, "revision": revision, "files": listed}
    text = json.dumps(manifest, indent=1, sort_keys=True)
    (folder / "manifest.json").write_text(text + "\n", encoding="utf-8")
    return revision


def content_revision(scene: JsonObject, files: Files) -> str:
    """Return the content address of a bundle: the first 16 hexadecimal digits of a SHA-256.

    Equal reconstructions have equal addresses. The scene id and `report.timings_s`, `report.peak_memory_mb` and
    `report.volatile` are not hashed.
    """
    report = {key: value for key, value in scene["report"].items() if key not in _VOLATILE_REPORT_KEYS}
    kept = {**{key: value for key, value in scene.items() if key != "id"}, "report": report}
    hashes = {name: digest for name, (digest, _) in files.items() if name != "scene.json"}
    hashed = {"files": hashes, "scene": kept}
    text = json.dumps(hashed, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a regular file, in hexadecimal."""
    digest = hashlib.sha256()
    with open_regular(path, path.name)[0] as file:
        while chunk := file.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()


def _read(folder: Path, check_hashes: bool) -> tuple[JsonObject, str, Files]:
    sizes = _list_files(folder)
    for required in ("scene.json", "manifest.json"):
        if required not in sizes:
            raise BundleError(f"bundle {folder}: {required} is missing")
        if sizes[required] > MAX_SCENE_JSON_BYTES:
            raise BundleError(f"bundle {folder}: {required} has {sizes[required]} bytes, more than 32 MiB")
    claimed_revision, files = _manifest(folder, sizes)
    data = read_regular(folder / "scene.json", f"bundle {folder}: scene.json", MAX_SCENE_JSON_BYTES)
    if hashlib.sha256(data).hexdigest() != files["scene.json"][0]:
        raise BundleError(f"bundle {folder}: scene.json does not match its SHA-256 in the manifest")
    try:
        scene = parse_json(data, "scene.json")
        validate_scene(scene)
        _check_references(scene, sizes)
        if content_revision(scene, files) != claimed_revision:
            raise BundleError(f"manifest.json: revision {show(claimed_revision)} is not that of the content")
        for name, (digest, _) in files.items() if check_hashes else ():
            if name != "scene.json" and hash_file(folder / name) != digest:
                raise BundleError(f"{name}: does not match its SHA-256 in the manifest")
        check_mesh_files(folder, files, decompress=check_hashes)
    except BundleError as error:
        raise BundleError(f"bundle {folder}: {error}") from error
    return scene, claimed_revision, files


def _manifest(folder: Path, sizes: dict[str, int]) -> tuple[str, Files]:
    data = read_regular(folder / "manifest.json", f"bundle {folder}: manifest.json", MAX_SCENE_JSON_BYTES)
    manifest = as_object(parse_json(data, f"bundle {folder}: manifest.json"))
    if manifest.get("format") != MANIFEST_FORMAT or not isinstance(manifest.get("files"), dict):
        raise BundleError(f"bundle {folder}: manifest.json is not a {MANIFEST_FORMAT} file")
    revision = manifest.get("revision")
    if not isinstance(revision, str) or not REVISION.fullmatch(revision):
        raise BundleError(f"bundle {folder}: manifest.json: revision: expected 16 hexadecimal digits")
    files: Files = {}
    for name, entry in as_object(manifest["files"]).items():
        digest, size = as_object(entry).get("sha256"), as_object(entry).get("bytes")
        if not isinstance(digest, str) or not _SHA256.fullmatch(digest) or type(size) is not int:
            raise BundleError(
                f"bundle {folder}: manifest.json: files[{show(name)}]: expected sha256 and bytes"
            )
        if name not in sizes:
            raise BundleError(f"bundle {folder}: {show(name)} is in the manifest but not in the folder")
        if sizes[name] != size:
            raise BundleError(f"bundle {folder}: {name} has {sizes[name]} bytes, the manifest says {size}")
        files[name] = (digest, size)
    extra = sorted(sizes.keys() - files.keys() - {"manifest.json"})
    if extra:
        raise BundleError(f"bundle {folder}: {extra[0]!r} is not in the manifest")
    return revision, files


def _check_references(scene: JsonObject, sizes: dict[str, int]) -> None:
    for name, place in referenced_files(scene).items():
        if name not in sizes:
            raise BundleError(f"{place}: {name} is not in the bundle")


def _list_files(folder: Path) -> dict[str, int]:
    """Return {relative path: bytes} of all files; raise BundleError at a limit or at a file that is not regular."""
    sizes: dict[str, int] = {}
    entries_seen = 0
    pending = [("", 0)]
    while pending:
        prefix, depth = pending.pop()
        if depth > MAX_DEPTH:
            raise BundleError(f"bundle {folder}: folders are nested more than {MAX_DEPTH} deep")
        with os.scandir(folder / prefix) as entries:
            for entry in entries:
                name = prefix + entry.name
                check_relative_path(name, f"bundle {folder}")
                entries_seen += 1
                if entries_seen > MAX_FILES:
                    raise BundleError(f"bundle {folder}: more than {MAX_FILES} files and folders")
                info = entry.stat(follow_symlinks=False)
                if stat.S_ISDIR(info.st_mode):
                    pending.append((name + "/", depth + 1))
                    continue
                if not stat.S_ISREG(info.st_mode):
                    kind = "a symbolic link" if stat.S_ISLNK(info.st_mode) else "not a plain file"
                    raise BundleError(f"bundle {folder}: {name} is {kind}")
                if info.st_size > MAX_FILE_BYTES:
                    raise BundleError(f"bundle {folder}: {name} has {info.st_size} bytes, more than 256 MiB")
                sizes[name] = info.st_size
    if sum(sizes.values()) > MAX_TOTAL_BYTES:
        raise BundleError(f"bundle {folder}: {sum(sizes.values())} bytes in all, more than 4 GiB")
    return dict(sorted(sizes.items()))
