"""The list of acts in the tab "Correct": entries of the file in words, undo, redo, and deletion of one."""

from typing import TYPE_CHECKING, Any

from studio.correcting.document import DocumentState
from studio.correcting.pending import Preview
from studio.correcting.yaml_text import comments_of, entry_line
from studio.text import bare, plain_markdown

if TYPE_CHECKING:
    from studio.correcting.tab import CorrectPart

_SHOWN = 60  # acts in the list; the file has all

_NOTHING: tuple[str, ...] = ("none",)


class ActList:
    """The folder "Acts"."""

    def __init__(self, part: "CorrectPart") -> None:
        self._part = part
        gui = part.page.server.gui
        with gui.add_folder("Acts"):
            self._file = gui.add_text("File", str(part.session.document.path), disabled=True)
            self._undo = part.button("Undo", lambda: part.show(part.session.document.undo()))
            self._redo = part.button("Redo", lambda: part.show(part.session.document.redo()))
            self._list = gui.add_markdown("No acts yet.")
            self._which = gui.add_dropdown("Act", _NOTHING, initial_value=_NOTHING[0])
            self._delete = part.button("Delete act", self._remove)

    def show(self, state: DocumentState, preview: Preview) -> None:
        """Show the entries of the file, and which of them the scene does not have yet."""
        words = words_of(state)
        first_pending = len(words) - preview.pending
        lines = []
        for number, text in list(enumerate(words, start=1))[-_SHOWN:]:
            mark = " (not applied yet)" if number > first_pending and not preview.taken_back else ""
            lines.append(f"{number}. {plain_markdown(text)}{mark}")
        if len(words) > _SHOWN:
            lines.insert(0, f"{len(words) - _SHOWN} more before these.\n")
        if preview.taken_back:
            lines.append("\nThe scene was made with other corrections; *Apply* makes it follow this list.")
        problems = filter(None, (state.error, preview.error))
        lines += [f"\n**{plain_markdown(problem, 1000)}**" for problem in problems]
        self._list.content = "\n".join(lines) or "No acts yet."
        self._undo.disabled, self._redo.disabled = state.undo is None, state.redo is None
        self._undo.hint, self._redo.hint = _hint(state.undo), _hint(state.redo)
        options = tuple(f"{number}: {bare(text, 40)}" for number, text in enumerate(words, start=1)) or (
            "none",
        )
        if tuple(self._which.options) != options:
            self._which.options = options
            self._which.value = options[-1]

    def _remove(self) -> None:
        chosen = str(self._which.value)
        if chosen != "none":
            number = int(chosen.split(":")[0])
            self._part.show(self._part.session.document.delete(number - 1, f"delete act {number}"))


def words_of(state: DocumentState) -> list[str]:
    """Return each entry in words: the comment beside it, else the entry itself."""
    comments = comments_of(state.text, len(state.entries))
    return [comment or _plain(entry) for comment, entry in zip(comments, state.entries)]


def _plain(entry: Any) -> str:
    return entry_line(entry).removeprefix("- ") if isinstance(entry, dict) else str(entry)


def _hint(title: str | None) -> str | None:
    return None if title is None else bare(title, 120)
