"""kill -9 at random moments of publish, pack, add and push: what is there is whole, and the next run works."""

import random

import pytest

from benchmarks import registry_kills
from registry import SceneBundle

pytestmark = pytest.mark.stage


@pytest.mark.parametrize("verb", ["publish", "pack", "add", "push"])
@pytest.mark.parametrize("kills", [5, pytest.param(20, marks=pytest.mark.end_to_end)])
def test_killed_at_random_moments_nothing_is_half_there(tmp_path, verb, kills):
    found = registry_kills.run_kills(tmp_path / "home", verb, kills, random.Random(f"{verb} {kills}"))
    assert found["problems"] == []
    assert found["turns"] >= kills
    assert found["next_s"] < 15


@pytest.mark.end_to_end
def test_pushes_to_s3_killed_at_random_moments_are_there_or_not(tmp_path):
    pytest.importorskip("s3fs", reason="S3 is tested with the extra s3")
    pytest.importorskip("moto.server", reason="S3 is tested with moto")
    found = registry_kills.measure(tmp_path, ["push_s3"], 20, seed=1)
    assert found["push_s3"]["problems"] == []


def test_the_judge_sees_what_is_half_there(tmp_path):
    """The judge of the kills fails where a scene, a pack or an entry is damaged, lost or without the other."""
    registry_kills.make_home(tmp_path)
    for number in range(4):
        registry_kills.turn("publish", tmp_path, number, "")
    registry = registry_kills.SceneRegistry(tmp_path / "registry")
    assert list(registry_kills.check_registry(registry, {"room", "hall"})) == []
    assert list(registry_kills.check_registry(registry, {"room", "attic"})) == ["attic: lost"]
    (registry.get("room").path / "objects/002/collision_000.obj").unlink()
    assert "half a scene" in " ".join(registry_kills.check_registry(registry, {"room"}))

    address, checked = str(tmp_path / "place"), registry_kills.SceneRegistry(tmp_path / "checked")
    registry_kills.turn("push", tmp_path, 0, address)
    place = registry_kills.open_place(f"{address}_0")
    assert list(registry_kills.check_place(place.url, checked)) == []
    assert registry_kills.leftovers(tmp_path, [place.url]) == set()
    revision = SceneBundle.open(tmp_path / "one").revision
    pack = tmp_path / "place_0" / "packs" / "room" / f"{revision}.simrecon"
    whole = pack.read_bytes()
    pack.write_bytes(whole[: len(whole) // 2])
    again = registry_kills.SceneRegistry(tmp_path / "again")
    assert "is listed" in " ".join(registry_kills.check_place(place.url, again))
    next((tmp_path / "place_0" / "index" / "room").iterdir()).unlink()
    assert "half a pack" in " ".join(registry_kills.check_place(place.url, again))
    assert registry_kills.leftovers(tmp_path, [place.url]) == {f"{place.url}/packs/room/{pack.name}"}
