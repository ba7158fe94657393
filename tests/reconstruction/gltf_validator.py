"""Khronos' glTF validator, where tools/setup_gltf_validator.sh has installed it."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

_HOME = Path(__file__).resolve().parents[2] / "tools" / "gltf"


def gltf_issues(files: list[Path]) -> dict[str, list[dict]]:
    """Return the issues of each file, `severity` 0 error, 1 warning, 2 information; skips where it is missing."""
    if shutil.which("node") is None or not (_HOME / "node_modules" / "gltf-validator").is_dir():
        if os.environ.get("SIMRECON_REQUIRE_GLTF_VALIDATOR"):
            pytest.fail("SIMRECON_REQUIRE_GLTF_VALIDATOR is set; run tools/setup_gltf_validator.sh")
        pytest.skip("no glTF validator; run tools/setup_gltf_validator.sh")
    command = ["node", str(_HOME / "validate.js"), *map(str, files)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)
