"""Rebuilding an index looks at each scene once, in this process or in others with the same result."""

import sys

import pytest

from registry import EnvironmentMissing, SceneRegistry, searching

pytestmark = pytest.mark.stage


@pytest.fixture
def filled(tmp_path, make_bundle):
    """Return a function that publishes so many scenes in a new registry."""

    def fill(scenes: int) -> SceneRegistry:
        found = SceneRegistry(tmp_path / f"registry{scenes}")
        for number in range(scenes):
            found.publish(make_bundle(f"room{number}", str(number)), f"room{number}")
        return found

    return fill


def _calls(act) -> int:
    """Return how many functions, of Python and of C, an act calls."""
    count = 0

    def profile(frame, event, argument):
        nonlocal count
        count += event in ("call", "c_call")

    sys.setprofile(profile)
    try:
        act()
    finally:
        sys.setprofile(None)
    return count


def test_rebuilding_is_linear_in_the_number_of_scenes(filled):
    filled(1).rebuild()  # pays for what is set up once
    few, more, most = (_calls(filled(scenes).rebuild) for scenes in (2, 12, 42))
    assert most - more < 3.1 * (more - few)  # 30 scenes and 10


def test_processes_find_the_same(filled, monkeypatch):
    reg = filled(5)
    (reg.get("room2").path / "scene.json").write_text("{}")
    (reg.get("room4").path / "scene.json").write_text("{}")
    monkeypatch.setattr(searching, "_search_by_process", None)
    expected = reg.rebuild()
    monkeypatch.undo()
    monkeypatch.setattr(searching, "_CHUNK", 2)
    (reg.root / "index.sqlite").unlink()
    records, problems = reg.rebuild()
    assert [(r.scene_id, r.revision) for r in records] == [(r.scene_id, r.revision) for r in expected[0]]
    assert problems == expected[1]
    assert len(problems) == 2


def test_an_error_of_a_process_arrives(filled, monkeypatch):
    reg = filled(3)
    before = reg.revisions()
    monkeypatch.setattr(searching, "_CHUNK", 1)
    lock = reg.lock_path("room1", "publish")
    lock.unlink()
    lock.mkdir()
    with pytest.raises(EnvironmentMissing, match=str(lock)):
        reg.rebuild()
    monkeypatch.setattr(searching, "_CODE", "import os; os._exit(9)")
    with pytest.raises(EnvironmentMissing, match="ended with code 9"):
        reg.rebuild()
    assert reg.revisions() == before


def test_a_registry_without_a_folder_of_scenes_is_empty(filled):
    reg = filled(1)
    (reg.root / "scenes").rename(reg.root / "elsewhere")
    assert reg.rebuild() == ([], [])
