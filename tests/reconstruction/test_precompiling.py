import json
import os
import subprocess
import sys
from importlib import import_module

import pytest
from numba.core import types
from numba.core.dispatcher import Dispatcher

from reconstruction.core import precompiling
from reconstruction.core.precompiling import Kernel, described, listed_kernels, numba_type

MULTICUT = "reconstruction.instances.partition.multicut"


@pytest.mark.parametrize(
    "kind",
    [
        types.float32,
        types.boolean,
        types.none,
        types.Omitted(3),
        types.Array(types.uint8, 3, "C"),
        types.Array(types.float64, 1, "A", readonly=True),
        types.UniTuple(types.int64, 2),
        types.Tuple([types.int64, types.Array(types.boolean, 2, "F")]),
    ],
)
def test_argument_types_survive_json(kind):
    assert numba_type(json.loads(json.dumps(described(kind)))) == kind


def test_a_type_without_a_form_is_refused():
    with pytest.raises(TypeError, match="no form"):
        described(types.unicode_type)


@pytest.mark.parametrize("module", sorted({kernel.module for kernel in listed_kernels()}))
def test_listed_kernels_exist(module):
    for kernel in listed_kernels():
        if kernel.module == module:
            dispatcher = getattr(import_module(module), kernel.name)
            assert isinstance(dispatcher, Dispatcher)
            assert len(kernel.types) <= dispatcher.py_func.__code__.co_argcount
            assert all(isinstance(numba_type(one), types.Type) for one in kernel.types)


def _few_kernels() -> list[Kernel]:
    """Return the kernels of one small module."""
    return [kernel for kernel in listed_kernels() if kernel.module == MULTICUT]


@pytest.mark.stage
def test_compiled_once_and_then_found(tmp_path, monkeypatch):
    """In processes of their own; the stamp holds until the code changes."""
    listed = tmp_path / "kernels.json"
    listed.write_text(json.dumps([[k.module, k.name, k.types] for k in _few_kernels()]))
    line = (
        "from pathlib import Path\n"
        "from reconstruction.core import precompiling\n"
        f"precompiling.LISTED = Path({str(listed)!r})\n"
        "seconds = []\n"
        "before = precompiling.are_compiled()\n"
        "if __name__ == '__main__':\n"
        "    count, failed = precompiling.compile_all(1, lambda kernel, s: seconds.append(s))\n"
        "    print(before, precompiling.are_compiled(), count, sum(seconds), *failed)\n"
    )
    program = tmp_path / "program.py"
    program.write_text(line)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    first, second = (
        subprocess.run(
            [sys.executable, str(program)],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
            timeout=300,
        ).stdout.split()
        for _ in range(2)
    )
    assert first[:3] == ["False", "True", str(len(_few_kernels()))]
    assert second[:3] == ["True", "True", str(len(_few_kernels()))]
    assert float(second[3]) < 0.5 * float(first[3])
    assert len(second) == 4
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(precompiling, "LISTED", listed)
    assert precompiling.are_compiled()
    listed.write_text("[]")
    assert not precompiling.are_compiled()


@pytest.mark.stage
def test_a_kernel_that_fails_is_named_and_the_others_are_compiled(tmp_path, monkeypatch):
    wrong = [MULTICUT, _few_kernels()[0].name, ["none"]]
    good = [[k.module, k.name, k.types] for k in _few_kernels()]
    listed = tmp_path / "kernels.json"
    listed.write_text(json.dumps([wrong, *good]))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(precompiling, "LISTED", listed)
    count, failed = precompiling.compile_all(1)
    assert count == len(good) + 1
    (line,) = failed
    assert line.startswith(f"{MULTICUT}.{wrong[1]}: ")
    assert not precompiling.are_compiled()
