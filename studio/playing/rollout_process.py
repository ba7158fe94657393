"""A process that makes rollouts: the page's process keeps its memory, and its threads their time.

One process makes one rollout or one list of tasks. It sends what `studio.playing.rollout` sends, as it is made.
"""

import multiprocessing
import threading
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from registry.errors import SimReconError
from studio.playing.rollout import RolloutRequest

_END_S = 5.0  # that a process may take to end before it is killed


@dataclass(frozen=True)
class TasksRequest:
    """Asks for the tasks of a scene that a robot can likely do, the easiest first."""

    scene: str
    registry: str
    revision: str
    robot: str


@dataclass(frozen=True)
class Failed:
    """The work failed."""

    message: str


class RolloutProcess:
    """Runs a request in a new process and hands on what it sends."""

    def __init__(
        self,
        request: RolloutRequest | TasksRequest,
        on_message: Callable[[Any], None],
        on_end: Callable[[str], None],
    ) -> None:
        """Start.

        Args:
            request: What to make.
            on_message: Receives a `RolloutHead`, then `RolloutFrame`s; or names of tasks. Called in a thread.
            on_end: Receives "" at the end, or why it failed; not called after `stop`.
        """
        # spawn: the page's process has threads, and a simulator must not be forked.
        context = multiprocessing.get_context("spawn")
        self._receiver, sender = context.Pipe(duplex=False)
        self._process = context.Process(target=_work, args=(request, sender), daemon=True)
        self._process.start()
        sender.close()
        self._stopped = False
        self._on_message, self._on_end = on_message, on_end
        self._thread = threading.Thread(target=self._listen, name="studio-rollout", daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        """Tell whether the process works."""
        return self._process.is_alive()

    def stop(self) -> None:
        """End the process; what it sent before stays."""
        self._stopped = True
        self._process.terminate()
        self._process.join(_END_S)
        if self._process.is_alive():
            self._process.kill()

    def _listen(self) -> None:
        failure = "the process that makes it was killed; most likely memory ran out"
        while True:
            try:
                message = self._receiver.recv()
            except (EOFError, OSError):
                break
            if message is None:
                failure = ""
                break
            if isinstance(message, Failed):
                failure = message.message
                break
            if not self._stopped:
                self._on_message(message)
        self._receiver.close()
        self._process.join()
        if not self._stopped:
            self._on_end(failure)


def _work(request: RolloutRequest | TasksRequest, sender: Connection) -> None:
    """Make a request in this process; send the results, then None, or `Failed`."""
    try:
        if isinstance(request, TasksRequest):
            sender.send(_tasks(request))
        else:
            from simrecon_envs.processes import prepare_process
            from studio.playing.rollout import record, replay

            prepare_process()
            (replay if request.trajectory else record)(request, sender.send)
        sender.send(None)
    except BrokenPipeError:
        pass  # the page has closed
    except SimReconError as error:
        sender.send(Failed(str(error)))
    except Exception as error:
        sender.send(Failed(f"{type(error).__name__}: {error}"))
    finally:
        sender.close()


def _tasks(request: TasksRequest) -> tuple[str, ...]:
    from studio.playing.tasks import tasks_of

    return tasks_of(request.scene, request.registry, request.revision, request.robot)
