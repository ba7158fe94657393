"""The benchmarks of the registry: their judges see what is lost, and the made registry verifies."""

import json
import shutil

import pytest

from benchmarks import registry_size, registry_writers
from registry import SceneRegistry
from registry.exchange import list_place, open_place, pull_scene

pytestmark = pytest.mark.stage


@pytest.mark.parametrize("target", ["registry", "folder"])
def test_writers_lose_nothing_and_a_loss_would_be_seen(tmp_path, target):
    address = str(tmp_path / "written")
    found = registry_writers.run_writers(tmp_path / "home", target, address, processes=2, publishes=7)
    assert found["problems"] == []
    assert (found["publishes"], found["scenes"]) == (7, 6)
    if target == "registry":
        registry = SceneRegistry(tmp_path / "written")
        pushed = set(registry.revisions().items())
        registry.remove("scene0003")
        shutil.rmtree(registry.get("scene0004").path / "objects")
        said = " ".join(registry_writers.judge_registry(tmp_path, address, pushed))
        assert "scene0003: lost" in said
        assert "scene0004: " in said
        return
    place = open_place(address)
    pushed = {(shared.scene_id, shared.revision) for shared in list_place(place)}
    gone = list_place(place, "scene0003")[0]
    place.remove([gone.entry_key])
    place.remove([list_place(place, "scene0004")[0].pack_key])
    said = registry_writers.judge_place(tmp_path / "judge", address, pushed)
    assert f"{('scene0003', gone.revision)}: no entry" in said
    assert any(line.startswith("('scene0004'") and line.endswith("no pack") for line in said)


def test_the_made_registry_verifies_and_every_act_runs(tmp_path):
    home, out = tmp_path / "home", tmp_path / "out.json"
    options = ["--scenes", "110", "--repeats", "1", "--rebuild", "--home", str(home), "--json", str(out)]
    assert registry_size.main(options) == 0
    acts = json.loads(out.read_text())["acts"]
    assert {name for name, *_ in registry_size.ACTS} < acts.keys()
    registry = SceneRegistry(home / "registry")
    names = list(registry.revisions())
    assert len(names) == 110
    assert all(registry.verify(name).ok for name in names)
    place = open_place(home / "place")
    assert {shared.scene_id for shared in list_place(place)} == set(names)
    assert pull_scene(place, registry_size.scene_name(7), SceneRegistry(tmp_path / "mine")).new
    assert registry_size.main([*options, "--scenes", "120"]) == 2
