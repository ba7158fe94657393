"""While a run trains: counting, showing, keeping checkpoints, and stopping where it can be gone on from."""

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

WINDOW = 100  # episodes that the success rate is of
_SAVE_EVERY_S = 60.0
_SAVE_SHARE = 0.1  # of all steps, at most, between two checkpoints
_POINTS = 100  # of the learning curve


@dataclass
class Tally:
    """How training went so far; written with every checkpoint, so that a resumed run goes on counting."""

    steps: int = 0
    seconds: float = 0.0
    episodes: int = 0
    successes: int = 0
    curve: list[list[float]] = field(default_factory=list)
    """[steps, success rate, mean return, mean length] of the last 100 episodes, at most 100 times a run."""


class Stop:
    """Whether somebody asked to stop: Ctrl-C or SIGTERM. The second time it is done at once."""

    def __init__(self) -> None:
        self.asked = False

    @contextlib.contextmanager
    def listening(self, say: Callable[[str], None]) -> Iterator[None]:
        """Take the signals while the block runs."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def ask(number: int, _: Any) -> None:
            if self.asked:
                raise KeyboardInterrupt
            self.asked = True
            say("stopping: the update is finished and a checkpoint written (again: stop at once)")

        before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


class Watch(BaseCallback):
    """Counts episodes, shows progress, and saves between updates, the only place where steps and weights agree."""

    def __init__(self, folder: RunFolder, total: int, tally: Tally, stop: Stop, progress: Progress) -> None:
        """Watch a run of `total` steps that has made `tally.steps`."""
        super().__init__()
        self.tally = tally
        self._folder, self._total, self._stop, self._progress = folder, total, stop, progress
        self._recent: deque[tuple[float, float, float]] = deque(maxlen=WINDOW)
        self._began, self._before = time.perf_counter(), tally.seconds
        self._saved_at, self._saved_steps = self._began, tally.steps

    def _on_rollout_start(self) -> None:
        """Between two updates."""
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
        """Return the share of the last episodes that succeeded; None before the first has ended."""
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
