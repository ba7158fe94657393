"""Policies that end the process, hang, or run code when they are loaded: one clear error, never a success."""

import threading
import time
from pathlib import Path

import pytest

from reconstruction.cli import main
from registry import UsageError
from simrecon_envs.benchmark.policies import PolicySpec, PolicyTimeout, time_limit
from simrecon_envs.benchmark.run import RunSettings, run_suite
from simrecon_envs.benchmark.suite import Suite

POLICY = """
import sys, time
import numpy as np

class Ends:
    def __init__(self, env, at):
        self.at, self.shape = at, env.action_space.shape
        self.now("make")
    def now(self, place):
        if place == self.at:
            sys.exit(0)
        if "hang_" + place == self.at:
            while True:
                try:
                    time.sleep(0.01)
                except Exception:
                    pass
    def reset(self):
        self.now("reset")
    def act(self, observation):
        self.now("act")
        return np.zeros(self.shape, np.float32)

def quits(task, **arguments):
    sys.exit(0)

class EndsInOptions(Ends):
    policy_options = staticmethod(quits)

class NoDict(Ends):
    policy_options = ["obs_mode"]
"""


@pytest.fixture
def policies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "ending_policy.py").write_text(POLICY)
    (tmp_path / "ends_on_import.py").write_text("import sys\nsys.exit(0)\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)


CASES = {
    (
        "ending_policy:Ends",
        "make",
    ): r"making it for things, .* raised SystemExit: 0 \(.*ending_policy.py:\d+\)",
    ("ending_policy:Ends", "reset"): r"reset\(\) in things, .* raised SystemExit",
    ("ending_policy:Ends", "act"): r"act\(\) at step 1 of an episode of things, .* raised SystemExit",
    ("ending_policy:Ends", "hang_make"): r"making it for .* longer than 0.5 s; allow more with --timeout",
    ("ending_policy:Ends", "hang_reset"): r"reset\(\) in .* longer than 0.5 s",
    ("ending_policy:Ends", "hang_act"): r"act\(\) at step 1 .* longer than 0.5 s",
    ("ending_policy:EndsInOptions", ""): "its policy_options for things-.* raised SystemExit",
    ("ending_policy:NoDict", ""): "its policy_options is no dict, but list",
    ("ends_on_import:Policy", ""): "importing ends_on_import raised SystemExit: 0",
}


@pytest.mark.parametrize(("name", "at"), CASES)
@pytest.mark.usefixtures("policies")
def test_a_policy_that_ends_or_hangs_is_an_error(name: str, at: str, suite: Suite, scenes_root: Path) -> None:
    settings = RunSettings(registry=str(scenes_root), episodes=1, timeout_s=0.5)
    with pytest.raises(UsageError, match=CASES[name, at]):
        run_suite(suite, suite.select(kinds=["reach"])[:1], PolicySpec(name, {"at": at}), settings)


@pytest.mark.usefixtures("policies")
def test_the_command_fails_where_a_policy_exits_with_success(
    suite_file: Path, scenes_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    line = ["benchmark", "run", str(suite_file), "--kinds", "reach", "--registry", str(scenes_root)]
    line += [
        "--policy",
        "ending_policy:Ends",
        "--policy-option",
        "at=act",
        "--out",
        str(tmp_path / "results.json"),
    ]
    assert main(line) == 2
    assert "raised SystemExit" in capsys.readouterr().err
    assert not (tmp_path / "results.json").exists()


def test_the_command_warns_before_a_pickle_is_loaded(
    suite_file: Path, scenes_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    line = ["benchmark", "run", str(suite_file), "--registry", str(scenes_root)]
    line += ["--policy", "simrecon_envs.training:trained", "--policy-option", f"run={tmp_path}"]
    assert main(line) == 2  # there is no run in that folder
    said = capsys.readouterr().err
    assert f"warning: {tmp_path} is loaded with pickle, which can run any code" in said
    assert PolicySpec("still").warnings() == []


def test_a_limit_leaves_no_alarm_behind_and_is_skipped_in_threads() -> None:
    with time_limit(0.2):
        pass
    time.sleep(0.3)
    with pytest.raises(PolicyTimeout), time_limit(0.05):
        time.sleep(5)
    done = []

    def elsewhere() -> None:
        with time_limit(0.05):
            time.sleep(0.2)
        done.append(True)

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert done == [True]
