"""End to end on a small generated room: render, reconstruct, evaluate, report.

The other one, `ci_table`, is that of `tests/benchmarks/test_runner.py`.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from synthetic.benchmark_capture import write_capture
from synthetic.suites import CI_CAPTURES

ROOT = Path(__file__).resolve().parents[2]


def simrecon(home: Path, *arguments: object) -> subprocess.CompletedProcess:
    """Run the command line in a separate process."""
    line = [sys.executable, "-m", "reconstruction.cli", *map(str, arguments)]
    environment = {**os.environ, "SIMRECON_HOME": str(home)}
    done = subprocess.run(line, capture_output=True, text=True, cwd=ROOT, env=environment, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]
    return done


@pytest.mark.end_to_end
def test_a_generated_room_end_to_end(tmp_path):
    name = "ci_stack"
    write_capture(CI_CAPTURES[name], tmp_path / name)
    truth, home = tmp_path / name / "ground_truth", tmp_path / "home"
    simrecon(
        home, "reconstruct", tmp_path / name / "video.mp4", "--scene", name, "--preset", "fast", "--quiet"
    )
    simrecon(home, "evaluate", name, "--ground-truth", truth, "--json", tmp_path / "figures.json", "--quiet")
    data = json.loads((tmp_path / "figures.json").read_text())
    figures, stages = data["metrics"], data["stages"]
    # Loose bounds that a working pipeline keeps on any machine; the real figures are in docs/benchmarks.md.
    assert figures["ate_cm"] < 1.0
    assert figures["tilt_deg"] < 1.0
    assert figures["cd_cm"] < 4.0
    assert figures["f_5cm"] > 80
    assert figures["object_recall_25"] >= 0.5
    assert figures["stable_rate"] >= 0.8
    assert figures["psnr_db"] > 18
    assert figures["coverage"] > 0.8
    assert stages["depth"]["median_rel"] < 0.02
    assert set(stages) >= {"poses", "depth", "surface", "instances", "assembly", "rendering"}
    simrecon(home, "report", name, "--ground-truth", truth, "--out", tmp_path / "report.html")
    assert (tmp_path / "report.html").stat().st_size > 100_000
