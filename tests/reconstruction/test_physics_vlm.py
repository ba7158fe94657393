"""Material and mass by a vision-language model: questions, validation of answers, failures."""

import json
import re

import numpy as np
import pytest
from chat_server import Server, chat
from notes import Notes
from surfaces import floor_sheet, frames_of, merged, solid_box, surface_from

from reconstruction.assets import AssetsConfig, build_assets, outside_inputs
from reconstruction.assets.physics.load import load_physicist
from reconstruction.core.progress import NO_PROGRESS
from reconstruction.instances import InstancesConfig, make_instances
from registry.errors import EnvironmentMissing

pytestmark = pytest.mark.stage

ID = 2  # of the crate: the floor is 1
GOOD = {"id": ID, "material": "wood", "filling": "open", "lightest_kg": 2.0, "heaviest_kg": 8.0}


@pytest.fixture(scope="module")
def crate():
    """A brown box of 40 x 40 x 40 cm on a floor."""
    box = solid_box((-0.2, -0.2, 0.0), (0.2, 0.2, 0.4), (120, 80, 50))
    surface = surface_from(merged(floor_sheet((200, 200, 190)), box))
    posed, depth = frames_of(surface, 160, 120)
    return (
        posed,
        depth,
        surface,
        make_instances(posed, depth, surface, InstancesConfig(), progress=NO_PROGRESS),
    )


@pytest.fixture
def server(monkeypatch):
    with Server() as running:
        monkeypatch.setenv("SIMRECON_VLM_URL", running.url)
        monkeypatch.setenv("SIMRECON_VLM_MODEL", "tiny-vl")
        monkeypatch.setattr("time.sleep", lambda _: None)
        yield running


def built(crate, progress=NO_PROGRESS, **options):
    (item,) = build_assets(*crate, AssetsConfig(**options), progress=progress).objects
    return item


def test_the_answer_is_used_with_its_range(crate, server) -> None:
    server.responses = [chat(json.dumps(GOOD))]
    said, table = built(crate, physics="vlm"), built(crate)
    assert said.physics.material == "wood"
    assert said.physics.mass_kg == pytest.approx(4.0)  # the geometric middle of 2 and 8
    assert said.physics.ranges.mass_kg == (2.0, 8.0)
    assert said.provenance.physics == "tiny-vl: wood, open"
    assert table.provenance.physics.startswith("material table by")
    np.testing.assert_array_equal(said.visual.vertices, table.visual.vertices)
    text, picture = server.requests[0]["messages"][0]["content"]
    said_cm = re.search(r"(\d+) x (\d+) cm on the ground, (\d+) cm high", text["text"]).groups()
    assert [int(side) for side in said_cm] == pytest.approx([40, 40, 40], abs=1)
    assert "wood, ceramic, glass" in text["text"]
    assert picture["type"] == "image_url"


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"id": 9}, "there is no object 9"),
        ({"material": "cheese"}, "no material 'cheese'"),
        ({"lightest_kg": 9.0}, "lightest_kg 9 is more than heaviest_kg 8"),
        ({"lightest_kg": 0.01}, "within a factor of 100"),
        ({"lightest_kg": 900.0, "heaviest_kg": 2000.0}, "liters is not possible"),
        ({"lightest_kg": 0.001, "heaviest_kg": 0.002}, "liters is not possible"),
        ({"lightest_kg": -1.0}, "greater than 0"),
        ({"filling": "liquid"}, "filling"),
    ],
)
def test_an_impossible_answer_is_requested_again(crate, server, wrong, reason) -> None:
    server.responses = [chat(json.dumps(GOOD | wrong)), chat(json.dumps(GOOD))]
    posed, _, _, found = crate
    said = load_physicist(AssetsConfig(physics="vlm")).choose(found, posed, progress=NO_PROGRESS)
    assert said[ID].mass_kg == (2.0, 8.0)
    assert reason in server.requests[1]["messages"][2]["content"]


@pytest.mark.parametrize("response", [chat("no idea"), (401, {}, "no")])
def test_the_table_decides_where_there_is_no_usable_answer(crate, server, response) -> None:
    server.responses = [response]
    watcher = Notes()
    item = built(crate, watcher, physics="vlm")
    assert item.provenance.physics.startswith("material table by")
    assert any(note.startswith("physics: ") and "the table decides" in note for note in watcher.notes)


def test_a_missing_endpoint_is_an_error(monkeypatch) -> None:
    monkeypatch.delenv("SIMRECON_VLM_URL", raising=False)
    assert load_physicist(AssetsConfig()) is None
    with pytest.raises(EnvironmentMissing, match=r"assets\.physics needs .* set SIMRECON_VLM_URL"):
        load_physicist(AssetsConfig(physics="vlm"))


def test_another_model_does_not_reuse_a_result(monkeypatch) -> None:
    assert outside_inputs(AssetsConfig()) == ()
    monkeypatch.setenv("SIMRECON_VLM_MODEL", "one")
    first = outside_inputs(AssetsConfig(physics="vlm"))
    monkeypatch.setenv("SIMRECON_VLM_MODEL", "two")
    assert outside_inputs(AssetsConfig(physics="vlm")) != first
