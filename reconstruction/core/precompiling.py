"""Compile the Numba kernels of all stages before their first use, in several processes.

`kernels.json` lists each kernel with the types of its arguments, in the order of first use. `python tools/kernels.py`
writes it after a run of the pipeline. Numba keeps what is compiled beside the code or in `NUMBA_CACHE_DIR`, so that a
machine compiles a kernel once.
"""

import contextlib
import hashlib
import importlib
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from registry.locks import LockHeld, file_lock

LISTED = Path(__file__).with_name("kernels.json")
_PACKAGES = ("reconstruction.", "simrecon_envs.")
_NICENESS = 10  # of the process that compiles while a reconstruction has begun
Types = tuple[Any, ...]  # JSON: "float32", ["array", "float32", 2, "C", is it read-only], ["tuple", ...]


@dataclass(frozen=True)
class Kernel:
    """A compiled function and one tuple of argument types."""

    module: str
    name: str
    types: Types

    def __str__(self) -> str:
        """Return the name as a person reads it."""
        return f"{self.module}.{self.name}"


def listed_kernels() -> list[Kernel]:
    """Read the kernels of a JSON list of [module, name, types]."""
    rows = json.loads(LISTED.read_text())
    return [Kernel(module, name, tuple(types)) for module, name, types in rows]


def compiled_kernels() -> list[Kernel]:
    """Return the kernels that this process has compiled or loaded so far, in the order of their modules' import.

    Kernels for literal arguments are left out: other kernels call them and are compiled together with them.
    """
    from numba.core import types
    from numba.core.dispatcher import Dispatcher

    out = []
    for name, module in list(sys.modules.items()):
        if not name.startswith(_PACKAGES):
            continue
        for own, value in vars(module).items():
            if isinstance(value, Dispatcher) and value.py_func.__module__ == name:
                out += [
                    Kernel(name, own, tuple(map(described, given)))
                    for given in value.signatures
                    if not any(isinstance(one, types.Literal) for one in given)
                ]
    return out


def described(numba_type: Any) -> Any:
    """Return a Numba type as JSON.

    Raises:
        TypeError: The list has no form for this type.
    """
    from numba.core import types

    if isinstance(numba_type, types.Array):
        return [
            "array", described(numba_type.dtype), numba_type.ndim, numba_type.layout, not numba_type.mutable
        ]  # fmt: skip
    if isinstance(numba_type, types.BaseTuple):
        return ["tuple", *map(described, numba_type)]  # pyright: ignore[reportArgumentType]
    if isinstance(numba_type, types.Omitted):
        return ["omitted", numba_type.value]
    if isinstance(numba_type, types.Boolean):
        return "boolean"
    if isinstance(numba_type, types.Number | types.NoneType):
        return str(numba_type)
    raise TypeError(f"an argument of type {numba_type!r}: the list of kernels has no form for it")


def numba_type(text: Any) -> Any:
    """Return the Numba type that `described` gave."""
    from numba.core import types

    if isinstance(text, str):
        return getattr(types, text)
    kind, *rest = text
    if kind == "array":
        dtype, dimensions, layout, readonly = rest
        return types.Array(numba_type(dtype), dimensions, layout, readonly=readonly)
    if kind == "omitted":
        return types.Omitted(rest[0])
    return types.Tuple([numba_type(item) for item in rest])


def compile_kernel(kernel: Kernel) -> float:
    """Compile one kernel, or load it if it is there; return the seconds."""
    start = time.perf_counter()
    dispatcher = getattr(importlib.import_module(kernel.module), kernel.name)
    dispatcher.compile(tuple(map(numba_type, kernel.types)))
    return time.perf_counter() - start


def compile_all(
    processes: int, told: Callable[[Kernel, float], object] = lambda kernel, seconds: None
) -> tuple[int, list[str]]:
    """Compile all listed kernels in processes of their own; return how many there are, and a line for each that failed.

    A kernel that fails here is compiled on its first use, which then says why it cannot.

    Args:
        processes: at work at once.
        told: receives each kernel that is ready and the seconds that it took.
    """
    kernels, failed = listed_kernels(), []
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        jobs = {pool.submit(compile_kernel, kernel): kernel for kernel in kernels}
        for job in as_completed(jobs):
            if (error := job.exception()) is None:
                told(jobs[job], job.result())
            else:
                failed.append(f"{jobs[job]}: {type(error).__name__}: {error}")
    if not failed:
        note_compiled()
    return len(kernels), failed


def are_compiled() -> bool:
    """Return whether `compile_all` or a process behind a run has finished here with the code as it is now."""
    try:
        return _stamp().read_text() == _state()
    except OSError:
        return False


def _stamp() -> Path:
    """Return the file that says which code's kernels are compiled; where Numba itself keeps them, if that can be."""
    named, beside = os.environ.get("NUMBA_CACHE_DIR"), LISTED.parent / "__pycache__"
    for folder in [Path(named)] if named else [beside, Path.home() / ".cache" / "numba"]:
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            if os.access(folder, os.W_OK):
                return folder / "simrecon_kernels"
    return beside / "simrecon_kernels"


def _state() -> str:
    """Return a digest of the sources with kernels and of what else Numba compiles them for."""
    digest = hashlib.sha256()
    for text in (sys.version, version("numba"), version("llvmlite"), platform.node(), platform.machine()):
        digest.update(text.encode())
    digest.update(LISTED.read_bytes())
    for module in sorted({kernel.module for kernel in listed_kernels()}):
        digest.update(Path(__file__).parents[2].joinpath(*module.split(".")).with_suffix(".py").read_bytes())
    return digest.hexdigest()


def note_compiled() -> None:
    """Keep that all kernels are compiled; where nothing can be written, nothing is kept."""
    with contextlib.suppress(OSError):
        _stamp().write_text(_state())


@contextmanager
def compiling_behind() -> Iterator[subprocess.Popen[bytes] | None]:
    """Compile in a process of low priority within a block, unless all is compiled; it ends with the block.

    Of several reconstructions on one machine only one starts such a process.
    """
    process = None
    if (os.cpu_count() or 1) > 1 and not are_compiled():
        quiet = subprocess.DEVNULL
        line = [sys.executable, "-m", "reconstruction.core.precompiling"]
        process = subprocess.Popen(line, stdin=quiet, stdout=quiet, stderr=quiet)
    try:
        yield process
    finally:
        if process is not None:
            process.terminate()
            process.wait()


def _compile_alone() -> int:
    """Compile all kernels in this process, at low priority; return 0 at once where another process does so."""
    os.nice(_NICENESS)
    with contextlib.suppress(LockHeld), file_lock(_stamp().with_suffix(".lock"), blocking=False):
        for kernel in listed_kernels():
            compile_kernel(kernel)
        note_compiled()
    return 0  # where a kernel cannot be compiled, the stage that needs it says so


if __name__ == "__main__":
    sys.exit(_compile_alone())
