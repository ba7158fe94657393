"""A run that compiles its kernels and one that finds them compiled give the same bits."""

import importlib
import os
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core.dispatcher import Dispatcher

import reconstruction

pytestmark = pytest.mark.stage

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = """
import hashlib
import numpy as np
from reconstruction.depth import DepthConfig, estimate_depth
from reconstruction.gaussians import GaussiansConfig, make_gaussians
from synthetic.capture import make_test_capture

capture = make_test_capture(8, 160, 120)
depth = estimate_depth(capture.posed, DepthConfig(depth_side_px=160, sweep_side_px=120, planes=32))
config = GaussiansConfig(iterations=12, side_px=120, coarse_side_px=80, max_gaussians=3000)
made = make_gaussians(capture.posed, capture.depth, config)
for array in (depth.depth, made.gaussians.means, made.depth.depth):
    print(hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest())
"""


def kernels() -> list[Dispatcher]:
    """Return every compiled function of the package's modules."""
    found = {}
    for module in pkgutil.walk_packages(reconstruction.__path__, "reconstruction."):
        if "report" in module.name:
            continue
        for value in vars(importlib.import_module(module.name)).values():
            if isinstance(value, Dispatcher):
                found[id(value)] = value
    return list(found.values())


def test_kernels_that_may_reorder_sums_are_inlined_into_their_callers():
    """Else the linker chooses between a copy optimized alone and one optimized inside its caller."""
    loose = [k for k in kernels() if k.targetoptions.get("fastmath")]
    assert len(loose) >= 9
    for kernel in loose:
        inlined = kernel.targetoptions.get("forceinline") or kernel.targetoptions.get("inline") == "always"
        assert inlined, f"{kernel.py_func.__module__}.{kernel.py_func.__qualname__} needs forceinline=True"


@pytest.mark.end_to_end
def test_the_first_run_and_the_second_give_the_same_bits(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kernels"), "PYTHONPATH": str(ROOT)}
    runs = [
        subprocess.run(
            [sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=True
        ).stdout
        for _ in range(2)
    ]
    assert runs[0] == runs[1]
