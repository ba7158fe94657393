"""Processes that simulate start with the simulator imported."""

import multiprocessing
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor

import pytest

from simrecon_envs.processes import start_method

pytestmark = pytest.mark.env


def _loaded() -> tuple[bool, int]:
    return "mani_skill" in sys.modules and "torch" in sys.modules, os.getppid()


def _ask() -> None:
    """Print whether a process of `start_method` starts with ManiSkill, and whether this one started it."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context(start_method())) as pool:
        loaded, parent = pool.submit(_loaded).result()
    sys.stdout.write(f"{loaded} {parent == os.getpid()} {'torch' in sys.modules}\n")


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no fork server")
def test_a_process_starts_with_the_simulator_imported():
    # In a process of its own: this one may have a fork server already.
    done = subprocess.run([sys.executable, __file__], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "False", "False"]


if __name__ == "__main__":
    _ask()
