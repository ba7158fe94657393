"""README.md of a place: the listing of its scenes -> Markdown that the Hugging Face Hub shows as the dataset's card.

Nothing reads it back. The last push writes it, so two pushes at once may leave one that names only some scenes until
the next push.
"""

from registry.errors import BundleError
from registry.exchange.card import PRIVACY
from registry.exchange.place import Place
from registry.exchange.sharing import SharedScene, list_place

README = "README.md"
_MARK = "<!-- written by simrecon push; remove this line to keep your own text -->"
_MOST_LISTED = 500
_MAX_BYTES = 4 << 20


def write_readme(place: Place) -> bool:
    """Write the README of a place from its listing; return false if it has one of the user's own, which stays."""
    try:
        mine = _MARK in place.read(README, _MAX_BYTES).decode("utf-8", "replace")
    except FileNotFoundError:
        mine = True
    except BundleError:
        mine = False
    if mine:
        place.write(README, _text(place, list_place(place)).encode())
    return mine


def _text(place: Place, scenes: list[SharedScene]) -> str:
    if len(scenes) == 1:
        try:
            card = place.read(f"packs/{scenes[0].scene_id}/{scenes[0].revision}.md", _MAX_BYTES).decode()
        except FileNotFoundError:
            card = ""
        head, end, body = card.partition("\n---\n")
        if end:
            return f"{head}{end}\n{_MARK}\n{body}"
    rows = [
        f"| [SimRecon/{s.scene_id}](packs/{s.scene_id}/{s.revision}.md) | {s.revision} | {_day(s.pushed)} |"
        for s in scenes[:_MOST_LISTED]
    ]
    more = [f"\nand {len(scenes) - _MOST_LISTED} more."] if len(scenes) > _MOST_LISTED else []
    address = place.url if "://" in place.url else "PLACE"  # a local path is nobody else's business
    lines = [
        "---",
        "license: other",
        'license_name: "see the card of each scene"',
        'pretty_name: "SimRecon scenes"',
        "task_categories:",
        "- robotics",
        "tags:",
        *(f"- {tag}" for tag in ("simrecon", "robotics", "simulation", "gymnasium", "maniskill", "real2sim")),
        "---",
        "",
        _MARK,
        "",
        "# SimRecon scenes",
        "",
        f"{len(scenes)} rooms that were reconstructed from videos for robot simulation, as Gymnasium environments.",
        "",
        f"> **Private things.** {PRIVACY}",
        "",
        "```sh",
        f"simrecon pull {address} --list",
        f"simrecon pull {address} {scenes[0].scene_id if scenes else 'SCENE'}",
        "```",
        "",
        "| scene | revision | pushed |",
        "| --- | --- | --- |",
        *rows,
        *more,
        "",
    ]
    return "\n".join(lines)


def _day(pushed: str) -> str:
    return f"{pushed[:4]}-{pushed[4:6]}-{pushed[6:8]}"
