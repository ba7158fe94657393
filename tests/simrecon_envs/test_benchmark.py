"""Suites: proofs and their reproduction, left-out candidates, files, errors, runs, comparisons."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_scenes import CUBE
from made_suites import SUITE_CONFIG

from reconstruction.cli import main
from registry import EnvironmentMissing, SceneRegistry, UsageError
from simrecon_envs.benchmark.candidates import Candidate, composites, scene_candidates
from simrecon_envs.benchmark.compare import compare_results
from simrecon_envs.benchmark.feasibility import ProofSettings, prove
from simrecon_envs.benchmark.generate import generate_suite
from simrecon_envs.benchmark.parallel import Workers
from simrecon_envs.benchmark.policies import PolicySpec
from simrecon_envs.benchmark.records import Records
from simrecon_envs.benchmark.results import Results, load_results
from simrecon_envs.benchmark.run import RunSettings, run_suite
from simrecon_envs.benchmark.suite import Suite, load_suite

KINDS = ("reach", "pick")

POLICY = """
import numpy as np

class Policy:
    policy_options = {"control_mode": "pd_joint_delta_pos", "obs_mode": "state_dict"}

    def __init__(self, env, gain="1"):
        self.env, self.gain, self.resets = env, float(gain), 0

    def reset(self):
        self.resets += 1

    def act(self, observation):
        assert self.resets and observation["agent"]["qpos"].shape == (9,)
        return np.full(self.env.action_space.shape, self.gain, np.float32)

class Wrong:
    def __init__(self, env, how):
        self.answer = {"nan": np.full(8, np.nan), "short": np.zeros(7), "words": "left", "none": None}.get(how)
        self.how = how

    def act(self, observation):
        if self.how == "raise":
            raise KeyError("qpos")
        return self.answer

class Smell:
    policy_options = {"obs_mode": "smell"}

class Greedy:
    policy_options = {"task": "none"}

def lazy(env):
    return object()
"""


@pytest.fixture(scope="module")
def results(suite: Suite, scenes_root: Path) -> dict[str, Results]:
    """Return the results of the policies oracle and still, in new environments."""
    settings = RunSettings(registry=str(scenes_root))
    return {
        name: run_suite(suite, suite.select(), PolicySpec(name), settings) for name in ("oracle", "still")
    }


def test_a_suite_says_what_is_to_be_done_and_holds_no_place_of_this_machine(
    suite: Suite, suite_file: Path, scenes_root: Path
) -> None:
    assert {task.kind for task in suite.tasks} == set(KINDS)
    assert len(suite.tasks) <= SUITE_CONFIG.per_scene
    revision = SceneRegistry(scenes_root).get("things").revision
    for task in suite.tasks:
        assert task.env_id == f"SimRecon/things-{task.task}-v0"
        assert (task.scene, task.revision, task.robot) == ("things", revision, "panda")
        assert task.instruction.endswith(".")
        assert len(set(task.seeds)) == 2
        assert all(0 < run.steps < task.max_steps and run.path_m > 0.02 for run in task.oracle)
        assert all(name.startswith("things/") for name in task.objects)
    assert suite.options == {"randomize": {"shift_m": 0.03, "turn_rad": 0.3}}
    text = suite_file.read_text()
    assert str(scenes_root) not in text
    assert "/root" not in text
    reasons = {one.task: one.reason for one in suite.left_out}
    assert "cm wide" in reasons["pick_block"]
    assert any("not tried: the scene has 3 tasks without it" in reason for reason in reasons.values())


def test_the_oracle_does_all_of_it_again_and_doing_nothing_does_none(results: dict[str, Results]) -> None:
    oracle, still = (results[name].summary()["all"] for name in ("oracle", "still"))
    assert oracle["success"]["value"] == 1.0
    assert oracle["path_efficiency"]["value"] == pytest.approx(1.0, abs=1e-3)  # the same episodes
    assert oracle["steps"]["value"] == np.mean([e.oracle_steps for e in results["oracle"].episodes])
    assert still["success"]["value"] == 0.0
    assert still["path_efficiency"]["value"] == 0.0
    assert still["seconds"]["value"] is None
    low, high = oracle["success"]["interval"]
    assert 0.5 < low < high == 1.0


def test_a_comparison_is_paired(results: dict[str, Results], tmp_path: Path) -> None:
    files = {name: tmp_path / f"{name}.json" for name in results}
    for name, result in results.items():
        result.save(files[name])
        assert load_results(files[name]) == result
    count = len(results["oracle"].episodes)
    found = compare_results(load_results(files["still"]), load_results(files["oracle"]))
    assert (found["all"].success, found["all"].only_first, found["all"].only_second) == (1.0, 0, count)
    assert found["all"].p == pytest.approx(2 * 0.5**count)
    assert found["all"].steps is None
    assert found["notes"] == []
    same = compare_results(results["oracle"], results["oracle"])["all"]
    assert (same.success, same.p, same.steps, same.efficiency) == (0.0, 1.0, 0.0, 0.0)
    less = replace(results["still"], episodes=results["still"].episodes[1:], made_with={"sapien": "1"})
    notes = " ".join(compare_results(less, results["oracle"])["notes"])
    assert "0 episodes that only the first ran, 1 that only the second ran" in notes
    assert "sapien 1 and" in notes
    with pytest.raises(UsageError, match="no episode in common"):
        compare_results(replace(less, episodes=()), results["oracle"])


def test_tasks_are_chosen_by_name_kind_and_side(suite: Suite) -> None:
    assert {t.kind for t in suite.select(kinds=["pick"])} == {"pick"}
    assert {t.kind for t in suite.select(tasks="things-reach_*,things-pick_*")} >= {"pick", "reach"}
    sides = [
        suite.select(split=side)
        for side in ("train", "test")
        if any(t.object_side == side for t in suite.tasks)
    ]
    assert sorted(t.name for part in sides for t in part) == sorted(t.name for t in suite.tasks)
    assert {t.scene_side for t in suite.tasks} == {"train"}
    with pytest.raises(UsageError, match=r"none of the suite's \d tasks is in the split 'test' \(by scene\)"):
        suite.select(split="test", split_by="scene")
    with pytest.raises(UsageError, match="things-"):
        suite.select(tasks="nothing*")


def test_what_is_done_by_itself_is_no_task(scenes_root: Path) -> None:
    revision = SceneRegistry(scenes_root).get("things").revision
    there = Candidate(scene="things", revision=revision, robot="panda", task="place_cube_on_table", kind="place",
                      objects=(CUBE,), problems=())  # fmt: skip
    proof = prove(there, ProofSettings(seeds=1, registry=str(scenes_root)))
    assert "done at reset" in proof.reason or "doing nothing" in proof.reason
    gone = prove(replace(there, task="pick_lamp"), ProofSettings(registry=str(scenes_root)))
    assert "has no task 'pick_lamp'" in gone.reason


def test_seeds_that_change_nothing_are_one_episode(scenes_root: Path) -> None:
    config = replace(SUITE_CONFIG, kinds=("reach",), per_scene=1, seeds=4, randomize="none")
    one = generate_suite(["things"], config, registry=scenes_root)
    assert [len(task.oracle) for task in one.tasks] == [1]
    assert one.options == {}


def test_candidates_take_turns_and_composites_are_about_different_things(scenes_root: Path) -> None:
    found = scene_candidates("things", ("panda", "fetch"), ("reach", "push", "navigate"), scenes_root)
    head = [(c.robot, c.kind) for c in found[:5]]
    assert head == [
        ("panda", "reach"), ("panda", "push"), ("fetch", "reach"), ("fetch", "push"), ("fetch", "navigate")
    ]  # fmt: skip
    assert not any(c.kind == "navigate" and c.robot == "panda" for c in found)
    pairs = list(composites([c for c in found if not c.problems], most=3))
    assert len(pairs) == 6
    assert pairs[0].task.startswith("push_")
    assert all(len(set(c.objects)) >= 2 for c in pairs)


def test_suites_that_were_edited_or_are_none_say_so(suite_file: Path, tmp_path: Path) -> None:
    body = json.loads(suite_file.read_text())
    wrong = {
        "is no JSON": "{",
        "expected the schema 'simrecon.suite/2', found 'other'": json.dumps({**body, "schema": "other"}),
        "the tasks were changed after it was written": json.dumps({**body, "options": {}}),
        "the field 'left_out' is missing": json.dumps({key: body[key] for key in body if key != "left_out"}),
        "tasks[0].oracle: expected at least one episode": json.dumps(
            {**body, "tasks": [{**body["tasks"][0], "oracle": []}]}
        ),
        "two tasks of one name": json.dumps({**body, "tasks": body["tasks"][:1] * 2}),
        "no tasks": json.dumps({**body, "tasks": []}),
    }
    for message, text in wrong.items():
        file = tmp_path / "wrong.json"
        file.write_text(text)
        with pytest.raises(UsageError, match=r"suite .*wrong\.json") as caught:
            load_suite(file)
        assert message in str(caught.value)
    with pytest.raises(UsageError, match="there is no such file"):
        load_suite(tmp_path / "absent.json")


def test_scenes_that_are_missing_or_changed_are_listed(
    suite: Suite, scenes_root: Path, tmp_path: Path
) -> None:
    still = PolicySpec("still")
    with pytest.raises(
        UsageError, match=r"1 of the suite's 1 scenes are not in the registry.*things \(revision"
    ):
        run_suite(suite, list(suite.tasks), still, RunSettings(registry=str(tmp_path)))
    older = replace(suite.tasks[0], revision="0" * 16)
    with pytest.raises(UsageError, match=r"things is [0-9a-f]{16}, the suite's is 0000.*--any-revision"):
        run_suite(suite, [older], still, RunSettings(registry=str(scenes_root)))
    settings = RunSettings(registry=str(scenes_root), any_revision=True, episodes=1)
    result = run_suite(suite, [older], still, settings)
    assert "the suite's is 0000000000000000" in result.notes[0]
    assert result.episodes[0].revision == suite.tasks[0].revision
    with pytest.raises(
        UsageError, match=r"2 of 3 scenes are not in the registry.*attic, cellar\. There are: bare"
    ):
        generate_suite(["attic", "things", "cellar"], SUITE_CONFIG, registry=scenes_root)


def test_a_policy_of_anybody_runs_and_wrong_ones_say_why(
    suite: Suite, scenes_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_test_policy.py").write_text(POLICY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    settings = RunSettings(registry=str(scenes_root), episodes=1)
    task = [suite.select(kinds=["reach"])[0]]
    mine = PolicySpec("my_test_policy:Policy", {"gain": "0.3"})
    fresh = replace(settings, episodes=None, fresh=1)
    result = run_suite(suite, task, mine, fresh, records=Records(tmp_path / "out.json"))
    assert [e.proven for e in result.episodes] == [False]
    assert result.episodes[0].seed not in task[0].seeds
    assert result.policy["options"]["control_mode"] == "pd_joint_delta_pos"
    again = run_suite(suite, task, mine, fresh, records=Records(tmp_path / "out.json"))
    assert again == result  # even act_ms: nothing was run again
    (tmp_path / "my_test_policy.py").write_text(POLICY + "\n")
    run_suite(suite, task, mine, fresh, records=Records(tmp_path / "out.json"))
    assert len(list(Records(tmp_path / "out.json").folder.iterdir())) == 2  # the policy's file changed
    for name, message in {
        "nobody": "expected oracle, still, random or module:callable",
        "no_such_module:Policy": "there is no module 'no_such_module'",
        "my_test_policy:Absent": "no callable 'Absent'",
        "my_test_policy:Greedy": "policy_options has task, which the suite decides",
        "my_test_policy:Smell": "obs_mode 'smell': expected state, .*rgb",
        "my_test_policy:lazy": "the returned object has no act",
    }.items():
        with pytest.raises(UsageError, match=message):
            run_suite(suite, task, PolicySpec(name), settings)
    at = "at step 1 of an episode of things, reach_.*, panda"
    for how, message in {
        "raise": rf"act\(\) {at} raised KeyError: 'qpos' \(.*my_test_policy.py:\d+\)",
        "nan": rf"a non-finite action .* {at}; expected 8 finite numbers",
        "short": rf"an action of shape \(7,\) {at}",
        "words": rf"str, not an array of numbers {at}",
        "none": rf"NoneType, not an array of numbers {at}",
    }.items():
        with pytest.raises(UsageError, match=message):
            run_suite(suite, task, PolicySpec("my_test_policy:Wrong", {"how": how}), settings)
    with pytest.raises(UsageError, match=r"making it for things, .* argument 'size'"):
        run_suite(suite, task, PolicySpec("my_test_policy:Policy", {"size": "1"}), settings)


def test_the_command_line_runs_compares_and_explains(
    suite_file: Path, scenes_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    common = [
        "benchmark",
        "run",
        str(suite_file),
        "--kinds",
        "reach",
        "--episodes",
        "1",
        "--registry",
        str(scenes_root),
    ]
    files = [str(tmp_path / f"{name}.json") for name in ("random", "oracle")]
    for name, file in zip(("random", "oracle"), files, strict=True):
        assert main([*common, "--policy", name, "--out", file]) == 0
    said = capsys.readouterr()
    assert "oracle" in said.out
    assert "100.0 % [" in said.out
    assert "s left] things-reach_" in said.err
    assert main(["benchmark", "compare", *files]) == 0
    assert "McNemar p" in capsys.readouterr().out
    assert sorted(p.name for p in tmp_path.iterdir()) == ["oracle.json", "random.json"]
    for wrong, message in {
        ("generate", "--out", "x.json"): "name SCENEs or pass --all",
        (
            "generate",
            "things",
            "--out",
            "x.json",
            "--kinds",
            "juggle",
        ): "'juggle' is not a kind of task. Kinds: reach",
        ("generate", "things", "--out", "x.json", "--randomize", "shift_m"): "expected KEY=VALUE",
        ("generate", "things", "--out", "x.json", "--robots", "pandda"): "panda",
        ("demos", str(suite_file)): "name an output folder",
        ("demos", str(suite_file), "--lerobot", "d", "--demo-obs", "state"): "which needs state_dict",
    }.items():
        assert main(["benchmark", *wrong, "--registry", str(scenes_root)]) == 2
        assert message in capsys.readouterr().err


@pytest.mark.end_to_end
def test_a_process_that_dies_is_one_clear_error() -> None:
    with Workers(2) as workers, pytest.raises(EnvironmentMissing, match="fewer --jobs"):
        list(workers.map(os._exit, [3, 3]))


@pytest.mark.end_to_end
def test_jobs_change_nothing(scenes_root: Path) -> None:
    config = replace(SUITE_CONFIG, kinds=(*KINDS, "sequence"), per_scene=6)
    one, two = (generate_suite(["things"], config, registry=scenes_root, jobs=jobs) for jobs in (1, 2))
    assert one == two
    assert {task.kind for task in one.tasks} == {"reach", "pick", "sequence"}
