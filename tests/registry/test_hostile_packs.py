"""Hostile packs are refused before anything is written, in time and memory that are bounded."""

import json
import os
import subprocess
import sys
from pathlib import Path

import hostile_packs
import pytest

from registry import SceneBundle
from registry.exchange import pack_scene

pytestmark = pytest.mark.stage

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def said(tmp_path_factory, make_bundle):
    """Return {case: error, seconds, peak_mb, written} of another process that tried to add every hostile pack."""
    folder = tmp_path_factory.mktemp("hostile")
    temporary = folder / "tmp"
    temporary.mkdir()
    pack = pack_scene(SceneBundle.open(make_bundle("room")), folder / "good.simrecon")
    command = [sys.executable, hostile_packs.__file__, str(pack.path), str(folder)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(temporary)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=200, check=False)
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in folder.iterdir()) == ["good.simrecon", "tmp"]
    assert list(temporary.iterdir()) == []
    return json.loads(done.stdout)


@pytest.mark.parametrize("case", hostile_packs.CASES)
def test_refused_in_one_line_with_nothing_written(said, case):
    found = said[case]
    assert found["error"].startswith(("BundleError: ", "UsageError: ")), found["error"]
    assert hostile_packs.CASES[case][1] in found["error"]
    assert len(found["error"]) < 1000
    assert found["error"].isprintable()
    assert not found["written"]
    assert found["seconds"] < 2
    assert found["peak_mb"] < 500
