"""kill -9 at random moments of pack, add and push: what is there is whole, and the next run works."""

import os
import random
import shutil
import subprocess
import sys
import time
from pathlib import Path

import exchange_worker
import pytest

from registry import SceneBundle, SceneRegistry
from registry.exchange import add_scene, list_place, open_place, pack_scene, pull_scene, push_scene

pytestmark = pytest.mark.stage

ROOT = Path(__file__).parents[2]


@pytest.fixture
def folder(tmp_path, make_bundle):
    """Return a folder with two revisions of `room`, as bundles and packs, and one of each already in place."""
    for name in ("one", "two"):
        shutil.copytree(make_bundle("room", name), tmp_path / name)
        pack_scene(SceneBundle.open(tmp_path / name), tmp_path / f"{name}.simrecon")
    (tmp_path / "tmp").mkdir()
    return tmp_path


def check(folder: Path, verb: str) -> None:
    """Everything that is visible is whole."""
    if verb == "pack" and (path := folder / "packed" / "room.simrecon").exists():
        whole = {(folder / f"{name}.simrecon").read_bytes() for name in ("one", "two")}
        assert path.read_bytes() in whole
    if verb == "add":
        registry = SceneRegistry(folder / "registry")
        for record in registry.list():
            assert registry.verify(record.scene_id).ok
    if verb == "push":
        checked = SceneRegistry(folder / "checked")
        for root in sorted((folder / "places").iterdir()):
            place = open_place(root)
            for shared in list_place(place):
                pull_scene(place, f"{shared.scene_id}@{shared.revision}", checked, replace=True)
            for key in place.keys("packs"):
                if key.endswith(".simrecon"):
                    add_scene(Path(place.root) / "packs" / key, checked, replace=True)
            if len(list(root.rglob("*.json"))) == 2:
                shutil.rmtree(root)  # complete, and checked
            else:
                (folder / "killed").mkdir(exist_ok=True)
                root.rename(folder / "killed" / root.name)


@pytest.mark.parametrize("verb", ["pack", "add", "push"])
@pytest.mark.parametrize("kills", [4, pytest.param(20, marks=pytest.mark.end_to_end)])
def test_killed_at_random_moments_nothing_is_half_there(folder, verb, kills):
    chance = random.Random(f"{verb} {kills}")
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(folder / "tmp")}
    command = [sys.executable, exchange_worker.__file__, verb, str(folder)]
    for _ in range(kills):
        process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        first = process.stdout.readline()  # the imports are over, and one turn is done
        assert first == "0\n"
        time.sleep(chance.uniform(0, 0.25))
        process.kill()
        process.communicate(timeout=20)
        check(folder, verb)
    _next_run_works_and_cleans(folder, verb)


def _next_run_works_and_cleans(folder: Path, verb: str) -> None:
    """No lock is stale, and what killed processes left is removed once it is a minute old."""
    began = time.monotonic()
    for left in [*(folder / "tmp").iterdir(), *folder.rglob(".*.tmp")]:
        os.utime(left, (0, 0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tempfile.tempdir", str(folder / "tmp"))
        bundle = SceneBundle.open(folder / "two")
        if verb == "pack":
            path = pack_scene(bundle, folder / "packed" / "room.simrecon").path
            assert path.read_bytes() == (folder / "two.simrecon").read_bytes()
        elif verb == "add":
            registry = SceneRegistry(folder / "registry")
            for name in ("one", "two"):  # publishing removes what a killed publish of the scene left
                add_scene(folder / f"{name}.simrecon", registry, replace=True)
            assert sorted(p.name for p in (registry.scenes_folder / "room").iterdir()) == [bundle.revision]
        else:
            for root in sorted((folder / "killed").iterdir()):
                for name in ("one", "two"):
                    push_scene(SceneBundle.open(folder / name), open_place(root))
                assert list_place(open_place(root))[0].revision == bundle.revision
    assert time.monotonic() - began < 15
    assert list((folder / "tmp").iterdir()) == []
    assert list(folder.rglob(".*.tmp")) == []
