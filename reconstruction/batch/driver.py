"""Drive a batch: hand jobs to an engine, write every event to the journal, repeat what was the machine's fault.

Two rows whose videos have the same size run one after the other, because equal videos share a folder of stage results.
"""

import contextlib
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Protocol

from reconstruction.batch.attempt import Job, stage_number
from reconstruction.batch.engines import Engine
from reconstruction.batch.journal import Journal
from reconstruction.batch.outcomes import MACHINE, Outcome, plain
from registry import SceneRegistry
from registry.errors import SimReconError

_TICK_S = 0.3
_TROUBLE = 3  # videos in a row that fail for the machine's fault end the batch


@dataclass(frozen=True)
class Policy:
    """When an attempt is repeated."""

    retries: int = 3  # further attempts after a transient failure that reached no further stage
    pause_s: float = 2.0  # before the next attempt; doubled for each in a row that reached no further stage,
    longest_pause_s: float = 60.0  # up to this


@dataclass(frozen=True)
class Task:
    """A video to run: its first job, and the key of videos that may not run at the same time."""

    job: Job
    video: str
    apart: object = None
    furthest: int = 0  # number of the last stage that an attempt began
    in_vain: int = 0  # failed attempts since then


@dataclass
class Counts:
    """How far a batch is."""

    total: int
    published: int = 0
    failed: int = 0
    running: int = 0
    waiting: int = 0
    seconds_left: float | None = None

    @property
    def ended(self) -> int:
        """Return the number of videos that ended."""
        return self.published + self.failed


class Display(Protocol):
    """Shows events and progress."""

    def started(self, job: Job, counts: Counts) -> None:
        """Show that an attempt began."""

    def ended(self, job: Job, outcome: Outcome, result: str, counts: Counts) -> None:
        """Show that an attempt ended; `result` as in the journal."""

    def tick(self, counts: Counts, running: Sequence[Job]) -> None:
        """Show progress; called several times a second."""

    def say(self, text: str) -> None:
        """Show a line."""


@dataclass
class Summary:
    """The end of a batch."""

    published: int
    failed: int
    waiting: int
    interrupted: bool
    trouble: str = ""  # fault of the machine that ended the batch early
    kinds: tuple[str, ...] = ()  # of the failures


class Driver:
    """Runs tasks on an engine until all have ended, or until it is stopped."""

    def __init__(
        self,
        journal: Journal,
        engine: Engine,
        registry: SceneRegistry,
        display: Display,
        policy: Policy | None = None,
        on_end: Callable[[], None] = lambda: None,
    ) -> None:
        self._journal, self._engine, self._registry = journal, engine, registry
        self._display, self._policy, self._on_end = display, policy or Policy(), on_end
        self._stopping = 0
        self._seconds: list[float] = []  # wall times of videos that were published
        self._in_a_row: list[Outcome] = []  # failures of the machine since the last success

    def run(self, tasks: Sequence[Task]) -> Summary:
        """Run all tasks.

        Raises:
            EnvironmentMissing: the journal cannot be written.
        """
        self._counts = Counts(len(tasks), waiting=len(tasks))
        self._waiting: list[tuple[float, Task]] = [(0.0, task) for task in tasks]
        self._running: dict[str, Task] = {}
        self._kinds: list[str] = []
        trouble = ""
        with _signals(self._on_signal):
            try:
                while self._running or (self._waiting and not self._stopping):
                    self._hand_out()
                    for job, outcome in self._engine.finished(_TICK_S):
                        self._end(job, outcome)
                    if not trouble and (trouble := self._machine_trouble()):
                        self._display.say(f"stopping: {trouble}")
                        self._stop()
                    self._tick()
                    if self._stopping > 1:
                        break
            finally:
                self._engine.close()
        counts = self._counts
        interrupted = bool(self._stopping) and not trouble
        left = len(self._waiting) + len(self._running)
        return Summary(counts.published, counts.failed, left, interrupted, trouble, tuple(self._kinds))

    def _hand_out(self) -> None:
        """Start jobs while the engine has room."""
        now = time.monotonic()
        busy = {task.apart for task in self._running.values() if task.apart is not None}
        position = 0
        while position < len(self._waiting) and not self._stopping:
            ready_at, task = self._waiting[position]
            if ready_at > now or (task.apart is not None and task.apart in busy):
                position += 1
                continue
            if not self._engine.room(task.job):
                return
            del self._waiting[position]
            busy.add(task.apart)
            self._start(task)

    def _start(self, task: Task) -> None:
        job = task.job
        self._journal.append(
            "started",
            scene=job.scene_id,
            video=task.video,
            fingerprint=job.fingerprint,
            attempt=job.attempt,
            engine=self._engine.name,
        )
        self._running[job.scene_id] = task
        self._count()
        self._display.started(job, self._counts)
        self._engine.start(job)

    def _end(self, job: Job, outcome: Outcome) -> None:
        task = self._running.pop(job.scene_id)
        outcome, revision = self._checked(task, outcome)
        result = self._result(task, outcome)
        self._journal.append(
            "ended",
            scene=job.scene_id,
            fingerprint=job.fingerprint,
            attempt=job.attempt,
            result=result,
            kind=outcome.kind,
            cause=outcome.cause,
            cure=outcome.cure,
            exit_code=outcome.exit_code,
            revision=revision,
            wall_s=round(outcome.wall_s, 2),
            peak_memory_mb=round(outcome.peak_memory_mb),
            host=outcome.host,
            notes=list(outcome.notes),
        )
        if result == "published":
            self._counts.published += 1
            self._seconds.append(outcome.wall_s)
        elif result == "failed":
            self._counts.failed += 1
            self._kinds.append(outcome.kind)
        self._watch_machine(outcome, result)
        self._count()
        self._display.ended(job, outcome, result, self._counts)
        self._on_end()

    def _checked(self, task: Task, outcome: Outcome) -> tuple[Outcome, str]:
        """Return (outcome, revision): published only if the registry has the scene."""
        if outcome.kind != "published":
            return outcome, ""
        try:
            return outcome, self._registry.get(task.job.scene_id).revision
        except SimReconError as error:
            cause = f"the run ended well, but {plain(str(error))}"
            cure = "Check that --registry is the same folder on every machine."
            return replace(outcome, kind="bug", cause=cause, cure=cure), ""

    def _result(self, task: Task, outcome: Outcome) -> str:
        """Return the result for the journal; a transient failure is queued again."""
        if outcome.kind == "published":
            return "published"
        if outcome.kind == "interrupted" or (outcome.transient and self._stopping):
            self._waiting.append((0.0, task))
            return "interrupted"
        reached = stage_number(task.job.log)
        in_vain = 1 if reached > task.furthest else task.in_vain + 1
        if outcome.transient and in_vain <= self._policy.retries:
            pause = min(self._policy.pause_s * 2 ** (in_vain - 1), self._policy.longest_pause_s)
            avoid = task.job.avoid
            if outcome.kind in MACHINE and outcome.node:
                avoid = (*avoid, outcome.node)
            again = replace(task.job, attempt=task.job.attempt + 1, avoid=avoid)
            task = replace(task, job=again, furthest=max(reached, task.furthest), in_vain=in_vain)
            self._waiting.insert(0, (time.monotonic() + pause, task))
            return "retry"
        return "failed"

    def _watch_machine(self, outcome: Outcome, result: str) -> None:
        if result == "published" or outcome.kind in ("video", "usage"):
            self._in_a_row.clear()
        elif result == "failed" and outcome.kind in MACHINE:
            self._in_a_row.append(outcome)

    def _machine_trouble(self) -> str:
        """Return the cause why the next videos would fail, too, or ""."""
        kinds = {outcome.kind for outcome in self._in_a_row}
        if len(self._in_a_row) < _TROUBLE or len(kinds) > 1 or not self._waiting:
            return ""
        last = self._in_a_row[-1]
        return (
            f"{len(self._in_a_row)} videos in a row failed for the machine's fault: {last.cause}. {last.cure}"
        )

    def _count(self) -> None:
        counts = self._counts
        counts.running, counts.waiting = len(self._running), len(self._waiting)
        left = counts.running + counts.waiting
        if self._seconds:
            recent = self._seconds[-200:]
            each = sum(recent) / len(recent)
            counts.seconds_left = (
                each * (left - 0.5 * counts.running) / max(1, min(self._engine.places, left or 1))
            )

    def _tick(self) -> None:
        self._count()
        self._display.tick(self._counts, [task.job for task in self._running.values()])

    def _on_signal(self) -> None:
        self._stopping += 1
        if self._stopping == 1:
            self._display.say(
                "stopping: running videos end now and resume in the next run; once more to kill them"
            )
            self._engine.stop()

    def _stop(self) -> None:
        self._stopping = max(1, self._stopping)
        self._engine.stop()


@contextmanager
def _signals(handle: Callable[[], None]) -> Iterator[None]:
    """Call `handle` for SIGINT and SIGTERM while the block runs."""
    kept = {}
    for name in (signal.SIGINT, signal.SIGTERM):
        with contextlib.suppress(ValueError):  # not the main thread
            kept[name] = signal.signal(name, lambda *_: handle())
    try:
        yield
    finally:
        for name, before in kept.items():
            signal.signal(name, before)
