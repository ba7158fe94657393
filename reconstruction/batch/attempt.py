"""Run one video in its own process: a `Job` in, an `Outcome` out. Every engine calls this on its machine."""

import contextlib
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path

import psutil

from reconstruction.batch.outcomes import CURES, Outcome, classify, plain
from reconstruction.cache import digest_input
from reconstruction.downloads import as_local, drop_copy
from reconstruction.remote_cache import drop_results
from registry import SimReconError, registry_folder
from registry.roots import is_address

_POLL_S = 0.25
_GRACE_S = 30.0  # from SIGINT to SIGKILL
_FULL_BYTES = 64 << 20  # a disk with less free space counts as full
_TAIL_BYTES = 20_000
_OOM_COUNTER = Path("/sys/fs/cgroup/memory.events")


@dataclass(frozen=True)
class Job:
    """One attempt at a video."""

    scene_id: str
    fingerprint: str
    arguments: tuple[str, ...]  # of `simrecon reconstruct`, without the work folder
    registry: Path | str  # folder or address
    log: Path
    work_dir: str | None = None  # may hold $VARIABLES of the machine that runs it
    report: Path | None = None  # page of `simrecon report` to write, or None
    attempt: int = 1
    cores: int = 2
    gpus: float = 0.0
    memory_mb: int = 0  # reserved
    memory_limit_mb: int = 0  # a process tree beyond it is ended; 0: no limit
    time_limit_s: float = 0.0  # 0: no limit
    keep_work: bool = True
    pinned: tuple[int, ...] = ()  # CPU numbers; empty: any
    avoid: tuple[str, ...] = ()  # nodes of a cluster that it failed on


def run_attempt(job: Job, stop: threading.Event | None = None) -> Outcome:
    """Run `simrecon reconstruct`, and then `simrecon report`, for one video.

    Args:
        job: the attempt.
        stop: ends the attempt gently once it is set; so does `KeyboardInterrupt`.

    Returns:
        How it ended; this function does not raise for the failure of a video.
    """
    began = time.monotonic()
    try:
        outcome = _reconstruct(job, stop or threading.Event())
    except OSError as error:  # the log cannot be written, a process cannot be started
        where = f" ({error.filename})" if error.filename else ""
        kind = "disk" if error.errno in (28, 122) else "machine"
        outcome = Outcome(kind, plain(f"{error.strerror}{where}"), CURES[kind])
    return replace(outcome, wall_s=time.monotonic() - began, host=socket.gethostname())


def _reconstruct(job: Job, stop: threading.Event) -> Outcome:
    job.log.parent.mkdir(parents=True, exist_ok=True)
    work = _work_of(job)
    command = ["reconstruct", *job.arguments, "--registry", str(job.registry)]
    if work is not None:
        command += ["--work-dir", str(work)]
    ooms = _oom_kills()
    with job.log.open("wb") as log:
        watched = _watch(command, job, stop, log)
    if watched.verdict is not None:
        return watched.verdict
    folders = [f for f in (work, registry_folder(job.registry), job.log.parent) if isinstance(f, Path)]
    outcome = classify(
        watched.exit_code,
        tail(job.log),
        out_of_memory=_oom_kills() > ooms,
        full_disk=_full_disk(folders),
    )
    notes: list[str] = []
    if outcome.kind == "published":
        notes += _write_report(job, work, stop)
        if work is not None and not job.keep_work:
            notes += _drop(job, work)
    return replace(outcome, peak_memory_mb=watched.peak_mb, notes=tuple(notes))


def _work_of(job: Job) -> Path | str | None:
    """Return the work folder of an attempt on this machine, its address, or None for the default."""
    if job.work_dir is None or is_address(job.work_dir):
        return job.work_dir
    return Path(os.path.expandvars(job.work_dir)).expanduser() / job.scene_id


def _drop(job: Job, work: Path | str) -> list[str]:
    """Delete the stage results of a published scene, and a downloaded film; return a note if an address fails."""
    video, notes = job.arguments[0], []
    try:
        if isinstance(work, Path):
            shutil.rmtree(work, ignore_errors=True)
        else:
            drop_results(work, registry_folder(job.registry), digest_input(as_local(video)))
        if is_address(video):
            drop_copy(video)
    except SimReconError as error:
        notes.append(f"results are not deleted: {plain(str(error))}")
    return notes


def _write_report(job: Job, work: Path | str | None, stop: threading.Event) -> list[str]:
    """Write the page of `simrecon report`; return a note if that fails, which does not fail the video."""
    if job.report is None:
        return []
    job.report.parent.mkdir(parents=True, exist_ok=True)
    partial = job.report.with_suffix(".part.html")
    command = ["report", job.scene_id, "--out", str(partial), "--registry", str(job.registry), "--quiet"]
    if work is not None:
        command += ["--work-dir", str(work)]
    with job.log.open("ab") as log:
        watched = _watch(command, job, stop, log)
    if watched.exit_code == 0 and partial.is_file():
        partial.replace(job.report)
        return []
    partial.unlink(missing_ok=True)
    return [f"no report page: {classify(watched.exit_code or 1, tail(job.log)).cause}"]


@dataclass
class _Watched:
    """The end of a process: its exit code, its peak memory, and the outcome if it was ended by its limits."""

    exit_code: int
    peak_mb: float
    verdict: Outcome | None = None


def _watch(command: list[str], job: Job, stop: threading.Event, log) -> _Watched:
    """Run a command line in a process group of its own until it ends, is stopped, or breaks a limit."""
    process = subprocess.Popen(
        [sys.executable, "-m", "reconstruction.batch.child", *command],
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=subprocess.STDOUT,
        env=_environment(job.cores),
        start_new_session=True,
    )
    began, peak, verdict = time.monotonic(), 0.0, None
    try:
        _pin(process.pid, job.pinned)
        while process.poll() is None and verdict is None:
            peak = max(peak, _tree_mb(process.pid))
            if stop.is_set():
                verdict = _interrupted()
            elif job.time_limit_s and time.monotonic() - began > job.time_limit_s:
                verdict = Outcome("time", f"took longer than {job.time_limit_s:g} s", CURES["time"])
            elif job.memory_limit_mb and peak > job.memory_limit_mb:
                cause = f"used {peak:.0f} MB, more than the limit of {job.memory_limit_mb} MB"
                verdict = Outcome("memory", cause, CURES["memory"])
            else:
                stop.wait(_POLL_S) if process.poll() is None else None
    except KeyboardInterrupt:
        verdict = _interrupted()
    finally:
        if verdict is not None:
            _end(process, gently=verdict.kind == "interrupted")
        _sweep(process)
    return _Watched(process.returncode, peak, verdict)


def _interrupted() -> Outcome:
    return Outcome("interrupted", "interrupted", CURES["interrupted"])


def _end(process: subprocess.Popen, gently: bool) -> None:
    if gently:
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_GRACE_S)
    if process.poll() is None:
        _kill_group(process)


def _sweep(process: subprocess.Popen) -> None:
    """End what is left of the group, and collect the exit code."""
    _kill_group(process)
    process.wait()
    if process.stdin is not None:
        process.stdin.close()


def _kill_group(process: subprocess.Popen) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)


def _environment(cores: int) -> dict[str, str]:
    """Return the environment of a run on so many threads."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
    found = {name: value for name, value in os.environ.items() if name not in ("SIMRECON_DEBUG",)}
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    return {**found, **dict.fromkeys(names, str(max(1, min(cores, usable)))), "PYTHONUNBUFFERED": "1"}


def _pin(pid: int, cpus: tuple[int, ...]) -> None:
    if cpus and hasattr(os, "sched_setaffinity"):
        with contextlib.suppress(OSError):
            os.sched_setaffinity(pid, cpus)


def _tree_mb(pid: int) -> float:
    """Return the memory of a process and its descendants in MiB."""
    total = 0
    with contextlib.suppress(psutil.Error):
        process = psutil.Process(pid)
        for one in (process, *process.children(recursive=True)):
            with contextlib.suppress(psutil.Error):
                total += one.memory_info().rss
    return total / 2**20


def _oom_kills() -> int:
    """Return how many processes the kernel has ended for lack of memory in this control group."""
    try:
        found = re.search(r"^oom_kill (\d+)", _OOM_COUNTER.read_text(), re.MULTILINE)
    except OSError:
        return 0
    return int(found[1]) if found else 0


def _full_disk(folders: list[Path]) -> str:
    for folder in folders:
        place = folder
        while not place.exists() and place != place.parent:
            place = place.parent
        with contextlib.suppress(OSError):
            if shutil.disk_usage(place).free < _FULL_BYTES:
                return str(folder)
    return ""


def tail(path: Path) -> str:
    """Return the end of a log; "" if there is none."""
    try:
        with path.open("rb") as stream:
            stream.seek(max(0, path.stat().st_size - _TAIL_BYTES))
            return stream.read().decode("utf-8", "replace")
    except OSError:
        return ""


def stage_of(path: Path) -> str:
    """Return the stage that a running log ends in, such as `3/11 depth`, or ""."""
    found = re.findall(r"^\[(\d+/\d+)\] (\w+)", tail(path), re.MULTILINE)
    return " ".join(found[-1]) if found else ""


def stage_number(path: Path) -> int:
    """Return the number of the stage that a log ends in, such as 3; 0 before the first."""
    found = re.match(r"\d+", stage_of(path))
    return int(found[0]) if found else 0
