"""Suites and results of other people: names stay file names, every field is covered by the digest and checked."""

import copy
import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from registry import UsageError
from simrecon_envs.benchmark.results import EpisodeResult, Results, load_results
from simrecon_envs.benchmark.suite import LeftOut, OracleRun, Suite, SuiteTask, load_suite

pytestmark = pytest.mark.unit

TASK = SuiteTask(
    name="room-pick_mug-panda", env_id="SimRecon/room-pick_mug-v0", scene="room", revision="0123456789abcdef",
    task="pick_mug", kind="pick", robot="panda", instruction="Pick the mug.", max_steps=100, objects=("room/7",),
    scene_side="train", object_side="test", oracle=(OracleRun(seed=3, steps=40, path_m=0.5),),
)  # fmt: skip
SUITE = Suite(
    tasks=(TASK,),
    left_out=(LeftOut(scene="room", robot="panda", task="pick_tv", kind="pick", reason="80 cm wide"),),
    options={"randomize": {"shift_m": 0.03}},
    settings={"seed": 0},
    made_with={"sapien": "3"},
)
EPISODE = EpisodeResult(
    task="room-pick_mug-panda", revision="0123456789abcdef", kind="pick", scene="room", robot="panda",
    scene_side="train", object_side="test", seed=3, proven=True, success=True, steps=40, path_m=0.5, oracle_path_m=0.5,
    oracle_steps=40.0, reward=-1.5, act_ms=0.1,
)  # fmt: skip


def written(tmp_path: Path, body: dict) -> Path:
    path = tmp_path / "suite.json"
    path.write_text(json.dumps(body))
    return path


def stored(tmp_path: Path) -> dict:
    SUITE.save(tmp_path / "suite.json")
    return json.loads((tmp_path / "suite.json").read_text())


def changed(body: dict, place: str, value: object) -> dict:
    """Return a copy with the value at "tasks.0.name" replaced; a `None` value removes it."""
    out = copy.deepcopy(body)
    *path, last = [int(part) if part.isdigit() else part for part in place.split(".")]
    at = out
    for part in path:
        at = at[part]
    at[last] = value
    return out


def test_a_suite_is_what_was_written(tmp_path: Path) -> None:
    stored(tmp_path)
    assert load_suite(tmp_path / "suite.json") == SUITE


NAMES = (
    "../../evil",
    "/etc/cron.d/x",
    "a/b",
    "a\\b",
    "..",
    ".hidden",
    "",
    "a\0b",
    "a\nb",
    "a b",
    "x" * 500,
    "ü",
    "a..b",
)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("field", ["name", "scene", "robot", "task", "revision"])
def test_a_name_that_is_no_file_name_is_refused(field: str, name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"{field}: .* is not of the form"):
        replace(TASK, **{field: name})
    path = written(tmp_path, changed(stored(tmp_path), f"tasks.0.{field}", name))
    with pytest.raises(UsageError, match=rf"suite .*suite\.json: tasks\[0\]\.{field}") as caught:
        load_suite(path)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    "env_id", ["os:x", "evil_module:Env-v0", "SimRecon/a:b", "CartPole-v1", "SimRecon/../x"]
)
def test_an_environment_of_another_module_is_refused(env_id: str, tmp_path: Path) -> None:
    path = written(tmp_path, changed(stored(tmp_path), "tasks.0.env_id", env_id))
    with pytest.raises(UsageError, match=r"tasks\[0\]\.env_id: .* is not of the form"):
        load_suite(path)


OTHER = {
    "tasks.0.instruction": "Pick the can.",
    "tasks.0.scene_side": "test",
    "tasks.0.object_side": "train",
    "tasks.0.objects.0": "room/8",
    "tasks.0.kind": "push",
    "tasks.0.task": "push_mug",
    "tasks.0.name": "other",
    "tasks.0.max_steps": 101,
    "tasks.0.oracle.0.path_m": 0.6,
    "tasks.0.oracle.0.steps": 41,
    "tasks.0.oracle.0.seed": 4,
    "left_out.0.reason": "unknown",
    "options.randomize": "none",
    "settings.seed": 1,
    "made_with.sapien": "4",
}


@pytest.mark.parametrize("place", OTHER)
def test_the_digest_covers_every_field(place: str, tmp_path: Path) -> None:
    path = written(tmp_path, changed(stored(tmp_path), place, OTHER[place]))
    with pytest.raises(UsageError, match="the tasks were changed after it was written"):
        load_suite(path)


def test_every_field_of_a_task_is_in_the_test_above() -> None:
    fields = {place.split(".")[2] for place in OTHER if place.startswith("tasks.0.")}
    assert fields | {"env_id", "scene", "revision", "robot"} == set(asdict(TASK))


WRONG: dict[str, tuple[str, object, str]] = {
    "words for steps": (
        "tasks.0.max_steps",
        "x",
        r"tasks\[0\]\.max_steps: expected a whole number, found 'x'",
    ),
    "no steps": ("tasks.0.max_steps", 0, r"tasks\[0\]\.max_steps: expected 1 to"),
    "half a step": ("tasks.0.max_steps", 1.5, "expected a whole number, found 1.5"),
    "true for steps": ("tasks.0.max_steps", True, "expected a whole number, found True"),
    "many steps": ("tasks.0.max_steps", 10**30, "expected a whole number"),
    "words for a path": (
        "tasks.0.oracle.0.path_m",
        "x",
        r"tasks\[0\]\.oracle\[0\]\.path_m: expected a number",
    ),
    "no path": ("tasks.0.oracle.0.path_m", 0, "a path longer than 0"),
    "a path below zero": ("tasks.0.oracle.0.path_m", -1, r"path_m: expected a number, at least 0, found -1"),
    "nothing for a path": ("tasks.0.oracle.0.path_m", None, "path_m: expected a number, found None"),
    "a seed below zero": ("tasks.0.oracle.0.seed", -1, "seed: expected a whole number, at least 0"),
    "a large seed": ("tasks.0.oracle.0.seed", 2**40, "a seed below"),
    "a list for a name": ("tasks.0.name", ["a"], r"tasks\[0\]\.name: expected text"),
    "a side that is none": ("tasks.0.scene_side", "left", "scene_side: expected train or test"),
    "text for objects": ("tasks.0.objects", "room/7", r"objects: expected a list"),
    "numbers for objects": ("tasks.0.objects", [7], r"objects\[0\]: expected text"),
    "escapes": ("tasks.0.instruction", "\x1b[31mred", "instruction: expected printable text"),
    "text for a task": ("tasks.0", "pick", r"tasks\[0\]: expected an object"),
    "text for tasks": ("tasks", "pick", "tasks: expected a list"),
    "an unknown field": ("tasks.0.extra", 1, r"tasks\[0\]: unknown field 'extra'"),
    "an unknown part": ("extra", 1, "unknown field 'extra'"),
    "an option of the runner": ("options.registry", "/tmp", "options: 'registry' is none of"),
    "options that are none": ("options", [], "options: expected an object"),
    "words for the seed": ("settings.seed", "x", r"settings\.seed: expected a whole number"),
    "numbers for versions": ("made_with.sapien", 3, r"made_with\.sapien: expected text"),
    "reasons that are none": ("left_out.0.reason", 3, r"left_out\[0\]\.reason: expected text"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_field_of_a_wrong_type_is_named_in_one_line(name: str, tmp_path: Path) -> None:
    place, value, says = WRONG[name]
    path = written(tmp_path, changed(stored(tmp_path), place, value))
    with pytest.raises(UsageError, match=says) as caught:
        load_suite(path)
    assert str(caught.value).startswith(f"suite {path}: ")
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b'{"schema": NaN}', "NaN is no number"),
        (b'{"a": 1, "a": 2}', "the key 'a' comes twice"),
        (b"[" * 100_000, "no JSON"),
        (b"\xff\xfe\x00", "no JSON"),
        (b"[]", "found 'list'"),
        (b'{"schema": "simrecon.suite/1"}', "make it again"),
    ],
)
def test_a_file_that_is_no_suite_says_so(text: bytes, says: str, tmp_path: Path) -> None:
    path = tmp_path / "suite.json"
    path.write_bytes(text)
    with pytest.raises(UsageError, match=says):
        load_suite(path)


@pytest.mark.parametrize(
    ("place", "value", "says"),
    [
        ("episodes.0.steps", "x", r"episodes\[0\]\.steps: expected a whole number"),
        ("episodes.0.success", 1, r"success: expected true or false"),
        ("episodes.0.oracle_path_m", None, "oracle_path_m: expected a number"),
        ("episodes.0.reward", "x", "reward: expected a number"),
        ("episodes", {}, "episodes: expected a list"),
        ("policy", [], "policy: expected an object"),
        ("policy", {}, "the field 'name' is missing"),
        ("notes", [3], r"notes\.0: expected text"),
        ("suite", "x", "suite: expected an object"),
    ],
)
def test_results_are_checked_alike(place: str, value: object, says: str, tmp_path: Path) -> None:
    results = Results(
        suite={"name": "s", "digest": "d"},
        policy={"name": "still"},
        selection={},
        episodes=(EPISODE,),
        notes=("n",),
    )
    results.save(tmp_path / "r.json")
    assert load_results(tmp_path / "r.json") == results
    body = json.loads((tmp_path / "r.json").read_text())
    with pytest.raises(UsageError, match=says):
        load_results(written(tmp_path, changed(body, place, value)))
