"""An overrides file as a document: acts are appended at once, and can be undone, redone and deleted.

Every change is first a line of the journal and then the new file, each written whole. The file is read before each
change, so that edits by hand, and those of another page, are taken over as acts of the same history.
"""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from registry.errors import EnvironmentMissing, UsageError
from registry.files import write_whole
from registry.locks import file_lock
from studio.correcting import yaml_text
from studio.correcting.journal import History, Journal


@dataclass(frozen=True)
class DocumentState:
    """One moment of the document."""

    text: str
    entries: list[dict]
    undo: str | None  # title of the act that an undo takes back
    redo: str | None
    error: str = ""  # one line if a part of the text is no correction; if it is not YAML `entries` is empty
    by_hand: bool = False  # whether this call took over an edit made by hand


class Document:
    """The overrides file of a scene. Several processes may hold the same one open."""

    def __init__(self, path: Path, first_text: str = "") -> None:
        """Open a file, and begin it with a text if neither it nor its journal exists.

        Raises:
            EnvironmentMissing: it cannot be read or written.
        """
        self.path = path.absolute()
        self._journal = Journal(self.path.with_name(self.path.name + ".journal"))
        with self._held():
            if not self.path.exists() and not self._journal.path.exists():
                self._write(first_text)
            self._catch_up()
            self._journal.compact()

    def state(self) -> DocumentState:
        """Return the present state, after edits by hand are taken over."""
        with self._held():
            by_hand = self._catch_up()
            return self._state(by_hand)

    def append(self, entry: dict, title: str) -> DocumentState:
        """Add an entry at the end; the title becomes a comment beside it.

        Raises:
            UsageError: the file is broken by an edit by hand, or the entry is none that a stage can apply.
        """
        check_entries([entry], title)
        return self._changed(title, lambda text: yaml_text.appended(text, entry, title))

    def replace(self, number: int, entry: dict, title: str) -> DocumentState:
        """Replace entry `number` (from 0)."""
        check_entries([entry], title)
        return self._changed(
            title, lambda text: yaml_text.replaced(text, self._known(text, number), entry, title)
        )

    def delete(self, number: int, title: str) -> DocumentState:
        """Remove entry `number` (from 0)."""
        return self._changed(title, lambda text: yaml_text.removed(text, self._known(text, number)))

    def undo(self) -> DocumentState:
        """Take back the last act; without one nothing changes."""
        return self._stepped("undo")

    def redo(self) -> DocumentState:
        """Bring back the act that was undone last; without one nothing changes."""
        return self._stepped("redo")

    def _changed(self, title: str, edit: Any) -> DocumentState:
        with self._held():
            by_hand = self._catch_up()
            yaml_text.entries_of(self._history.text, self.path.name)
            text = edit(self._history.text)
            self._make({"act": yaml_text.one_line(title), "text": text})
            return self._state(by_hand)

    def _stepped(self, step: str) -> DocumentState:
        with self._held():
            by_hand = self._catch_up()
            if getattr(self._history, f"{step}_title") is not None:
                self._make({step: True})
            return self._state(by_hand)

    def _known(self, text: str, number: int) -> int:
        count = len(yaml_text.entries_of(text, self.path.name))
        if not 0 <= number < count:
            raise UsageError(f"{self.path.name}: no entry {number + 1}; it has {count}")
        return number

    @property
    def _history(self) -> History:
        return self._journal.history

    def _catch_up(self) -> bool:
        """Follow the journal, finish a change that was cut off, take over an edit by hand; return if there was one."""
        found = self._read()
        history = self._journal.refresh(found)
        if found == history.text:
            return False
        if not history.written and found == history.before:
            self._write(history.text)  # the process ended between journal and file
            self._journal.add({"written": True})
            return False
        self._journal.add({"by_hand": True, "text": found})
        return True

    def _make(self, line: dict) -> None:
        self._journal.add(line)
        self._write(self._history.text)
        self._journal.add({"written": True})

    def _state(self, by_hand: bool) -> DocumentState:
        history = self._history
        entries, error = [], ""
        try:
            entries = yaml_text.entries_of(history.text, self.path.name)
            check_entries(entries, self.path.name)
        except UsageError as problem:
            error = " ".join(str(problem).split())
        return DocumentState(history.text, entries, history.undo_title, history.redo_title, error, by_hand)

    @contextlib.contextmanager
    def _held(self) -> Iterator[None]:
        """Keep other processes from changing the file meanwhile."""
        try:
            with file_lock(self.path.with_name(self.path.name + ".lock")):
                yield
        except OSError as error:
            raise EnvironmentMissing(f"{self.path}: {error.strerror or error}") from error

    def _read(self) -> str:
        try:
            return self.path.read_bytes().decode("utf-8", "surrogateescape")
        except FileNotFoundError:
            return ""

    def _write(self, text: str) -> None:
        write_whole(self.path, text.encode("utf-8", "surrogateescape"))


def check_entries(entries: list[Any], name: str) -> None:
    """Raise UsageError for the first entry that no stage can apply."""
    from reconstruction.editing.entries import check_entry

    for number, entry in enumerate(entries, start=1):
        check_entry(entry, name if len(entries) == 1 else f"{name}: entry {number}")
