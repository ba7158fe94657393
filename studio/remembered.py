"""Paths that the user gave for a scene (options of `simrecon studio SCENE`), kept between visits."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

from registry import SceneBundle
from registry.errors import UsageError
from registry.files import write_whole

if TYPE_CHECKING:
    from reconstruction.measure.stage_results import StageResults

FOLDER = "corrections"  # beside the registry


def remember(
    registry_root: Path, scene_id: str, *, video: Path | None = None, work_dir: Path | None = None,
    overrides: Path | None = None,
) -> None:  # fmt: skip
    """Write paths of a scene that the user gave (film, work folder, overrides file) beside the registry.

    Raises:
        UsageError: the film or the work folder does not exist.
    """
    said = {"video": video, "work_dir": work_dir, "overrides": overrides}
    new = {name: str(path.absolute()) for name, path in said.items() if path is not None}
    for name in ("video", "work_dir"):
        if name in new and not Path(new[name]).exists():
            raise UsageError(f"--{name.replace('_', '-')} {said[name]}: no such file or folder")
    if new:
        path = _file(registry_root, scene_id)
        known = {name: str(place) for name, place in remembered(registry_root, scene_id).items()}
        write_whole(path, json.dumps({**known, **new}).encode())


def remembered(registry_root: Path, scene_id: str) -> dict[str, Path]:
    """Return the paths given for a scene: those of `video`, `work_dir`, `overrides` that are known."""
    try:
        given = json.loads(_file(registry_root, scene_id).read_text())
    except (OSError, ValueError):
        return {}
    return {str(k): Path(str(v)) for k, v in given.items()} if isinstance(given, dict) else {}


def find_stage_results(bundle: SceneBundle, registry_root: Path) -> "StageResults":
    """Locate the stage results of a bundle, in the work folder that the user gave or in the default one."""
    from reconstruction.measure.stage_results import StageResults  # the whole pipeline: seconds

    work_dir = remembered(registry_root, bundle.scene["id"]).get("work_dir")
    return StageResults.find(bundle, registry_root, work_dir)


def _file(registry_root: Path, scene_id: str) -> Path:
    return registry_root.parent / FOLDER / f"{scene_id}.json"
