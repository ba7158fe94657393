"""Processes that simulate start with the simulator loaded, and with the variables of the process that asks."""

import gc
import multiprocessing
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor

import pytest

from simrecon_envs.collection import without_collection
from simrecon_envs.processes import in_worker, start_method

pytestmark = pytest.mark.env


def _loaded() -> tuple[bool, bool, int, str | None]:
    loaded = "mani_skill" in sys.modules and "torch" in sys.modules
    return loaded, gc.get_freeze_count() > 100_000, os.getppid(), os.environ.get("SIMRECON_TRIED")


def _ask() -> None:
    """Print what a process of `start_method` starts with, and what this one has loaded."""
    context = multiprocessing.get_context(start_method())
    os.environ["SIMRECON_TRIED"] = "after the server"
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        loaded, frozen, parent, _ = pool.submit(_loaded).result()
        variable = pool.submit(in_worker(_loaded)).result()[3]
    print(loaded, frozen, parent == os.getpid(), "torch" in sys.modules, variable, sep="\n")  # noqa: T201


@pytest.mark.skipif(sys.platform != "linux", reason="fork servers are used on Linux")
def test_a_process_starts_with_the_simulator_and_with_the_variables_of_now():
    # In a process of its own: this one may have a fork server already.
    done = subprocess.run([sys.executable, __file__], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["True", "True", "False", "False", "after the server"]


def test_collection_is_as_before_after_a_pause():
    assert gc.isenabled()
    with without_collection():
        assert not gc.isenabled()
    assert gc.isenabled()
    with pytest.raises(ZeroDivisionError), without_collection():
        1 / 0  # noqa: B018
    assert gc.isenabled()


if __name__ == "__main__":
    _ask()
