"""A note in the work folder of where a scene's film and corrections lie, so that the studio finds them again."""

import json
from dataclasses import dataclass
from pathlib import Path

from registry.files import write_whole


@dataclass(frozen=True)
class MadeBy:
    """Absolute paths of the last run that published a scene."""

    video: Path
    folder: Path  # working directory of the run
    overrides: Path | None  # file of corrections


def note_made_by(work_dir: Path, scene_id: str, video: Path, overrides: Path | None) -> None:
    """Write the note of a published scene."""
    path = work_dir / f"made-{scene_id}.json"
    said = {"video": str(video.absolute()), "folder": str(Path.cwd())}
    if overrides is not None:
        said["overrides"] = str(overrides.absolute())
    write_whole(path, json.dumps(said).encode())


def read_made_by(work_dir: Path, scene_id: str) -> MadeBy | None:
    """Read the note of a scene; None if there is none."""
    try:
        said = json.loads((work_dir / f"made-{scene_id}.json").read_text())
        overrides = Path(said["overrides"]) if "overrides" in said else None
        return MadeBy(Path(said["video"]), Path(said["folder"]), overrides)
    except (OSError, ValueError, KeyError, TypeError):
        return None
