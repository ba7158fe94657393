"""Journal of a batch: one JSON object a line, only ever appended to; the state of every video is read from it.

A line is on disk before the driver goes on. A line that was cut off by a crash is skipped, and the next one starts on a
line of its own. One driver at a time holds the journal.
"""

import contextlib
import datetime
import json
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from registry.errors import EnvironmentMissing, UsageError
from registry.locks import LockHeld, file_lock

SCHEMA = "simrecon.batch/1"
NAME = "journal.jsonl"


@dataclass(frozen=True)
class VideoState:
    """What the journal says about one video."""

    scene_id: str
    video: str = ""
    fingerprint: str = ""  # of the last attempt
    result: str = ""  # of the last attempt: "" (none ended), "published", "failed", "retry", "interrupted"
    kind: str = ""
    cause: str = ""
    cure: str = ""
    revision: str = ""
    attempts: int = 0
    wall_s: float = 0.0  # of all attempts
    last_wall_s: float = 0.0
    peak_memory_mb: float = 0.0
    host: str = ""
    ended_utc: str = ""
    notes: tuple[str, ...] = ()


class Journal:
    """The file `journal.jsonl` of a batch's folder."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / NAME

    def events(self) -> list[dict[str, Any]]:
        """Return all events in order; empty if there is no journal."""
        try:
            lines = self.path.read_bytes().split(b"\n")
        except FileNotFoundError:
            return []
        found = []
        for line in lines:
            with contextlib.suppress(ValueError):
                event = json.loads(line)
                if isinstance(event, dict) and isinstance(event.get("event"), str):
                    found.append(event)
        return found

    def states(self) -> dict[str, VideoState]:
        """Return the state of each video by scene id."""
        return fold(self.events())

    def known_ids(self) -> dict[str, str]:
        """Return the scene ids that earlier runs gave to videos, by path or address."""
        return {state.video: state.scene_id for state in self.states().values() if state.video}

    @contextmanager
    def held(self) -> Iterator["Journal"]:
        """Hold the journal while the block runs a batch.

        Raises:
            UsageError: another driver holds it.
            EnvironmentMissing: the folder cannot be written.
        """
        with contextlib.ExitStack() as stack:
            try:
                stack.enter_context(file_lock(self.path.with_suffix(".lock"), blocking=False))
                self.path.open("ab").close()
            except LockHeld as error:
                raise UsageError(
                    f"{self.path.parent}: another `simrecon batch` runs there ({error.holder}); wait for it, or choose "
                    "another folder with --out"
                ) from None
            except OSError as error:
                raise EnvironmentMissing(
                    f"cannot write to {self.path.parent}: {error.strerror or error}. Choose another folder with --out"
                ) from error
            yield self

    def append(self, event: str, **values: Any) -> None:
        """Write an event, and wait until it is on the disk.

        Raises:
            EnvironmentMissing: the disk is full or not writable.
        """
        said = {"event": event, "time": utc_now(), **values}
        line = json.dumps(said, ensure_ascii=True).encode() + b"\n"
        try:
            with self.path.open("r+b") as stream:
                end = stream.seek(0, os.SEEK_END)
                if end:
                    stream.seek(end - 1)
                    line = line if stream.read(1) == b"\n" else b"\n" + line
                stream.seek(end)
                stream.write(line)
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            raise EnvironmentMissing(
                f"cannot write {self.path}: {error.strerror or error}. Free some space, then run the same batch again: "
                "it continues"
            ) from error


def fold(events: Iterable[dict[str, Any]]) -> dict[str, VideoState]:
    """Return the state of each video, by scene id, after these events."""
    states: dict[str, VideoState] = {}
    for event in events:
        scene = event.get("scene")
        if not isinstance(scene, str):
            continue
        state = states.get(scene, VideoState(scene))
        if event["event"] == "started":
            state = replace(
                state,
                video=str(event.get("video", "")),
                fingerprint=str(event.get("fingerprint", "")),
                result="",
                attempts=state.attempts + 1,
            )
        elif event["event"] == "ended":
            wall = float(event.get("wall_s", 0.0))
            known = ("fingerprint", "result", "kind", "cause", "cure", "revision", "host")
            state = replace(
                state,
                **{name: str(event.get(name, "")) for name in known},
                wall_s=state.wall_s + wall,
                last_wall_s=wall,
                peak_memory_mb=float(event.get("peak_memory_mb", 0.0)),
                ended_utc=str(event.get("time", "")),
                notes=tuple(map(str, event.get("notes", ()))),
            )
        states[scene] = state
    return states


def utc_now() -> str:
    """Return the time now as ISO 8601 in UTC, in milliseconds."""
    return datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="milliseconds")
