"""Export a bundle into a folder through a staging folder, so that a failed export changes nothing."""

import json
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from reconstruction.exports.glb import write_glb_scene
from reconstruction.exports.meshes import FOLDER, write_meshes
from reconstruction.exports.mjcf import write_mjcf
from reconstruction.exports.scene import ExportScene, read_scene
from reconstruction.exports.urdf import write_urdf
from reconstruction.exports.usd import write_usd
from registry import SceneBundle
from registry.errors import BundleError, UsageError
from registry.schema import check_relative_path

INDEX = "export.json"
FORMATS = {"mjcf": write_mjcf, "urdf": write_urdf, "usd": write_usd, "glb": write_glb_scene}
_WITH_MESH_FILES = {"mjcf", "urdf"}


@dataclass(frozen=True)
class ExportResult:
    """The files that an export wrote."""

    folder: Path
    main: dict[str, Path]  # format -> the file to open
    files: int  # count, over all formats in the folder
    bytes: int
    notes: tuple[str, ...]  # deviations from the bundle


def export_scene(bundle: SceneBundle, formats: Sequence[str], folder: Path) -> ExportResult:
    """Export a scene to some of `FORMATS`; other formats of the same revision in the folder are kept.

    Raises:
        UsageError: the folder holds files that no export of this scene wrote.
        EnvironmentMissing: a format needs a package that is not installed.
        BundleError: a mesh cannot be exported.
    """
    folder = Path(folder).absolute()
    before = _present(folder, bundle.scene["id"])
    scene = read_scene(bundle)
    folder.parent.mkdir(parents=True, exist_ok=True)
    staging = Path(tempfile.mkdtemp(prefix=".simrecon-export-", dir=folder.parent))
    try:
        written = _write(scene, formats, staging)
        if before.get("revision") == bundle.revision:
            written = {**before["formats"], **written}
        elif before:
            for name in {name for files in before["formats"].values() for name in files}:
                (folder / name).unlink(missing_ok=True)
        index = {"scene": scene.id, "revision": bundle.revision, "formats": written, "notes": scene.notes}
        (staging / INDEX).write_text(json.dumps(index, indent=1) + "\n", encoding="utf-8")
        _move(staging, folder)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    names = {name for files in written.values() for name in files}
    sizes = [(folder / name).stat().st_size for name in names]
    main = {name: folder / written[name][0] for name in formats}
    return ExportResult(folder, main, len(names), sum(sizes), scene.notes)


def _write(scene: ExportScene, formats: Sequence[str], staging: Path) -> dict[str, list[str]]:
    written = {}
    if _WITH_MESH_FILES & set(formats):
        write_meshes(scene.bodies, staging)
    meshes = sorted(f"{FOLDER}/{path.name}" for path in (staging / FOLDER).glob("*"))
    for name in formats:
        (staging / FOLDER).mkdir(exist_ok=True)
        files = FORMATS[name](scene, staging)
        written[name] = files + (meshes if name in _WITH_MESH_FILES else [])
    return written


def _present(folder: Path, scene_id: str) -> dict:
    """Return the index of an earlier export of this scene; {} if the folder is empty or missing."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return {}
    advice = "choose another --out or empty it yourself"
    if not (folder / INDEX).is_file():
        raise UsageError(f"{folder} holds files that no export wrote; {advice}")
    try:
        index = json.loads((folder / INDEX).read_text(encoding="utf-8"))
        owner, files = index["scene"], [name for part in index["formats"].values() for name in part]
        for name in files:
            check_relative_path(name, INDEX)
    except (ValueError, KeyError, TypeError, AttributeError, BundleError) as error:
        raise UsageError(f"{folder / INDEX} cannot be read ({error}); {advice}") from error
    if owner != scene_id:
        raise UsageError(f"{folder} holds the export of scene {owner!r}, not of {scene_id!r}; {advice}")
    return index


def _move(staging: Path, folder: Path) -> None:
    """Move all files into the folder, the index last; existing files are replaced atomically."""
    names = sorted(str(p.relative_to(staging)) for p in staging.rglob("*") if p.is_file())
    for name in [*(n for n in names if n != INDEX), INDEX]:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (staging / name).replace(folder / name)
