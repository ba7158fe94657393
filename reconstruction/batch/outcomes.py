"""Classify how one attempt at a video ended: exit code and log in, kind, cause and cure out."""

import re
import signal
from dataclasses import dataclass, field
from typing import Literal

Kind = Literal[
    "published", "video", "usage", "bug", "time", "busy", "killed", "memory", "disk", "machine", "interrupted"
]
TRANSIENT = frozenset({"busy", "killed", "memory", "disk", "machine"})
"""Kinds that another attempt, or another machine, may not meet again."""
MACHINE = frozenset({"memory", "disk", "machine"})
"""Kinds that the machine is to blame for."""
CURES: dict[str, str] = {
    "video": "Film it again, or see `simrecon check` for the trouble.",
    "usage": "Correct the row.",
    "bug": "The log has the details; please report it.",
    "time": "Raise --time-limit, or use --preset fast.",
    "busy": "Wait for the other process to end, then run the same batch again.",
    "killed": "Run the same batch again: it continues after the last finished stage.",
    "memory": "Use a machine with more memory, a smaller --at-once, or --preset fast.",
    "disk": "Free some space, or choose another disk with --work-dir; then run the same batch again.",
    "machine": "See `simrecon doctor`; then run the same batch again.",
    "interrupted": "Run the same batch again: it continues after the last finished stage.",
}
_DISK = re.compile(r"no space left|disk is full|disk quota|GB free on this disk", re.IGNORECASE)
_MEMORY = re.compile(r"out of memory|MemoryError|cannot allocate memory|std::bad_alloc", re.IGNORECASE)
_BUSY = "another process is reconstructing it"
_MESSAGE = re.compile(r"^simrecon \w+: ", re.MULTILINE)
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+")
_SENTENCE = re.compile(r"(?<=[a-z0-9)\"'%])[.;] (?=[A-Z`])|\. (?=\S)")
_LONGEST = 300


@dataclass(frozen=True)
class Outcome:
    """The end of one attempt."""

    kind: Kind
    cause: str = ""  # one line
    cure: str = ""
    exit_code: int | None = None
    wall_s: float = 0.0
    peak_memory_mb: float = 0.0
    host: str = ""
    node: str = ""  # of a cluster, to avoid it next time
    notes: tuple[str, ...] = field(default=())

    @property
    def transient(self) -> bool:
        """Whether another attempt may succeed."""
        return self.kind in TRANSIENT


def plain(text: str) -> str:
    """Return a text on one line without control characters, which could change a terminal; at most 300 characters."""
    clean = _CONTROL.sub(" ", text).strip()
    clean = clean.encode("utf-8", "replace").decode()
    return clean if len(clean) <= _LONGEST else clean[: _LONGEST - 1] + "…"


def classify(exit_code: int, log: str, *, out_of_memory: bool = False, full_disk: str = "") -> Outcome:
    """Return the outcome of an ended process.

    Args:
        exit_code: of `simrecon reconstruct`; negative for a signal.
        log: the end of what it printed.
        out_of_memory: the kernel ended a process of this machine for lack of memory meanwhile.
        full_disk: a folder of the run on a full disk, or "".
    """
    if exit_code == 0:
        return Outcome("published", exit_code=0)
    message = _last_message(log)
    if exit_code < 0 or exit_code in (128 + signal.SIGKILL, 128 + signal.SIGTERM):
        return _killed(exit_code, out_of_memory)
    if exit_code == 4 and (full_disk or _DISK.search(message)):
        return _outcome("disk", exit_code, message or f"the disk of {full_disk} is full")
    if exit_code == 4 and _MEMORY.search(message):
        return _outcome("memory", exit_code, message)
    if exit_code == 130:
        return _outcome("interrupted", exit_code, "interrupted")
    if exit_code == 2 and _BUSY in message:
        return _outcome("busy", exit_code, message)
    known: dict[int, Kind] = {2: "usage", 3: "video", 4: "machine"}
    if exit_code in known:
        return _outcome(known[exit_code], exit_code, message or f"ended with exit code {exit_code}")
    if _MEMORY.search(log[-4000:]):
        return _outcome("memory", exit_code, message or _last_line(log))
    if full_disk:
        return _outcome("disk", exit_code, message or _last_line(log))
    return _outcome("bug", exit_code, message or _last_line(log) or f"ended with exit code {exit_code}")


def _killed(exit_code: int, out_of_memory: bool) -> Outcome:
    number = -exit_code if exit_code < 0 else exit_code - 128
    name = signal.Signals(number).name if number in {s.value for s in signal.Signals} else str(number)
    if out_of_memory:
        return _outcome(
            "memory", exit_code, f"the machine ran out of memory; the kernel ended the process ({name})"
        )
    return _outcome("killed", exit_code, f"the process was ended from outside, or crashed ({name})")


def _outcome(kind: Kind, exit_code: int, message: str) -> Outcome:
    cause, cure = split_cure(plain(message))
    return Outcome(kind, cause, cure or CURES[kind], exit_code)


def split_cure(message: str) -> tuple[str, str]:
    """Return (cause, cure) of a message: its first sentence, and the rest."""
    found = _SENTENCE.search(message)
    if found is None or found.start() < 12:
        return message, ""
    return message[: found.start()].rstrip(".;"), message[found.end() :].strip()


def _last_message(log: str) -> str:
    """Return the last message of the command line's errors, or ""."""
    starts = list(_MESSAGE.finditer(log))
    return log[starts[-1].end() :].strip() if starts else ""


def _last_line(log: str) -> str:
    lines = [line for line in log.splitlines() if line.strip()]
    return lines[-1] if lines else ""
