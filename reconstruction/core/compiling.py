"""Report just-in-time compilation of Numba kernels as progress, from Numba's compile events.

Compilation takes seconds per kernel. Kernels have `cache=True`, so a machine compiles each once after an installation
or update. `Run` wraps every stage with `compilation_shown`; stages need no code for it.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from reconstruction.core.progress import Progress

_PAUSE_NOTE = (
    "compiling kernels on their first use: tens of seconds, once on this machine (see `simrecon doctor`)"
)

_NAMED = 4  # kernels whose names a note gives; with more, the installation is new


class CompilationShown:
    """A progress sink that forwards to a listener and replaces the current step while Numba compiles.

    Notes on compilation go to the listener only, into no manifest.
    """

    def __init__(self, listener: Progress) -> None:
        self._listener = listener
        self._lock = threading.RLock()  # kernels may compile in any thread
        self._step: tuple[int, str] | None = None
        self._done = 0
        self._depth = 0  # of nested compilations: a kernel compiles the kernels that it calls
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
        """Handle the start of the compilation of a kernel."""
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
        """Handle the end of the last started compilation; show the former step again."""
        with self._lock:
            self._depth -= 1
            if self._depth > 0:
                return
            self.seconds += time.perf_counter() - self._began
            if self._step is not None:
                self._listener.start(*self._step)
                self._listener.advance(self._done)

    def sum_up(self) -> None:
        """Note how many kernels were compiled, if any, and in what time."""
        if self.kernels:
            count = len(self.kernels)
            which = f" ({', '.join(self.kernels)})" if count <= _NAMED else ""
            self._listener.note(f"compiled {count} kernel{'s'[: count > 1]}{which} in {self.seconds:.0f} s")


@contextmanager
def compilation_shown(listener: Progress) -> Iterator[CompilationShown]:
    """Yield a progress sink that also reports Numba compilations within the block."""
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
