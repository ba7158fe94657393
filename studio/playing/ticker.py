"""`Ticker`: calls a function at a steady rate in a thread while it runs."""

import logging
import threading
import time
from collections.abc import Callable

logger = logging.getLogger(__name__)
RATE_HZ = 30
_LONGEST_S = 0.25  # a tick never covers more: a stalled machine does not jump


class Ticker:
    """Calls `tick(seconds since the last tick)` 30 times a second between `start` and `stop`; sleeps else."""

    def __init__(self, tick: Callable[[float], None], name: str) -> None:
        """Start stopped; the thread lives until `close`."""
        self._tick = tick
        self._running, self._ended = threading.Event(), False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        """Tell whether ticks are made."""
        return self._running.is_set()

    def start(self) -> None:
        """Begin to tick."""
        self._running.set()

    def stop(self) -> None:
        """Stop; a tick that has begun is finished."""
        self._running.clear()

    def close(self) -> None:
        """End the thread."""
        self._ended = True
        self._running.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=10)

    def _run(self) -> None:
        while True:
            self._running.wait()
            last = time.perf_counter()
            while self._running.is_set() and not self._ended:
                time.sleep(max(0.0, 1.0 / RATE_HZ - (time.perf_counter() - last)))
                now = time.perf_counter()
                passed, last = min(now - last, _LONGEST_S), now
                try:
                    self._tick(passed)
                except Exception:
                    logger.exception("studio: an animation stopped")
                    self._running.clear()
            if self._ended:
                return
