"""The runner keeps what is done, does again what it must, and turns failures into rows. Real commands, no stand-ins."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from benchmarks.results import load_result, load_results
from benchmarks.run import main, run_command
from reconstruction.pipeline import DEFAULT_STAGE_NAMES
from synthetic.benchmark_capture import write_capture
from synthetic.suites import CI_CAPTURES
from synthetic.videos import write_not_a_video

pytestmark = pytest.mark.stage

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def broken(tmp_path_factory) -> tuple[Path, list[str], Path]:
    """Run a capture that is no video; return the folder of results, the arguments, and the page."""
    root = tmp_path_factory.mktemp("broken")
    (root / "captures" / "shopping").mkdir(parents=True)
    write_not_a_video(root / "captures" / "shopping" / "video.mp4")
    out, page = root / "out", root / "page.md"
    arguments = [
        "--captures",
        str(root / "captures"),
        "--variants",
        "fast",
        "--out",
        str(out),
        "--page",
        str(page),
    ]
    assert main(arguments) == 1
    return out, arguments, page


def test_a_capture_that_fails_is_a_row_that_says_why(broken):
    out, _, page = broken
    result = load_result(out / "shopping" / "fast.json")
    assert (result.status, result.exit_code) == ("reconstruct failed", 3)
    assert "video.mp4" in result.error
    assert str(out) not in result.error  # the page is published; whose machine it was is nobody's business
    assert result.machine["cores"] >= 1
    assert result.commit
    text = page.read_text()
    assert "shopping" in text
    assert "reconstruct failed, exit code 3" in text
    assert "| failed |" in text


def test_what_is_done_is_kept_also_a_failure(broken, capsys):
    out, arguments, _ = broken
    before = (out / "shopping" / "fast.json").stat().st_mtime_ns
    assert main(arguments) == 1
    assert "kept" in capsys.readouterr().out
    assert (out / "shopping" / "fast.json").stat().st_mtime_ns == before


@pytest.mark.parametrize("how", ["force", "retry", "other code", "other input", "other arguments"])
def test_what_must_be_done_again_is(broken, how, capsys):
    _, arguments, _ = broken
    arguments = [*arguments, "--dry-run"]
    path = broken[0] / "shopping" / "fast.json"
    kept = path.read_text()
    data = json.loads(kept)
    if how == "force":
        arguments.append("--force")
    elif how == "retry":
        arguments.append("--retry-failed")
    else:
        key, value = {
            "other code": ("sources", "0"),
            "other input": ("inputs", "0"),
            "other arguments": ("arguments", ["--preset", "quality"]),
        }[how]
        path.write_text(json.dumps(data | {key: value}))
    try:
        assert main(arguments) == 0
        assert "fast: to do" in capsys.readouterr().out
        if how == "other code":
            assert main([*arguments, "--keep-stale"]) == 1  # kept, and still a failure
            assert "kept" in capsys.readouterr().out
    finally:
        path.write_text(kept)


def test_a_damaged_result_is_named(broken, capsys):
    out, arguments, _ = broken
    path = out / "shopping" / "fast.json"
    kept = path.read_text()
    path.write_text(kept[:100])
    try:
        assert main(arguments) == 2
        assert str(path) in capsys.readouterr().err
    finally:
        path.write_text(kept)


def test_a_command_that_takes_too_long_is_stopped_with_its_children(tmp_path):
    code = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'import time; time.sleep(60)'])"
    before = set(psutil.Process().children(recursive=True))
    began = time.perf_counter()
    # As the command does: what a shell started in the background has Ctrl-C ignored, and so have its children.
    before_it = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        exit_code, error = run_command(
            [sys.executable, "-c", code], tmp_path, tmp_path / "log", timeout_s=1.0
        )
    finally:
        signal.signal(signal.SIGINT, before_it or signal.SIG_DFL)
    assert exit_code == 124
    assert "--timeout-s" in error
    assert time.perf_counter() - began < 20
    started = set(psutil.Process().children(recursive=True)) - before
    assert not [process for process in started if process.status() != psutil.STATUS_ZOMBIE]


def test_the_last_lines_of_a_failed_command_are_kept(tmp_path):
    code = "import sys; print('begin', file=sys.stderr); sys.exit('the disk is full')"
    assert run_command([sys.executable, "-c", code], tmp_path, tmp_path / "log", 60.0) == (
        1,
        "begin\nthe disk is full",
    )
    assert run_command([sys.executable, "-c", "print(1)"], tmp_path, tmp_path / "log", 60.0) == (0, "")


@pytest.mark.end_to_end
@pytest.mark.timeout(1800)
def test_interrupted_and_resumed_a_small_capture_gets_its_figures(tmp_path):
    write_capture(CI_CAPTURES["ci_stack"], tmp_path / "captures" / "room")
    out, page = tmp_path / "out", tmp_path / "page.md"
    line = [
        sys.executable,
        "-m",
        "benchmarks.run",
        "--captures",
        str(tmp_path / "captures"),
        "--variants",
        "fast",
    ]
    line += ["--out", str(out), "--page", str(page)]
    process = subprocess.Popen(line, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    deadline = time.monotonic() + 300
    log = out / "room" / "fast.log"
    while not (log.is_file() and f"[2/{len(DEFAULT_STAGE_NAMES)}]" in log.read_text()):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.1)
    children = psutil.Process(process.pid).children(recursive=True)
    assert children
    os.kill(process.pid, signal.SIGINT)
    said, _ = process.communicate(timeout=300)
    assert process.returncode == 130
    assert "interrupted" in said
    assert not any(child.is_running() for child in children)
    assert load_results(out) == []

    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "frames: already done" in log.read_text()
    result = load_results(out)[0]
    assert result.status == "done"
    # Loose bounds that a working pipeline keeps on any machine; the real figures are in docs/benchmarks.md.
    at_most = {
        "ate_cm": 1.0,
        "tilt_deg": 1.0,
        "cd_cm": 4.0,
        "stages.depth.median_rel": 0.02,
        "registered_share": 1,
    }
    at_least = {"f_5cm": 80, "object_recall_25": 0.5, "stable_rate": 0.8, "psnr_db": 18, "coverage": 0.8}
    assert {name: value for name, bound in at_most.items() if (value := result.metrics[name]) > bound} == {}
    assert {name: value for name, bound in at_least.items() if (value := result.metrics[name]) < bound} == {}
    assert result.metrics["registered_share"] > 0
    assert result.metrics["time_s"] == pytest.approx(sum(result.report["timings_s"].values()))
    assert result.metrics["peak_memory_mb"] > 100
    assert "### room" in page.read_text()

    # A run whose stages all come from the cache tells what they cost when they were computed. Without the truth
    # (another input, so it is done again) the evaluation is quick.
    (tmp_path / "captures" / "room" / "ground_truth").rename(tmp_path / "ground_truth")
    again = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert again.returncode == 0, again.stdout + again.stderr
    repeated = load_results(out)[0]
    assert "assembly: already done" in log.read_text()
    assert repeated.wall_s["reconstruct"] < 0.5 * repeated.metrics["time_s"]
    for stage in DEFAULT_STAGE_NAMES:
        assert repeated.report["timings_s"][stage] == result.report["timings_s"][stage]
    for key in ("psnr_db", "ssim", "coverage", "stable_rate", "registered_share", "objects"):
        assert repeated.metrics[key] == result.metrics[key], key
    assert repeated.reason("cd_cm") == "no ground truth was given"
