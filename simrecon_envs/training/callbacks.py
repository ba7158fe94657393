"""During training: count episodes, show progress, write checkpoints, stop on signals between updates."""

import contextlib
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from simrecon_envs.files import write_json
from simrecon_envs.training.folder import RunFolder
from simrecon_envs.training.models import save
from simrecon_envs.training.progress import Interrupted, Progress

WINDOW = 100  # latest episodes over which the success rate is computed
_SAVE_EVERY_S = 60.0
_SAVE_SHARE = 0.1  # greatest share of all steps between two checkpoints
_POINTS = 100  # greatest number of points of the learning curve


@dataclass
class Tally:
    """Counters of a run; saved with every checkpoint so that a resumed run continues them."""

    steps: int = 0
    seconds: float = 0.0
    episodes: int = 0
    successes: int = 0
    curve: list[list[float]] = field(default_factory=list)
    """Learning curve: [steps, success rate, mean return, mean length] over the latest 100 episodes."""


class Stop:
    """Flag that SIGINT (Ctrl-C) or SIGTERM was received. A second signal raises KeyboardInterrupt."""

    def __init__(self) -> None:
        """Begin without a signal."""
        self.asked = False

    @contextlib.contextmanager
    def listening(self, say: Callable[[str], None]) -> Iterator[None]:
        """Handle the signals inside a `with` block."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def ask(number: int, _: Any) -> None:
            if self.asked:
                raise KeyboardInterrupt
            self.asked = True
            say("stopping after this update and a checkpoint (again: stop at once)")

        before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


class Watch(BaseCallback):
    """Counts episodes, shows progress, and saves between updates, when step count and weights are consistent."""

    def __init__(self, folder: RunFolder, total: int, tally: Tally, stop: Stop, progress: Progress) -> None:
        """Watch a run of `total` steps, `tally.steps` of which are done."""
        super().__init__()
        self.tally = tally
        self._folder, self._total, self._stop, self._progress = folder, total, stop, progress
        self._recent: deque[tuple[float, float, float]] = deque(maxlen=WINDOW)
        self._began, self._before = time.perf_counter(), tally.seconds
        self._saved_at, self._saved_steps = self._began, tally.steps

    def _on_rollout_start(self) -> None:
        """Save or stop between two updates."""
        self._count()
        if self._stop.asked:
            if self.num_timesteps > self._saved_steps:
                self.save()
            raise Interrupted
        made = self.num_timesteps - self._saved_steps
        old = time.perf_counter() - self._saved_at >= _SAVE_EVERY_S
        if made and (old or made >= _SAVE_SHARE * self._total):
            self.save()

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                self.tally.episodes += 1
                self.tally.successes += info["is_success"]
                self._recent.append((info["is_success"], info["episode"]["r"], info["episode"]["l"]))
        self._progress.training(self.num_timesteps, self.success_rate)
        return True

    def _on_rollout_end(self) -> None:
        curve = self.tally.curve
        every = max(self._total // _POINTS, 1)
        if self._recent and (not curve or self.num_timesteps - curve[-1][0] >= every):
            means = [sum(column) / len(self._recent) for column in zip(*self._recent, strict=True)]
            curve.append([self.num_timesteps, *(round(mean, 4) for mean in means)])

    @property
    def success_rate(self) -> float | None:
        """Return the success rate over the latest episodes; None before the first one ends."""
        return sum(row[0] for row in self._recent) / len(self._recent) if self._recent else None

    def _count(self) -> None:
        self.tally.steps = self.num_timesteps
        self.tally.seconds = self._before + time.perf_counter() - self._began

    def save(self) -> None:
        """Write a checkpoint."""
        self._count()
        with self._folder.new_checkpoint(self.num_timesteps) as path:
            save(self.model, path)
            write_json(path / "tally.json", asdict(self.tally))
        self._saved_at, self._saved_steps = time.perf_counter(), self.num_timesteps
