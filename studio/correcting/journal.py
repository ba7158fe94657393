"""The history of an overrides file beside it: the text after each act, for undo and redo, also after a killed server.

The journal is a file of JSON lines that only grows: `{"act": title, "text": ...}`, `{"by_hand": true, "text": ...}`,
`{"undo": true}`, `{"redo": true}`, and `{"written": true}` once the overrides file holds the text that the line before
it asks for. An incomplete last line, left by a killed process, is ignored: its act was not confirmed.
"""

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from registry.files import write_whole

_KEPT = 500  # states; a longer history loses its oldest ones when the file is opened
BY_HAND = "edit by hand"


@dataclass(frozen=True)
class State:
    """One state of the overrides file, and the act that led to it."""

    text: str
    title: str = ""


@dataclass
class History:
    """States of the file in order; `now` is the present one, later ones can be redone."""

    states: list[State] = field(default_factory=lambda: [State("")])
    now: int = 0
    written: bool = True  # whether the file was seen to hold the present state
    before: str = ""  # text before the last change

    @property
    def text(self) -> str:
        """The text that the file should have."""
        return self.states[self.now].text

    @property
    def undo_title(self) -> str | None:
        """The act that an undo takes back; None if there is none."""
        return self.states[self.now].title if self.now else None

    @property
    def redo_title(self) -> str | None:
        """The act that a redo brings back; None if there is none."""
        later = self.states[self.now + 1 : self.now + 2]
        return later[0].title if later else None

    def apply(self, line: dict[str, Any]) -> None:
        """Follow one line of the journal."""
        if line.get("written"):
            self.written = True
            return
        self.before, self.written = self.text, bool(line.get("by_hand"))
        if line.get("undo"):
            self.now = max(0, self.now - 1)
        elif line.get("redo"):
            self.now = min(len(self.states) - 1, self.now + 1)
        else:
            title = BY_HAND if line.get("by_hand") else str(line.get("act", ""))
            self.states[self.now + 1 :] = [State(str(line["text"]), title)]
            self.now += 1


class Journal:
    """The journal file of one overrides file. The caller holds the lock."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.history = History()
        self._read = 0  # bytes of the file that `history` holds
        self._identity: tuple[int, int] | None = None

    def refresh(self, first_text: str) -> History:
        """Read the lines that were added since, by this or another process; begin a journal if there is none.

        Args:
            first_text: the text of the overrides file, which a new journal begins with.
        """
        try:
            found = self.path.stat()
        except FileNotFoundError:
            self._restart([State(first_text)], 0)
            return self.history
        if self._identity != (found.st_dev, found.st_ino) or found.st_size < self._read:
            self.history, self._read = History([]), 0
            self._identity = (found.st_dev, found.st_ino)
        try:
            self._read_on()
        except (ValueError, KeyError, IndexError, TypeError):
            self.path.replace(self.path.with_name(self.path.name + ".damaged"))
            self.history = History([])
        if not self.history.states:
            self._restart([State(first_text)], 0)
        return self.history

    def _read_on(self) -> None:
        with self.path.open("rb") as stream:
            stream.seek(self._read)
            for raw in stream:
                if not raw.endswith(b"\n"):
                    break
                self._read += len(raw)
                self._follow(raw)

    def add(self, line: dict[str, Any]) -> None:
        """Append a line, on disk when this returns, and follow it."""
        raw = (json.dumps(line, ensure_ascii=True) + "\n").encode()
        descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            os.ftruncate(descriptor, self._read)  # without an incomplete line at the end
            os.pwrite(descriptor, raw, self._read)
            if not line.get("written"):
                os.fsync(descriptor)
        finally:
            os.close(descriptor)
        self._read += len(raw)
        self.history.apply(line)

    def compact(self) -> None:
        """Drop the oldest states of a long history."""
        history = self.history
        if len(history.states) > 2 * _KEPT:
            first = max(0, history.now - _KEPT)
            self._restart(history.states[first:], history.now - first)

    def _follow(self, raw: bytes) -> None:
        line = json.loads(raw)
        if "states" in line:
            states = [State(str(text), str(title)) for text, title in line["states"]]
            self.history = History(states, int(line["now"]))
        else:
            self.history.apply(line)

    def _restart(self, states: list[State], now: int) -> None:
        """Begin a journal of these states."""
        line = {"states": [[state.text, state.title] for state in states], "now": now}
        raw = (json.dumps(line) + "\n").encode()
        write_whole(self.path, raw)
        found = self.path.stat()
        self._identity, self._read = (found.st_dev, found.st_ino), len(raw)
        self.history = History(states, now)
