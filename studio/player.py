"""The page that shows a scene: viser's, with a script that keeps it fluent where drawing is slow."""

from functools import lru_cache
from pathlib import Path

import viser

_VISER = Path(viser.__file__).parent / "client" / "build" / "index.html"
_FOLDER = Path(__file__).parent / "page"
_EXPORT = "export { MeshoptSimplifier };"  # the last line of a module, which has no place in a script


@lru_cache(maxsize=1)
def player_html() -> str:
    """Return viser's page with the script `page/frame_rate.js` at its head."""
    return with_frame_rate(_VISER.read_text(encoding="utf-8"))


def with_frame_rate(html: str) -> str:
    """Put the script, and the simplifier that it calls, at the head of a page of viser's."""
    simplifier = (_FOLDER / "meshopt_simplifier.js").read_text(encoding="utf-8").replace(_EXPORT, "")
    script = (_FOLDER / "frame_rate.js").read_text(encoding="utf-8")
    head = html.index("<head>") + len("<head>")
    return f"{html[:head]}<script>{simplifier}\n{script}</script>{html[head:]}"
