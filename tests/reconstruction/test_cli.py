"""The command line as a user meets it: one clear message, the right exit code, an untouched registry."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from registry import SceneRegistry
from synthetic.videos import BAD_VIDEOS, HARD_VIDEOS

pytestmark = pytest.mark.end_to_end

ROOT = Path(__file__).resolve().parents[2]
NEEDS_POSES = ("pure_rotation",)  # Refused only after matching, so the test of it is slow.


def simrecon(*arguments: object, home: Path, timeout: float = 300) -> subprocess.CompletedProcess:
    """Run the command in a process of its own, with its own home."""
    environment = {**os.environ, "SIMRECON_HOME": str(home)}
    environment.pop("SIMRECON_DEBUG", None)
    command = [sys.executable, "-m", "reconstruction.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment, timeout=timeout)


def assert_refused(done: subprocess.CompletedProcess, exit_code: int, home: Path) -> str:
    """Check the code, the message's form, and that nothing is left in the registry; return the message."""
    assert done.returncode == exit_code, done.stderr
    assert "Traceback" not in done.stderr + done.stdout
    message = done.stderr[done.stderr.rindex("simrecon reconstruct: ") :]
    # Wrong use may show what can be written; everything else is one or a few lines.
    assert len(message.strip().splitlines()) <= (3 if exit_code != 2 else 8), message
    assert SceneRegistry(home / "registry").list() == []
    return message


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.end_to_end) if n in NEEDS_POSES else n for n in BAD_VIDEOS],
)
def test_hopeless_input_is_refused(name, tmp_path):
    video = tmp_path / f"{name}.mp4"
    BAD_VIDEOS[name](video)
    message = assert_refused(simrecon("reconstruct", video, home=tmp_path / "home"), 3, tmp_path / "home")
    assert f"{name}.mp4" in message or name in NEEDS_POSES


def test_missing_video_is_wrong_use(tmp_path):
    message = assert_refused(simrecon("reconstruct", "no.mp4", home=tmp_path), 2, tmp_path)
    assert "no such file" in message


def test_empty_folder_cannot_be_reconstructed(tmp_path):
    (tmp_path / "images").mkdir()
    assert_refused(simrecon("reconstruct", tmp_path / "images", home=tmp_path / "home"), 3, tmp_path / "home")


def test_registry_that_cannot_be_written_is_named_before_any_work(tmp_path, demo_video):
    blocked = tmp_path / "a_file"
    blocked.write_text("")
    done = simrecon("reconstruct", demo_video, "--registry", blocked / "registry", home=tmp_path / "home")
    assert done.returncode == 4, done.stderr
    assert "a_file" in done.stderr
    assert "Traceback" not in done.stderr
    assert "frames" not in done.stderr, "no stage may start"


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (("--set", "depth.nonsense=1"), "depth has no option"),
        (("--set", "nostage.x=1"), "the stages are"),
        (("--set", "frames.max_side_px=wide"), "frames.max_side_px"),
        (("--scale", "by-eye=2"), "camera-height"),
        (("--scene", "Bad Name"), "Bad Name"),
        (("--overrides", "no.yaml"), "no.yaml"),
    ],
)
def test_wrong_use_says_what_is_possible(flags, says, tmp_path, demo_video):
    message = assert_refused(simrecon("reconstruct", demo_video, *flags, home=tmp_path), 2, tmp_path)
    assert says in message


def test_device_cuda_is_refused_where_there_is_none(tmp_path, demo_video):
    torch = pytest.importorskip("torch")
    if torch.cuda.is_available():
        pytest.skip("this machine has CUDA")
    message = assert_refused(
        simrecon("reconstruct", demo_video, "--device", "cuda", home=tmp_path), 4, tmp_path
    )
    assert "CUDA" in message


def test_unknown_scene_names_what_exists(tmp_path):
    for verb in ("show", "verify", "remove"):
        done = simrecon(verb, "scene0007", home=tmp_path)
        assert done.returncode == 2
        assert "scene0007" in done.stderr
        assert "Traceback" not in done.stderr


def test_empty_registry_lists_as_empty(tmp_path):
    assert "no scenes" in simrecon("list", home=tmp_path).stdout
    assert json.loads(simrecon("list", "--json", home=tmp_path).stdout) == []


def test_every_option_is_listed_with_its_meaning(tmp_path):
    done = simrecon("reconstruct", "--list-options", home=tmp_path)
    assert done.returncode == 0, done.stderr
    for line in done.stdout.splitlines():
        if line.startswith("  "):
            name, _, meaning = line.strip().partition("  ")
            assert "=" in name
            assert meaning.strip(), f"{name} has no description"


def test_hard_but_possible_inputs_are_generated_for_the_slow_runs():
    assert {"half_blurred", "half_duplicated", "portrait"} <= set(HARD_VIDEOS)
