"""A folder of named files, and a row factory."""

import sys
from pathlib import Path

import pytest

from reconstruction.batch.rows import VideoRow
from registry import SceneRegistry

sys.path.append(str(Path(__file__).parents[2] / "simrecon_envs"))
from made_scenes import publish


@pytest.fixture
def films(tmp_path: Path) -> Path:
    """A folder with three films by name, a folder of images, and things that are none."""
    folder = tmp_path / "films"
    folder.mkdir()
    for number, name in enumerate(("Küche 1.mp4", "room.mp4", "room.MOV")):
        (folder / name).write_bytes(bytes(10 + number))
    (folder / "photos").mkdir()
    (folder / "photos" / "a.jpg").write_bytes(b"x")
    (folder / "notes.txt").write_text("no film")
    (folder / ".hidden.mp4").write_bytes(b"x")
    (folder / "films.batch" / "previews").mkdir(parents=True)
    (folder / "films.batch" / "previews" / "a.jpg").write_bytes(b"x")
    return folder


@pytest.fixture
def defaults() -> VideoRow:
    """The options of rows that say nothing else."""
    return VideoRow("", Path(), preset="fast")


@pytest.fixture
def registry(tmp_path: Path) -> SceneRegistry:
    """A registry with the hand-made scene `room`."""
    made = SceneRegistry(tmp_path / "registry", create=True)
    publish(made, "room", tmp_path / "made")
    return made
