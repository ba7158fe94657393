# pyright: strict
"""Tell and replace characters that control a terminal, a page or a file of lines."""

import re
from typing import Any, cast

# C0 controls, DEL, C1 controls, line separators, directions of text, zero-width marks, halves of UTF-16 pairs.
_CONTROL = r"\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\u200e\u200f\ud800-\udfff\ufeff"
_IN_LINES = re.compile(f"[{_CONTROL}]")
_IN_LINE = re.compile(f"[{_CONTROL}\t\n]")
# The same characters in JSON as bytes: escapes, DEL, and the UTF-8 of what lies above ASCII.
_IN_JSON = re.compile(
    rb"\\[ubfr]|\x7f|\xc2[\x80-\x9f]|\xe2\x80[\x8e\x8f\xa8-\xae]|\xe2\x81[\xa6-\xa9]|\xef\xbb\xbf"
)


def is_plain(text: str, lines: bool = False) -> bool:
    """Return whether a text has no control character; with `lines`, newlines and tabs are allowed."""
    return (_IN_LINES if lines else _IN_LINE).search(text) is None


def plain(text: str, lines: bool = False) -> str:
    """Return a text with every control character replaced by "?"; with `lines`, newlines and tabs are kept."""
    return (_IN_LINES if lines else _IN_LINE).sub("?", text)


def may_have_controls(json_text: bytes) -> bool:
    """Return false if no string of a JSON text (UTF-8) can have a control character other than newline and tab."""
    return _IN_JSON.search(json_text) is not None


_KEEPS_LINES = frozenset(("overrides", "config", "steps", "evidence"))


def plain_strings(value: Any, lines: bool = False) -> Any:
    """Return JSON with every control character of its strings replaced; for writing what users and models said.

    Newlines are kept in overrides, options, evidence and steps of the graph, elsewhere they become spaces.
    """
    if isinstance(value, str):
        return plain(value if lines else value.replace("\n", " ").replace("\t", " "), lines)
    if isinstance(value, dict):
        items = cast("dict[Any, Any]", value).items()
        return {
            plain(key) if isinstance(key, str) else key: plain_strings(item, lines or key in _KEEPS_LINES)
            for key, item in items
        }
    if isinstance(value, list | tuple):
        return [plain_strings(item, lines) for item in cast("list[Any]", value)]
    return value
