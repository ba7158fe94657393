"""`simrecon pack`, `add`, `push`, `pull`, `show --card`: what they print, and their exit codes."""

import json

import pytest

from reconstruction.cli import main
from registry import SceneRegistry


@pytest.fixture
def simrecon(tmp_path, monkeypatch, capsys):
    """Return a function that runs a command line with a machine's registry: code, stdout, stderr."""

    def run(machine: str, *words: object) -> tuple[int, str, str]:
        monkeypatch.setenv("SIMRECON_HOME", str(tmp_path / machine))
        code = main([str(word) for word in words])
        said = capsys.readouterr()
        return code, said.out, said.err

    return run


@pytest.fixture
def rooms(tmp_path):
    """Publish `room` and `hall` on the machine `mine`."""
    registry = SceneRegistry(tmp_path / "mine" / "registry", create=True)
    for scene_id in ("room", "hall"):
        registry.publish(_bundle(tmp_path / f"bundle_{scene_id}", scene_id), scene_id)
    return registry


def _bundle(folder, scene_id, label="floor"):
    from boxes_bundle import write_bundle

    return write_bundle(folder, scene_id, label)


def test_pack_and_add(simrecon, rooms, tmp_path):
    file = tmp_path / "room.simrecon"
    code, out, _ = simrecon("mine", "pack", "room", "-o", file, "--licence", "CC0-1.0")
    assert code == 0
    assert f"revision {rooms.get('room').revision}" in out
    assert "licence: CC0-1.0" in out
    assert "photographs of a real room" in out
    code, out, _ = simrecon("theirs", "add", file)
    assert code == 0
    assert out.startswith("added SimRecon/room: revision")
    assert simrecon("theirs", "add", file)[1].startswith("was there already: SimRecon/room")
    code, out, _ = simrecon("theirs", "add", file, "--as", "room_2", "--json")
    assert json.loads(out)["env_id"] == "SimRecon/room_2"
    code, out, _ = simrecon("theirs", "show", "room", "--card")
    assert out.startswith("---\nlicense: cc0-1.0\n")
    assert "licence: CC0-1.0" in simrecon("theirs", "show", "room")[1]
    assert simrecon("theirs", "verify", "room_2")[0] == 0


def test_wrong_use_is_one_line(simrecon, rooms, tmp_path):
    for words, code, part in (
        (("pack", "roon"), 2, "Did you mean 'room'"),
        (("add", tmp_path / "none"), 2, "there is no such file or folder"),
        (("push", tmp_path / "place"), 2, "name SCENEs before PLACE"),
        (("push", "roon", tmp_path / "place"), 2, "Did you mean 'room'"),
        (("push", "room", "hall", "s4://x/y"), 2, "s4://x/y"),
        (("pull", tmp_path / "place"), 2, "--list` shows what there is"),
        (("pull", tmp_path / "place", "room"), 2, "has no scenes"),
        (("pull", tmp_path / "place", "r*"), 2, "has no scene"),
    ):
        got, _, err = simrecon("mine", *words)
        assert (got, err.count("\n")) == (code, 1), err
        assert part in err
    assert not (tmp_path / "place").exists()


def test_push_list_and_pull(simrecon, rooms, tmp_path):
    place = tmp_path / "place"
    code, out, _ = simrecon("mine", "push", "room", "hall", place, "--catalog")
    assert code == 0
    assert "pushed" in out
    assert "catalog.json: 2 scenes" in out
    assert "room@" in simrecon("mine", "push", "--all", place)[1]
    assert (place / "README.md").is_file()
    code, out, _ = simrecon("theirs", "pull", place, "--list")
    assert [line.split()[0] for line in out.splitlines()] == ["hall", "room"]
    assert "1 objects" in out
    assert [
        row["scene"] for row in json.loads(simrecon("theirs", "pull", place, "r*", "--list", "--json")[1])
    ] == ["room"]
    assert simrecon("theirs", "pull", place, "room")[1].startswith("added SimRecon/room")
    rows = json.loads(simrecon("theirs", "pull", place, "--all", "--json")[1])["scenes"]
    assert {row["scene"]: row["new"] for row in rows} == {"hall": True, "room": False}


def test_one_scene_that_fails_does_not_stop_the_others(simrecon, rooms, tmp_path):
    place = tmp_path / "place"
    simrecon("mine", "push", "room", "hall", place)
    theirs = SceneRegistry(tmp_path / "theirs" / "registry", create=True)
    theirs.publish(_bundle(tmp_path / "own", "hall", "ceiling"), "hall")
    own = theirs.get("hall").revision
    code, out, err = simrecon("theirs", "pull", place, "--all")
    assert code == 2
    assert "added SimRecon/room" in out
    assert "hall@" in err
    assert "--replace" in err
    assert "1 of 2 scenes were not pulled" in err
    assert theirs.get("hall").revision == own
    assert simrecon("theirs", "pull", place, "hall", "--replace")[0] == 0
    assert theirs.get("hall").revision != own
    assert simrecon("theirs", "pull", place, "hall", "room", "--as", "x")[0] == 2
