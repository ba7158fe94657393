"""Apply: `simrecon reconstruct` with the corrections, in a process of its own that outlives the page.

The process writes to a log file. A page that is opened later finds a run that is still going by its record and follows
it. What the run has computed is kept by the stage cache, however it ends.
"""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from registry import open_registry
from registry.errors import UsageError
from registry.files import write_whole
from studio.correcting.origin import Origin

KEPT_RESULTS = 3  # of each stage: uncorrected, before and after, so that an undo is applied at once
_STAGE = re.compile(r"\[(\d+)/(\d+)\] ([a-z_]+): (.*)")
_STEP = re.compile(r"(.*) (\d+)/(\d+), about")
_ENDED = "studio: exit code "


@dataclass(frozen=True)
class ApplyState:
    """Progress of a run."""

    running: bool
    stage: str = ""
    done: float = 0.0  # share of the stages, 0 to 1
    said: str = ""  # the last line of progress
    error: str = ""  # one line, if it failed
    revision: str = ""  # of the new scene, if it was published
    elapsed_s: float = 0.0
    reused: tuple[str, ...] = ()  # stages whose results were kept
    computed: tuple[str, ...] = ()


class ApplyRun:
    """One run of `simrecon reconstruct`, started here or found going."""

    def __init__(
        self, record: Path, log: Path, pid: int, started: float, registry_root: Path, scene_id: str
    ) -> None:
        self._record, self._log, self.pid, self._started = record, log, pid, started
        self._registry_root, self._scene_id = registry_root, scene_id
        self._process: subprocess.Popen | None = None
        self._elapsed_s: float | None = None

    @classmethod
    def start(
        cls, origin: Origin, overrides: Path, folder: Path, *, require_stable: bool = True
    ) -> "ApplyRun":
        """Start a run.

        Args:
            origin: how the scene was made.
            overrides: the file of corrections.
            folder: where the log and the record of the run are kept.
            require_stable: do not publish a scene in which an object moves in the final simulation.

        Raises:
            UsageError: a run of this scene is still going.
        """
        going = cls.find(origin.scene_id, folder, origin.registry_root)
        if going is not None:
            raise UsageError(f"{origin.scene_id}: Apply is running already (process {going.pid})")
        folder.mkdir(parents=True, exist_ok=True)
        log = folder / f"{origin.scene_id}.apply.log"
        arguments = origin.command(
            overrides.absolute() if overrides.exists() else None, require_stable=require_stable,
            keep_results=KEPT_RESULTS,
        )  # fmt: skip
        child = [sys.executable, "-m", "studio.correcting.apply", *arguments]
        with log.open("wb") as stream:
            process = subprocess.Popen(
                child, cwd=origin.folder, env=_environment(), stdin=subprocess.DEVNULL, stdout=stream,
                stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip
        started = time.time()
        record = folder / f"{origin.scene_id}.apply.json"
        said = {"pid": process.pid, "born": _birth(process.pid), "started": started, "log": str(log)}
        write_whole(record, json.dumps(said).encode())
        run = cls(record, log, process.pid, started, origin.registry_root, origin.scene_id)
        run._process = process
        return run

    @classmethod
    def find(cls, scene_id: str, folder: Path, registry_root: Path) -> "ApplyRun | None":
        """Return the run of a scene that is still going, started by this or another page; None if there is none."""
        record = folder / f"{scene_id}.apply.json"
        try:
            said = json.loads(record.read_text())
            pid, born, log = int(said["pid"]), said["born"], Path(said["log"])
            started = float(said["started"])
        except (OSError, ValueError, KeyError, TypeError):
            return None
        if _exit_code(log) is not None or _birth(pid) is None or _birth(pid) != born:
            return None
        return cls(record, log, pid, started, registry_root, scene_id)

    def state(self) -> ApplyState:
        """Return how far the run is."""
        code = self._ended()
        lines = self._lines()
        stages = [found.groups() for line in lines if (found := _STAGE.fullmatch(line))]
        reused = tuple(name for _, _, name, said in stages if said.startswith("already done"))
        begun = tuple(name for _, _, name, said in stages if said == "...")
        elapsed = self._elapsed_s or time.time() - self._started
        if code is None:
            return ApplyState(True, *_progress(stages), elapsed_s=elapsed, reused=reused, computed=begun)
        if code != 0:
            return ApplyState(
                False, error=_failure(lines, code), elapsed_s=elapsed, reused=reused, computed=begun
            )
        revision = open_registry(self._registry_root).get(self._scene_id).revision
        return ApplyState(False, "", 1.0, "done", "", revision, elapsed, reused, begun)

    def cancel(self) -> None:
        """End the run; finished stages stay in the stage cache."""
        if self._ended() is None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.pid, signal.SIGTERM)

    def wait(self, timeout_s: float) -> ApplyState:
        """Return the state at the end of the run.

        Raises:
            TimeoutError: it takes longer.
        """
        end = time.monotonic() + timeout_s
        while (state := self.state()).running:
            if time.monotonic() > end:
                raise TimeoutError(f"{self._scene_id}: Apply is still running after {timeout_s:g} s")
            time.sleep(0.1)
        return state

    def _ended(self) -> int | None:
        """Return the exit code; None while the run goes on."""
        code = _exit_code(self._log)
        if code is None and self._process is not None:
            code = self._process.poll()
        elif code is None and _birth(self.pid) is None:
            code = _exit_code(self._log)
            code = -signal.SIGKILL if code is None else code
        if code is not None and self._elapsed_s is None:
            self._elapsed_s = time.time() - self._started
        return code

    def _lines(self) -> list[str]:
        text = self._log.read_bytes().decode("utf-8", "replace")
        return [line for line in re.split(r"[\r\n]+", text) if line.strip()]


def _progress(stages: list[tuple[str, ...]]) -> tuple[str, float, str]:
    """Return the present stage, the share of the work, and the last line of progress."""
    if not stages:
        return "", 0.0, "starting"
    number, total, name, said = stages[-1]
    step = _STEP.match(said)
    inside = int(step[2]) / max(int(step[3]), 1) if step else 0.0
    return name, (int(number) - 1 + inside) / int(total), "" if said == "..." else said


def _failure(lines: list[str], code: int) -> str:
    """Return one line with the reason of a failure."""
    if code == -signal.SIGTERM:
        return "Apply was cancelled; finished stages are kept, and so are your acts"
    if code < 0:
        return f"Apply was ended by signal {-code}; finished stages are kept, apply again to go on"
    said = [k for k, line in enumerate(lines) if line.startswith("simrecon reconstruct:")]
    if said:
        return " ".join(
            " ".join(lines[said[-1] :]).removeprefix("simrecon reconstruct:").split(_ENDED)[0].split()
        )
    last = [line for line in lines if not line.startswith(_ENDED)]
    return f"Apply failed with exit code {code}: {last[-1] if last else 'it said nothing'}"


def _exit_code(log: Path) -> int | None:
    """Return the exit code at the end of a log; None if the run has not written it."""
    try:
        last = log.read_bytes()[-100:].decode("utf-8", "replace").rstrip("\n").rsplit("\n", 1)[-1]
    except OSError:
        return None
    return int(last.removeprefix(_ENDED)) if last.startswith(_ENDED) else None


def _birth(pid: int) -> float | None:
    """Return when a process was started; None if it does not run."""
    import psutil

    try:
        process = psutil.Process(pid)
        return None if process.status() == psutil.STATUS_ZOMBIE else process.create_time()
    except psutil.Error:
        return None


def _environment() -> dict[str, str]:
    """Return the environment with this source tree first among the modules, whatever folder the run starts in."""
    root = str(Path(__file__).resolve().parents[2])
    others = os.environ.get("PYTHONPATH", "")
    return {
        **os.environ,
        "PYTHONPATH": root + (os.pathsep + others if others else ""),
        "PYTHONUNBUFFERED": "1",
    }


def _main() -> int:
    """Run a `simrecon` command line, and note its exit code as the last line of the log."""
    from reconstruction.cli import main

    os.nice(5)  # the page stays responsive
    code = 1
    try:
        code = main(sys.argv[1:])
    finally:
        sys.stderr.write(f"{_ENDED}{code}\n")
        sys.stderr.flush()
    return code


if __name__ == "__main__":
    sys.exit(_main())
