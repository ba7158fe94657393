"""First use of a kernel compiles it, which takes seconds: whoever waits is told. Numba says when it compiles what.

Kernels carry `cache=True`, so a machine compiles each once after an installation or an update. `Run` wraps every
stage with `compilation_shown`; a stage need not know of it, and no list of kernels has to be kept.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from reconstruction.core.progress import Progress

_PAUSE_NOTE = (
    "compiling kernels on their first use: tens of seconds, once on this machine (see `simrecon doctor`)"
)


class CompilationShown:
    """Passes progress on; while Numba compiles, the step is the compilation, and then it is the old one again.

    What is said of compiling is for whoever watches: it goes to the listener and into no manifest.
    """

    def __init__(self, listener: Progress) -> None:
        self._listener = listener
        self._lock = threading.RLock()  # kernels may compile in any thread
        self._step: tuple[int, str] | None = None
        self._done = 0
        self._depth = 0  # a kernel compiles the kernels that it calls
        self._began = 0.0
        self.kernels: list[str] = []
        self.seconds = 0.0

    def start(self, total: int, label: str) -> None:
        """See `Progress.start`."""
        with self._lock:
            self._step, self._done = (total, label), 0
            self._listener.start(total, label)

    def advance(self, n: int = 1) -> None:
        """See `Progress.advance`."""
        with self._lock:
            self._done += n
            self._listener.advance(n)

    def note(self, message: str) -> None:
        """See `Progress.note`."""
        with self._lock:
            self._listener.note(message)

    def compiling(self, kernel: str) -> None:
        """A kernel begins to compile."""
        with self._lock:
            self._depth += 1
            if self._depth > 1:
                return
            if not self.kernels:
                self._listener.note(_PAUSE_NOTE)
            self.kernels.append(kernel)
            self._began = time.perf_counter()
            self._listener.start(0, f"compiling {kernel} (first use)")

    def compiled(self) -> None:
        """The kernel that began last is compiled."""
        with self._lock:
            self._depth -= 1
            if self._depth > 0:
                return
            self.seconds += time.perf_counter() - self._began
            if self._step is not None:
                self._listener.start(*self._step)
                self._listener.advance(self._done)

    def sum_up(self) -> None:
        """Say what was compiled, if anything."""
        if self.kernels:
            count = len(self.kernels)
            self._listener.note(f"compiled {count} kernel{'s'[: count > 1]} in {self.seconds:.0f} s")


@contextmanager
def compilation_shown(listener: Progress) -> Iterator[CompilationShown]:
    """Give a progress sink that also shows what Numba compiles within the block."""
    from numba.core import event

    shown = CompilationShown(listener)

    class Tell(event.Listener):
        def on_start(self, event) -> None:
            shown.compiling(event.data["dispatcher"].py_func.__name__.lstrip("_"))

        def on_end(self, event) -> None:
            shown.compiled()

    with event.install_listener("numba:compile", Tell()):
        yield shown
    shown.sum_up()
