"""Edits of the text of an overrides file: entries are added, removed and replaced; all other text stays as it is.

Each edit is a cut or an insertion in the text. The result is parsed again: if it does not hold exactly the expected
entries (unusual styles, anchors and aliases), the file is written anew from its entries.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import yaml

from registry.errors import UsageError

_WIDTH = 1 << 20  # characters; one entry is one line
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def entries_of(text: str, name: str = "the overrides file") -> list[Any]:
    """Parse the text of an overrides file into its list of entries.

    Raises:
        UsageError: it is not YAML, or not a list; the message starts with `name`.
    """
    try:
        entries = yaml.load(text, Loader=_LOADER)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark is not None else ""
        reason = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise UsageError(
            f"{name}{where}: not valid YAML: {reason}; mend the file by hand, or undo"
        ) from error
    except (ValueError, RecursionError) as error:  # a date that does not exist, a list in itself
        raise UsageError(f"{name}: not valid YAML: {error}; mend the file by hand, or undo") from error
    if entries is None:
        return []
    if not isinstance(entries, list):
        raise UsageError(f"{name}: expected a list of entries such as `- {{id: 3, relabel: mug}}`")
    return entries


def entry_line(entry: dict, comment: str = "") -> str:
    """Return one entry as a line of YAML, `- {...}  # comment`, without the line's end."""
    plain = _flow(entry)
    words = one_line(comment)
    return f"- {plain}  # {words}" if words else f"- {plain}"


def one_line(text: str) -> str:
    """Return a text without control characters and line breaks, at most 80 characters."""
    words = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return words if len(words) <= 80 else words[:79] + "…"


def appended(text: str, entry: dict, comment: str = "") -> str:
    """Return the text of a file with one more entry at its end."""
    old = entries_of(text)
    return _first_that_holds([*old, entry], _appendings(text, entry, comment))


def removed(text: str, number: int) -> str:
    """Return the text of a file without its entry `number`, counted from 0."""
    old = entries_of(text)
    wanted = [*old[:number], *old[number + 1 :]]
    return _first_that_holds(wanted, _cuts(text, number, None))


def replaced(text: str, number: int, entry: dict, comment: str = "") -> str:
    """Return the text of a file with another entry in the place of entry `number`, counted from 0."""
    old = entries_of(text)
    wanted = [*old[:number], entry, *old[number + 1 :]]
    return _first_that_holds(wanted, _cuts(text, number, entry_line(entry, comment)))


def _flow(value: Any) -> str:
    """Return a value as YAML on one line; characters that a terminal does not print are escaped."""

    def dumped(readable: bool) -> str:
        return yaml.safe_dump(
            value, default_flow_style=True, width=_WIDTH, sort_keys=False, allow_unicode=readable
        ).rstrip("\n")

    text = dumped(True)
    return text if text.isprintable() else dumped(False)


@dataclass(frozen=True)
class _Layout:
    """Spans of the list of a file and of its items in the text, as indices of characters."""

    brackets: bool  # the list is written [...], not with dashes
    column: int  # of the list
    end: int  # behind the list
    items: list[tuple[int, int]]  # from and to; a block ends where the next one begins

    @classmethod
    def of(cls, text: str) -> "_Layout | None":
        """Parse a file; None if it has no list."""
        depth, begin, found = 0, 0, None
        for event in yaml.parse(text, Loader=yaml.SafeLoader):
            if isinstance(event, yaml.CollectionStartEvent):
                depth += 1
                if depth == 1:
                    found = cls(bool(event.flow_style), event.start_mark.column, 0, [])
                if depth == 2:
                    begin = event.start_mark.index
            elif isinstance(event, yaml.CollectionEndEvent):
                depth -= 1
                if depth == 1 and found:
                    found.items.append((begin, event.end_mark.index))
                if depth == 0 and found:
                    return replace(found, end=event.end_mark.index)
            elif isinstance(event, yaml.ScalarEvent | yaml.AliasEvent) and depth == 1 and found:
                found.items.append((event.start_mark.index, event.end_mark.index))
        return None


def _appendings(text: str, entry: dict, comment: str) -> Iterator[str]:
    """Yield the text with the entry added: to a list with a dash a line, or within brackets."""
    layout = _Layout.of(text)
    body = text if not text or text.endswith("\n") else text + "\n"
    line = entry_line(entry, comment)
    if layout is None:
        yield body + line + "\n"
        yield line + "\n"
    elif layout.brackets:
        head, tail = text[: layout.end - 1].rstrip(), text[layout.end - 1 :]
        comma = "," if layout.items and not head.endswith(",") else ""
        yield f"{head}{comma}{' ' if layout.items else ''}{_flow(entry)}{tail}"
        yield f"{head}\n{comma}{_flow(entry)}\n{tail}"  # the last entry is followed by a comment
    else:
        indent = " " * layout.column
        yield f"{body}{indent}{line}\n"
        end = layout.items[-1][1]
        end += len(text[end:].split("\n", 1)[0])  # with a comment behind it
        yield f"{text[:end].rstrip()}\n{indent}{line}\n{text[end:].lstrip()}"


def _cuts(text: str, number: int, line: str | None) -> Iterator[str]:
    """Yield the text with the lines of one entry cut out, and `line` in their place if it is given."""
    layout = _Layout.of(text)
    if layout is None or layout.brackets:
        return
    start, end = layout.items[number]
    dash = text.rfind("-", 0, start)
    begin = text.rfind("\n", 0, dash) + 1
    if text[begin:dash].strip():
        return  # it begins behind something else on its line
    lines = text[begin:end].splitlines(keepends=True)
    while len(lines) > 1 and (not lines[-1].strip() or lines[-1].lstrip().startswith("#")):
        lines.pop()  # comments before the next entry stay
    last = begin + len("".join(lines).rstrip())
    after = text.find("\n", last)
    after = len(text) if after < 0 else after + 1
    indent = " " * layout.column
    yield text[:begin] + (f"{indent}{line}\n" if line is not None else "") + text[after:]


def _first_that_holds(wanted: list[Any], candidates: Iterator[str]) -> str:
    """Return the first candidate that parses to the wanted entries; a new file of them if there is none."""
    wish = repr(wanted)
    try:
        for candidate in candidates:
            try:
                if repr(entries_of(candidate)) == wish:
                    return candidate
            except UsageError:
                continue
    except yaml.YAMLError:
        pass
    return "".join(entry_line(entry) + "\n" for entry in wanted)


def comments_of(text: str, count: int) -> list[str]:
    """Return the comment behind each of `count` entries on its own line; "" where there is none."""
    try:
        layout = _Layout.of(text)
    except yaml.YAMLError:
        layout = None
    if layout is None or layout.brackets or len(layout.items) != count:
        return [""] * count
    rests = [text[end:].split("\n", 1)[0].strip() for _, end in layout.items]
    return [rest.lstrip("# ").rstrip() if rest.startswith("#") else "" for rest in rests]
