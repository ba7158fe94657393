"""A damaged file of the stage cache: the stage is computed again, with the same result, and later runs find it."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from notes import Notes

from reconstruction.cache import DamagedResult, StageStore, quick_digest
from reconstruction.config import PipelineConfig
from reconstruction.core.types import Edge, SceneGraph
from reconstruction.measure.stage_results import StageResults
from reconstruction.runner import Run
from synthetic.videos import short_film, write_video

pytestmark = pytest.mark.stage

GRAPH = SceneGraph(edges=(Edge(1, "supported_by", 0, 1.0, ""),))


class _Stages(Notes):
    """Collects notes, and which stages were found in the cache."""

    def __init__(self) -> None:
        super().__init__()
        self.cached: dict[str, bool] = {}

    def begin_stage(self, name: str, number: int, total: int, cached: bool) -> None:
        self.cached[name] = cached

    def end_stage(self, name: str, usage: object) -> None:
        pass


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    path = tmp_path_factory.mktemp("film") / "film.mp4"
    write_video(path, short_film(24))
    return path


@pytest.fixture(scope="module")
def finished(film, tmp_path_factory):
    """Return a work folder in which the first stage is finished, and its result."""
    work = tmp_path_factory.mktemp("finished")
    run = _run(film, work)
    return work, np.array(run.results["frames"].images)


def _run(film: Path, work: Path, listener: _Stages | None = None) -> Run:
    run = Run(film, PipelineConfig(), StageStore(work), listener=listener or _Stages())
    run.execute(until="frames")
    return run


def _cut(file: Path) -> None:
    with file.open("r+b") as stream:
        stream.truncate(file.stat().st_size // 2)


def _zero(file: Path) -> None:
    file.write_bytes(bytes(file.stat().st_size))


def _zero_a_block(file: Path) -> None:
    size = file.stat().st_size
    with file.open("r+b") as stream:
        stream.seek(size // 3)
        stream.write(bytes(size // 20))


def _to_folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


def _without(name: str):
    def change(file: Path) -> None:
        record = json.loads(file.read_text())
        del record[name]
        file.write_text(json.dumps(record))

    return change


def _with(**values: object):
    return lambda file: file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


def _largest(folder: Path) -> Path:
    return max(folder.glob("*.npy"), key=lambda file: file.stat().st_size)


DAMAGES = {
    "structure cut": ("data.json", _cut),
    "structure empty": ("data.json", lambda f: f.write_bytes(b"")),
    "structure not UTF-8": ("data.json", lambda f: f.write_bytes(b"\xff\xfe{}")),
    "structure nested": ("data.json", lambda f: f.write_text("[" * 100_000)),
    "structure a list": ("data.json", lambda f: f.write_text("[]")),
    "structure missing": ("data.json", Path.unlink),
    "structure a folder": ("data.json", _to_folder),
    "array cut": ("array", _cut),
    "array of zeros": ("array", _zero),
    "array with lost blocks": ("array", _zero_a_block),
    "array missing": ("array", Path.unlink),
    "manifest missing": ("manifest.json", Path.unlink),
    "manifest cut": ("manifest.json", _cut),
    "manifest a list": ("manifest.json", lambda f: f.write_text("[]")),
    "manifest without time": ("manifest.json", _without("usage")),
    "manifest with words for times": ("manifest.json", _with(usage={"wall_s": "x"})),
    "manifest with a list of files": ("manifest.json", _with(files=["data.json"])),
    "manifest names a file outside": ("manifest.json", _with(files={"../../etc": "0"})),
    "result is a file": ("", lambda f: (shutil.rmtree(f), f.write_text("x"))),
    "result is empty": ("", lambda f: (shutil.rmtree(f), f.mkdir())),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_stage_is_computed_again(damage, finished, film, tmp_path):
    done, images = finished
    work = shutil.copytree(done, tmp_path / "work")
    (folder,) = work.glob("01_frames-*")
    name, change = DAMAGES[damage]
    change(_largest(folder) if name == "array" else folder / name)
    listener = _Stages()
    run = _run(film, work, listener)
    assert run.computed == {"frames"}
    assert np.array_equal(run.results["frames"].images, images)
    told = [note for note in listener.notes if "again" in note]
    assert len(told) == (0 if damage in ("manifest missing", "result is a file", "result is empty") else 1)
    assert all(str(folder) in note or "manifest" in note for note in told)
    assert _run(film, work).computed == set(), "the second run finds the new result"
    assert not list(work.glob("tmp-*"))


def test_an_intact_stage_is_not_computed_again(finished, film):
    assert _run(film, finished[0]).computed == set()


def test_a_result_of_a_version_without_digests_is_read(finished, film, tmp_path):
    work = shutil.copytree(finished[0], tmp_path / "work")
    (manifest,) = work.glob("01_frames-*/manifest.json")
    _without("files")(manifest)
    assert _run(film, work).computed == set()


def test_digests_show_a_changed_size_and_changed_ends_of_large_files(tmp_path):
    file = tmp_path / "large"
    data = np.random.default_rng(0).integers(0, 256, 20 << 20, dtype=np.uint8).tobytes()
    file.write_bytes(data)
    digests = {quick_digest(file)}
    for changed in (data[:-1], data + b"\0", b"\0\0\0" + data[3:], data[:-3] + b"\0\0\0"):
        file.write_bytes(changed)
        digests.add(quick_digest(file))
    assert len(digests) == 5


def test_a_damaged_result_is_named_where_it_is_read_directly(tmp_path):
    store = StageStore(tmp_path)
    store.save(GRAPH, 10, "scene_graph", "k", {})
    data = tmp_path / "10_scene_graph-k" / "data.json"
    data.write_text("{")
    with pytest.raises(DamagedResult, match="10_scene_graph-k"):
        store.load(SceneGraph, 10, "scene_graph", "k")
    results = StageResults({"frames": data.parent}, {})
    assert results.get("frames") is None
    assert "reconstruct the scene again" in results.missing["frames"]
