"""Scene card: a scene.json -> Markdown with the front matter of a Hugging Face dataset card.

All texts of the scene (labels, file names, licence) are untrusted: they are shown in code spans without control
characters, so that they can become neither markup nor terminal codes.
"""

import json
import math
import re
from typing import Any

NOT_STATED = "not stated"
PRIVACY = (
    "Textures, Gaussians and pictures of this scene are photographs of a real room. They may show faces, screens, "
    "papers or other private things. Look through `instances/`, `preview.png` and the textures before you share it."
)
_MAX_LICENCE = 120
# Identifiers that Hugging Face knows; others are written as `license: other` with a name.
_LICENCES = frozenset(
    [
        "apache-2.0",
        "mit",
        "bsd-2-clause",
        "bsd-3-clause",
        "cc",
        "cc0-1.0",
        "cc-by-2.0",
        "cc-by-3.0",
        "cc-by-4.0",
        "cc-by-sa-3.0",
        "cc-by-sa-4.0",
        "cc-by-nc-3.0",
        "cc-by-nc-4.0",
        "cc-by-nc-sa-3.0",
        "cc-by-nc-sa-4.0",
        "cc-by-nd-4.0",
        "cc-by-nc-nd-4.0",
        "gpl-3.0",
        "odbl",
        "pddl",
        "odc-by",
        "cdla-permissive-1.0",
        "cdla-permissive-2.0",
        "cdla-sharing-1.0",
        "unlicense",
        "wtfpl",
    ]
)
_TAGS = ("simrecon", "robotics", "simulation", "gymnasium", "maniskill", "sapien", "real2sim", "3d")
_DATE = re.compile(r"\d{4}-\d\d-\d\d")


def scene_card(scene: dict[str, Any], revision: str) -> str:
    """Return the card of a valid scene as Markdown; equal scenes have equal cards.

    Args:
        scene: Content of scene.json.
        revision: Revision of the bundle.
    """
    scene_id, licence = scene["id"], licence_of(scene)
    lines = [
        *_front_matter(f"SimRecon/{scene_id}", licence),
        f"# SimRecon/{scene_id}",
        "",
        f"A room that was reconstructed from a video for robot simulation: {len(scene['objects'])} objects, "
        f"{_movable(scene)} of them movable, as a Gymnasium environment.",
        "",
        f"> **Private things.** {PRIVACY}",
        "",
        "| | |",
        "| --- | --- |",
        *(f"| {name} | {value} |" for name, value in _facts(scene, revision, licence)),
        "",
        "## Figures",
        "",
        "| | |",
        "| --- | --- |",
        *(f"| {name} | {value} |" for name, value in _figures(scene)),
        "",
        "## Objects",
        "",
        *(f"- {line}" for line in _object_lines(scene)),
        "",
        "## Use",
        "",
        "```python",
        "import gymnasium as gym, simrecon_envs",
        "",
        f'env = gym.make(simrecon_envs.add("{scene_id}.simrecon"))',
        "```",
        "",
    ]
    return "\n".join(lines)


def licence_of(scene: dict[str, Any]) -> str:
    """Return the licence that the scene states, without control characters; "not stated" if there is none."""
    said = _volatile(scene).get("licence")
    return check_licence(said) if isinstance(said, str) and said.strip() else NOT_STATED


def check_licence(text: str) -> str:
    """Return a licence's name as one line of printable characters, of at most 120."""
    return printable(text)[:_MAX_LICENCE].strip() or NOT_STATED


def date_of(scene: dict[str, Any]) -> str:
    """Return the day on which the scene was reconstructed, "2026-11-26"; "not recorded" in older bundles."""
    said = _volatile(scene).get("created_utc")
    match = _DATE.match(said) if isinstance(said, str) else None
    return match.group() if match else "not recorded"


def source_name(scene: dict[str, Any]) -> str:
    """Return the name of the video without folders."""
    return re.split(r"[/\\]", printable(str(scene["source"]["file"])))[-1][:120] or "unnamed"


def printable(text: str) -> str:
    """Replace all that is not printable (control characters, bidirectional marks, line ends) by single spaces."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def _code(text: Any) -> str:
    """Return untrusted text as a code span that fits into a table cell."""
    kept = printable(str(text))[:200].translate({ord("`"): "'", ord("|"): "/"})
    return f"`{kept}`" if kept else ""


def _front_matter(name: str, licence: str) -> list[str]:
    known = licence.lower().replace(" ", "-")
    lines = ["---"]
    if licence == NOT_STATED:
        lines.append("license: unknown")
    elif known in _LICENCES:
        lines.append(f"license: {known}")
    else:
        lines += ["license: other", f"license_name: {json.dumps(licence, ensure_ascii=False)}"]
    lines += [f"pretty_name: {json.dumps(name)}", "task_categories:", "- robotics", "tags:"]
    return [*lines, *(f"- {tag}" for tag in _TAGS), "---", ""]


def _facts(scene: dict[str, Any], revision: str, licence: str) -> list[tuple[str, str]]:
    source = scene["source"]
    return [
        ("revision", _code(revision)),
        (
            "video",
            f"{_code(source_name(scene))}, SHA-256 {_code(source['sha256'])} (the video is not included)",
        ),
        ("reconstructed", date_of(scene)),
        ("licence", _code(licence) if licence != NOT_STATED else f"{NOT_STATED}: ask who made it"),
    ]


def _figures(scene: dict[str, Any]) -> list[tuple[str, str]]:
    scale, physics = scene["scale"], scene["report"].get("physics", {})
    sigma = _number(scale.get("uncertainty"))
    found = [("scale", _code(scale["method"]) + ("" if sigma is None else f", 1 sigma {100 * sigma:.0f} %"))]
    for key, text, factor, unit in (
        ("stable_rate", "movable objects that stay at rest for 10 s", 100, " %"),
        ("floating_rate", "movable objects that float at the start", 100, " %"),
        ("spawn_penetration_mm", "deepest overlap at the start", 1, " mm"),
    ):
        if (value := _number(physics.get(key))) is not None:
            found.append((text, f"{factor * value:.4g}{unit}"))
    fractions = [_number(item["provenance"]["observed_fraction"]) or 0.0 for item in scene["objects"]]
    if fractions:
        found.append(
            ("surface of the objects that a frame shows", f"{100 * sum(fractions) / len(fractions):.0f} %")
        )
    found.append(("camera frames", str(len(scene["cameras"]["frames"]))))
    return found


def _object_lines(scene: dict[str, Any]) -> list[str]:
    shown = [
        f"{_code(item.get('name') or item['label'])}, {' x '.join(f'{100 * side:.0f}' for side in item['scale'])} cm"
        for item in sorted(scene["objects"], key=lambda item: item["id"])[:200]
    ]
    more = len(scene["objects"]) - len(shown)
    return [*shown, f"and {more} more"] if more else shown or ["none"]


def _movable(scene: dict[str, Any]) -> int:
    return sum(item["dynamic"] for item in scene["objects"])


def _volatile(scene: dict[str, Any]) -> dict[str, Any]:
    found = scene["report"].get("volatile")
    return found if isinstance(found, dict) else {}


def _number(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if abs(value) < 1e300 and math.isfinite(value) else None
