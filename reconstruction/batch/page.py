"""Overview page of a batch: `index.html` with a picture, figures and a link for each scene, and all failures."""

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from reconstruction.batch.display import duration
from registry.files import write_whole

PER_PAGE = 500
_SHOWN = (
    ("objects", "n_objects", "{:.0f}"),
    ("movable", "n_dynamic", "{:.0f}"),
    ("stay put", "stable_rate", "{:.0%}"),
    ("overlap mm", "spawn_penetration_mm", "{:.1f}"),
    ("floating", "floating_rate", "{:.0%}"),
    ("scale ±", "scale_uncertainty", "{:.0%}"),
)


def write_pages(out: Path, name: str, scenes: Sequence[dict[str, Any]]) -> list[Path]:
    """Write `index.html`, and `index_2.html` … where there are more than 500 scenes; return the paths.

    Args:
        out: folder of the batch, with `previews/` and `reports/`.
        name: of the batch.
        scenes: rows of `Results.tables`.
    """
    import jinja2

    source = files("reconstruction.batch").joinpath("index.html.j2").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string(source)
    published = [scene for scene in scenes if scene["state"] == "published"]
    failed = [scene for scene in scenes if scene["state"] == "failed"]
    others = [scene for scene in scenes if scene["state"] not in ("published", "failed")]
    pages = [published[start : start + PER_PAGE] for start in range(0, len(published), PER_PAGE)] or [[]]
    names = ["index.html", *(f"index_{number}.html" for number in range(2, len(pages) + 1))]
    for number, (file, shown) in enumerate(zip(names, pages, strict=True)):
        text = template.render(
            name=name,
            tiles=_tiles(scenes, published, failed, others),
            cards=[_card(out, scene) for scene in shown],
            failed=failed if number == 0 else [],
            others=others[:PER_PAGE] if number == 0 else [],
            n_others=len(others),
            pages=names if len(names) > 1 else [],
            here=file,
        )
        write_whole(out / file, text.encode("utf-8", "replace"))
    return [out / file for file in names]


def _tiles(
    scenes: Sequence, published: Sequence, failed: Sequence, others: Sequence
) -> list[tuple[str, str]]:
    seconds = [scene["time_s"] for scene in published if scene.get("time_s") is not None]
    stable = [scene["stable_rate"] for scene in published if scene.get("stable_rate") is not None]
    tiles = [("videos", f"{len(scenes)}"), ("published", f"{len(published)}"), ("failed", f"{len(failed)}")]
    if others:
        tiles.append(("not ended", f"{len(others)}"))
    if seconds:
        tiles.append(("mean time", duration(sum(seconds) / len(seconds))))
    if stable:
        tiles.append(("objects that stay put", f"{sum(stable) / len(stable):.0%}"))
    return tiles


def _card(out: Path, scene: dict[str, Any]) -> dict[str, Any]:
    """Return what is shown of a scene: its links only where the files are there."""
    scene_id = scene["scene"]
    preview, report = f"previews/{scene_id}.jpg", f"reports/{scene_id}.html"
    figures = [(label, form.format(scene[key])) for label, key, form in _SHOWN if _number(scene.get(key))]
    return {
        "scene": scene_id,
        "video": Path(scene["video"]).name,
        "preview": preview if (out / preview).is_file() else "",
        "report": report if (out / report).is_file() else "",
        "figures": figures,
        "time": duration(scene["time_s"]) if _number(scene.get("time_s")) else "",
    }


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
