"""Text of scenes for display. Labels and notes are untrusted: viser renders Markdown and HTML as they come."""

import html
import unicodedata

_MAX_CHARACTERS = 400
# Punctuation that Markdown interprets; `<`, `>`, `&` and quotes are escaped by `html.escape`.
_MARKDOWN = "\\`*_{}[]()#+-.!|~:@$^="


def bare(value: object, limit: int = _MAX_CHARACTERS) -> str:
    r"""Return one line of printable text, for elements that show text as it is (buttons, labels in the scene).

    Control, format (for example right-to-left override) and private characters are shown as `\uXXXX`; line breaks
    become spaces; text beyond `limit` characters is cut.
    """
    out = []
    for character in str(value)[: limit + 1]:
        if character in "\t\n\r":
            out.append(" ")
        elif unicodedata.category(character)[0] == "C":
            out.append(f"\\u{ord(character):04x}")
        else:
            out.append(character)
    return "".join(out) if len(out) <= limit else "".join(out[:limit]) + "…"


def plain(value: object, limit: int = _MAX_CHARACTERS) -> str:
    """Return text that HTML shows as it is: `bare`, with `<`, `>`, `&` and quotes escaped."""
    return html.escape(bare(value, limit), quote=True)


def plain_markdown(value: object, limit: int = _MAX_CHARACTERS) -> str:
    """Return text that Markdown shows as it is: `plain`, with Markdown's punctuation as character references."""
    escaped = bare(value, limit)
    return "".join(f"&#{ord(c)};" if c in _MARKDOWN or c in "<>&\"'" else c for c in escaped)
