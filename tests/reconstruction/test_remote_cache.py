"""Stage results at an address: another machine goes on from them, and trouble of the address does not end a run."""

import contextlib
import gc
import io
import json
import shutil
import tarfile

import fsspec
import pytest

from reconstruction.cache import DamagedResult
from reconstruction.core.types import Edge, SceneGraph
from reconstruction.remote_cache import RemoteResults, drop_results, open_store, work_folder
from registry.errors import EnvironmentMissing, UsageError

pytestmark = pytest.mark.stage

DIGEST = "0123456789abcdef" * 4
STAGE = (8, "scene_graph")


def graph(number: int) -> SceneGraph:
    return SceneGraph(edges=(Edge(number, "supported_by", 0, 1.0, ""),))


@pytest.fixture(params=["memory", "file", "s3"])
def address(request, tmp_path) -> str:
    """An empty place to keep results."""
    if request.param == "s3":
        request.getfixturevalue("s3")
        return f"s3://lab/{tmp_path.name}"
    return f"file://{tmp_path}/there" if request.param == "file" else f"memory://{tmp_path.name}"


class Machine:
    """A machine with a disk of its own."""

    def __init__(self, folder, address: str) -> None:
        self.root, self.address, self.notes = folder / "registry", address, []

    def store(self):
        return open_store(self.address, self.root, DIGEST, note=self.notes.append)

    def run(self, key: str, number: int) -> bool:
        """Return whether a run computed the result of a fingerprint; it is loaded either way."""
        with self.store() as store:
            computed = not store.has(*STAGE, key)
            if computed:
                store.save(graph(number), *STAGE, key, {"note": key})
            store.check(*STAGE, key)
            assert store.load(SceneGraph, *STAGE, key) == graph(number)
            assert store.manifest(*STAGE, key) == {"note": key}
        assert not list(store.work_dir.glob("tmp-*"))
        return computed


@pytest.fixture
def machines(tmp_path, address):
    return [Machine(tmp_path / name, address) for name in "ab"]


def test_another_machine_goes_on_from_what_one_has_finished(machines):
    one, other = machines
    assert one.run("k1", 1)
    assert not other.run("k1", 1)
    assert not one.run("k1", 1)
    assert one.notes == other.notes == []


def test_results_from_before_the_address_are_uploaded_when_they_are_used(machines):
    one, other = machines
    with open_store(None, one.root, DIGEST) as store:
        store.save(graph(1), *STAGE, "k1", {"note": "k1"})
    assert not one.run("k1", 1)
    assert not other.run("k1", 1)


def test_the_last_results_of_a_stage_stay(machines):
    one, other = machines
    for number in range(4):
        assert one.run(f"k{number}", number)
    left = RemoteResults(one.address, DIGEST).names()
    assert len(left) == 2
    assert "08_scene_graph-k3" in left
    assert not other.run("k3", 3)
    assert other.run("k0", 0)


def test_a_damaged_result_is_removed_here_and_there_and_computed_again(machines):
    one, other = machines
    one.run("k1", 1)
    remote = RemoteResults(one.address, DIGEST)
    manifest = json.dumps({"note": "k1", "files": {"scene_graph.json": "0" * 64}}).encode()
    _put_tar(remote, "08_scene_graph-k1", {"manifest.json": manifest})
    with other.store() as store:
        assert store.has(*STAGE, "k1")
        with pytest.raises(DamagedResult):
            store.check(*STAGE, "k1")
        store.remove(*STAGE, "k1")
        assert not store.has(*STAGE, "k1")
    assert other.run("k1", 1)
    shutil.rmtree(work_folder(one.address, one.root, DIGEST))
    assert not one.run("k1", 1)


@pytest.mark.parametrize("name", ["../out", "/tmp/simrecon-out", "sub/file"])
def test_an_archive_that_names_files_elsewhere_is_refused(machines, name, tmp_path):
    one, other = machines
    _put_tar(RemoteResults(one.address, DIGEST), "08_scene_graph-k1", {name: b"x", "manifest.json": b"{}"})
    assert one.run("k1", 1)  # computed, and uploaded in its place
    assert not other.run("k1", 1)
    assert one.notes == []
    assert not list(tmp_path.rglob("out"))


def test_dropped_results_are_gone_here_and_there(machines):
    one, other = machines
    one.run("k1", 1)
    gc.collect()  # frames of exceptions may keep the store, which leases its results
    drop_results(one.address, one.root, DIGEST)
    assert RemoteResults(one.address, DIGEST).names() == []
    assert one.run("k1", 1)
    assert not other.run("k1", 1)


def test_an_address_that_fails_during_a_run_is_said_once_and_the_run_goes_on(tmp_path, monkeypatch):
    one = Machine(tmp_path, f"memory://{tmp_path.name}")
    with one.store() as store:

        def refuse(*args, **kwargs):
            raise ConnectionResetError("the network is down")

        monkeypatch.setattr(type(fsspec.filesystem("memory")), "pipe_file", refuse)
        monkeypatch.setattr(type(fsspec.filesystem("memory")), "put_file", refuse)
        for number in range(3):
            assert not store.has(*STAGE, f"k{number}")
            store.save(graph(number), *STAGE, f"k{number}", {})
            assert store.load(SceneGraph, *STAGE, f"k{number}") == graph(number)
    (note,) = one.notes
    assert "the network is down" in note
    assert "went on without it" in note


@pytest.mark.parametrize(
    ("address", "error"),
    [
        ("nope://x/y", UsageError),
        ("s3://nobody-made-this/work", UsageError),
        ("file:///dev/null/work", EnvironmentMissing),
    ],
)
def test_an_address_that_cannot_be_opened_is_an_error_before_anything_runs(s3, tmp_path, address, error):
    with pytest.raises(error), Machine(tmp_path, address).store():
        pass


def _put_tar(remote: RemoteResults, name: str, files: dict[str, bytes]) -> None:
    stream = io.BytesIO()
    with contextlib.closing(tarfile.open(fileobj=stream, mode="w:")) as tar:
        for file, content in files.items():
            member = tarfile.TarInfo(file)
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    remote.place.write(f"{remote.folder}/{name}.tar", stream.getvalue())
