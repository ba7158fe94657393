"""`PhysicsPlayer`: steps a `PhysicsSession` at real time in a thread and hands on what moved."""

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from registry.errors import UsageError
from studio.playing.session import PhysicsSession

logger = logging.getLogger(__name__)
RATE_HZ = 30  # of the poses that are handed on
_SHARE = 0.2  # of the last tick in the mean of `PlayerState.real_time`

Act = Callable[[PhysicsSession], None]


@dataclass(frozen=True)
class PlayerState:
    """State of the player after a tick."""

    running: bool
    time_s: float  # simulated, since the last reset
    moving: int  # bodies that are awake
    real_time: float  # simulated seconds a second of wall time; 1 if the machine keeps up at speed 1


class PhysicsPlayer:
    """Runs a session in a thread of its own; acts are done between two ticks, in the order they were given.

    While everything sleeps, nothing is stepped and nothing is handed on.
    """

    def __init__(
        self,
        session: PhysicsSession,
        on_change: Callable[[dict[int, np.ndarray]], None],
        on_state: Callable[[PlayerState], None] = lambda state: None,
        on_refusal: Callable[[str], None] = lambda text: None,
        *,
        rate_hz: float = RATE_HZ,
    ) -> None:
        """Start paused.

        Args:
            session: The physics; only the player's thread touches it from now on.
            on_change: Receives the poses (7,) of the bodies that moved, by id; called in the player's thread.
            on_state: Receives the state after a tick that changed something.
            on_refusal: Receives the message of an act that cannot be done.
            rate_hz: Ticks a second of wall time.
        """
        self._session, self._on_change, self._on_state = session, on_change, on_state
        self._on_refusal = on_refusal
        self._tick_s = 1.0 / rate_hz
        self._acts: deque[Act] = deque()
        self._changed = threading.Condition()
        self._running = self._ended = False
        self.speed = 1.0
        self._real_time = 1.0
        self._thread = threading.Thread(target=self._run, name="studio-physics", daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        """Tell whether time passes."""
        return self._running

    @property
    def session(self) -> PhysicsSession:
        """Return the session; read it only while the player is paused."""
        return self._session

    def play(self) -> None:
        """Let time pass; bodies without support begin to fall."""
        self.do(PhysicsSession.wake)
        self._set_running(True)

    def pause(self) -> None:
        """Stop time; acts are still done."""
        self._set_running(False)

    def step(self) -> None:
        """Pause, and simulate one tick."""
        self._set_running(False)
        tick = self._tick_s

        def act(session: PhysicsSession) -> None:
            session.wake()
            session.advance(tick)

        self.do(act)

    def reset(self) -> None:
        """Pause, and return everything to its start pose."""
        self._set_running(False)
        self.do(PhysicsSession.reset)

    def do(self, act: Act) -> None:
        """Have an act done between two ticks."""
        with self._changed:
            self._acts.append(act)
            self._changed.notify()

    def close(self) -> None:
        """End the thread; further acts are ignored."""
        with self._changed:
            self._ended = True
            self._changed.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=10)

    def _set_running(self, running: bool) -> None:
        with self._changed:
            self._running = running
            self._changed.notify()

    def _run(self) -> None:
        due, last = time.perf_counter(), None
        while True:
            with self._changed:
                if not self._acts and not (self._running and not self._session.at_rest):
                    last = None
                self._changed.wait_for(
                    lambda: self._ended or self._acts or (self._running and not self._session.at_rest)
                )
                if self._ended:
                    return
                acts, running = list(self._acts), self._running
                self._acts.clear()
            now = time.perf_counter()
            due = max(due, now - self._tick_s)  # time that was lost is not caught up
            try:
                self._tick(acts, running)
            except Exception:
                logger.exception("studio: the physics stopped")
                self._set_running(False)
            if running and last is not None:
                self._real_time += _SHARE * (
                    self._tick_s * self.speed / max(now - last, 1e-6) - self._real_time
                )
            last = now if running else None
            due += self._tick_s
            time.sleep(max(0.0, due - time.perf_counter()))

    def _tick(self, acts: list[Act], running: bool) -> None:
        session = self._session
        for act in acts:
            try:
                act(session)
            except UsageError as error:
                self._on_refusal(str(error))
        if running:
            session.advance(self._tick_s * self.speed)
        changes = session.changes()
        if changes:
            with contextlib.suppress(RuntimeError):  # the page has just been closed
                self._on_change(changes)
        self._on_state(PlayerState(self._running, session.time_s, len(session.moving), self._real_time))
